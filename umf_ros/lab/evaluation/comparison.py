"""Two views of a place, each pair on its own: scans, images or frames of recordings, compared and drawn."""

from __future__ import annotations

import csv
from collections import OrderedDict
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from umf_ros.bags.frames import FrameReader
from umf_ros.bags.presets import settings_for
from umf_ros.bags.reader import open_bag
from umf_ros.core.config import KeyframePolicy, Verification
from umf_ros.core.errors import BagError, ConfigError, UmfError, writing
from umf_ros.core.frames import Candidate, Frame, Image, Keyframe, LoopClosure, Points
from umf_ros.core.geometry import transform
from umf_ros.detector import NOT_EMBEDDED, KeyframeSelector, assemble
from umf_ros.embedding import Embedder
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
from umf_ros.runs.run_file import pose_numbers
from umf_ros.sensors.calibration import load_calibration
from umf_ros.submaps.history import can_be_merged, submap_around
from umf_ros.verification import Hypothesis, Verifier
from umf_ros.verification import constants as const
from umf_ros.verification.acceptance import load_acceptance
from umf_ros.verification.pose_search import consistent_pixels

NO_CALIBRATION = "no calibration: images alone give no pose without one"
NO_DEPTH = "no depth: images without a scan or a right image give no metric pose"
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

VIEW_COLUMNS = ("match_scan", "query_scan", "match_left", "match_right", "query_left", "query_right")
POSE = ("x", "y", "z", "qx", "qy", "qz", "qw")
SIGMA = ("sigma_x", "sigma_y", "sigma_z", "sigma_rx", "sigma_ry", "sigma_rz")
RESULT_COLUMNS = ("accepted", "probability", *POSE, *SIGMA, "reason", "milliseconds", "similarity")
"""`match_T_query` in m, its standard deviations in m and rad about the axes of the match body."""

Pair = tuple["PlaceView", "PlaceView"]
Seen = tuple[Keyframe, Keyframe | None]
"""A keyframe, and its submap where its scan shows too little."""
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


class Comparer:
    """Reads views, caches their keyframes, and compares them, each pair on its own.

    Args:
        embedder: the network.
        settings: the verification group of the settings.
        calibration: file, or name of a data set; None: files have none, recordings that of their data set.
        bin_columns: numbers per point of a .bin; 0: found from the data.
        config: parameter file for recordings, or None.
        dataset: of the recordings, or auto.
        warn: called once per distinct warning.

    Raises:
        CalibrationError: the calibration cannot be read.
        ConfigError: the acceptance model cannot be read.
    """

    def __init__(
        self,
        embedder: Embedder,
        settings: Verification,
        calibration: Path | None = None,
        bin_columns: int = 0,
        config: Path | None = None,
        dataset: str = "auto",
        warn: Callable[[str], None] = lambda _: None,
    ) -> None:
        self._embedder, self._verifier = embedder, Verifier(settings)
        self._bin_columns, self._config, self._dataset = bin_columns, config, dataset
        self._warn = cache(warn)
        self._named = None if calibration is None else str(calibration)
        self._calibration = UNCALIBRATED if calibration is None else load_calibration(str(calibration))
        self._cache: OrderedDict[PlaceView, Seen | UmfError] = OrderedDict()
        self._expected: dict[Path, list[PlaceView]] = {}

    def expect(self, views: Iterable[PlaceView]) -> None:
        """Announce the views in the order of their use: a recording is read once for many of them."""
        for view in dict.fromkeys(views):
            reference = split_reference(view.scan)
            if reference is not None:
                self._expected.setdefault(reference[0], []).append(view)

    def compare(self, match: PlaceView, query: PlaceView) -> Row:
        """Compare two views, and their submaps where the scans give no pose; return the values of `RESULT_COLUMNS`.

        Raises:
            UmfError: one of them cannot be read; says which.
        """
        (their_scan, their_submap), (our_scan, our_submap) = self._read("match", match), self._read("query", query)
        keyframes = their_scan, our_scan
        similarity = similarity_of(*keyframes)
        if self._named is None and not (match.scan and query.scan):
            return result_row(NO_CALIBRATION, similarity, 0.0)
        verdict = judge(self._verifier, *keyframes)
        elapsed_ms = sum(self._verifier.latency_ms.values())
        merged = their_submap or their_scan, our_submap or our_scan
        submaps = (their_submap or our_submap) is not None and not _share_scans(match, query, *merged)
        if verdict.closure is None and submaps:
            verdict = judge(self._verifier, *merged)
            elapsed_ms += sum(self._verifier.latency_ms.values())
        blind = verdict.closure is None and not any(keyframe.has_depth for keyframe in keyframes)
        reason = NO_DEPTH if blind else verdict.outcome
        return result_row(reason, similarity, elapsed_ms, verdict.probability, verdict.closure)

    def keyframe(self, view: PlaceView) -> Keyframe:
        """Return the keyframe of a view.

        Raises:
            UmfError: it cannot be read.
        """
        return self._load(view)[0]

    def _load(self, view: PlaceView) -> Seen:
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

    def _read(self, role: str, view: PlaceView) -> Seen:
        try:
            return self._load(view)
        except UmfError as error:
            raise SensorFileError(f"{role}: {error}") from None

    def _from_files(self, view: PlaceView) -> Keyframe:
        if not view.scan and not view.left:
            raise SensorFileError("neither a scan nor a left image")
        cloud = read_scan(Path(view.scan), self._bin_columns) if view.scan else None
        names = [view.left, view.right]
        if cloud is not None and any(names) and self._named is None:
            self._warn("images beside a scan are not used without a calibration")
            names = ["", ""]
        left, right = (fit_image(read_image(Path(name)), self._calibration) if name else None for name in names)
        frame = make_snapshot(cloud, left, right, self._calibration, warn=self._warn)
        keyframe = assemble(frame, lift(frame, self._embedder.embed(frame)))
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
                self._cache[one] = frame if isinstance(frame, UmfError) else along.seen_at(frame, self._embedder)
            except UmfError as error:
                self._cache[one] = error


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


