"""Place database of a fleet: PostgreSQL with pgvector beside the store of every rover."""
