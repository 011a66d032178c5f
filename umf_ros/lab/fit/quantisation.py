"""OpenVINO models of the networks, in single precision or with eight-bit convolutions (NNCF, post-training)."""

from __future__ import annotations

import hashlib
import logging
import tempfile
import zipfile
from collections.abc import Callable, Iterable, Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.nn.utils.fusion import fuse_conv_bn_eval

from umf_ros.core.frames import Frame, ScanMotion
from umf_ros.core.io import atomic_write
from umf_ros.embedding.inputs import blank_input
from umf_ros.embedding.local_features import network_size
from umf_ros.embedding.runtimes import FACTS, OUTPUTS, SUPERS, XFEAT_SHAPE, import_openvino
from umf_ros.lab.datasets.views import draw_look, read_frame
from umf_ros.lab.simulation.camera import Camera
from umf_ros.lab.simulation.survey import save, shard_plan, survey_world
from umf_ros.networks.config import XFEAT_OUTPUTS, read_config
from umf_ros.networks.umf import FlatUmf
from umf_ros.networks.weights import load_weights
from umf_ros.networks.xfeat import load_xfeat
from umf_ros.sensors.calibration import load_calibration

Precision = Literal["float32", "int8"]
WORLDS = range(300, 308)
"""Seeds of the training worlds that calibrate: one of each family."""
FRAMES = 16
"""Frames of each of them."""
NOT_QUANTISED = (
    # first layers and depth-wise convolutions: little time, and the most of the error
    r".*backbone\.stem.*",
    r".*trunk\.stem.*",
    r".*depthwise.*",
    r".*voxel_encoder\.stem\.0.*",
    r".*voxel_encoder\.down\.0\.0.*",
    r".*voxel_encoder\.stem\.1\.0/aten::(minimum|sub|add).*",
    r".*voxel_encoder\.fine.*",
    # outside of the encoders nothing gets faster in eight bits, and the norm of the descriptor would be cut off
    r".*module\.network(?!\.(image_encoder|voxel_encoder|scene\.trunk)\.).*",
)
XFEAT_NOT_QUANTISED = (r".*corners.*",)  # of the key points: a tenth of them moved by more than half a pixel
SMALL_VALUES = 4.0
"""The first features of the voxels reach 38; 99 of 100 are smaller than this, and those of all empty cells than 0.3."""


class TwoRangeConvolution(nn.Module):
    """A 3-D convolution of values from 0 on that are quantised in two ranges, as one has too coarse steps for both.

    Args:
        conv: the convolution.
        limit: upper end of the range of small values.
    """

    def __init__(self, conv: nn.Conv3d, limit: float) -> None:
        super().__init__()
        self.conv = conv
        self.limit: Tensor
        self.register_buffer("limit", torch.tensor(limit))

    def forward(self, x: Tensor) -> Tensor:
        """Return the result of the convolution."""
        small = torch.minimum(x, self.limit)
        return self.conv(small) + F.conv3d(x - small, self.conv.weight, None, self.conv.stride, self.conv.padding)


def fold_normalisation(network: nn.Module) -> None:
    """Fold each batch normalisation into the convolution before it, so that converted layers keep their names."""
    for sequence in [module for module in network.modules() if isinstance(module, nn.Sequential)]:
        for place, (layer, following) in enumerate(pairwise(list(sequence))):
            if isinstance(layer, nn.Conv2d | nn.Conv3d) and isinstance(following, nn.BatchNorm2d | nn.BatchNorm3d):
                sequence[place] = fuse_conv_bn_eval(layer, following)
                sequence[place + 1] = nn.Identity()


