"""MinkLoc++, as its network in `umf_ros.networks` says what it reads."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from umf_ros.lab.training.descriptors import DescriptorObjective
from umf_ros.lab.training.settings import DescriptorSettings


class MinkLocFusionSettings(DescriptorSettings):
    """What it was trained with."""

    method: Literal["minkloc_fusion"] = "minkloc_fusion"
    learning_rate: float = Field(5e-4, gt=0, description="peak of the cosine schedule")


class MinkLocFusionObjective(DescriptorObjective):
    """Nothing of its own."""

    settings_type = MinkLocFusionSettings


OBJECTIVE = MinkLocFusionObjective
