"""The scenes and traps are shared with the benchmark."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))

from umf_ros.config import Verification
from umf_ros.verification import Verifier


@pytest.fixture
def verifier() -> Verifier:
    return Verifier(Verification())
