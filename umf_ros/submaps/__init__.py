"""Submaps: scans of the last metres merged by odometry, for sensors whose single scans show too little of a place."""

from umf_ros.submaps.finder import SubmapFinder

__all__ = ["SubmapFinder"]
