"""A data set as a YAML file that lists its sequences; paths are relative to the file (docs/training.md)."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal, Protocol

from pydantic import Field, ValidationError

from umf_ros.core.config import Dataset, Group, problems
from umf_ros.core.errors import BagError, ConfigError
from umf_ros.core.io import read_yaml
from umf_ros.lab.datasets.robotcar import read_evaluation, read_training
from umf_ros.lab.datasets.s3li import ETNA_TEST, ETNA_TRAINING, read_bag, read_toolkit
from umf_ros.lab.datasets.s3li_folder import S3liSequence, find_s3li
from umf_ros.lab.datasets.sample import SampleSequence
from umf_ros.lab.datasets.simulated import WorldFolder


class ListEntry(Group):
    """Some sequences of a list."""

    @abstractmethod
    def read(self, base: Path) -> Sequence[SampleSequence]:
        """The sequences; `base` is what relative paths start from.

        Raises:
            UmfError: something is missing or damaged.
        """


class WorldsEntry(ListEntry):
    """Simulated worlds."""

    worlds: Path = Field(description="folder of shards")

    def read(self, base: Path) -> Sequence[SampleSequence]:
        """All worlds in the folder."""
        return WorldFolder(base / self.worlds).refresh()


class BagEntry(ListEntry):
    """One recording."""

    bag: Path = Field(description="mcap file, db3 folder or ROS 1 bag")
    ground_truth: Path | None = Field(None, description="RTKLIB .pos or TUM file; null: the recording's own")
    odometry: Path | None = Field(None, description="TUM file, where the recording has none")
    odometry_frame: Literal["body", "imu", "camera", "lidar"] = Field("body", description="whose poses they are")
    spacing_m: float = Field(1.0, gt=0, description="way between samples")

    def read(self, base: Path) -> Sequence[SampleSequence]:
        """The recording."""
        truth, odometry = (path and base / path for path in (self.ground_truth, self.odometry))
        found = read_bag(base / self.bag, truth, odometry, spacing_m=self.spacing_m, odometry_frame=self.odometry_frame)
        return [found]


class S3liEntry(ListEntry):
    """The recordings of Etna as they are published, wherever they lie in the folder."""

    s3li: Path = Field(description="folder of the bags, GT and Eval")
    split: Literal["training", "test"] = Field(description="part of the split of [UMF 5.1.2]")
    spacing_m: float = Field(1.0, gt=0, description="way between samples")

    def read(self, base: Path) -> Sequence[SampleSequence]:
        """Every recording of the split, with BASALT's headings."""
        wanted = ETNA_TRAINING if self.split == "training" else ETNA_TEST
        there = {one.name: one for one in find_s3li(base / self.s3li).sequences if one.recording and one.truth}
        missing = [name for name in wanted if name not in there]
        if missing:
            raise BagError(f"{base / self.s3li} lacks recording or positions of {', '.join(missing)}")
        return [self._read(there[name]) for name in wanted]

    def _read(self, one: S3liSequence) -> SampleSequence:
        assert one.recording is not None
        return read_bag(one.recording, one.truth[0], one.odometry, spacing_m=self.spacing_m, odometry_frame="imu")


class ToolkitEntry(ListEntry):
    """Pickles of the s3li-toolkit."""

    toolkit: list[Path] = Field(min_length=1, description="pickles; several are passes of one place")
    images: Path | None = Field(None, description="where the images are now")
    dataset: Dataset = Field("s3li-etna", description="whose calibration holds")

    def read(self, base: Path) -> Sequence[SampleSequence]:
        """One sequence."""
        images = self.images and base / self.images
        return [read_toolkit([base / path for path in self.toolkit], images, self.dataset)]


class RobotCarEntry(ListEntry):
    """Oxford RobotCar."""

    robotcar: Path = Field(description="folder of the pickles and submaps")
    images: Path | None = Field(None, description="folder of the images; null: laser alone")
    part: Literal["training", "database", "query"] = Field(description="which pickle")

    def read(self, base: Path) -> Sequence[SampleSequence]:
        """One sequence; every traversal is a pass."""
        root, images = base / self.robotcar, self.images and base / self.images
        return [read_training(root, images) if self.part == "training" else read_evaluation(root, images, self.part)]


KINDS: dict[str, type[ListEntry]] = {
    "worlds": WorldsEntry,
    "bag": BagEntry,
    "s3li": S3liEntry,
    "toolkit": ToolkitEntry,
    "robotcar": RobotCarEntry,
}


class TrainingData(Protocol):
    """Where training finds its sequences."""

    @property
    def worlds(self) -> Sequence[SampleSequence]:
        """Those found so far."""
        ...

    def refresh(self) -> Sequence[SampleSequence]:
        """Those there are now."""
        ...


class SequenceList:
    """All sequences that a YAML file lists, in its order.

    Raises:
        ConfigError: the file is no such list.
        UmfError: a sequence is missing or damaged.
    """

    def __init__(self, path: Path) -> None:
        self.worlds = [sequence for entry in entries_of(path) for sequence in entry.read(path.parent)]

    def refresh(self) -> list[SampleSequence]:
        """The sequences; recordings do not become more."""
        return self.worlds


def open_source(path: Path) -> TrainingData:
    """A folder of simulated worlds, or a YAML file that lists sequences.

    Raises:
        ConfigError: the file is no such list.
        UmfError: there is no folder, or a sequence is missing or damaged.
    """
    return SequenceList(path) if path.suffix in (".yaml", ".yml") else WorldFolder(path)


def entries_of(path: Path) -> list[ListEntry]:
    """Return the entries of a list of data sets; raise a `ConfigError` if it is none."""
    content = read_yaml(path)
    if not isinstance(content, list) or not content:
        raise ConfigError(f"{path}: expected a list of sequences")
    return [_entry(path, number, values) for number, values in enumerate(content, 1)]


def _entry(path: Path, number: int, values: Any) -> ListEntry:
    kinds = [kind for kind in KINDS if isinstance(values, dict) and kind in values]
    if len(kinds) != 1:
        raise ConfigError(f"{path}: entry {number} must name one of {', '.join(KINDS)}")
    try:
        return KINDS[kinds[0]].model_validate(values)
    except ValidationError as error:
        raise ConfigError(f"{path}: entry {number}: {problems(error)}") from None
