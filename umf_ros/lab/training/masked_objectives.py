"""Pretraining by masked images (SparK) and masked voxels (Voxel-MAE) [UMF 4.5.1].

A part of every sample is hidden, and an encoder learns to predict it: no labels, hence no revisits, are needed. The
weights are those of a whole network, of which one encoder (two, after starting from the other's) is trained; metric
learning starts from them.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Literal, Self

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from pydantic import Field, model_validator
from torch import Tensor, nn

from umf_ros.core.errors import ConfigError, writing
from umf_ros.core.geometry import Array
from umf_ros.embedding.inputs import CELLS, ORIGIN_M, VOXEL_M
from umf_ros.lab.datasets.sample import Sample, SampleSequence
from umf_ros.lab.datasets.views import Augmentation, View, ViewMaker
from umf_ros.lab.training.networks import RunSettings
from umf_ros.lab.training.objective import Judgement, Objective, generator
from umf_ros.networks.encoders import FEATURES
from umf_ros.networks.umf import UMF

EXAMPLES = 4
EXAMPLES_STEP = 2**31
"""No run has a step of that number: its draws are those of the examples."""
TRIES = 1000
GAP = 6
SCALE = 2

Column = tuple[str, Array]
"""A title and (B, H, W) values from 0 to 1."""


class PretrainingSettings(RunSettings):
    """Pretraining of one encoder of a network."""

    steps: int = Field(2000, ge=1, description="optimiser steps in all")
    epoch_steps: int = Field(100, ge=1, description="steps between checkpoints; new worlds are picked up there")
    weight_decay: float = Field(0.04, ge=0, description="of AdamW")
    warmup_steps: int = Field(50, ge=0, description="linear warm-up")
    clip: float = Field(5.0, gt=0, description="largest norm of the gradient")
    decoder_width: int = Field(64, ge=8, description="channels of the decoder, which is thrown away afterwards")


@dataclass(frozen=True, slots=True)
class MaskedBatch:
    """Values (B, ...) that an encoder is given, and a bool mask over them."""

    values: Tensor
    mask: Tensor

    def to(self, device: torch.device) -> Self:
        """The batch on another device."""
        return type(self)(self.values.to(device), self.mask.to(device))


class Pretraining(Objective):
    """Hides a part of one modality; a subclass says of which, and what predicts it.

    Every epoch leaves `reconstructions_<step>.png` in the run's folder.
    """

    def __init__(self, network: UMF, settings: PretrainingSettings) -> None:
        super().__init__(network, settings)
        network.requires_grad_(False)
        self._settings = settings
        self._views = ViewMaker(network.config, Augmentation(erase=0.0))  # nothing to be learned from blanks
        self._sequences: Sequence[SampleSequence] = []

    @abstractmethod
    def part(self, sample: Sample) -> Sample | None:
        """The modality of a sample that is used, or None when the sample lacks it."""

    @abstractmethod
    def masked(self, views: Sequence[View], rng: np.random.Generator) -> MaskedBatch:
        """A batch with freshly drawn masks."""

    @abstractmethod
    def draw(self, batch: MaskedBatch) -> list[Column]:
        """The input, the visible part of it, and the prediction."""

    def batch_maker(self, sequences: Sequence[SampleSequence], rank: int) -> Callable[[int], MaskedBatch]:
        """Return the function that makes the batch of a step, from samples of all sequences."""
        self._sequences = sequences
        return lambda step: self._batch(self._settings.batch, generator(self._settings.seed, step, rank))

    def judge(self, step: int, folder: Path) -> Judgement:
        """Draw the same examples under the same masks every time, so that progress can be seen.

        Raises:
            OutputError: the picture cannot be written.
        """
        device = next(self.parameters()).device
        batch = self._batch(EXAMPLES, generator(self._settings.seed, EXAMPLES_STEP))
        self.eval()
        with torch.inference_mode():
            _save(folder / f"reconstructions_{step:06d}.png", self.draw(batch.to(device)))
        return Judgement()

    def _batch(self, count: int, rng: np.random.Generator) -> MaskedBatch:
        ends = np.cumsum([len(sequence) for sequence in self._sequences])
        views: list[View] = []
        for _ in range(TRIES * count):
            row = int(rng.integers(ends[-1]))
            which = int(np.searchsorted(ends, row, side="right"))
            part = self.part(self._sequences[which].sample(row - int(ends[which])))
            if part is not None:
                views.append(self._views.varied(part, rng, mirror=rng.random() < 0.5))
            if len(views) == count:
                return self.masked(views, rng)
        raise ConfigError(f"train: next to no sample has what {self._settings.method} needs")


def _save(path: Path, columns: Sequence[Column]) -> None:
    """Columns of pictures side by side, one row per example [UMF figures 4.6, 4.8]."""
    drawn = [_column(name, np.clip(values * 255, 0, 255).astype(np.uint8)) for name, values in columns]
    encoded, content = cv2.imencode(".png", np.concatenate(drawn, axis=1))
    with writing(path):
        if encoded:
            path.write_bytes(content.tobytes())


def _column(name: str, images: NDArray[np.uint8]) -> NDArray[np.uint8]:
    height, width = images.shape[1:]
    title = np.full((26, width * SCALE + GAP), 255, np.uint8)
    cv2.putText(title, name, (4, 18), cv2.FONT_HERSHEY_SIMPLEX, 0.5, 0, 1, cv2.LINE_AA)
    rows = [title]
    for image in images:
        large = cv2.resize(image, (width * SCALE, height * SCALE), interpolation=cv2.INTER_NEAREST)
        rows.append(np.pad(large, ((0, GAP), (0, GAP)), constant_values=255))
    return np.concatenate(rows, axis=0)


PATCH = 32
"""Pixels per side of a patch: one cell of the encoder's coarsest map."""
NOISE = 0.01
"""Variance, in images of unit variance, that is not worth painting: a black sky would be amplified to snow."""


