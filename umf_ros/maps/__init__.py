"""Multi-session maps: recordings that share one pose graph and one frame."""
