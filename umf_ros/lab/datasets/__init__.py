"""Data sets for training and evaluation, all as one kind of sample; and graph files."""