class MaskedImagesSettings(PretrainingSettings):
    """Pretraining of the image encoder."""

    weights_suffix = "_image"

    method: Literal["masked_images"] = "masked_images"
    mask_ratio: float = Field(0.6, gt=0, lt=1, description="share of the image's patches that is hidden")


class MaskedImagesObjective(Pretraining):
    """The image encoder under a decoder that paints the hidden patches; their squared error, each normalised."""

    settings_type = MaskedImagesSettings

    def __init__(self, network: UMF, settings: MaskedImagesSettings) -> None:
        super().__init__(network, settings)
        self._size, self._ratio = network.config.image_size, settings.mask_ratio
        backbone = network.image_encoder.backbone.requires_grad_(True)
        self.decoder = PaintingDecoder(backbone.channels, settings.decoder_width)

    def part(self, sample: Sample) -> Sample | None:
        """The image alone."""
        return None if sample.image is None else replace(sample, points=None, intensity=None)

    def masked(self, views: Sequence[View], rng: np.random.Generator) -> MaskedBatch:
        """Images (B, 1, H, W), and which of their patches (B, 1, H/32, W/32) are visible."""
        image = torch.from_numpy(np.stack([view.image for view in views]))[:, None]
        return MaskedBatch(image, visible_patches(len(views), self._size, self._ratio, rng))

    def forward(self, batch: MaskedBatch) -> dict[str, Tensor]:
        """The loss of the hidden patches."""
        predicted, wanted = patches(self.paint(batch)), normalised(patches(batch.values.float()))
        error = (predicted - wanted).square().mean(dim=2)
        hidden = ~batch.mask.flatten(1)
        return {"total": (error * hidden).sum() / hidden.sum().clamp(min=1)}

    def paint(self, batch: MaskedBatch) -> Tensor:
        """The painting (B, 1, H, W), each patch with zero mean and unit variance."""
        backbone = self.network.image_encoder.backbone
        with sparse(backbone, batch.mask):
            maps = backbone(hide(batch.values, batch.mask))
        painting: Tensor = self.decoder(maps, batch.mask)
        return painting.float()

    def draw(self, batch: MaskedBatch) -> list[Column]:
        """Image, visible patches, painted image, and the normalised patches wanted and painted."""
        image, visible = batch.values, batch.mask
        painting = self.paint(batch)
        wanted = unpatch(normalised(patches(image)), self._size)
        low = image.amin(dim=(2, 3), keepdim=True)
        shown = {
            "image": image,
            "visible": hide(image - low, visible) + low,
            "painted": repainted(image, painting, visible),
            "patches, normalised": wanted,
            "patches, painted": torch.where(hide(torch.ones_like(image), visible) > 0, wanted, painting),
        }
        columns = {name: values[:, 0].float().cpu().numpy() for name, values in shown.items()}
        darkest, brightest = (
            np.quantile(columns["image"], q, axis=(1, 2))[:, None, None] for q in (0.01, 0.99)
        )  # every row has its own scale
        span = np.maximum(brightest - darkest, 1e-6)
        return [(name, (values - darkest) / span) for name, values in columns.items()]


