"""The subcommands of `umf`, one module each; heavy imports stay inside the functions."""
