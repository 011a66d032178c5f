"""Everything that writes a fitted file: acceptance, covariance, scene, vocabulary and adaptation."""