class PaintingDecoder(nn.Module):
    """U-shaped decoder from the maps of a backbone's stages to an image.

    Args:
        channels: of the four stages at strides 4, 8, 16 and 32.
        width: channels of the decoder at stride 32, halved with every doubling of resolution, 16 at least.
    """

    def __init__(self, channels: Sequence[int], width: int) -> None:
        super().__init__()
        widths = [max(width >> level, 16) for level in range(6)]
        deepest_first = list(reversed(channels))
        # what stands in for a hidden place, for every scale
        self.mask_tokens = nn.ParameterList(nn.Parameter(torch.randn(count) * 0.02) for count in deepest_first)
        self.projections = nn.ModuleList(
            nn.Conv2d(count, wide, 1 if level == 0 else 3, padding=0 if level == 0 else 1)
            for level, (count, wide) in enumerate(zip(deepest_first, widths[:4], strict=True))
        )
        self.blocks = nn.ModuleList(_double(*widths[level : level + 2]) for level in range(5))
        self.head = nn.Conv2d(widths[5], 1, 1)

    def forward(self, maps: Sequence[Tensor], visible: Tensor) -> Tensor:
        """Maps, finest first, and visible patches (B, 1, H/32, W/32) to an image (B, 1, H, W)."""
        x = maps[0].new_zeros(())
        for level, found in enumerate(reversed(maps)):
            filled = torch.where(spread(visible, found.shape[2]), found, self.mask_tokens[level].view(1, -1, 1, 1))
            x = self.blocks[level](x + self.projections[level](filled))
        return self.head(self.blocks[4](x))


def _double(inputs: int, outputs: int) -> nn.Sequential:
    """Twice the resolution."""
    return nn.Sequential(
        nn.Upsample(scale_factor=2, mode="bilinear", align_corners=False),
        nn.Conv2d(inputs, outputs, 3, padding=1, bias=False),
        nn.BatchNorm2d(outputs),
        nn.ReLU(),
    )


def patches(image: Tensor) -> Tensor:
    """(B, patches, pixels) of images (B, 1, H, W), row by row."""
    return F.unfold(image, PATCH, stride=PATCH).transpose(1, 2)


def unpatch(flat: Tensor, size: tuple[int, int]) -> Tensor:
    """Inverse of `patches`."""
    return F.fold(flat.transpose(1, 2), size, PATCH, stride=PATCH)


def normalised(flat: Tensor) -> Tensor:
    """Each patch with zero mean and unit variance, or less where there is nothing but noise."""
    return (flat - flat.mean(dim=2, keepdim=True)) / _contrast(flat)


def _contrast(flat: Tensor) -> Tensor:
    return (flat.var(dim=2, keepdim=True) + NOISE).sqrt()


def repainted(image: Tensor, painting: Tensor, visible: Tensor) -> Tensor:
    """The image with its hidden patches painted, in the brightness and contrast they had."""
    flat = patches(image.float())
    painted = patches(painting) * _contrast(flat) + flat.mean(dim=2, keepdim=True)
    size = (image.shape[2], image.shape[3])
    return unpatch(torch.where(visible.flatten(1)[..., None], flat, painted), size)


def visible_patches(batch: int, image_size: tuple[int, int], ratio: float, rng: np.random.Generator) -> Tensor:
    """(B, 1, H/32, W/32) bool, False for the `ratio` of the patches of every image that is hidden."""
    rows, columns = image_size[0] // PATCH, image_size[1] // PATCH
    kept = max(round(rows * columns * (1 - ratio)), 1)
    rank = rng.random((batch, rows * columns)).argsort(axis=1).argsort(axis=1)
    return torch.from_numpy(rank < kept).view(batch, 1, rows, columns)


@contextmanager
def sparse(encoder: nn.Module, visible: Tensor) -> Iterator[None]:
    """Let the encoder see only the visible patches inside the block.

    Args:
        encoder: every convolution of it is followed by a batch normalisation.
        visible: (B, 1, H/32, W/32) bool.
    """
    emulated: list[nn.Module] = []
    for layer in encoder.modules():
        # an attribute of the instance hides the method of the class
        if isinstance(layer, nn.BatchNorm2d):
            layer.forward = partial(_normalise_visible, layer, visible)  # type: ignore[method-assign]
        elif isinstance(layer, nn.MaxPool2d):
            layer.forward = partial(_pool_visible, layer, visible)  # type: ignore[method-assign]
        else:
            continue
        emulated.append(layer)
    try:
        yield
    finally:
        for layer in emulated:
            del layer.forward


