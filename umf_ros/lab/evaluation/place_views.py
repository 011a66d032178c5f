"""Views of places: scans, images or frames of recordings, with the submaps around them."""

from __future__ import annotations

import re
from collections import OrderedDict
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from umf_ros.bags.frames import FrameReader
from umf_ros.bags.presets import settings_for
from umf_ros.bags.reader import open_bag
from umf_ros.core.config import KeyframePolicy, ParameterSource
from umf_ros.core.errors import BagError, UmfError
from umf_ros.core.frames import Frame, Keyframe
from umf_ros.detector import NOT_EMBEDDED, KeyframeSelector, assemble, make_keyframe
from umf_ros.embedding import Embedder, check_inputs
from umf_ros.embedding.depth import lift
from umf_ros.lab.scan_files import (
    OUT_OF_REACH,
    UNCALIBRATED,
    SensorFileError,
    fit_image,
    make_snapshot,
    read_image,
    read_scan,
)
from umf_ros.sensors.calibration import load_calibration
from umf_ros.submaps.history import can_be_merged, submap_around
from umf_ros.verification import constants as const

CACHED_KEYFRAMES = 1000
"""Keyframes in memory, of up to two fifths of a megabyte each with their submap."""
FRAMES_AT_ONCE = 100
"""Frames with their images that one pass through a recording collects."""
REACH_NS = 10**9
"""A frame further than this from a moment does not stand for it."""
EPOCH_S = 10**9
"""From so many seconds on, a moment counts since the epoch and not from the start of a recording."""

Moment = int | float
"""Nanoseconds since the epoch, or seconds from the start of the recording."""

Seen = tuple[Keyframe, Keyframe | None]
"""A keyframe, and its submap where its scan shows too little."""


@dataclass(frozen=True, slots=True)
class PlaceView:
    """Measurements of one place at one time.

    Attributes:
        scan: file of a scan, or `BAG@MOMENT`, a frame that brings its own images; empty: none.
        left: file of the left image; empty: none.
        right: file of the right image; empty: none.
    """

    scan: str = ""
    left: str = ""
    right: str = ""

    @property
    def moment(self) -> Moment:
        """The moment of a view that is a frame of a recording.

        Raises:
            SensorFileError: it is not a moment, or images are given beside it.
        """
        if self.left or self.right:
            raise SensorFileError(f"{self.scan} brings its own images")
        try:
            return parse_moment(self.scan.rpartition("@")[2])
        except ValueError as error:
            raise SensorFileError(f"{self.scan}: {error}") from None


class ViewReader:
    """Reads views and caches their keyframes.

    Args:
        embedder: the network.
        calibration: file, or name of a data set; None: files have none, recordings that of their data set.
        bin_columns: numbers per point of a .bin; 0: found from the data.
        config: parameter file for recordings, or None.
        dataset: of the recordings, or auto.
        warn: called once per distinct warning.
        method: name of the embedder, which refuses views without what it reads; "": of no known one.

    Attributes:
        calibrated: whether files have a calibration.

    Raises:
        CalibrationError: the calibration cannot be read.
    """

    def __init__(
        self,
        embedder: Embedder,
        calibration: Path | None = None,
        bin_columns: int = 0,
        config: ParameterSource = None,
        dataset: str = "auto",
        warn: Callable[[str], None] = lambda _: None,
        method: str = "",
    ) -> None:
        self._embedder, self._method = embedder, method
        self._bin_columns, self._config, self._dataset = bin_columns, config, dataset
        self._warn = cache(warn)
        self.calibrated = calibration is not None
        self._named = str(calibration) if calibration is not None else None
        self._calibration = UNCALIBRATED if calibration is None else load_calibration(str(calibration))
        self._cache: OrderedDict[PlaceView, Seen | UmfError] = OrderedDict()
        self._expected: dict[Path, list[PlaceView]] = {}

    def expect(self, views: Iterable[PlaceView]) -> None:
        """Announce the views in the order of their use: a recording is read once for many of them."""
        for view in dict.fromkeys(views):
            reference = split_reference(view.scan)
            if reference is not None:
                self._expected.setdefault(reference[0], []).append(view)

    def keyframe(self, view: PlaceView) -> Keyframe:
        """Return the keyframe of a view.

        Raises:
            UmfError: it cannot be read.
        """
        return self.load(view)[0]

    def load(self, view: PlaceView) -> Seen:
        """Return the keyframe of a view, and its submap.

        Raises:
            UmfError: it cannot be read.
        """
        if view not in self._cache:
            try:
                if reference := split_reference(view.scan):
                    self._read_recording(reference[0], view)
                else:
                    self._cache[view] = self._from_files(view), None
            except UmfError as error:
                self._cache[view] = error
        self._cache.move_to_end(view)
        while len(self._cache) > CACHED_KEYFRAMES:
            self._cache.popitem(last=False)
        found = self._cache[view]
        if isinstance(found, UmfError):
            raise found
        return found

    def _from_files(self, view: PlaceView) -> Keyframe:
        if not view.scan and not view.left:
            raise SensorFileError("neither a scan nor a left image")
        cloud = read_scan(Path(view.scan), self._bin_columns) if view.scan else None
        names = [view.left, view.right]
        if cloud is not None and any(names) and not self.calibrated:
            self._warn("images beside a scan are not used without a calibration")
            names = ["", ""]
        left, right = (fit_image(read_image(Path(name)), self._calibration) if name else None for name in names)
        frame = make_snapshot(cloud, left, right, self._calibration, warn=self._warn)
        self._check(view, frame)
        keyframe = make_keyframe(frame, self._embedder)
        if not view.left and not len(keyframe.points):
            raise SensorFileError(f"{view.scan} has {OUT_OF_REACH}")
        return keyframe

    def _read_recording(self, path: Path, view: PlaceView) -> None:
        """Keep the keyframe and submap of a frame, and of the frames of its recording that are expected next."""
        expected, wanted = self._expected.get(path, []), {view: view.moment}
        start = expected.index(view) if view in expected else 0
        for one in expected[start : start + FRAMES_AT_ONCE]:
            with suppress(SensorFileError):  # it is reported when it is asked for
                wanted[one] = one.moment
        bag = open_bag(path)
        settings = settings_for(bag, self._config, self._dataset, calibration=self._named)
        along = _ScansOnPath(settings.keyframe)
        frames = along.record(FrameReader(bag, settings, warn=self._warn))
        found = nearest_frames(frames, list(wanted.values()))
        along.read_on(frames)
        for one, frame in zip(wanted, found, strict=True):
            try:
                if isinstance(frame, UmfError):
                    raise frame
                self._check(one, frame)
                self._cache[one] = along.seen_at(frame, self._embedder)
            except UmfError as error:
                self._cache[one] = error

    def _check(self, view: PlaceView, frame: Frame) -> None:
        check_inputs(self._method, view.scan or view.left, frame.left is not None, frame.points is not None)


