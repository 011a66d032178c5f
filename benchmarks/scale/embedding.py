"""Time of both networks in their shipped precision or on a GPU, beside single precision, and how alike both are."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from umf_ros.core.config import EmbeddingSettings
from umf_ros.core.frames import Frame
from umf_ros.core.resources import find
from umf_ros.embedding import FeatureRequest
from umf_ros.embedding.runtimes import MODEL_SUFFIX, Arrays, OpenVinoRuntime, Runtime, make_runtime, outputs_of
from umf_ros.lab.datasets.views import read_frame
from umf_ros.lab.fit.quantisation import export_model, image_input, rendered_frames, save_model
from umf_ros.lab.program import JsonFile, write_figures
from umf_ros.lab.simulation.world import VALIDATION
from umf_ros.networks.config import XFEAT_OUTPUTS, read_config

OF_DETECTOR = outputs_of(FeatureRequest(image=False))
"""Outputs of UMF that the detector asks for: its image features are those of XFeat."""


def main(
    worlds: Annotated[int, typer.Option(min=1, help="Validation worlds, 16 frames each.")] = 2,
    repeats: Annotated[int, typer.Option(min=1, help="How often each frame is embedded.")] = 3,
    frames_folder: Annotated[Path, typer.Option("--frames", help="Folder of rendered frames.")] = Path(
        "runs/calibration"
    ),
    device: Annotated[str, typer.Option(help="cuda compares a GPU in half precision with torch on the CPU.")] = "cpu",
    json_file: JsonFile = None,
) -> None:
    """Run both networks in both precisions, on one thread of a CPU; what else runs on the machine slows both alike."""
    seeds = range(VALIDATION.start, VALIDATION.start + worlds)
    frames = [frame for frame in rendered_frames(frames_folder, seeds, print) if frame.left is not None]
    frames = [frame for frame in frames if frame.points is not None]
    figures = {name: measure(name, frames, repeats, device) for name in ("umf_scene", "xfeat")}
    total = {kind: sum(found[f"{kind}_ms"] for found in figures.values()) for kind in ("float32", "shipped")}
    show(figures, total["shipped"] / total["float32"])
    ratio = total["shipped"] / total["float32"]
    write_figures(json_file, {"networks": figures, "ratio": ratio, "frames": len(frames)})


def measure(name: str, frames: Sequence[Frame], repeats: int, device: str) -> dict[str, Any]:
    """Return the figures of one network: median and 95 % of the ms in both precisions, and cosines between descriptors.

    Both precisions run each input one after the other.
    """
    weights = find(f"models/{name}.safetensors")
    umf = name != "xfeat"
    outputs = OF_DETECTOR if umf else XFEAT_OUTPUTS
    inputs = [read_frame(frame, read_config(weights)) if umf else image_input(frame) for frame in frames]
    single, shipped = pair_on_cpu(weights, outputs) if device == "cpu" else pair_with(device, weights, outputs)
    descriptor = "descriptor" if umf else "descriptors"
    cosines = [
        cosine(shipped.run(values)[descriptor], single.run(values)[descriptor]) for values in inputs
    ]  # the first run of a shape compiles
    taken: dict[str, list[float]] = {"float32": [], "shipped": []}
    for values in inputs * repeats:
        taken["float32"].append(timed(single, values))
        taken["shipped"].append(timed(shipped, values))
    found: dict[str, Any] = {"precision": shipped.precision}
    found |= {"cosine_median": float(np.median(cosines)), "cosine_least": min(cosines)}
    for kind, times in taken.items():
        found |= {f"{kind}_ms": 1e3 * float(np.median(times)), f"{kind}_p95_ms": 1e3 * float(np.quantile(times, 0.95))}
    return found | {"ratio": found["shipped_ms"] / found["float32_ms"]}


def pair_on_cpu(weights: Path, outputs: tuple[str, ...]) -> tuple[Runtime, Runtime]:
    """Return a network in single precision and as shipped, both in OpenVINO on one thread."""
    shipped = OpenVinoRuntime(weights, outputs, threads=1)
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / weights.name
        copy.write_bytes(weights.read_bytes())
        save_model(export_model(weights, "float32", Path(folder), print, outputs), copy.with_suffix(MODEL_SUFFIX))
        return OpenVinoRuntime(copy, outputs, threads=1), shipped


def pair_with(device: str, weights: Path, outputs: tuple[str, ...]) -> tuple[Runtime, Runtime]:
    """Return a network in single precision on one thread of the CPU, and on another device, both in torch."""
    settings = EmbeddingSettings(runtime="torch", threads=1)
    other = settings.model_copy(update={"device": device})
    return make_runtime(weights, settings, outputs), make_runtime(weights, other, outputs)


def timed(runtime: Runtime, values: Arrays) -> float:
    """Return the seconds of one inference."""
    started = time.perf_counter()
    runtime.run(values)
    return time.perf_counter() - started


def cosine(one: NDArray[np.float32], other: NDArray[np.float32]) -> float:
    """Return the median cosine between two descriptors (D,), or two maps of descriptors (D, H, W)."""
    product = (one * other).sum(axis=0)
    return float(np.median(product / (np.linalg.norm(one, axis=0) * np.linalg.norm(other, axis=0))))


def show(figures: dict[str, dict[str, Any]], ratio: float) -> None:
    """Print the figures."""
    table = Table("network", "precision", "float32 [ms]", "this [ms]", "95 % [ms]", "ratio", "cosine: median", "least")
    for name, found in figures.items():
        times = (f"{found[kind]:.1f}" for kind in ("float32_ms", "shipped_ms", "shipped_p95_ms"))
        cosines = (f"{found[kind]:.4f}" for kind in ("cosine_median", "cosine_least"))
        table.add_row(name, found["precision"], *times, f"{found['ratio']:.2f}", *cosines)
    table.add_row("both", "", "", "", "", f"{ratio:.2f}", "", "")
    Console().print(table)


if __name__ == "__main__":
    typer.run(main)
