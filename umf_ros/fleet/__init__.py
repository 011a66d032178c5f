"""One memory of places for many rovers: PostgreSQL with pgvector. The rover's own store stays its truth."""
