"""What to look at first: everything about a run that a person should know, the worst first, each with what helps."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np

from umf_ros.bags.reader import Bag
from umf_ros.pose_graph.closures import State
from umf_ros.runs import sensor_findings
from umf_ros.runs.consistency import in_words
from umf_ros.runs.finished_run import FinishedRun
from umf_ros.runs.inputs import Advice, absent_inputs, useless_inputs
from umf_ros.runs.sensor_check import SensorReport
from umf_ros.runs.true_places import TruePlaces
from umf_ros.runs.truth import JudgedRun
from umf_ros.runs.why import ClosureDiagnosis, GateDiagnosis

PENDING = (State.UNDECIDED, State.WAITING)
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
    yield from sensor_findings.about_sensors(about.sensors, about.run.settings)


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
    received = {name: one["received"] for name, one in summary.get("inputs", {}).items()}
    if summary["frames"] and not summary["pairs"] and received.get("left") and received.get("cloud"):
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
        "loop.min_time_gap_s and loop.min_travel_m",
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
        f"none of {len(run.candidates)} candidates became a closure; the best ({best.reason}) is at "
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
