"""From a retrieved candidate to a metric loop closure, or to the reason why not."""

from umf_ros.verification.lifting import lift, thin_scan
from umf_ros.verification.verifier import Verifier

__all__ = ["Verifier", "lift", "thin_scan"]
