"""Two views of a place, each pair on its own, compared, listed and drawn."""

from __future__ import annotations

import csv
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from umf_ros.core.config import Verification
from umf_ros.core.errors import ConfigError, UmfError, writing
from umf_ros.core.frames import Candidate, Image, Keyframe, LoopClosure, Points
from umf_ros.core.geometry import transform
from umf_ros.lab.evaluation.place_views import PlaceView, Seen, ViewReader, split_reference
from umf_ros.lab.scan_files import SensorFileError
from umf_ros.runs.run_file import pose_numbers
from umf_ros.verification import Hypothesis, RejectReason, Verifier
from umf_ros.verification import constants as const
from umf_ros.verification.acceptance import load_acceptance
from umf_ros.verification.pose_search import consistent_pixels

NO_CALIBRATION = "no calibration: images alone give no pose without one"
NO_DEPTH = "no depth: images without a scan or a right image give no metric pose"
VIEW_COLUMNS = ("match_scan", "query_scan", "match_left", "match_right", "query_left", "query_right")
POSE = ("x", "y", "z", "qx", "qy", "qz", "qw")
SIGMA = ("sigma_x", "sigma_y", "sigma_z", "sigma_rx", "sigma_ry", "sigma_rz")
RESULT_COLUMNS = ("accepted", "probability", *POSE, *SIGMA, "reason", "milliseconds", "similarity")
"""`match_T_query` in m, its standard deviations in m and rad about the axes of the match body."""

Pair = tuple[PlaceView, PlaceView]
Row = dict[str, Any]


class Comparer:
    """Compares views, each pair on its own.

    Args:
        views: reads them.
        settings: the verification group of the settings.

    Raises:
        ConfigError: the acceptance model cannot be read.
    """

    def __init__(self, views: ViewReader, settings: Verification) -> None:
        self._views, self._verifier = views, Verifier(settings)

    def compare(self, match: PlaceView, query: PlaceView) -> Row:
        """Compare two views, and submaps where the scans give no certain pose; return the values of `RESULT_COLUMNS`.

        Raises:
            UmfError: one of them cannot be read; says which.
        """
        (their_scan, their_submap), (our_scan, our_submap) = self._read("match", match), self._read("query", query)
        keyframes = their_scan, our_scan
        similarity = similarity_of(*keyframes)
        if not self._views.calibrated and not (match.scan and query.scan):
            return result_row(NO_CALIBRATION, similarity, 0.0)
        verdict = judge(self._verifier, *keyframes)
        elapsed_ms = sum(self._verifier.latency_ms.values())
        merged = their_submap or their_scan, our_submap or our_scan
        submaps = (their_submap or our_submap) is not None and not _share_scans(match, query, *merged)
        if submaps and (verdict.closure is None or verdict.doubtful):
            verdict = judge(self._verifier, *merged)
            elapsed_ms += sum(self._verifier.latency_ms.values())
        blind = verdict.closure is None and not any(keyframe.has_depth for keyframe in keyframes)
        reason = NO_DEPTH if blind else verdict.outcome
        return result_row(reason, similarity, elapsed_ms, verdict.probability, verdict.closure)

    def _read(self, role: str, view: PlaceView) -> Seen:
        try:
            return self._views.load(view)
        except UmfError as error:
            raise SensorFileError(f"{role}: {error}") from None


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
            known = any(keyframe.has_depth for keyframe in (self.query, self.match))
            return f"rejected: {RejectReason.NO_POSE.value if known else NO_DEPTH}"
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

    has_scans = any(len(one.points) for one in (explanation.query, explanation.match))
    has_images = any(image is not None for image in (query_image, match_image))
    is_judged = bool(explanation.contributions)
    rows = has_images + (has_scans or is_judged) or 1
    figure = Figure(figsize=(15, 0.8 + 5.1 * rows), layout="constrained")
    parts = figure.add_gridspec(rows, 1)
    if has_images:
        _draw_images(figure.add_subplot(parts[0]), explanation, query_image, match_image)
    below = parts[-1].subgridspec(1, max(2 * has_scans + is_judged, 1))
    if has_scans:
        _draw_scans(figure.add_subplot(below[0]), explanation, 1, "left [m]", "from above")
        _draw_scans(figure.add_subplot(below[1]), explanation, 2, "up [m]", "from the side")
    if is_judged:
        _draw_contributions(figure.add_subplot(below[-1]), explanation)
    stamps = f"query {explanation.query.stamp_ns}   match {explanation.match.stamp_ns}"
    figure.suptitle(f"{explanation.verdict}\n{stamps}", fontsize=14)
    with writing(path, ValueError):
        figure.savefig(path, dpi=100, format=path.suffix[1:] or "png")  # the name as it is


def _draw_images(axes: Any, explanation: Explanation, query: Image | None, match: Image | None) -> None:
    camera = explanation.query.camera
    blank = np.zeros((camera.height, camera.width), np.uint8)
    left, right = (blank if image is None else image for image in (query, match))
    axes.imshow(np.hstack([left, right]), cmap="gray", vmin=0, vmax=255)
    shown = explanation.pixels[:: max(1, len(explanation.pixels) // MOST_LINES)]
    for u, v, match_u, match_v in shown:
        axes.plot([u, match_u + left.shape[1]], [v, match_v], color="limegreen", linewidth=0.7, alpha=0.8)
    agreeing = f": {len(shown)} image features that agree with the pose" if len(shown) else ""
    axes.set_title(f"query | match{agreeing}")
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
    axes.set(xlabel="log-odds", title=f"what speaks for it: {sum(values):+.1f} in all")
