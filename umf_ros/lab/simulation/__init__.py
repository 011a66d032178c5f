"""Planetary worlds, the S3LI sensors inside them, and their recordings."""
