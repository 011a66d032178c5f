"""Recorded sensor data, read and written without a ROS environment."""