def rendered_frames(folder: Path, seeds: Iterable[int], report: Callable[[str], None]) -> Iterator[Frame]:
    """Yield frames of worlds with full-size images; worlds that are in the folder are not rendered again.

    Cameras and exposures vary; one image and one scan in eight are missing.

    Raises:
        OutputError: the folder cannot be written.
    """
    rig = load_calibration("simulated")
    for seed in seeds:
        path = folder / f"world_{seed:05d}.npz"
        if not path.exists():
            report(f"rendering world {seed}")
            save(path, _render(seed))
        rng = np.random.default_rng(seed)
        with np.load(path) as stored:
            images, scans = stored["images"], stored["points"]
        for number, (image, scan) in enumerate(zip(images, scans, strict=True)):
            points = scan[np.isfinite(scan[:, 0])].astype(np.float32)
            left = draw_look(rng).take(image, rng) if number % 2 else image
            yield Frame(
                stamp_ns=number,
                camera=rig.camera,
                body_T_camera=rig.body_T_camera,
                body_T_lidar=rig.body_T_lidar,
                left=None if number % 8 == 3 else left,
                points=None if number % 8 == 6 else points[:, :3],
                intensity=None if number % 8 == 6 else points[:, 3],
                motion=None if number % 8 == 6 else ScanMotion.none(len(points)),
            )


def _render(seed: int) -> dict[str, Any]:
    """Return images (N, H, W) and points (N, P, 4), x y z and intensity, NaN at the end, from all over a world."""
    survey = survey_world(seed, *shard_plan(seed))
    camera = Camera(survey.world, survey.calibration.camera)
    steps = [(index, step) for index, drive in enumerate(survey.passes) for step in range(len(drive.path))]
    images, scans = [], []
    for index, step in (steps[place] for place in np.linspace(0, len(steps) - 1, FRAMES).astype(int)):
        drive = survey.passes[index]
        world_T_camera = survey.pose(index, step) @ survey.calibration.body_T_camera
        rng = np.random.default_rng([seed, 17, index, step])
        images.append(camera.take(world_T_camera, drive.sun, rng, drive.exposure).image)
        scans.append(survey.sample(index, step).points)
    points = np.full((FRAMES, max(map(len, scans)), 4), np.nan, np.float16)
    for row, scan in zip(points, scans, strict=True):
        row[: len(scan)] = scan
    return {"images": np.stack(images), "points": points}


def export_model(
    weights: Path,
    precision: Precision,
    calibration: Path,
    report: Callable[[str], None],
    outputs: tuple[str, ...] = OUTPUTS + SUPERS,
) -> Any:
    """Return the OpenVINO model of the UMF network or of XFeat.

    Args:
        weights: safetensors file; one named `xfeat` holds XFeat.
        precision: of the convolutions.
        calibration: folder of the rendered worlds, read and filled for "int8".
        report: called with what is done.
        outputs: of the UMF network.

    Raises:
        WeightsError: the weights cannot be used.
        OutputError: the folder cannot be written.
    """
    of_xfeat = weights.stem == "xfeat"
    report(f"converting {weights.name}")
    model = _convert_xfeat(weights) if of_xfeat else _convert_umf(weights, outputs)
    if precision == "int8":
        config = None if of_xfeat else read_config(weights)
        frames = rendered_frames(calibration, WORLDS, report)
        inputs = [list(read_frame(frame, config)) if config else image_input(frame) for frame in frames]
        kept = XFEAT_NOT_QUANTISED if of_xfeat else NOT_QUANTISED
        model = quantise(model, [one for one in inputs if one], kept, report)
    model.set_rt_info(precision, [FACTS, "precision"])
    model.set_rt_info(hashlib.sha256(weights.read_bytes()).hexdigest(), [FACTS, "weights"])
    return model


