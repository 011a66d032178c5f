"""Findings about a run, worst first, and the verdict that they add up to."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from umf_ros.bags.reader import Bag
from umf_ros.core.config import Settings
from umf_ros.core.keyframes import gap_remedy
from umf_ros.pose_graph.closures import State
from umf_ros.runs.diagnosis import ClosureDiagnosis, GateDiagnosis
from umf_ros.runs.reader import Advice, FinishedRun, absent_inputs, useless_inputs
from umf_ros.runs.sensor_check import Disagreement, SensorReport
from umf_ros.runs.truth import JudgedRun, TruePlaces, in_words

BLANK, DIM = 3.0, 8.0
"""Grey values, by hand: standard deviations of an image that shows nothing, and next to nothing."""
FEW_RETURNS = 500
"""Of a scan, by hand: a place takes more to be told by."""
LAG_S = 0.1
"""By hand: twice the step that lags are tried in."""
MOUNTING_DEG = 6.0
"""Measured on simulated drives: right mountings come out within 3.3 deg, the worst about the vertical."""
SCALE = 0.08
"""Measured on simulated drives: a right baseline comes out within 1 %."""
SAME_DEG = 5.0
"""By hand: two sensors that differ from the odometry alike: it is the odometry."""
REFUSED = ("size", "encoding", "step", "truncated", "compressed", "fields", "datatype", "unusable", "stamp")
"""Reasons why a message is of no use by itself, whatever the others are."""
ACROSS = 0.5
"""Of the way, by hand: a body drives along its x, or its y where it can."""


def about_sensors(seen: SensorReport, settings: Settings) -> Iterator[Advice]:
    """Findings about light, returns, baseline, clocks and mountings."""
    yield from _images(seen)
    yield from _scans(seen)
    yield from _odometry_frame(seen)
    yield from _clocks(seen)
    yield from _mountings(seen)
    yield from _baseline(seen)


def _images(seen: SensorReport) -> Iterator[Advice]:
    for name, contrast in (("left", seen.left_contrast), ("right", seen.right_contrast)):
        if contrast < BLANK:
            yield Advice(
                "fault",
                f"the {name} images are empty: their grey values vary by {contrast:.1f} in the median",
                "is the camera covered, or the topic another one's? topics." + name + "_image",
            )
        elif contrast < DIM:
            yield Advice(
                "warning",
                f"the {name} images show little: their grey values vary by {contrast:.1f} in the median",
                "exposure and gain of the camera",
            )


def _scans(seen: SensorReport) -> Iterator[Advice]:
    if seen.returns < FEW_RETURNS:
        yield Advice(
            "warning",
            f"scans have {seen.returns:.0f} returns in the median",
            "places take a few thousand: merge scans, or see min_intensity and max_height_m of the calibration",
        )
    if seen.intensity_max == 0:
        yield Advice("warning", "all intensities are 0: the descriptor does without them", "a field named intensity")


def _odometry_frame(seen: SensorReport) -> Iterator[Advice]:
    if seen.forward is None or abs(seen.forward[2]) < ACROSS or abs(seen.forward[2]) < np.abs(seen.forward[:2]).max():
        return
    yield Advice(
        "fault",
        "the odometry is not of the body: by its poses the way goes along the body's z axis, and z is up",
        "--odometry-frame camera, imu or lidar says whose poses the file holds (of the camera z looks ahead)",
    )


def _clocks(seen: SensorReport) -> Iterator[Advice]:
    lags = {name: one.lag_s for name, one in _known(seen).items()}
    if not lags or max(map(abs, lags.values())) < LAG_S:
        return
    if len(lags) == 2 and abs(lags["lidar"] - lags["camera"]) < LAG_S:
        what = f"the odometry's clock is about {lags['lidar']:+.1f} s off those of camera and LiDAR"
        yield Advice("fault", what, "correct its stamps: closures and scans are placed by it")
        return
    for name, lag in lags.items():
        if abs(lag) >= LAG_S:
            sensor = {"lidar": "LiDAR", "camera": "camera"}[name]
            cure = "the stamps of its driver (PTP, or a constant): no parameter corrects them"
            yield Advice(
                "fault", f"the {sensor}'s clock is about {-lag:+.1f} s off the odometry's, by its motion", cure
            )


def _mountings(seen: SensorReport) -> Iterator[Advice]:
    known = {name: one.mounting_deg for name, one in _known(seen).items() if one.mounting_deg is not None}
    off = {name: turn for name, turn in known.items() if np.linalg.norm(turn) > MOUNTING_DEG}
    if len(off) == 2 and np.linalg.norm(off["lidar"] - off["camera"]) < SAME_DEG:
        yield Advice(
            "fault",
            f"the odometry is not of the body frame: camera and LiDAR both say it is turned by {_turn(off['lidar'])}",
            "--odometry-frame camera, imu or lidar says whose poses the file holds; a topic must be of the body",
        )
        return
    for name, turn in off.items():
        sensor = {"lidar": "LiDAR", "camera": "camera"}[name]
        yield Advice(
            "fault",
            f"the {sensor}'s mounting is off by {_turn(turn)}: so its motion says, held against the odometry's",
            f"body_T_{name} of the calibration",
        )


def _baseline(seen: SensorReport) -> Iterator[Advice]:
    if abs(seen.stereo_scale - 1) > SCALE:
        yield Advice(
            "fault",
            f"stereo sees everything {seen.stereo_scale:.2f} times as far as the LiDAR: the baseline is wrong by that "
            "factor",
            f"baseline of the calibration, or P[3] of the right camera_info: divide by {seen.stereo_scale:.3f}",
        )


def _known(seen: SensorReport) -> dict[str, Disagreement]:
    return {name: one for name, one in (("lidar", seen.lidar), ("camera", seen.camera)) if one is not None}


def _turn(mounting_deg: np.ndarray) -> str:
    """As "10 deg about y"."""
    axis = int(np.abs(mounting_deg).argmax())
    return f"{np.linalg.norm(mounting_deg):.0f} deg, mostly about {'xyz'[axis]} ({mounting_deg[axis]:+.0f} deg)"


PENDING = (State.PENDING,)
MUCH_MISSED, MUCH_REJECTED, WELL_COVERED = 0.3, 0.2, 0.5
"""Shares, by hand: of revisits, of closures, of keyframes."""
SLOW = 1.0
"""Recorded time by the time it took, below which a rover runs ahead of the detector."""
MOST_EXPLAINED = 200
"""Missed revisits that are looked into; more change no advice."""


@dataclass(frozen=True)
class ExaminedRun:
    """A run with all that is known about it.

    Attributes:
        run: what it left.
        judged: what the truth says.
        bag: the recording, or None.
        sensors: what the recording's measurements say of each other.
        odometry_from_file: whether the odometry was not the recording's.
    """

    run: FinishedRun
    judged: JudgedRun
    places: TruePlaces
    gates: GateDiagnosis
    bag: Bag | None = None
    sensors: SensorReport = field(default_factory=SensorReport)

    @property
    def odometry_from_file(self) -> bool:
        """Whether the odometry came from a file."""
        return bool(self.run.summary.get("odometry_file")) or self.run.odometry is not None

    def states(self) -> Counter[str]:
        """How many closures the graph left in which state."""
        return Counter(verdict.state for verdict in self.run.verdicts.values())

    def missed(self) -> list[ClosureDiagnosis]:
        """Why each missed revisit was missed."""
        chosen = self.judged.missed[:: max(1, len(self.judged.missed) // MOST_EXPLAINED)]
        rows = [self.places.row(stamp) for stamp in chosen]
        return [self.gates.explain(row) for row in rows if row is not None]


def look_first(about: ExaminedRun) -> list[Advice]:
    """Every finding: causes before what they bring about, of either kind the worst first, and notes at the end."""
    found: list[Advice] = []
    for rules in (_CAUSES, _EFFECTS):
        mine = [finding for rule in rules for finding in rule(about)]
        found += [
            finding for severity in ("fault", "warning", "note") for finding in mine if finding.severity == severity
        ]
    return sorted(found, key=lambda finding: finding.severity == "note")


def _inputs(about: ExaminedRun) -> Iterator[Advice]:
    if about.bag is not None:
        yield from absent_inputs(about.bag, about.run.settings, about.odometry_from_file)
    yield from useless_inputs(about.run.summary.get("inputs", {}))
    for text in about.run.summary.get("warnings", []):
        yield Advice("warning", text)


def _sensors(about: ExaminedRun) -> Iterator[Advice]:
    yield from about_sensors(about.sensors, about.run.settings)


def _truth(about: ExaminedRun) -> Iterator[Advice]:
    run, (known, total) = about.run, about.judged.covered
    if run.truth is None or not total:
        return
    spans = [f"{stamps[0] * 1e-9:.1f} to {stamps[-1] * 1e-9:.1f} s" for stamps in (run.truth.stamps_ns, run.stamps)]
    if not known:
        off_s = (int(run.truth.stamps_ns[0]) - int(run.stamps[0])) * 1e-9
        yield Advice(
            "fault",
            f"the ground truth is of another clock: it covers none of the {total} keyframes ({spans[0]} against "
            f"{spans[1]}, {off_s:+.1f} s from start to start)",
            "shift its stamps to those of the sensors; nothing was judged",
        )
    elif known < WELL_COVERED * total:
        what = f"the ground truth covers {known} of {total} keyframes ({spans[0]} against {spans[1]})"
        yield Advice("warning", what, "closures outside of it are not judged")


def _pairs(about: ExaminedRun) -> Iterator[Advice]:
    summary, settings = about.run.summary, about.run.settings
    usable = {
        name: one["received"] - sum(count for reason, count in one["dropped"].items() if reason in REFUSED)
        for name, one in summary.get("inputs", {}).items()
    }
    if summary["frames"] and not summary["pairs"] and usable.get("left") and usable.get("cloud"):
        yield Advice(
            "fault",
            f"none of {summary['frames']} scans has an image within {settings.sync.slop_s:g} s of it",
            "the clocks of camera and LiDAR differ, or sync.slop_s is too small",
        )
    if not summary["keyframes"]:
        yield Advice(
            "fault", f"no keyframe came of {summary['frames']} frames", "umf inspect says what the recording holds"
        )


def _gaps(about: ExaminedRun) -> Iterator[Advice]:
    count, rules = len(about.places.stamps), about.run.settings.loop
    if (
        not count
        or about.run.summary.get("interrupted")
        or any(about.places.admissible(row).any() for row in range(count - 1, 0, -1))
    ):
        return
    seconds = (int(about.places.stamps[-1]) - int(about.places.stamps[0])) * 1e-9
    metres = np.nanmax([row.path_length_m for row in about.run.keyframes] + [0.0])
    yield Advice(
        "fault",
        f"the gap rules exclude every pair: a match must be {rules.min_time_gap_s:g} s older and "
        f"{rules.min_travel_m:g} m back, and the run lasts {seconds:.0f} s and {metres:.0f} m",
        gap_remedy(seconds, float(metres), about.run.settings),
    )


def _graph(about: ExaminedRun) -> Iterator[Advice]:
    run, states = about.run, about.states()
    if not run.verdicts or not (total := sum(states.values())):
        return
    pending, rejected = sum(states[state] for state in PENDING), states[State.REJECTED] + states[State.REFUSED]
    reasons = Counter(one.reason for one in run.verdicts.values() if one.state != State.ACCEPTED)
    commonest = reasons.most_common(1)[0][0] if reasons else ""
    if pending and not states[State.ACCEPTED]:
        yield Advice(
            "fault",
            f"all closures are pending: the graph used none of {total} ({commonest}), so the optimised trajectory is "
            "the odometry",
            "the odometry must reach the keyframes of the closures; pending is not rejected",
        )
    elif rejected > MUCH_REJECTED * total:
        sigma = np.nanmedian([one.sigma for one in run.verdicts.values() if one.state == State.REJECTED] or [np.nan])
        yield Advice(
            "warning",
            f"the graph rejected {rejected} of {total} closures ({commonest}, {sigma:.1f} sigma in the median)",
            "odometry worse than pose_graph.odometry_sigma_m and odometry_sigma_deg say, or wrong closures: click some",
        )


def _closures(about: ExaminedRun) -> Iterator[Advice]:
    wrong = [one for one in about.judged.closures if not one.is_true]
    if wrong:
        highest = max(one.closure.probability for one in wrong)
        kept = sum(one.is_true and one.closure.probability > highest for one in about.judged.closures)
        worst = max(wrong, key=lambda one: one.translation_error_m)
        yield Advice(
            "fault",
            f"{len(wrong)} of {len(about.judged.closures)} closures are false, the worst "
            f"{worst.translation_error_m:.1f} m off",
            f"verification.min_probability above {highest:.3f} would have kept {kept} true ones and no false one",
        )
    count = len(about.judged.missed)
    if count and count > MUCH_MISSED * about.judged.revisits:
        whys = about.missed()
        gate, number = Counter(why.gate for why in whys).most_common(1)[0]
        first = next(why for why in whys if why.gate == gate)
        everything = count == about.judged.revisits
        yield Advice(
            "fault" if everything and not about.run.closures else "warning",
            f"{count} of {about.judged.revisits} revisits are missed, {number / len(whys):.0%} of them at the gate "
            f"'{gate}' (at {(first.stamp_ns - int(about.places.stamps[0])) * 1e-9:.1f} s: {first.what})",
            first.parameter or "umf why RUN STAMP says it of each",
        )


def _untrue(about: ExaminedRun) -> Iterator[Advice]:
    """Where no truth tells what was missed: nothing found among what was tested."""
    run = about.run
    if run.closures or run.truth is not None or not run.candidates:
        return
    best = max(run.candidates, key=lambda one: one.probability or 0)
    yield Advice(
        "warning",
        f"none of {len(run.candidates)} candidates became a closure; the best ({best.outcome}) is at "
        f"{(best.query_stamp_ns - int(run.stamps[0])) * 1e-9:.1f} s",
        f"umf why {run.folder.name} {best.query_stamp_ns}",
    )


def _honest(about: ExaminedRun) -> Iterator[Advice]:
    truth = about.run.summary["ground_truth"] or {}
    median, inside = truth.get("nees_median"), truth.get("inside_95")
    if median is None or inside is None:
        return
    words = in_words(median, inside)
    if words.startswith("too small"):
        yield Advice(
            "warning",
            f"stated errors of the closures are {words}",
            "the calibration's mounting or the odometry within a scan; verification.odometry_drift",
        )


def _map(about: ExaminedRun) -> Iterator[Advice]:
    before, after = about.judged.ate_odometry_m, about.judged.ate_optimized_m
    if before is not None and after is not None and after > 1.1 * before:
        yield Advice(
            "warning",
            f"the optimised trajectory is worse than the odometry: {after:.2f} m against {before:.2f} m",
            "colour the closures by the graph's verdict; wrong ones pull, pose_graph.odometry_sigma_* weigh",
        )


def _speed(about: ExaminedRun) -> Iterator[Advice]:
    summary = about.run.summary
    if summary["drops"].get("worker"):
        what = f"{summary['drops']['worker']} frames were dropped because the machine was late"
        yield Advice("warning", what, "verification.refine_best and loop.top_k cost the most, keyframe.* how often")
    factor = summary.get("realtime_factor", SLOW)
    if summary["keyframes"] and 0 < factor < SLOW:
        yield Advice(
            "note",
            f"slower than the recording: {factor:.2f} of its speed",
            "verification.refine_best and loop.top_k cost the most, keyframe.min_translation_m how often",
        )


def _end(about: ExaminedRun) -> Iterator[Advice]:
    if about.run.summary.get("interrupted"):
        yield Advice("note", "the run was interrupted: it covers what was done until then")


Rule = Callable[[ExaminedRun], Iterator[Advice]]
_CAUSES: tuple[Rule, ...] = (_truth, _gaps, _sensors, _pairs, _inputs)
_EFFECTS: tuple[Rule, ...] = (_graph, _closures, _untrue, _map, _honest, _speed, _end)


Mark = Literal["good", "warn", "bad"]
USELESS = 3
"""Exit status of a run that ended well on inputs that could not give anything."""


@dataclass(frozen=True, slots=True)
class RunVerdict:
    """Attributes: sentence: for a person; mark: its class in the style sheet; exit_code: of the command."""

    sentence: str
    mark: Mark
    exit_code: int = 0


def conclude(about: ExaminedRun, findings: list[Advice]) -> RunVerdict:
    """Green only when something was found, or when there was nothing to find."""
    sentence = ", ".join(filter(None, (_found(about), _used(about)))) + _errors(about) + "."
    warnings = [finding for finding in findings if finding.severity != "note"]
    if any(finding.severity == "fault" for finding in warnings):
        return RunVerdict(f"{_capital(warnings[0].what)}. {sentence}", "bad", 0 if about.run.closures else USELESS)
    if about.run.closures and not warnings:
        return RunVerdict(sentence, "good")
    nothing_to_find = about.judged.covered[0] and not about.judged.revisits
    if not about.run.closures and nothing_to_find:
        return RunVerdict(f"No place was seen twice. {sentence}", "good" if not warnings else "warn")
    if warnings:
        return RunVerdict(f"{_capital(warnings[0].what)}. {sentence}", "warn")
    return RunVerdict(sentence, "warn")


def _found(about: ExaminedRun) -> str:
    judged, count = about.judged, len(about.run.closures)
    if about.run.truth is None or (judged.covered[1] and not judged.covered[0]):
        reason = "there is no ground truth" if about.run.truth is None else "no ground truth of this time"
        return f"{count} loop closures; {reason} to judge them by"
    true = sum(one.is_true for one in judged.closures)
    return f"{true} true and {len(judged.closures) - true} false loop closures at {judged.revisits} revisits"


def _used(about: ExaminedRun) -> str:
    """What the graph made of them: pending is not rejected."""
    states = about.states()
    total = sum(states.values())
    if not total:
        return ""
    accepted, pending = states[State.ACCEPTED], sum(states[state] for state in PENDING)
    rejected = total - accepted - pending
    rest = [f"{number} {word}" for number, word in ((pending, "pending"), (rejected, "rejected")) if number]
    used = "all of them" if accepted == total else f"{accepted or 'none'} of them"
    return f"the graph used {used}" + (f" ({', '.join(rest)})" if rest else "")


def _errors(about: ExaminedRun) -> str:
    before, after = about.judged.ate_odometry_m, about.judged.ate_optimized_m
    if before is None or after is None:
        return ""
    return f"; trajectory error {before:.2f} m by odometry, {after:.2f} m optimised"


def _capital(text: str) -> str:
    if "_" in text.split(" ", 1)[0]:  # the name of a parameter
        return text
    return text[:1].upper() + text[1:]
