"""Folder of a run: writing, reading, judging and reporting."""
