"""The growing database of places seen."""
