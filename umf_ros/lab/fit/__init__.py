"""Everything that writes a fitted file: acceptance, reranking, covariance, scene, vocabulary, and an adaptation."""