def spread(visible: Tensor, height: int) -> Tensor:
    """The patches' visibility at the resolution of a map with `height` rows."""
    factor = height // visible.shape[2]
    return visible.repeat_interleave(factor, 2).repeat_interleave(factor, 3)


def hide(image: Tensor, visible: Tensor) -> Tensor:
    """Images (B, 1, H, W) with zeros in the hidden patches."""
    return image * F.interpolate(visible.to(image.dtype), scale_factor=float(PATCH))


def _normalise_visible(layer: nn.BatchNorm2d, visible: Tensor, x: Tensor) -> Tensor:
    where = spread(visible, x.shape[2])[:, 0]
    rows = x.permute(0, 2, 3, 1)
    seen = F.batch_norm(
        rows[where],
        layer.running_mean,
        layer.running_var,
        layer.weight,
        layer.bias,
        layer.training,
        layer.momentum or 0.1,
        layer.eps,
    )
    return rows.new_zeros(rows.shape, dtype=seen.dtype).masked_scatter(where[..., None], seen).permute(0, 3, 1, 2)


def _pool_visible(layer: nn.MaxPool2d, visible: Tensor, x: Tensor) -> Tensor:
    pooled = F.max_pool2d(x, layer.kernel_size, layer.stride, layer.padding)
    return pooled * spread(visible, pooled.shape[2])


RARE = -4.0
"""Log-odds of a voxel being occupied before anything is learned: one in fifty."""
RINGS_M = (15.0, 30.0)
HALF = CELLS // 2


class MaskedScansSettings(PretrainingSettings):
    """Pretraining of the voxel encoder."""

    weights_suffix = "_lidar"

    method: Literal["masked_scans"] = "masked_scans"
    ring_ratios: tuple[float, float, float] = Field(
        (0.7, 0.6, 0.5), description="share of the occupied voxels that is hidden nearer than 15 m, 30 m, and beyond"
    )

    @model_validator(mode="after")
    def _rings_decrease(self) -> Self:
        near, middle, far = self.ring_ratios
        if not 1 > near >= middle >= far > 0:
            raise ValueError("ring_ratios must not grow with distance and lie between 0 and 1")
        return self


class MaskedScansObjective(Pretraining):
    """The voxel encoder under a light decoder that says which voxels are occupied, the hidden ones among them."""

    settings_type = MaskedScansSettings

    def __init__(self, network: UMF, settings: MaskedScansSettings) -> None:
        super().__init__(network, settings)
        encoder = network.voxel_encoder
        for layer in (encoder.stem, encoder.down, encoder.bottom):
            layer.requires_grad_(True)
        self.decoder = OccupancyDecoder(network.config.voxel_channels, settings.decoder_width)
        self._ratios = settings.ring_ratios

    def part(self, sample: Sample) -> Sample | None:
        """The scan alone."""
        return None if sample.points is None else replace(sample, image=None)

    def masked(self, views: Sequence[View], rng: np.random.Generator) -> MaskedBatch:
        """Grids (B, 20, 20, 20, 48), and which of their voxels (B, 20, 20, 20, 8) are hidden; both folded."""
        grid = torch.from_numpy(np.stack([view.scan.grid for view in views]))
        return MaskedBatch(grid, hidden_voxels(occupancy(grid), self._ratios, rng))

    def forward(self, batch: MaskedBatch) -> dict[str, Tensor]:
        """Binary cross-entropy of the occupancy."""
        wanted = occupancy(batch.values).float()
        return {"total": F.binary_cross_entropy_with_logits(self.predict(batch), wanted)}

    def predict(self, batch: MaskedBatch) -> Tensor:
        """Logits (B, 20, 20, 20, 8) of the occupancy of the whole grid, from the voxels that are not hidden."""
        encoder = self.network.voxel_encoder
        features = batch.values.unflatten(-1, (FEATURES, 8))
        grid = (features * ~batch.mask[..., None, :]).flatten(-2)
        fine = encoder.stem(grid.permute(0, 4, 1, 2, 3))
        middle = encoder.down(fine)
        logits: Tensor = self.decoder(fine, middle, encoder.bottom(middle))
        return logits.float()

    def draw(self, batch: MaskedBatch) -> list[Column]:
        """Occupancy, what of it is visible, and what is predicted, from above.

        The brighter, the higher the ground lies; the darker, the less sure it is.
        """
        occupied = occupancy(batch.values)
        shown = {"scan": occupied, "visible": occupied & ~batch.mask, "predicted": self.predict(batch).sigmoid()}
        return [(name, _from_above(unfold(values.float()).cpu().numpy())) for name, values in shown.items()]


