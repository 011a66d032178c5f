"""From a retrieved candidate to a metric loop closure, or to the reason why not."""

from umf_ros.verification.measurement import Measurement
from umf_ros.verification.prepared_scan import thin_frame, thin_scan
from umf_ros.verification.verifier import NO_DEPTH, Verdict, Verifier

__all__ = ["NO_DEPTH", "Measurement", "Verdict", "Verifier", "thin_frame", "thin_scan"]
