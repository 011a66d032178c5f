"""What was seen at one place and time, read from files and recordings, as keyframes."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

from umf_ros.bags.frames import FrameReader
from umf_ros.bags.moments import Moment, nearest_frames, parse_moment, split_reference
from umf_ros.bags.presets import settings_for
from umf_ros.bags.reader import open_bag
from umf_ros.core.errors import SensorFileError, UmfError
from umf_ros.core.frames import Frame, Keyframe
from umf_ros.detector import make_keyframe
from umf_ros.embedding.embedder import Embedder
from umf_ros.sensors.calibration import load_calibration
from umf_ros.sensors.scan_files import OUT_OF_REACH, read_scan
from umf_ros.sensors.snapshots import UNCALIBRATED, fit_image, make_snapshot, read_image

KEPT = 1000
"""Keyframes in memory, of a fifth of a megabyte each."""
FRAMES_AT_ONCE = 100
"""Frames, images and all, that one pass through a recording collects."""


@dataclass(frozen=True, slots=True)
class PlaceView:
    """What was seen at one place and time.

    Attributes:
        scan: file of a scan, or `BAG@MOMENT`, a frame that brings its own images; empty: none.
        left: file of the left image; empty: none.
        right: file of the right image; empty: none.
    """

    scan: str = ""
    left: str = ""
    right: str = ""


@dataclass(frozen=True, slots=True)
class ReadingRules:
    """How views are read.

    Attributes:
        calibration: file, or name of a data set; None: files have none, recordings that of their data set.
        bin_columns: numbers per point of a .bin; 0: found from the data.
        config: parameter file for recordings, or None.
        dataset: of the recordings, or auto.
    """

    calibration: Path | None = None
    bin_columns: int = 0
    config: Path | None = None
    dataset: str = "auto"


class KeyframeSource:
    """The keyframes of views; that of a view that is asked for often is made once.

    Args:
        embedder: the network.
        rules: how views are read.
        warn: told, once, every line about what is odd.

    Raises:
        CalibrationError: the calibration cannot be read.
    """

    def __init__(
        self, embedder: Embedder, rules: ReadingRules = ReadingRules(), warn: Callable[[str], None] = lambda _: None
    ) -> None:
        self._embedder = embedder
        self._rules = rules
        self._warn = _once(warn)
        self._calibration = UNCALIBRATED if rules.calibration is None else load_calibration(str(rules.calibration))
        self._kept: OrderedDict[PlaceView, Keyframe | UmfError] = OrderedDict()
        self._expected: dict[Path, list[PlaceView]] = {}

    @property
    def calibrated(self) -> bool:
        """Whether the files have a calibration."""
        return self._calibration is not UNCALIBRATED

    def expect(self, views: Iterable[PlaceView]) -> None:
        """Say which views will be asked for, in which order: a recording is read once for many of them."""
        for view in dict.fromkeys(views):
            reference = split_reference(view.scan)
            if reference is not None:
                self._expected.setdefault(reference[0], []).append(view)

    def keyframe(self, view: PlaceView) -> Keyframe:
        """The keyframe of a view.

        Raises:
            UmfError: it cannot be read.
        """
        if view not in self._kept:
            self._read(view)
        self._kept.move_to_end(view)
        found = self._kept[view]
        if isinstance(found, UmfError):
            raise found
        return found

    def _read(self, view: PlaceView) -> None:
        reference = split_reference(view.scan)
        try:
            if reference is None:
                self._keep(view, self._from_files(view))
            else:
                self._read_recording(reference[0], view)
        except UmfError as error:
            self._keep(view, error)

    def _from_files(self, view: PlaceView) -> Keyframe:
        keyframe = make_keyframe(self._snapshot(view), self._embedder)
        if not view.left and not len(keyframe.points):
            raise SensorFileError(f"{view.scan} has {OUT_OF_REACH}")
        return keyframe

    def _snapshot(self, view: PlaceView) -> Frame:
        if not view.scan and not view.left:
            raise SensorFileError("neither a scan nor a left image")
        cloud = read_scan(Path(view.scan), self._rules.bin_columns) if view.scan else None
        names = [view.left, view.right]
        if cloud is not None and any(names) and not self.calibrated:
            self._warn("images beside a scan are not used without a calibration")
            names = ["", ""]
        left, right = (fit_image(read_image(Path(name)), self._calibration) if name else None for name in names)
        return make_snapshot(cloud, left, right, self._calibration, warn=self._warn)

    def _read_recording(self, path: Path, view: PlaceView) -> None:
        """Keep the keyframe of a frame, and of those of its recording that will be asked for next."""
        expected = self._expected.get(path, [view])
        start = expected.index(view) if view in expected else 0
        moments: dict[PlaceView, Moment] = {}
        for one in {view: None} | dict.fromkeys(expected[start : start + FRAMES_AT_ONCE]):
            try:
                moments[one] = _moment_of(one)
            except UmfError as error:
                self._keep(one, error)
        if view not in moments:
            return
        bag = open_bag(path)
        calibration = str(self._rules.calibration) if self._rules.calibration else None
        settings = settings_for(bag, self._rules.config, self._rules.dataset, calibration=calibration)
        found = nearest_frames(FrameReader(bag, settings, warn=self._warn), list(moments.values()))
        for one, frame in zip(moments, found, strict=True):
            try:
                self._keep(one, make_keyframe(frame.checked(), self._embedder))
            except UmfError as error:
                self._keep(one, error)

    def _keep(self, view: PlaceView, found: Keyframe | UmfError) -> None:
        self._kept[view] = found
        while len(self._kept) > KEPT:
            self._kept.popitem(last=False)


def _moment_of(view: PlaceView) -> Moment:
    if view.left or view.right:
        raise SensorFileError(f"{view.scan} brings its own images")
    try:
        return parse_moment(view.scan.rpartition("@")[2])
    except ValueError as error:
        raise SensorFileError(f"{view.scan}: {error}") from None


def _once(warn: Callable[[str], None]) -> Callable[[str], None]:
    """Tell every line once."""
    told: set[str] = set()

    def tell(text: str) -> None:
        if text not in told:
            told.add(text)
            warn(text)

    return tell