class OccupancyDecoder(nn.Module):
    """From the encoder's maps at 20^3, 10^3 and 5^3 cells to the occupancy of voxels.

    Args:
        channels: of the maps.
        width: channels of the decoder.
    """

    def __init__(self, channels: tuple[int, int, int], width: int) -> None:
        super().__init__()
        fine, middle, deep = channels
        self.deep, self.middle, self.fine = (nn.Conv3d(count, width, 1) for count in (deep, middle, fine))
        self.mix_middle, self.mix_fine = _mix(width), _mix(width)
        self.head = nn.Conv3d(width, 8, 1)  # the eight children of a cell of the 20^3 grid
        nn.init.constant_(self.head.get_parameter("bias"), RARE)

    def forward(self, fine: Tensor, middle: Tensor, deep: Tensor) -> Tensor:
        """Maps (B, C, X, Y, Z) to logits (B, 20, 20, 20, 8), folded."""
        x = self.mix_middle(_double_cells(self.deep(deep)) + self.middle(middle))
        x = self.head(self.mix_fine(_double_cells(x) + self.fine(fine)))
        return x.permute(0, 2, 3, 4, 1)


def occupancy(grid: Tensor) -> Tensor:
    """(B, 20, 20, 20, 8) bool of a folded grid (B, 20, 20, 20, 48)."""
    return grid[..., :8] > 0


def _mix(width: int) -> nn.Sequential:
    return nn.Sequential(nn.Conv3d(width, width, 3, padding=1, bias=False), nn.BatchNorm3d(width), nn.ReLU())


def _double_cells(cells: Tensor) -> Tensor:
    return F.interpolate(cells, scale_factor=2.0, mode="nearest")


def voxel_ranges() -> Array:
    """(20, 20, 20, 8) horizontal distance of every voxel's centre from the body, m; folded as in `VoxelScan`."""
    x, y = (ORIGIN_M[axis] + (np.arange(CELLS) + 0.5) * VOXEL_M[axis] for axis in (0, 1))
    ranges = np.broadcast_to(np.hypot(x[:, None], y[None])[..., None], (CELLS, CELLS, CELLS))
    folded = ranges.reshape(HALF, 2, HALF, 2, HALF, 2).transpose(0, 2, 4, 1, 3, 5)
    return folded.reshape(HALF, HALF, HALF, 8)


def hidden_voxels(occupied: Tensor, ratios: tuple[float, float, float], rng: np.random.Generator) -> Tensor:
    """Hide occupied voxels, fewer of them in the sparse distance (range-aware masking of Voxel-MAE).

    Args:
        occupied: (B, 20, 20, 20, 8) bool, folded.
        ratios: shares hidden nearer than 15 m, nearer than 30 m, and beyond.
        rng: draws them.

    Returns:
        (B, 20, 20, 20, 8) bool.
    """
    ring = torch.from_numpy(np.digitize(voxel_ranges(), RINGS_M)).flatten()
    hidden = torch.zeros(len(occupied), ring.numel(), dtype=torch.bool)
    for row, there in zip(hidden, occupied.flatten(1), strict=True):
        for number, ratio in enumerate(ratios):
            members = torch.nonzero(there & (ring == number)).squeeze(1).numpy()
            row[rng.permutation(members)[: round(ratio * len(members))]] = True
    return hidden.view(occupied.shape)


def unfold(cells: Tensor) -> Tensor:
    """Depth to space: (B, 20, 20, 20, 8) to (B, 40, 40, 40)."""
    children = cells.unflatten(-1, (2, 2, 2)).permute(0, 1, 4, 2, 5, 3, 6)
    return children.reshape(len(cells), CELLS, CELLS, CELLS)


def _from_above(grid: Array) -> Array:
    """(B, X, Y, Z) chances of being occupied as (B, H, W) pictures, ahead up."""
    levels = np.linspace(0.25, 1.0, grid.shape[3])
    seen = (grid * levels).max(axis=3)[:, ::-1, ::-1]
    return seen.repeat(3, axis=1).repeat(3, axis=2)
