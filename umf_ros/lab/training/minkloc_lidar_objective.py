"""MinkLoc++'s cloud branch alone, as its network in `umf_ros.networks` says what it reads."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from umf_ros.lab.training.descriptors import DescriptorObjective
from umf_ros.lab.training.settings import DescriptorSettings


class MinkLocLidarSettings(DescriptorSettings):
    """What it was trained with."""

    method: Literal["minkloc_lidar"] = "minkloc_lidar"
    learning_rate: float = Field(1e-3, gt=0, description="peak of the cosine schedule")


class MinkLocLidarObjective(DescriptorObjective):
    """Nothing of its own."""

    settings_type = MinkLocLidarSettings


OBJECTIVE = MinkLocLidarObjective
