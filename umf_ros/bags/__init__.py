"""Recorded sensor data, read without a ROS environment."""
