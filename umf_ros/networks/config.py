"""Configuration and inputs of the network, and the files of its weights; torch is imported when it is needed."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, Self

from pydantic import ConfigDict, Field, ValidationError
from pydantic.dataclasses import dataclass
from safetensors import safe_open

from umf_ros.core.config import problems
from umf_ros.core.errors import WeightsError, reading, shortened
from umf_ros.core.limits import LARGEST_TEXT, check_size
from umf_ros.core.resources import find

CELLS = 40
"""Voxels along each side of the grid."""
FEATURES = 6
"""Features of a voxel (`umf_ros.embedding.inputs.VoxelScan`)."""
XFEAT_CELL = 8
"""Side, in pixels, of the cell of one descriptor of XFeat."""
XFEAT_STRIDE = 32
"""Stride of the deepest layer of XFeat, in pixels; sides of images are multiples of it."""
XFEAT_OUTPUTS = ("descriptors", "corners", "reliability")
"""Names of the outputs of XFeat."""
Size = Annotated[int, Field(ge=1, le=8192)]
Depth = Annotated[int, Field(ge=1, le=64)]
"""Limits of the sizes in a weights file: a damaged one must not fill the memory."""
Backbone = Literal["resnet18", "resnet34", "resnet50", "efficientnet_lite0"]


@dataclass(frozen=True, config=ConfigDict(strict=True, extra="forbid"))
class NetworkConfig:
    """Architecture of the network.

    Attributes:
        backbone: image encoder.
        width: channels of its first stage (64 in the published ResNet); ignored by EfficientNet-Lite0.
        image_size: height and width of the network's input, multiples of 32.
        pyramid: channels of the image feature pyramid.
        voxel_channels: channels of the voxel encoder at 20^3, 10^3 and 5^3 cells.
        voxel_blocks: residual blocks of the voxel encoder at 10^3 and at 5^3 cells.
        tokens: width of the fusion transformer.
        heads, layers, feedforward: of the fusion transformer.
        descriptor: length of the global descriptor, without the scene descriptor.
        coarse_voxels, fine_voxels: maximum number of occupied voxels for fusion and for local features.
        local: width of the two local transformer layers.
        image_local, cloud_local: lengths of the local descriptors.
        super_iterations: rounds of the iterative attention of the super-features.
        image_supers, cloud_supers: number of super-features and their length.
        scene: length of the scene descriptor (a trunk pretrained on photographs); 0 for none.
    """

    backbone: Backbone = "resnet18"
    width: Annotated[int, Field(ge=1, le=1024)] = 32
    image_size: tuple[Size, Size] = (96, 128)
    pyramid: Size = 96
    voxel_channels: tuple[Size, Size, Size] = (24, 64, 128)
    voxel_blocks: Annotated[int, Field(ge=0, le=64)] = 0
    tokens: Size = 128
    heads: Size = 4
    layers: Depth = 1
    feedforward: Size = 256
    descriptor: Size = 256
    coarse_voxels: Size = 160
    fine_voxels: Size = 512
    local: Size = 64
    image_local: Size = 64
    cloud_local: Size = 32
    super_iterations: Depth = 3
    image_supers: tuple[Size, Size] = (64, 64)
    cloud_supers: tuple[Size, Size] = (64, 32)
    scene: Annotated[int, Field(ge=0, le=8192)] = 0

    def __post_init__(self) -> None:
        if any(side % 32 for side in self.image_size):
            raise ValueError(f"image_size must be multiples of 32, not {self.image_size}")
        if self.tokens % self.heads or self.local % 4:
            raise ValueError("the width of a transformer must be a multiple of its heads")

    @property
    def length(self) -> int:
        """Length of the whole descriptor."""
        return self.descriptor + self.scene

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> NetworkConfig:
        """Return the configuration from its values as JSON holds them.

        Raises:
            WeightsError: a name or a value does not describe this architecture.
        """
        fields: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in values.items()}
        try:
            return cls(**fields)
        except ValidationError as error:
            raise WeightsError(f"weights of another architecture: {shortened(problems(error))}") from None


class NetworkInput(NamedTuple):
    """A batch of preprocessed frames, of NumPy arrays or torch tensors, in the order of an exported network's inputs.

    Attributes:
        image: (B, 1, H, W) float32, normalised.
        image_present: (B,) bool.
        grid: (B, 20, 20, 20, 48) float32 features of the voxels, folded (`umf_ros.embedding.inputs.VoxelScan`).
        coarse_index: (B, T) int64 flat indices of occupied cells of the 10^3 grid.
        coarse_mask: (B, T) bool; a row without True is a frame without a scan.
        fine_index: (B, V) int64 flat indices of occupied voxels of the 40^3 grid.
        fine_mask: (B, V) bool.
    """

    image: Any
    image_present: Any
    grid: Any
    coarse_index: Any
    coarse_mask: Any
    fine_index: Any
    fine_mask: Any

    def tensors(self) -> Self:
        """Return a batch of arrays as torch tensors, which share their memory."""
        import torch

        return type(self)(*(torch.from_numpy(array) for array in self))

    def to(self, device: Any) -> Self:
        """Return a batch of tensors on another device."""
        return type(self)(*(tensor.to(device) for tensor in self))


DEFAULT = "umf_scene"


def locate_weights(weights: Path | None) -> Path:
    """Return a weights file: as given, or the shipped one by its name or for None."""
    name = DEFAULT if weights is None else str(weights)
    return find(f"models/{name}.safetensors") if name == DEFAULT else Path(name)


def read_config(path: Path) -> NetworkConfig:
    """Return the architecture of the network of a weights file.

    Raises:
        WeightsError: missing, truncated or foreign file, or of another architecture.
    """
    with open_weights(path, "numpy") as stream:
        return NetworkConfig.from_dict(parse_architecture(path, stream))


@contextmanager
def open_weights(path: Path, framework: str) -> Iterator[Any]:
    """Open a weights file; every error while it is read becomes a `WeightsError`."""
    with reading(path, WeightsError, "is truncated or not a safetensors file"):
        if not path.is_file():
            raise WeightsError(f"weights {shortened(path)} do not exist")
        with path.open("rb") as file:
            check_size(int.from_bytes(file.read(8), "little"), "its header", LARGEST_TEXT)
        with safe_open(path, framework=framework) as stream:
            yield stream


def parse_architecture(path: Path, stream: Any) -> dict[str, Any]:
    """Return the architecture that an open weights file states.

    Raises:
        WeightsError: the file states none, or it cannot be parsed.
    """
    metadata = stream.metadata() or {}
    if "architecture" not in metadata:
        raise WeightsError(f"{path} holds weights of another architecture: it states none")
    try:
        return dict(json.loads(metadata["architecture"]))
    except (TypeError, ValueError, RecursionError):
        raise WeightsError(f"{path} holds weights of another architecture: its statement cannot be parsed") from None
