"""The UMF network and its parts: pure torch, no ROS."""
