"""Real DDS on this machine alone, in a domain of its own."""

from __future__ import annotations

import os
from collections.abc import Iterator

import pytest


def isolate_dds() -> None:
    os.environ["ROS_DOMAIN_ID"] = str(1 + os.getpid() % 100)
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"


isolate_dds()


@pytest.fixture
def ros_context() -> Iterator[None]:
    import rclpy

    rclpy.init()
    yield
    rclpy.try_shutdown()
