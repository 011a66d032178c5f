"""From a retrieved candidate to a metric loop closure, or to the reason why not."""

from umf_ros.verification.hypothesis import Hypothesis, RejectReason
from umf_ros.verification.prepared_scan import thin_frame, thin_scan
from umf_ros.verification.verifier import Verifier

__all__ = ["Hypothesis", "RejectReason", "Verifier", "thin_frame", "thin_scan"]
