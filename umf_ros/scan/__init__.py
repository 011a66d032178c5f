"""Points of scans: the compiled part of the package, `_kernels`, whose sources are in `kernels/`."""
