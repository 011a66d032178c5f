"""Records, geometry, settings and files that every package uses."""