def quantise(model: Any, inputs: list[list[Any]], ignored: tuple[str, ...], report: Callable[[str], None]) -> Any:
    """Return the model with eight-bit convolutions.

    Args:
        model: OpenVINO model.
        inputs: calibrate the ranges of the activations.
        ignored: patterns of the names of layers that stay in single precision.
        report: called with what is done.
    """
    import_openvino()  # first: NNCF imports it with its telemetry
    import nncf
    from nncf.quantization.advanced_parameters import AdvancedQuantizationParameters, OverflowFix
    from nncf.quantization.range_estimator import RangeEstimatorParametersSet

    logging.getLogger("nncf").setLevel(logging.ERROR)
    report(f"quantising on {len(inputs)} frames")
    # the bias correction of NNCF 3.4 costs .01 of cosine here, as most cells of a scan are empty, and ranges below the
    # largest value, NNCF's default for activations, cost recall of the LiDAR
    advanced = AdvancedQuantizationParameters(
        disable_bias_correction=True,
        overflow_fix=OverflowFix.DISABLE,
        activations_range_estimator_params=RangeEstimatorParametersSet.MINMAX,
    )
    return nncf.quantize(
        model,
        nncf.Dataset(inputs),
        preset=nncf.QuantizationPreset.MIXED,
        subset_size=len(inputs),
        ignored_scope=nncf.IgnoredScope(patterns=list(ignored), validate=False),
        advanced_parameters=advanced,
    )


def save_model(model: Any, path: Path) -> None:
    """Write a model: as a zip archive for the embedder, or for a path that ends in .xml as OpenVINO's two files.

    Raises:
        OutputError: the files cannot be written.
    """
    with tempfile.TemporaryDirectory() as folder:
        written = Path(folder) / "model.xml"
        # half precision would change what a model in single precision computes
        quantised = model.get_rt_info([FACTS, "precision"]).value == "int8"
        import_openvino().save_model(model, written, compress_to_fp16=quantised)
        files = {suffix: written.with_suffix(suffix).read_bytes() for suffix in (".xml", ".bin")}
    if path.suffix == ".xml":
        for suffix, content in files.items():
            with atomic_write(path.with_suffix(suffix)) as part:
                part.write_bytes(content)
        return
    with atomic_write(path) as part, zipfile.ZipFile(part, "w", zipfile.ZIP_DEFLATED, compresslevel=9) as archive:
        for suffix, content in files.items():
            archive.writestr(zipfile.ZipInfo(f"model{suffix}"), content, zipfile.ZIP_DEFLATED)


def convert(network: nn.Module, example: dict[str, Any], outputs: tuple[str, ...]) -> Any:
    """Return the OpenVINO model of a network, with named inputs of the shapes of the example, and named outputs."""
    import_openvino()
    from openvino.tools.ovc import convert_model

    model = convert_model(network, example_input=tuple(example.values()))
    shapes = [tuple(tensor.shape) for tensor in example.values()]
    model.reshape(dict(zip(model.inputs, shapes, strict=True)))
    for ports, names in ((model.inputs, example), (model.outputs, outputs)):
        for port, name in zip(ports, names, strict=True):
            port.get_tensor().set_names({name})
    return model


def _convert_umf(weights: Path, outputs: tuple[str, ...]) -> Any:
    flat = FlatUmf(load_weights(weights), outputs)
    fold_normalisation(flat)
    stem = flat.network.voxel_encoder.get_submodule("stem.1")
    assert isinstance(stem, nn.Sequential) and isinstance(stem[0], nn.Conv3d)
    stem[0] = TwoRangeConvolution(stem[0], SMALL_VALUES)
    return convert(flat, blank_input(read_config(weights)).tensors()._asdict(), outputs)


def _convert_xfeat(weights: Path) -> Any:
    model = convert(load_xfeat(weights), {"image": torch.zeros(XFEAT_SHAPE)}, XFEAT_OUTPUTS)
    model.reshape([1, 1, -1, -1])
    return model


def image_input(frame: Frame) -> list[Any]:
    """Return the input of XFeat; empty without an image."""
    if frame.left is None:
        return []
    size = network_size(frame.left.shape[1], frame.left.shape[0])
    return [cv2.resize(frame.left, size, interpolation=cv2.INTER_AREA).astype(np.float32)[None, None]]
