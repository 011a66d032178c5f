"""Speed, exactness and difficulty of the simulated worlds."""

from __future__ import annotations

import resource
import time
from concurrent.futures import ThreadPoolExecutor
from typing import Annotated, Any

import cv2
import numpy as np
import typer
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from umf_ros.core.frames import Image, StereoCamera
from umf_ros.core.geometry import Array, heading, invert, relative, transform, wrap_angle
from umf_ros.lab.program import JsonFile, write_figures
from umf_ros.lab.simulation.camera import Rendering
from umf_ros.lab.simulation.families import FAMILIES
from umf_ros.lab.simulation.lidar import PERIOD_NS, Lidar
from umf_ros.lab.simulation.presets import DEMO, ETNA, etna_surveys
from umf_ros.lab.simulation.route import SETTINGS, plan_passes
from umf_ros.lab.simulation.simulator import Simulator
from umf_ros.lab.simulation.survey import Survey
from umf_ros.lab.simulation.world import TEST, World, ground

WORLDS = 4
NEAR_M, NEAR_DEG = 12.0, 30.0


def main(
    quick: Annotated[bool, typer.Option("--quick", help="A smaller sample, in under three minutes.")] = False,
    seed: Annotated[int, typer.Option(help="First of the worlds.")] = TEST.start,
    json_file: JsonFile = None,
) -> None:
    """Measure the simulator on worlds from `seed` on."""
    console = Console()
    started = time.perf_counter()
    simulator = Simulator(DEMO, seed)
    build_s = time.perf_counter() - started
    figures: dict[str, Any] = {"fullres_frame_ms": fullres_ms(simulator, 8 if quick else 30)}
    figures |= {"training_frame_ms": 0.0, "world_build_s": build_s, "peak_rss_mb": 0.0, "shards_minutes": 0.0}
    figures |= exactness(simulator, 3 if quick else 10)
    del simulator
    worlds = [hard_world(seed + number, step_m=2.4 if quick else 1.2) for number in range(WORLDS)]
    figures["training_frame_ms"] = float(np.median([world["frame_ms"] for world in worlds]))
    figures["peak_rss_mb"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    figures["shards_minutes"] = shards_minutes(seed, None if not quick else (figures["training_frame_ms"], build_s))
    for name in ("thumbnail", "orb"):
        figures[f"{name}_recall1_hard"] = float(np.mean([world[name] for world in worlds]))
    show(console, figures, worlds)
    write_figures(json_file, figures)


def fullres_ms(simulator: Simulator, count: int) -> float:
    """Median time of both 688x512 images and the scan on two threads."""
    times = []
    with ThreadPoolExecutor(2) as pool:
        for number in np.linspace(0, len(simulator.scan_stamps_ns) - 1, count).astype(int):
            started = time.perf_counter()
            left = pool.submit(simulator.picture, simulator.exposures[number])
            right = pool.submit(simulator.picture, simulator.exposures[number], True)
            simulator.scan(int(number))
            left.result(), right.result()
            times.append((time.perf_counter() - started) * 1e3)
    return float(np.median(times))


def exactness(simulator: Simulator, count: int) -> dict[str, float]:
    """Median errors of LiDAR points against the rendered depth, and of tracked corners against the disparity."""
    metres, pixels, disparities = [], [], []
    for number in np.linspace(1, len(simulator.scan_stamps_ns) - 2, count).astype(int):
        left = simulator.picture(simulator.exposures[number])
        right = simulator.picture(simulator.exposures[number], right=True)
        error_m, error_px = reprojection(simulator, int(number), left)
        metres.append(error_m)
        pixels.append(error_px)
        disparities.append(disparity_error(simulator.calibration.camera, left, right))
    return {
        "reprojection_cm": 100 * float(np.median(np.concatenate(metres))),
        "reprojection_px": float(np.median(np.concatenate(pixels))),
        "disparity_error_px": float(np.median(np.concatenate(disparities))),
    }


def reprojection(simulator: Simulator, number: int, picture: Rendering) -> tuple[Array, Array]:
    """Errors of one scan in depth (m), and in the image: how far the nearest rendered surface lies (px)."""
    calibration, stamp = simulator.calibration, int(simulator.scan_stamps_ns[number])
    camera = calibration.camera
    start, end = (simulator.pose(stamp + after) @ calibration.body_T_lidar for after in (0, PERIOD_NS))
    scan = simulator.scan(number)
    points = Lidar(simulator.world).motion_free(scan, relative(start, end))[scan.intensity > 0].astype(float)
    world_T_camera = simulator.pose(simulator.exposures[number].stamp_ns) @ calibration.body_T_camera
    seen = transform(invert(world_T_camera) @ start, points)
    seen = seen[seen[:, 2] > 0.5]
    uv = seen[:, :2] / seen[:, 2:] * camera.fx + [camera.cx, camera.cy]
    inside = ((uv > 4) & (uv < np.array([camera.width, camera.height]) - 5)).all(axis=1)
    uv, seen = uv[inside], seen[inside]
    column, row = np.round(uv).astype(int).T
    return np.abs(seen[:, 2] - picture.depth[row, column]), _nearest_pixel(camera, picture.depth, uv, seen)


def _nearest_pixel(camera: StereoCamera, depth: Array, uv: Array, seen: Array) -> Array:
    """Distance on the image from each point to the pixel whose surface is nearest to it in space."""
    centre = np.round(uv).astype(int)
    best, least = np.zeros(len(uv)), np.full(len(uv), np.inf)
    for across in range(-3, 4):
        for along in range(-3, 4):
            column, row = (centre + np.array([across, along])).T
            ray = np.stack([(column - camera.cx) / camera.fx, (row - camera.cy) / camera.fy, np.ones(len(uv))], 1)
            away = np.linalg.norm(ray * depth[row, column][:, None] - seen, axis=1)
            on_image = np.linalg.norm(np.stack([column, row], 1) - uv, axis=1)
            best, least = np.where(away < least, on_image, best), np.minimum(away, least)
    return best


def disparity_error(camera: StereoCamera, left: Rendering, right: Rendering) -> Array:
    """(N,) px between the tracked and the true disparity of corners."""
    sky = (left.depth > 0).astype(np.uint8)
    corners = cv2.goodFeaturesToTrack(left.image, 800, 0.01, 8, mask=sky)
    nowhere = np.empty_like(corners)
    tracked, found, _ = cv2.calcOpticalFlowPyrLK(
        left.image, right.image, corners, nowhere, winSize=(13, 13), maxLevel=4
    )
    column, row = np.round(corners[:, 0]).astype(int).T
    expected = camera.fx * camera.baseline / left.depth[row, column]
    return np.abs((corners - tracked)[:, 0, 0] - expected)[found[:, 0] == 1]


def hard_world(seed: int, step_m: float) -> dict[str, Any]:
    """Recall@1 of two simple methods on a revisit in the hard setting, and the time per training frame."""
    family, setting = FAMILIES[seed % len(FAMILIES)], SETTINGS["hard"]
    relief = ground(seed, family, setting.aliasing)
    passes = plan_passes(relief.trail, ("first", "offset"), setting, step_m, seed)
    world = World(seed, family, setting.aliasing, np.concatenate([drive.path for drive in passes]), relief)
    survey = Survey(world, passes, DEMO.layout.load())
    started = time.perf_counter()
    samples = list(survey.samples())
    frame_ms = (time.perf_counter() - started) / len(samples) * 1e3
    poses = np.stack([sample.world_T_body for sample in samples])
    images = [sample.image for sample in samples]
    first = np.array([sample.pass_index == 0 for sample in samples])
    return {
        "name": f"{family} {seed}",
        "frame_ms": frame_ms,
        "thumbnail": recall_at_1(thumbnails(images), poses, first),
        "orb": recall_at_1(orb_words(images, first), poses, first),
    }


def recall_at_1(descriptors: Array, poses: Array, first: NDArray[np.bool_]) -> float:
    """Share of revisits whose most similar frame of the first pass is the same place, where there is one."""
    similarity = descriptors[~first] @ descriptors[first].T
    places, turns = poses[:, :2, 3], heading(poses)
    away = np.linalg.norm(places[~first][:, None] - places[first][None], axis=2)
    turned = np.abs(np.degrees(wrap_angle(turns[~first][:, None] - turns[first][None])))
    same = (away <= NEAR_M) & (turned <= NEAR_DEG)
    asked = same.any(axis=1)
    return float(same[np.arange(len(same)), similarity.argmax(axis=1)][asked].mean())


def thumbnails(images: list[Image]) -> Array:
    """(N, 768) images of 32 x 24 pixels without mean and of unit length."""
    small = np.stack([cv2.resize(image, (32, 24), interpolation=cv2.INTER_AREA).ravel() for image in images])
    flat = small.astype(float) - small.mean(axis=1, keepdims=True)
    return flat / np.linalg.norm(flat, axis=1, keepdims=True)


def orb_words(images: list[Image], known: NDArray[np.bool_], words: int = 500) -> Array:
    """(N, words) tf-idf histograms of ORB features; the vocabulary comes from the `known` images."""
    orb = cv2.ORB.create(500)
    nowhere = np.empty(0, np.uint8)
    found = [orb.detectAndCompute(image, nowhere)[1] for image in images]
    bits = [
        np.zeros((0, 256), np.float32)
        if f is None
        else np.unpackbits(np.asarray(f, np.uint8), axis=1).astype(np.float32)
        for f in found
    ]
    vocabulary = _clusters(np.concatenate([b for b, take in zip(bits, known, strict=True) if take]), words)
    counts = np.stack([_histogram(b, vocabulary) for b in bits])
    inverse = np.log(len(images) / np.maximum((counts > 0).sum(axis=0), 1))
    weighted = counts / np.maximum(counts.sum(axis=1, keepdims=True), 1) * inverse
    return weighted / np.maximum(np.linalg.norm(weighted, axis=1, keepdims=True), 1e-9)


def _clusters(features: Array, words: int) -> Array:
    rng = np.random.default_rng(0)
    chosen = features[rng.permutation(len(features))[:20_000]]
    cv2.setRNGSeed(0)
    stop = (cv2.TERM_CRITERIA_COUNT, 10, 0.0)
    return np.asarray(cv2.kmeans(chosen, words, np.empty(0, np.int32), stop, 1, cv2.KMEANS_RANDOM_CENTERS)[2])


def _histogram(features: Array, vocabulary: Array) -> Array:
    squared = (vocabulary**2).sum(axis=1) - 2 * features @ vocabulary.T
    return np.bincount(squared.argmin(axis=1), minlength=len(vocabulary)).astype(float)


def shards_minutes(seed: int, measured: tuple[float, float] | None) -> float:
    """Minutes for the seven sequences; computed from ms per frame and s per world where those are given."""
    if measured is not None:
        frame_ms, build_s = measured
        return (sum(preset.samples for preset in ETNA.values()) * frame_ms / 1e3 + build_s) / 60
    started = time.perf_counter()
    for _, survey in etna_surveys(seed):
        for _ in survey.samples():
            pass
    return (time.perf_counter() - started) / 60


def show(console: Console, figures: dict[str, Any], worlds: list[dict[str, Any]]) -> None:
    table = Table("figure", "value")
    for name, value in figures.items():
        table.add_row(name, f"{value:.3g}")
    console.print(table)
    recalls = Table("world, hard setting", "thumbnail recall@1", "ORB words recall@1", "ms per training frame")
    for world in worlds:
        recalls.add_row(world["name"], f"{world['thumbnail']:.2f}", f"{world['orb']:.2f}", f"{world['frame_ms']:.1f}")
    console.print(recalls)


if __name__ == "__main__":
    typer.run(main)
