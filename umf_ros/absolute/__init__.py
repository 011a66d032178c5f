"""Absolute measurements of the pose graph: GNSS, gravity and elevation models, and the decisions about them."""
