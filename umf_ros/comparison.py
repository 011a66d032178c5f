"""Compare two views of a place, each pair on its own: scans, images or frames of recordings, for `umf compare`."""

from __future__ import annotations

import csv
from collections import OrderedDict
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from umf_ros.bags.frames import FrameReader, Moment, nearest_frames, parse_moment, split_reference
from umf_ros.bags.presets import settings_for
from umf_ros.bags.reader import open_bag
from umf_ros.core.config import Verification
from umf_ros.core.errors import ConfigError, SensorFileError, UmfError
from umf_ros.core.frames import Candidate, Keyframe, LoopClosure
from umf_ros.core.geometry import to_quaternion
from umf_ros.detector import make_keyframe
from umf_ros.embedding.embedder import Embedder
from umf_ros.sensors.calibration import load_calibration
from umf_ros.sensors.scan_files import OUT_OF_REACH, UNCALIBRATED, fit_image, make_snapshot, read_image, read_scan
from umf_ros.verification import Hypothesis, Verifier

NO_CALIBRATION = "no calibration: images alone give no pose without one"
NO_DEPTH = "no depth: images without a scan or a right image give no metric pose"
CACHED_KEYFRAMES = 1000
"""Keyframes in memory, of a fifth of a megabyte each."""
FRAMES_AT_ONCE = 100
"""Frames with their images that one pass through a recording collects."""

VIEW_COLUMNS = ("match_scan", "query_scan", "match_left", "match_right", "query_left", "query_right")
POSE = ("x", "y", "z", "qx", "qy", "qz", "qw")
SIGMA = ("sigma_x", "sigma_y", "sigma_z", "sigma_rx", "sigma_ry", "sigma_rz")
RESULT_COLUMNS = ("accepted", "probability", *POSE, *SIGMA, "reason", "milliseconds", "similarity")
"""`match_T_query` in m, its standard deviations in m and rad about the axes of the match body."""

Pair = tuple["PlaceView", "PlaceView"]
Row = dict[str, Any]


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
    def parts(self) -> tuple[tuple[str, str], ...]:
        """Names of the files by kind."""
        return ("scan", self.scan), ("left", self.left), ("right", self.right)

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


@dataclass(frozen=True, slots=True)
class Comparison:
    """Result for two views.

    Attributes:
        reason: why they are not the same place, or "accepted".
        similarity: cosine similarity of the descriptors.
        probability: that the best pose is right; None without one.
        closure: `match_T_query` with its covariance, where they are the same place.
        milliseconds: verification time, without reading and embedding.
    """

    reason: str
    similarity: float
    probability: float | None = None
    closure: LoopClosure | None = None
    milliseconds: float = 0.0

    @property
    def row(self) -> Row:
        """The values of `RESULT_COLUMNS`, None where there is none."""
        row: Row = dict.fromkeys(RESULT_COLUMNS)
        row |= {"accepted": int(self.closure is not None), "reason": self.reason}
        row |= {"milliseconds": round(self.milliseconds, 1), "similarity": round(self.similarity, 6)}
        if self.probability is not None:
            row["probability"] = round(self.probability, 6)
        if self.closure is not None:
            pose, sigma = self.closure.match_T_query, np.sqrt(np.diag(self.closure.covariance))
            numbers = [*pose[:3, 3], *to_quaternion(pose), *sigma]
            row |= dict(zip((*POSE, *SIGMA), (float(f"{number:.9g}") for number in numbers), strict=True))
        return row


class KeyframeSource:
    """Reads views and caches their keyframes.

    Args:
        embedder: the network.
        rules: how views are read.
        warn: called once per distinct warning.

    Raises:
        CalibrationError: the calibration cannot be read.
    """

    def __init__(
        self, embedder: Embedder, rules: ReadingRules = ReadingRules(), warn: Callable[[str], None] = lambda _: None
    ) -> None:
        self._embedder = embedder
        self._rules = rules
        self._warn = cache(warn)
        self._calibration = UNCALIBRATED if rules.calibration is None else load_calibration(str(rules.calibration))
        self._cache: OrderedDict[PlaceView, Keyframe | UmfError] = OrderedDict()
        self._expected: dict[Path, list[PlaceView]] = {}

    @property
    def calibrated(self) -> bool:
        """Whether the files have a calibration."""
        return self._calibration is not UNCALIBRATED

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
        if view not in self._cache:
            reference = split_reference(view.scan)
            try:
                if reference is None:
                    self._keep(view, self._from_files(view))
                else:
                    self._read_recording(reference[0], view)
            except UmfError as error:
                self._keep(view, error)
        self._cache.move_to_end(view)
        found = self._cache[view]
        if isinstance(found, UmfError):
            raise found
        return found

    def _from_files(self, view: PlaceView) -> Keyframe:
        if not view.scan and not view.left:
            raise SensorFileError("neither a scan nor a left image")
        cloud = read_scan(Path(view.scan), self._rules.bin_columns) if view.scan else None
        names = [view.left, view.right]
        if cloud is not None and any(names) and not self.calibrated:
            self._warn("images beside a scan are not used without a calibration")
            names = ["", ""]
        left, right = (fit_image(read_image(Path(name)), self._calibration) if name else None for name in names)
        frame = make_snapshot(cloud, left, right, self._calibration, warn=self._warn)
        keyframe = make_keyframe(frame, self._embedder)
        if not view.left and not len(keyframe.points):
            raise SensorFileError(f"{view.scan} has {OUT_OF_REACH}")
        return keyframe

    def _read_recording(self, path: Path, view: PlaceView) -> None:
        """Keep the keyframe of a frame, and of the frames of its recording that are expected next."""
        expected = self._expected.get(path, [view])
        start = expected.index(view) if view in expected else 0
        moments: dict[PlaceView, Moment] = {}
        for one in {view: None} | dict.fromkeys(expected[start : start + FRAMES_AT_ONCE]):
            try:
                moments[one] = one.moment
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
                self._keep(one, frame if isinstance(frame, UmfError) else make_keyframe(frame, self._embedder))
            except UmfError as error:
                self._keep(one, error)

    def _keep(self, view: PlaceView, found: Keyframe | UmfError) -> None:
        self._cache[view] = found
        while len(self._cache) > CACHED_KEYFRAMES:
            self._cache.popitem(last=False)


