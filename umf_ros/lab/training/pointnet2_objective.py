"""PointNet++, as its network in `umf_ros.networks` says what it reads."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from umf_ros.lab.training.descriptors import DescriptorObjective
from umf_ros.lab.training.settings import DescriptorSettings


class PointNet2Settings(DescriptorSettings):
    """What it was trained with."""

    method: Literal["pointnet2"] = "pointnet2"
    learning_rate: float = Field(1e-3, gt=0, description="peak of the cosine schedule")


class PointNet2Objective(DescriptorObjective):
    """Nothing of its own."""

    settings_type = PointNet2Settings


OBJECTIVE = PointNet2Objective
