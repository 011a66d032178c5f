"""Pose graph: one trajectory from odometry and loop closures."""
