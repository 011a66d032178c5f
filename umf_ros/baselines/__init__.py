"""Methods of the comparison; loaded by name, never imported by the runtime."""
