"""Moved to `umf_ros.core.io`; this name goes with its last user."""

from umf_ros.core.io import FileLock

__all__ = ["FileLock"]