class _ScansOnPath:
    """Keeps the scans that may be merged while the frames of a recording pass, one of every `MERGE_STEP_M`."""

    def __init__(self, policy: KeyframePolicy) -> None:
        self._selector = KeyframeSelector(policy)
        self._scans: list[Keyframe] = []
        self._path_m: dict[int, float] = {}

    def record(self, frames: Iterable[Frame]) -> Iterator[Frame]:
        """Yield frames unchanged."""
        for frame in frames:
            self._selector.select(frame)
            path_m = self._path_m[frame.stamp_ns] = self._selector.path_length_m(frame)
            last = self._scans[-1] if self._scans else None
            due = last is None or last.session != frame.session or path_m - last.path_length_m >= const.MERGE_STEP_M
            if due and frame.odom_T_body is not None and frame.points is not None:
                scan = assemble(frame, NOT_EMBEDDED, path_m, frame.session)
                self._scans += [scan] if can_be_merged(scan) else []
            yield frame

    def read_on(self, frames: Iterator[Frame]) -> None:
        """Record as many metres more as a submap holds."""
        end_m = list(self._path_m.values())[-1] + const.ODOMETRY_REACH_M
        while (frame := next(frames, None)) is not None and self._path_m[frame.stamp_ns] < end_m:
            pass

    def seen_at(self, frame: Frame, embedder: Embedder) -> Seen:
        """Return the keyframe of a recorded frame, and its submap where it needs one."""
        embedding = lift(frame, embedder.embed(frame))
        keyframe = assemble(frame, embedding, self._path_m[frame.stamp_ns], frame.session)
        if not can_be_merged(keyframe):
            return keyframe, None
        away = [(abs(one.path_length_m - keyframe.path_length_m), one) for one in self._scans]
        near = [one for metres, one in away if 0 < metres <= const.ODOMETRY_REACH_M and one.session == frame.session]
        return keyframe, submap_around(keyframe, near)


def parse_moment(text: str) -> Moment:
    """Nanoseconds since the epoch (16 digits or more), seconds since the epoch, or seconds from the start.

    Raises:
        ValueError: it is none of them.
    """
    if re.fullmatch(r"[0-9]{16,}", text):
        return int(text)
    if not re.fullmatch(r"-?([0-9]+\.?[0-9]*|\.[0-9]+)", text):
        raise ValueError(f"{text!r} is neither a stamp in ns nor seconds from the start")
    if (value := float(text)) < 0:
        raise ValueError(f"{text!r} is before the start")
    if value < EPOCH_S:
        return value
    seconds, _, fraction = text.partition(".")
    return int(seconds) * 10**9 + int(f"{fraction:0<9}"[:9])  # a float has no room for nanoseconds


def split_reference(text: str) -> tuple[Path, str] | None:
    """Recording and moment of `BAG@MOMENT`; None where there is no moment, or the whole is the name of a file."""
    name, separator, moment = text.rpartition("@")
    if not separator or not name or "/" in moment or Path(text).exists():
        return None
    return Path(name), moment


def nearest_frames(frames: Iterable[Frame], moments: list[Moment]) -> list[Frame | BagError]:
    """The frame nearest to each moment, an error where none is within a second; reads no further than it must.

    Raises:
        BagError: the recording has no frame.
    """
    best: list[Frame] = []
    wanted: list[int] = []
    for frame in frames:
        if not wanted:
            wanted = [one if isinstance(one, int) else frame.stamp_ns + round(1e9 * one) for one in moments]
            best = [frame] * len(moments)
        for position, stamp in enumerate(wanted):
            if abs(frame.stamp_ns - stamp) < abs(best[position].stamp_ns - stamp):
                best[position] = frame
        if frame.stamp_ns > max(wanted) + REACH_NS:
            break
    if not best:
        raise BagError("the recording has no frame with an image or a scan")
    return [
        frame
        if abs(frame.stamp_ns - stamp) <= REACH_NS
        else BagError(f"no frame within a second of {moment}; the nearest is at {frame.stamp_ns} ns")
        for frame, stamp, moment in zip(best, wanted, moments, strict=True)
    ]
