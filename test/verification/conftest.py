from __future__ import annotations

import pytest

from umf_ros.core.config import Verification
from umf_ros.verification import Verifier


@pytest.fixture
def verifier() -> Verifier:
    return Verifier(Verification())
