"""EfficientNet-Lite0: the published architecture, its padding, and the published weights taken over by name."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
import torch.nn.functional as F
from published import published_tensors
from torch import Tensor

from umf_ros.baselines.lite0 import EPSILON, pretrained_trunk, trunk_tensors
from umf_ros.baselines.place_network import count_parameters
from umf_ros.core.errors import WeightsError
from umf_ros.networks.efficientnet import CONTRAST, STAGES, EfficientNetLite0, SamePadding

CLASSIFIER = 320 * 1280 + 2 * 1280 + 1280 * 1000 + 1000
COLOURS = 2 * 32 * 9
PUBLISHED = 4_652_008


def plain_stages(weights: dict[str, Tensor], image: Tensor) -> list[Tensor]:
    """The published network step by step: three colours, convolution, normalisation, clipping."""

    def layer(x: Tensor, conv: str, norm: str, stride: int = 1) -> Tensor:
        kernel = weights[f"{conv}.weight"]
        side = kernel.shape[-1]
        groups = len(kernel) if conv.endswith("depthwise_conv") else 1
        total = max(side - stride, 0)
        x = F.pad(x, (total // 2, total - total // 2) * 2)
        x = F.conv2d(x, kernel, stride=stride, groups=groups)
        moments = (weights[f"{norm}.{name}"] for name in ("running_mean", "running_var", "weight", "bias"))
        return F.batch_norm(x, *moments, eps=EPSILON)

    x, number, found = layer(image.repeat(1, 3, 1, 1), "_conv_stem", "_bn0", 2).clamp(0, 6), 0, []
    for _, first, expansion, _, count in STAGES:
        for block in range(count):
            of, stride = f"_blocks.{number}.", first if block == 0 else 1
            y = layer(x, f"{of}_expand_conv", f"{of}_bn0").clamp(0, 6) if expansion > 1 else x
            y = layer(y, f"{of}_depthwise_conv", f"{of}_bn1", stride).clamp(0, 6)
            y = layer(y, f"{of}_project_conv", f"{of}_bn2")
            x, number = x + y if y.shape == x.shape and stride == 1 else y, number + 1
        found.append(x)
    return found


def test_the_trunk_has_the_published_parameters() -> None:
    """Less the classifier and two of three colours; a folded normalisation leaves one number a channel of its two."""
    folded = sum(block.numel() for name, block in EfficientNetLite0().named_parameters() if name.endswith("bias"))
    assert count_parameters(EfficientNetLite0()) == PUBLISHED - CLASSIFIER - COLOURS - folded


def test_the_trunk_does_what_the_published_network_does() -> None:
    published = published_tensors()
    trunk = EfficientNetLite0().eval()
    trunk.load_state_dict(trunk_tensors(published))
    image = torch.randn(2, 1, 64, 96, generator=torch.Generator().manual_seed(1))
    with torch.inference_mode():
        found, stages = trunk(image), plain_stages(published, image * CONTRAST)
    assert [tuple(each.shape[1:]) for each in found] == [(24, 16, 24), (40, 8, 12), (112, 4, 6), (320, 2, 3)]
    for ours, theirs in zip(found, (stages[1], stages[2], stages[4], stages[6]), strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-4, atol=1e-4 * float(theirs.abs().max()))


def test_a_shallow_trunk_is_the_beginning_of_the_whole_one(tmp_path: Path) -> None:
    torch.save(published_tensors(), tmp_path / "lite0.pth")
    whole, shallow = (pretrained_trunk(tmp_path / "lite0.pth", depth) for depth in (len(STAGES), 5))
    image = torch.randn(1, 1, 32, 64)
    with torch.inference_mode():
        torch.testing.assert_close(shallow(image)[-1], whole(image)[2])
    assert shallow.channels == [24, 40, 112]


def test_odd_padding_goes_to_the_right_and_to_the_bottom() -> None:
    layer = SamePadding(1, 1, 3, 2)
    torch.nn.init.ones_(layer.conv.weight)
    torch.nn.init.zeros_(layer.conv.bias)
    with torch.inference_mode():
        found = layer(torch.ones(1, 1, 4, 4))
    torch.testing.assert_close(found[0, 0], torch.tensor([[9.0, 6.0], [6.0, 4.0]]))


def test_weights_of_another_network_are_refused(tmp_path: Path) -> None:
    foreign = published_tensors()
    del foreign["_blocks.3._bn1.running_var"]
    with pytest.raises(WeightsError, match=r"_blocks\.3\._bn1\.running_var.* is missing"):
        trunk_tensors(foreign)
    (tmp_path / "text.pth").write_text("no weights")
    with pytest.raises(WeightsError, match="cannot read"):
        pretrained_trunk(tmp_path / "text.pth")
