"""Planetary worlds and the S3LI sensors inside them."""