class Comparer:
    """Compares views, each pair on its own.

    Args:
        source: reads the views.
        settings: the verification group of the settings.

    Raises:
        ConfigError: the acceptance model cannot be read.
    """

    def __init__(self, source: KeyframeSource, settings: Verification) -> None:
        self._source = source
        self._verifier = Verifier(settings)

    def compare(self, match: PlaceView, query: PlaceView) -> Comparison:
        """Compare two views.

        Raises:
            UmfError: one of them cannot be read; says which.
        """
        keyframes = self._read("match", match), self._read("query", query)
        similarity = similarity_of(*keyframes)
        if not self._source.calibrated and not (match.scan and query.scan):
            return Comparison(NO_CALIBRATION, similarity)
        verdict = judge(self._verifier, *keyframes)
        blind = verdict.closure is None and not any(keyframe.has_depth for keyframe in keyframes)
        return Comparison(
            reason=NO_DEPTH if blind else verdict.outcome,
            similarity=similarity,
            probability=verdict.probability,
            closure=verdict.closure,
            milliseconds=sum(self._verifier.latency_ms.values()),
        )

    def _read(self, role: str, view: PlaceView) -> Keyframe:
        try:
            return self._source.keyframe(view)
        except UmfError as error:
            raise SensorFileError(f"{role}: {error}") from None


def judge(verifier: Verifier, match: Keyframe, query: Keyframe) -> Hypothesis:
    """Verify one pair of keyframes without odometry and without the support of earlier pairs."""
    match, query = (
        replace(keyframe, stamp_ns=stamp_ns, odom_T_body=None, path_length_m=float("nan"), session=0)
        for stamp_ns, keyframe in enumerate((match, query), 1)
    )
    verifier.reset()
    return verifier.verify(query, [(Candidate(0, match.stamp_ns, similarity_of(match, query)), match)])[0]


def similarity_of(match: Keyframe, query: Keyframe) -> float:
    """Return the cosine similarity of the descriptors."""
    return float(query.embedding.descriptor @ match.embedding.descriptor)


def read_pairs(path: Path) -> list[Pair]:
    """Read match and query of every row; paths are relative to the list.

    Raises:
        ConfigError: the list cannot be read, names no views, or holds no pair.
    """
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            reader = csv.DictReader(file, skipinitialspace=True)
            known = [name for name in reader.fieldnames or () if name in VIEW_COLUMNS]
            if not known:
                raise ConfigError(f"{path} has none of the columns {', '.join(VIEW_COLUMNS)}")
            pairs = [(_listed("match", row, path.parent), _listed("query", row, path.parent)) for row in reader]
    except OSError as error:
        raise ConfigError(f"cannot read {path}: {error.strerror}") from None
    except (UnicodeDecodeError, csv.Error) as error:
        raise ConfigError(f"{path} is no CSV file: {error}") from None
    if not pairs:
        raise ConfigError(f"{path} holds no pair")
    return pairs


def view_row(match: PlaceView, query: PlaceView, base: Path) -> dict[str, str]:
    """Return the values of `VIEW_COLUMNS`; paths relative to the list where they lie beside or below it."""
    names = {f"{role}_{part}": name for role, view in (("match", match), ("query", query)) for part, name in view.parts}
    return {column: _relative(names[column], base) for column in VIEW_COLUMNS}


def failed_row(reason: str) -> Row:
    """Return the values of `RESULT_COLUMNS` of a pair that could not be compared."""
    return dict.fromkeys(RESULT_COLUMNS) | {"accepted": 0, "reason": reason}


def _listed(role: str, row: dict[str, str | None], base: Path) -> PlaceView:
    names = ((row.get(f"{role}_{part}") or "").strip() for part, _ in PlaceView().parts)
    return PlaceView(*(str(base / name) if name else "" for name in names))


def _relative(name: str, base: Path) -> str:
    path = Path(name)
    return str(path.relative_to(base)) if name and path.is_relative_to(base) else name
