"""Submaps: what a narrow sensor saw along some metres of way, to recognise a place from any side."""

from umf_ros.submaps.finder import SubmapFinder

__all__ = ["SubmapFinder"]
