"""Subcommands of `umf` that make, play or judge; heavy imports stay inside the functions."""
