"""Multimodal place recognition and loop closure for rovers with a camera and a LiDAR."""

__version__ = "0.1.0"
