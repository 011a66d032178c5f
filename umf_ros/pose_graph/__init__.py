"""Odometry and loop closures bent into one trajectory."""
