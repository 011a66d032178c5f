"""Subcommands of `umf` for simulation, training and evaluation; heavy imports stay inside the functions."""
