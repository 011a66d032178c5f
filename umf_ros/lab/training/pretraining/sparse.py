"""Dense convolutions that behave like sparse ones: hidden places stay empty through every layer.

A convolution sees zeros where nothing is visible, and the batch normalisation behind it counts visible
places only and puts the zeros back, as does pooling. So the statistics are those of whole images, and the mask does not
dissolve from layer to layer (Tian et al., "Designing BERT for convolutional networks", 2023).
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial

import torch.nn.functional as F
from torch import Tensor, nn

from umf_ros.lab.training.pretraining.masks import PATCH


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
