"""Methods of the comparison; loaded by name, never imported by the runtime."""

import numpy as np

from umf_ros.core.frames import Points
from umf_ros.core.geometry import Array


def unit_descriptor(values: Array) -> Points:
    """Return the values at unit length, and the first axis for values of length zero."""
    norm = float(np.linalg.norm(values))
    if norm < 1e-6:
        return np.eye(1, len(values), dtype=np.float32)[0]
    return (values / norm).astype(np.float32)
