"""The folder a run leaves behind."""