def _share_scans(match: PlaceView, query: PlaceView, theirs: Keyframe, ours: Keyframe) -> bool:
    """Whether submaps of one recording may hold the same scans, which are alike for no other reason."""
    one, other = split_reference(match.scan), split_reference(query.scan)
    if one is None or other is None or one[0] != other[0] or theirs.session != ours.session:
        return False
    return abs(theirs.path_length_m - ours.path_length_m) < 2 * const.ODOMETRY_REACH_M


def judge(verifier: Verifier, match: Keyframe, query: Keyframe) -> Hypothesis:
    """Verify one pair of keyframes without odometry and without the support of earlier pairs.

    Args:
        verifier: its memory is cleared.
        match: the earlier one.
        query: the later one.
    """
    match, query = (
        replace(keyframe, stamp_ns=stamp_ns, odom_T_body=None, path_length_m=float("nan"), session=0)
        for stamp_ns, keyframe in enumerate((match, query), 1)
    )
    verifier.reset()
    candidate = Candidate(0, match.stamp_ns, similarity_of(match, query))
    return verifier.verify(query, [(candidate, match)])[0]


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
    views = {"match": asdict(match), "query": asdict(query)}
    names = {column: views[column[:5]][column[6:]] for column in VIEW_COLUMNS}
    return {column: _relative(name, base) for column, name in names.items()}


def result_row(
    reason: str,
    similarity: float | None = None,
    milliseconds: float | None = None,
    probability: float | None = None,
    closure: LoopClosure | None = None,
) -> Row:
    """Return the values of `RESULT_COLUMNS`, None where there is none.

    Args:
        reason: why the views are not the same place, or "accepted".
        similarity: cosine similarity of the descriptors.
        milliseconds: verification time, without reading and embedding.
        probability: that the best pose is right.
        closure: `match_T_query` with its covariance, where they are the same place.
    """
    row: Row = dict.fromkeys(RESULT_COLUMNS) | {"accepted": int(closure is not None), "reason": reason}
    numbers = {"milliseconds": (milliseconds, 1), "similarity": (similarity, 6), "probability": (probability, 6)}
    row |= {name: round(value, digits) for name, (value, digits) in numbers.items() if value is not None}
    if closure is not None:
        values = pose_numbers(closure.match_T_query, closure.covariance)
        row |= dict(zip((*POSE, *SIGMA), (float(f"{value:.9g}") for value in values), strict=True))
    return row


def _listed(role: str, row: dict[str, str | None], base: Path) -> PlaceView:
    names = ((row.get(f"{role}_{part}") or "").strip() for part in ("scan", "left", "right"))
    return PlaceView(*(str(base / name) if name else "" for name in names))


def _relative(name: str, base: Path) -> str:
    path = Path(name)
    return str(path.relative_to(base)) if name and path.is_relative_to(base) else name


def parse_moment(text: str) -> Moment:
    """Nanoseconds since the epoch (16 digits or more), seconds since the epoch, or seconds from the start.

    Raises:
        ValueError: it is none of them.
    """
    if text.isdigit() and len(text) >= 16:
        return int(text)
    try:
        value = float(text)
    except ValueError:
        raise ValueError(f"{text!r} is neither a stamp in ns nor seconds from the start") from None
    if not value >= 0:
        raise ValueError(f"{text!r} is before the start")
    if value < EPOCH_S:
        return value
    seconds, _, fraction = text.partition(".")
    if not seconds.isdigit() or (fraction and not fraction.isdigit()):
        raise ValueError(f"{text!r} is neither a stamp in ns nor seconds from the start")
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


