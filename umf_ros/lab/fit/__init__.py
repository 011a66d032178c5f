"""Everything that writes a fitted file: acceptance, reranking, covariance, scene and vocabulary."""
