"""Shared fixtures: frames and keyframes made of noise, a small recording, and a DDS domain of their own."""

from __future__ import annotations

import fcntl
import os
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from hypothesis import settings

from umf_ros.core.frames import Embedding, Frame, Keyframe, LocalFeatures, StereoCamera, SuperFeatures
from umf_ros.core.geometry import make_pose

if TYPE_CHECKING:
    from umf_ros.lab.simulation.relief import Relief

# a shell that starts the tests in the background has them ignore Ctrl-C, which some of them press
signal.signal(signal.SIGINT, signal.default_int_handler)
# the same examples in every run, whatever the load of the machine
settings.register_profile("repeatable", derandomize=True, deadline=None, database=None)
settings.load_profile("repeatable")


MARKED = {
    "ros": ("nodes", "lab/live", "examples"),
    "postgres": ("fleet", "commands/test_fleet.py"),
    "browser": ("runs/test_browser.py",),
    "slow": (
        *("lab", "benchmarks", "maps", "submaps", "commands", "verification", "pose_graph", "embedding"),
        *("baselines", "runs", "test_durable_graph.py", "bags/test_hostile.py", "sensors/test_sensor_check.py"),
        *("test_packaging.py", "test_replay.py", "test_tasks.py", "test_imports.py"),
    ),
}
"""Markers by folders and files of tests; `make check` leaves all of them out."""
LONG = (
    *("nodes/test_live_graph.py", "submaps/test_finder.py", "test_detector.py", "commands/test_replay.py", "nodes"),
    *("commands/test_map", "maps", "lab/evaluation", "lab/simulation", "lab/training", "fleet", "benchmarks", "bags"),
)
"""Folders and files of tests that take longest: they begin first, so that no worker ends long after the others.

The first one simulates the small recording; those beside it do without.
"""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    root = Path(__file__).parent
    names = {item.path: item.path.relative_to(root).as_posix() for item in items}
    # stable: the order within a folder stays
    items.sort(key=lambda item: next((i for i, one in enumerate(LONG) if names[item.path].startswith(one)), len(LONG)))
    for item in items:
        name = names[item.path]
        for marker, places in MARKED.items():
            if name.startswith(tuple(place if place.endswith(".py") else f"{place}/" for place in places)):
                item.add_marker(marker)


CAMERA = StereoCamera(688, 512, 579.488, 579.488, 342.133, 255.806, 0.2003)


def unit(vector: np.ndarray) -> np.ndarray:
    return (vector / np.linalg.norm(vector)).astype(np.float32)


def make_keyframe(
    stamp_s: float,
    path_length_m: float = float("nan"),
    seed: int = 0,
    session: int = 0,
    dimension: int = 16,
    descriptor: np.ndarray | None = None,
) -> Keyframe:
    rng = np.random.default_rng(seed)
    image = LocalFeatures(
        positions=rng.uniform(0, 500, (5, 2)).astype(np.float32),
        descriptors=rng.standard_normal((5, 8)).astype(np.float16),
        saliency=rng.random(5).astype(np.float32),
        points=np.full((5, 3), np.nan, np.float32),
    )
    super_image = SuperFeatures(rng.standard_normal((4, 8)).astype(np.float16), rng.random(4).astype(np.float32))
    found = unit(rng.standard_normal(dimension)) if descriptor is None else descriptor
    return Keyframe(
        stamp_ns=round(stamp_s * 1e9),
        embedding=Embedding(found, image=image, super_image=super_image),
        camera=CAMERA,
        body_T_camera=make_pose(np.eye(3), rng.standard_normal(3)),
        points=rng.standard_normal((20, 3)).astype(np.float32),
        odom_T_body=np.eye(4) if np.isfinite(path_length_m) else None,
        path_length_m=path_length_m,
        session=session,
    )


def make_frame(stamp_s: float, odom_T_body: np.ndarray | None = None, session: int = 0) -> Frame:
    return Frame(
        stamp_ns=round(stamp_s * 1e9),
        camera=CAMERA,
        body_T_camera=np.eye(4),
        body_T_lidar=np.eye(4),
        points=np.zeros((10, 3), np.float32),
        intensity=np.zeros(10, np.float32),
        odom_T_body=odom_T_body,
        session=session,
    )


@pytest.fixture(autouse=True)
def no_node_is_left() -> Iterator[None]:
    """End the nodes of a test that failed: the tests after it share their domain with them."""
    from processes import Process  # its environment has the domain that is chosen above

    before = len(Process.started)
    yield
    for process in Process.started[before:]:
        process.kill()
    del Process.started[before:]


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(7)


@pytest.fixture
def ros_context() -> Iterator[None]:
    import rclpy

    rclpy.init(args=["--ros-args", "-p", "dataset:=s3li-etna"])  # its topics, instead of a search by type
    yield
    rclpy.try_shutdown()


@pytest.fixture(scope="session")
def mini_bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A fast drive around a small loop, one and a half times, in a world no one trained or tuned on."""
    shared = tmp_path_factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:  # the workers share it: it takes a minute to simulate
        shared = shared.parent
    folder, part = shared / "mini", shared / "mini.part"
    with (shared / "mini.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not folder.exists():
            part.mkdir(exist_ok=True)
            _simulate_mini(part / "mini.mcap")
            part.rename(folder)
    return folder / "mini.mcap"


def _simulate_mini(path: Path) -> None:
    from umf_ros.lab.simulation.bag_writer import BagWriter
    from umf_ros.lab.simulation.presets import DEMO, Preset, gentle_loop
    from umf_ros.lab.simulation.route import Walker
    from umf_ros.lab.simulation.simulator import Simulator, record, write_side_files

    def plan(relief: Relief, rng: np.random.Generator) -> Walker:
        return Walker(gentle_loop(relief, 30.0, rng), rng).forward(29).forward(20, lateral_m=0.5)

    look = {"speed_m_s": 3.0, "swing_deg": 2.0, "sun_deg": 15.0, "drift": DEMO.drift}
    preset = Preset("a small loop", plan, length_m=46, samples=50, **look)
    simulator = Simulator(preset, seed=20_777)
    with BagWriter(path) as bag:
        record(simulator, bag)
    write_side_files(simulator, path)


@pytest.fixture(scope="session")
def mini_config(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Settings for the mini bag: its loop closes sooner than a rover's, and every third scan is enough."""
    path = tmp_path_factory.mktemp("config") / "mini.yaml"
    loop, keyframe = "{min_time_gap_s: 8.0, min_travel_m: 15.0}", "{min_translation_m: 1.5, min_rotation_deg: 60.0}"
    path.write_text(f"/**: {{ros__parameters: {{loop: {loop}, keyframe: {keyframe}}}}}\n")
    return path
