"""Subcommands of `umf` that need the lab."""
