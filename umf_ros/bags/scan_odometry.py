"""Odometry of a recording without odometry, from its scans."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from itertools import chain
from pathlib import Path

import numpy as np

from umf_ros.bags.frames import FrameReader
from umf_ros.bags.inputs import present_topics
from umf_ros.bags.reader import Bag
from umf_ros.bags.trajectories import read_tum
from umf_ros.core.config import EmbeddingSettings, Settings, topics_of
from umf_ros.core.errors import BagError
from umf_ros.core.frames import Frame
from umf_ros.core.trajectory import Trajectory
from umf_ros.sensors.scan_odometry import ENGINES, MAX_LOST, ScanOdometry

OnScan = Callable[[float], None]
FIRST = 5
"""Scans that tell the velocity at the start."""


def can_track(bag: Bag, settings: Settings) -> bool:
    """Return whether a recording has scans on the expected topic, and no odometry."""
    present = present_topics(bag, settings)
    return bool(present.cloud) and not present.odometry


def odometry_of_scans(
    bag: Bag, settings: Settings, engine: str, made: Path | None = None, on_scan: OnScan = lambda _: None
) -> Trajectory:
    """Return poses of the body at the scans of the first session of a recording.

    Args:
        bag: the recording.
        settings: those of the replay; its topic of the odometry is left out.
        engine: a name of `ENGINES`.
        made: TUM file of an earlier run, which is read instead where it exists.
        on_scan: called for every scan with the processed share of the recording, 0 to 1.

    The velocity at the first scan is that of the first few, registered once more: it removes the motion from the scan
    that the map begins with.

    Raises:
        BagError: there are no scans, they come too slowly, or the engine lost track.
    """
    if made is not None and made.is_file():
        return read_tum(made)
    topics = topics_of(settings)
    if topics.cloud not in bag.topics:
        raise BagError(f"{bag.path} has no scans for --odometry {engine}")
    names = {name: "" for name in topics.model_dump() if name != "cloud"}
    alone = {"topics": topics.model_copy(update=names), "embedding": EmbeddingSettings()}
    told: list[str] = []
    reader = FrameReader(bag, settings.model_copy(update=alone), warn=told.append)
    scans = _first_session(reader)
    first, trial = list[Frame](), ScanOdometry(ENGINES[engine]())
    while len(trial.samples) < FIRST and (frame := next(scans, None)) is not None:
        if trial.add(frame):
            first.append(frame)
    odometry = ScanOdometry(ENGINES[engine](), trial.twist)
    for frame in chain(first, scans):
        odometry.add(frame)
        on_scan(reader.progress)
    if len(odometry.samples) < FIRST:
        why = told[0] if told else f"--odometry {engine} needs them"
        raise BagError(f"{bag.path} has no scans that follow each other: {why}")
    _check(engine, odometry, settings.sync.max_odometry_gap_s)
    return odometry.trajectory()


def _first_session(frames: Iterable[Frame]) -> Iterator[Frame]:
    """Yield the frames until the clock is set back."""
    session: int | None = None
    for frame in frames:
        session = frame.session if session is None else session
        if frame.session != session:
            return
        yield frame


def _check(engine: str, odometry: ScanOdometry, max_gap_s: float) -> None:
    stamps_ns = [one.stamp_ns for one in odometry.samples]
    period_s = float(np.median(np.diff(stamps_ns))) * 1e-9
    if period_s > max_gap_s:
        raise BagError(f"{engine} cannot follow scans that are {period_s:.1f} s apart: record odometry")
    lost = len(odometry.lost_ns)
    if lost > max(1, MAX_LOST * len(stamps_ns)):
        what = f"{engine} lost track of the scans {(odometry.lost_ns[0] - stamps_ns[0]) * 1e-9:.1f} s after the start"
        share = f"{lost} of {len(stamps_ns)} do not fit the motion before them"
        raise BagError(f"{what} ({share}); it sees too little or moves too far: use --odometry FILE.tum")
