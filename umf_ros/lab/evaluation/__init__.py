"""Retrieval and loop-closure metrics, plots and reports."""