MOST_LINES = 60


@dataclass(frozen=True, slots=True)
class Explanation:
    """The best pose for a pair and what speaks for it.

    Attributes:
        query: the later keyframe.
        match: the earlier one.
        best: the most probable hypothesis, or None when no pose fits.
        threshold: probability from which a closure is published.
        contributions: log-odds that each criterion adds, by name; "bias" is what has to be overcome.
        pixels: (K, 4) feature pairs that obey the pose.
    """

    query: Keyframe
    match: Keyframe
    best: Hypothesis | None
    threshold: float
    contributions: dict[str, float]
    pixels: Points

    @property
    def verdict(self) -> str:
        """One line for a person."""
        if self.best is None:
            return "rejected: no pose fits"
        probability = self.best.probability or 0.0
        word = "accepted" if probability >= self.threshold else "rejected"
        return f"{word}: probability {probability:.3f}, {self.threshold:g} is needed"


def explain(query: Keyframe, match: Keyframe, settings: Verification) -> Explanation:
    """Examine one pair on its own, without the support of neighbouring keyframes."""
    candidate = Candidate(0, match.stamp_ns, similarity_of(match, query))
    examined = Verifier(settings).examine(query, [(candidate, match)])
    if not examined:
        return Explanation(query, match, None, settings.min_probability, {}, np.empty((0, 4), np.float32))
    best = max(examined, key=lambda one: one.probability or 0.0)
    contributions = load_acceptance(settings.calibration).contributions(best.measurements)
    pixels = consistent_pixels(best, settings)
    return Explanation(query, match, best, settings.min_probability, contributions, pixels)


def draw(explanation: Explanation, query_image: Image | None, match_image: Image | None, path: Path) -> None:
    """Write the picture: images with inlier lines, aligned scans from above and from the side, contributions.

    Raises:
        OutputError: the file cannot be written.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(15, 11), layout="constrained")
    grid = figure.add_gridspec(2, 3, height_ratios=[1.0, 1.05], width_ratios=[1.1, 1, 0.9])
    _draw_images(figure.add_subplot(grid[0, :]), explanation, query_image, match_image)
    _draw_scans(figure.add_subplot(grid[1, 0]), explanation, 1, "left [m]", "from above")
    _draw_scans(figure.add_subplot(grid[1, 1]), explanation, 2, "up [m]", "from the side")
    _draw_contributions(figure.add_subplot(grid[1, 2]), explanation)
    stamps = f"query {explanation.query.stamp_ns}   match {explanation.match.stamp_ns}"
    figure.suptitle(f"{explanation.verdict}\n{stamps}", fontsize=14)
    with writing(path, ValueError):
        figure.savefig(path, dpi=100)


def _draw_images(axes: Any, explanation: Explanation, query: Image | None, match: Image | None) -> None:
    camera = explanation.query.camera
    blank = np.zeros((camera.height, camera.width), np.uint8)
    left, right = (blank if image is None else image for image in (query, match))
    axes.imshow(np.hstack([left, right]), cmap="gray", vmin=0, vmax=255)
    shown = explanation.pixels[:: max(1, len(explanation.pixels) // MOST_LINES)]
    for u, v, match_u, match_v in shown:
        axes.plot([u, match_u + left.shape[1]], [v, match_v], color="limegreen", linewidth=0.7, alpha=0.8)
    axes.set_title(f"query | match: {len(explanation.pixels)} feature pairs obey the pose")
    axes.set_axis_off()


def _draw_scans(axes: Any, explanation: Explanation, height_axis: int, label: str, title: str) -> None:
    match, query = explanation.match.points, explanation.query.points
    if explanation.best is not None:
        query = transform(explanation.best.pose, query)
        title += ", aligned"
    for points, colour, name in ((match, "tab:blue", "match"), (query, "tab:orange", "query")):
        axes.scatter(points[:, 0], points[:, height_axis], s=1.2, c=colour, label=name, linewidths=0)
    axes.set(xlabel="ahead of the match [m]", ylabel=label, title=f"scans {title}", xlim=(-2, 30))
    axes.set_aspect("equal" if height_axis == 1 else "auto")
    axes.legend(loc="upper left", markerscale=6)


def _draw_contributions(axes: Any, explanation: Explanation) -> None:
    names = sorted(explanation.contributions, key=lambda name: explanation.contributions[name])
    values = [explanation.contributions[name] for name in names]
    colours = ["tab:red" if value < 0 else "tab:green" for value in values]
    axes.barh([name.replace("_", " ") for name in names], values, color=colours)
    axes.axvline(0, color="black", linewidth=0.8)
    axes.set(
        xlabel="log-odds", title=f"what speaks for it: {sum(values):+.1f} in all" if values else "nothing to judge"
    )
