"""Points of scans: the compiled part of the package, `_kernels`, whose sources are in `kernels/`."""

from umf_ros.core.errors import UmfError

try:
    from umf_ros.scan import _kernels  # noqa: F401 - says what to do where it was not built
except ImportError as error:
    remedy = "run `make install`, `pip install .` or `colcon build` again"
    raise UmfError(f"the compiled part, umf_ros/scan/_kernels, is missing or of another Python: {remedy}") from error
