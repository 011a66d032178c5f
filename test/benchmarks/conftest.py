"""Benchmarks are programs, not a package: they are found by their folders."""

from __future__ import annotations

import sys
from pathlib import Path

for folder in ("accuracy", "robustness", "scale"):
    sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks" / folder))
