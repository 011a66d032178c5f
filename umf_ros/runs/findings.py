"""Findings about a run, worst first, and the verdict."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from math import inf, nan
from pathlib import Path
from typing import Literal

import numpy as np

from umf_ros.bags.inputs import SEVERITIES, Advice, Severity, absent_inputs, useless_inputs
from umf_ros.bags.reader import Bag
from umf_ros.core.config import Settings
from umf_ros.core.errors import UmfError, command_line
from umf_ros.pose_graph.closures import State
from umf_ros.runs.diagnosis import ClosureDiagnosis, explain
from umf_ros.runs.reader import FinishedRun
from umf_ros.runs.run_file import read_absolute_verdicts
from umf_ros.runs.truth import JudgedRun, in_words, judge_run
from umf_ros.runs.writer import is_unfinished, write_summary
from umf_ros.sensors.sensor_check import SENSORS, Overlay, SensorReport, describe_turn, find_contradictions

REFUSED = (
    *("size", "encoding", "step", "truncated", "compressed", "fields", "datatype", "unusable", "stamp"),
    *("camera_info", "transforms"),
)
"""Reasons for which a message is unusable by itself."""
MUCH_MISSED, MUCH_REJECTED, WELL_COVERED = 0.3, 0.2, 0.5
"""Shares, by hand: of revisits, of closures, of keyframes."""
REACH = "the odometry must reach the keyframes of the closures"
FEW_VIEWS, BIAS_PX = 5, 0.25
"""Least number of closures by images for a bias of the disparities, by hand, and least bias (*measured* on simulated
drives, 26201 to 26205: .09 px is found in right images, .34 and more in images that are off by half a pixel)."""
SLOW, SPARE = 1.0, 1.2
"""Recorded time over processing time, below which a rover outruns the detector; margin of the remedy, by hand."""
SHARES = 4
"""A match may be a quarter of the run back, and without odometry a quarter has as many keyframes: by hand."""
MOST_EXPLAINED = 200
"""Most missed revisits that are explained; more do not change the advice."""


def explain_missed(about: JudgedRun) -> list[ClosureDiagnosis]:
    """Return the diagnoses of missed revisits, `MOST_EXPLAINED` at most."""
    chosen = about.missed[:: max(1, len(about.missed) // MOST_EXPLAINED)]
    rows = [about.row(stamp) for stamp in chosen]
    return [explain(about, row) for row in rows if row is not None]


def _states(about: JudgedRun) -> Counter[str]:
    """Return the number of closures by their state in the graph."""
    return Counter(verdict.state for verdict in about.run.verdicts.values())


def _inputs(about: JudgedRun) -> Iterator[Advice]:
    odometry_from_file = bool(about.run.summary.get("odometry_file")) or about.run.odometry is not None
    if about.bag is not None:
        yield from absent_inputs(about.bag, about.run.settings, odometry_from_file)
    yield from useless_inputs(about.run.summary.get("inputs", {}), _recording(about))
    for text in about.run.summary.get("warnings", []):
        yield Advice("warning", text)


def _recording(about: JudgedRun) -> Path | None:
    """Return the path of the recording of a run, if it is known."""
    known = about.run.summary.get("recording", {}).get("path")
    return about.bag.path if about.bag is not None else known and Path(known)


def about_truth(about: JudgedRun) -> Iterator[Advice]:
    """Yield findings about the clock of the ground truth and its coverage."""
    run, (known, total) = about.run, about.covered
    if run.truth is None or not total:
        return
    if about.clock_offset_s:
        what = f"the ground truth's clock is {about.clock_offset_s:+.1f} s off that of the odometry, by the motion"
        yield Advice("fault", what, f"shift its stamps by {-about.clock_offset_s:+.1f} s; nothing was judged")
        return
    spans = [f"{stamps[0] * 1e-9:.1f} to {stamps[-1] * 1e-9:.1f} s" for stamps in (run.truth.stamps_ns, run.stamps)]
    if not known:
        off_s = (int(run.truth.stamps_ns[0]) - int(run.stamps[0])) * 1e-9
        clocks = f"{spans[0]} against {spans[1]}, {off_s:+.1f} s from start to start"
        what = f"the ground truth has another clock: it covers none of the {total} keyframes ({clocks})"
        yield Advice("fault", what, "shift its stamps to those of the sensors; nothing was judged")
    elif known < WELL_COVERED * total:
        what = f"the ground truth covers {known} of {total} keyframes ({spans[0]} against {spans[1]})"
        yield Advice("warning", what, "closures outside are not judged")


def judge(run: FinishedRun, bag: Bag | None = None, keep: bool = True) -> JudgedRun:
    """Judge the run by the truth, if there is one; `keep` writes the `ground_truth` entry into its summary.

    A truth that covers no part of a run that was judged before raises an `UmfError`.
    """
    judged = judge_run(run, bag)
    if run.truth is not None:
        covered, total = judged.covered
        if not covered and total and run.summary["ground_truth"]:
            fault = next(about_truth(judged)).what
            raise UmfError(f"{fault}; {run.folder} was judged before; nothing was written")
        run.summary["ground_truth"] = judged.summary() if covered or not total else None
    if keep:
        write_summary(run.folder, run.summary)
    return judged


def _pairs(about: JudgedRun) -> Iterator[Advice]:
    summary, settings = about.run.summary, about.run.settings
    usable = {
        name: one["received"] - sum(count for reason, count in one["dropped"].items() if reason in REFUSED)
        for name, one in summary.get("inputs", {}).items()
    }
    if summary["frames"] and not summary["pairs"] and usable.get("left") and usable.get("cloud"):
        what = f"none of {summary['frames']} scans has an image within {settings.sync.slop_s:g} s of it"
        yield Advice("fault", what, "the clocks of camera and LiDAR differ, or sync.slop_s is too small")
    if not summary["keyframes"]:
        what = f"none of {summary['frames']} frames became a keyframe"
        bag = _recording(about)
        remedy = "" if bag is None else f"contents of the recording: {command_line('inspect', bag)}"
        yield Advice("fault", what, remedy)


def _gaps(about: JudgedRun) -> Iterator[Advice]:
    count, rules = len(about.run.stamps), about.run.settings.loop
    if not count or about.run.summary.get("interrupted"):
        return
    if any(about.admissible(row).any() for row in range(count - 1, 0, -1)):
        return
    seconds = (int(about.run.stamps[-1]) - int(about.run.stamps[0])) * 1e-9
    metres = np.nanmax(about.run.keyframes["path_length_m"], initial=0.0)
    rule = f"a match must be {rules.min_time_gap_s:g} s older and {rules.min_travel_m:g} m back"
    what = f"the gap rules exclude every pair: {rule}, and the keyframes cover {seconds:.1f} s and {metres:.0f} m"
    yield Advice("fault", what, gap_remedy(seconds, float(metres), about.run.settings))


def gap_remedy(seconds: float, metres: float | None, settings: Settings) -> str:
    """Return settings with which a run of this duration has matches that the gap rules allow.

    Args:
        seconds: duration.
        metres: path length, 0 without odometry, None where it is unknown.
        settings: of the run.
    """
    changes = {"loop.min_time_gap_s": (settings.loop.min_time_gap_s, seconds / SHARES)}
    if metres == 0:
        # keyframes are selected by time, too
        for name in ("untracked_period_s", "min_period_s"):
            changes[f"keyframe.{name}"] = getattr(settings.keyframe, name), seconds / (SHARES * SHARES)
    else:
        changes["loop.min_travel_m"] = settings.loop.min_travel_m, metres / SHARES if metres else inf
    text = ", ".join(f"{name}: {new:.2g}" for name, (old, new) in changes.items() if new < old)
    if metres is None:
        text += ", loop.min_travel_m: a quarter of the path length"
    return text + (" (or supply odometry: --odometry FILE.tum)" if metres == 0 else "")


def _graph(about: JudgedRun) -> Iterator[Advice]:
    verdicts, states = about.run.verdicts.values(), _states(about)
    total, pending = states.total(), states[State.PENDING]
    if pending and not states[State.ACCEPTED]:
        reason = Counter(one.reason for one in verdicts if one.state != State.ACCEPTED).most_common(1)[0][0]
        what = f"all closures are pending: the graph used none of {total} ({reason})"
        what += ", so the optimised trajectory is the odometry"
        yield Advice("fault", what, f"{REACH}; pending is not rejected")
        return
    worse = "odometry worse than pose_graph.odometry_sigma_m and odometry_sigma_deg say, or wrong closures: click some"
    for state, remedy in ((State.REJECTED, worse), (State.REFUSED, REACH)):
        own = [one for one in verdicts if one.state == state]
        if len(own) > MUCH_REJECTED * total:
            reason = Counter(one.reason for one in own).most_common(1)[0][0]
            residuals = [one.residual for one in own]
            sigma = f", {np.nanmedian(residuals):.1f} sigma in the median" if remedy == worse else ""
            yield Advice("warning", f"the graph {state} {len(own)} of {total} closures ({reason}{sigma})", remedy)


def _absolute(about: JudgedRun) -> Iterator[Advice]:
    verdicts = read_absolute_verdicts(about.run.folder / "absolute_verdicts.csv")
    for source in sorted({one.source for one in verdicts}):
        own = [one for one in verdicts if one.source is source]
        left = Counter(one.reason for one in own if one.state is not State.ACCEPTED)
        why = f" ({left.most_common(1)[0][0]})" if left else ""
        accepted = len(own) - left.total()
        what = f"{source}: {accepted} of {len(own)} measurements accepted{why}"
        if accepted:
            yield Advice("note", what)
        else:
            yield Advice("warning", what, "docs/absolute.md explains each reason")


def _closures(about: JudgedRun) -> Iterator[Advice]:
    judged = about.closures
    if len(wrong := judged[~judged.is_true]):
        highest, worst_m = wrong.probability.max(), wrong.translation_error_m.max()
        kept = (judged.is_true & (judged.probability > highest)).sum()
        what = f"{len(wrong)} of {len(judged)} closures are false, the worst {worst_m:.1f} m off"
        remedy = f"verification.min_probability above {highest:.3f} would have kept {kept} true ones and no false one"
        yield Advice("fault", what, remedy)
    count, revisits = len(about.missed), about.revisits
    if count > MUCH_MISSED * revisits:
        whys = explain_missed(about)
        gate, number = Counter(why.gate for why in whys).most_common(1)[0]
        first = next(why for why in whys if why.gate == gate)
        at_s = (first.stamp_ns - int(about.run.stamps[0])) * 1e-9
        share = f"{number / len(whys):.0%} of them at the gate '{gate}'"
        what = f"{count} of {revisits} revisits are missed, {share} (at {at_s:.1f} s: {first.what})"
        severity: Severity = "fault" if count == revisits and not about.run.closures else "warning"
        yield Advice(severity, what, first.parameter or f"all of them: {command_line('why', about.run.folder)}")


def _unjudged(about: JudgedRun) -> Iterator[Advice]:
    """Report runs without closures and without a truth, which would show whether there were revisits."""
    run = about.run
    if run.closures or run.truth is not None or not run.candidates:
        return
    best = max(run.candidates, key=lambda one: one.probability or 0)
    at_s = (best.query_stamp_ns - int(run.stamps[0])) * 1e-9
    what = f"none of {len(run.candidates)} candidates became a closure; the best ({best.outcome}) is at {at_s:.1f} s"
    yield Advice("warning", what, f"its reasons: {command_line('why', run.folder, best.query_stamp_ns)}")


def _disparity(about: JudgedRun) -> Iterator[Advice]:
    names = ("disparity_bias_px", "disparity_bias_std_px")
    found = [[one.measurements.get(name, nan) for name in names] for one in about.run.candidates if one.accepted]
    biases_px, sigmas_px = np.array([one for one in found if one[1] > 0]).reshape(-1, 2).T
    if len(biases_px) < FEW_VIEWS:
        return
    # one pair knows little, for a bias looks the same from one place; all pairs of a run share it
    bias_px = np.average(biases_px, weights=sigmas_px**-2.0)
    scatter = max(1.0, float(np.mean(((biases_px - bias_px) / sigmas_px) ** 2)))
    if abs(bias_px) > max(BIAS_PX, SURE * float(np.sqrt(scatter / np.sum(sigmas_px**-2.0)))):
        more, less = ("too little", "far") if bias_px > 0 else ("too much", "near")
        what = f"stereo measures {abs(bias_px):.1f} px {more} disparity: distant features appear too {less}"
        yield Advice("warning", what, "rectification of the calibration, or R and P of both camera_info")


def _stated_errors(about: JudgedRun) -> Iterator[Advice]:
    truth = about.run.summary["ground_truth"] or {}
    median, inside = truth.get("nees_median"), truth.get("inside_95")
    words = "" if median is None or inside is None else in_words(median, inside)
    if words.startswith("too small"):
        remedy = "the calibration's mounting, the odometry within a scan, or the clock of the ground truth"
        yield Advice("warning", f"stated errors of the closures are {words}", remedy)


def _map(about: JudgedRun) -> Iterator[Advice]:
    before, after = about.ate_odometry_m, about.ate_optimized_m
    if before is not None and after is not None and after > 1.1 * before:
        what = f"the optimised trajectory is worse than the odometry: {after:.2f} m against {before:.2f} m"
        remedy = "colour the closures by the graph's verdict, look for wrong ones, check pose_graph.odometry_sigma_*"
        yield Advice("warning", what, remedy)


def _speed(about: JudgedRun) -> Iterator[Advice]:
    summary, now_m = about.run.summary, about.run.settings.keyframe.min_translation_m

    def fewer_keyframes(excess: float) -> str:
        return f"fewer keyframes: --set keyframe.min_translation_m={SPARE * excess * now_m:.2g} (now {now_m:g})"

    factor = summary.get("realtime_factor", SLOW)
    if dropped := summary["drops"].get("worker"):
        what = f"{dropped} frames were dropped because the machine was too slow"
        yield Advice("warning", what, fewer_keyframes(1 + dropped / max(summary["frames"], 1)))
    elif summary["keyframes"] and 0 < factor < SLOW:
        yield Advice("note", f"slower than the recording: {factor:.2f} of its speed", fewer_keyframes(1 / factor))


def _end(about: JudgedRun) -> Iterator[Advice]:
    if about.run.summary.get("interrupted"):
        what = "the run did not end: results cover the part before"
        bag = _recording(about)
        is_replay = bag is not None and is_unfinished(about.run.folder, bag)
        yield Advice("warning", what, f"continue it: {_again(about, bag)}" if is_replay else "")


def _again(about: JudgedRun, bag: Path | None) -> str:
    """Return the command that continues a replay, with the options that it was started with."""
    folder, made = about.run.folder, about.run.summary.get("odometry_file") or {}
    words = ["replay", bag, "--config", folder / "config.yaml", "--out", folder.parent, "--resume"]
    if "engine" in made:
        words += ["--odometry", made["engine"]]
    elif made:
        words += ["--odometry", made["path"], "--odometry-frame", made["frame"]]
    return command_line(*words)


BLANK, DIM = 3.0, 8.0
"""Grey values, by hand: largest standard deviations of an empty image, and of one with little contrast."""
FEW_RETURNS = 500
"""By hand: largest number of returns of a scan that is too sparse for place recognition."""
LAG_S = 0.1
"""By hand: least lag that is reported, twice the step of the search."""
FINE_DEG, FINE_SCALE, FINE_S = 0.5, 0.006, 0.01
"""Least errors by stereo that are reported (*measured* on simulated drives: those of right calibrations reach half)."""
SURE = 3.0
"""By hand: least standard deviations of an error by stereo that is reported."""
ACROSS = 0.5
"""By hand: least share of the motion along z for which the odometry is not that of the body."""


def about_sensors(seen: SensorReport) -> Iterator[Advice]:
    """Yield findings about exposure, returns, baseline, clocks and mountings."""
    yield from _measurements(seen)
    contradictions = find_contradictions(seen, impossible=False)
    is_rotated = any(one.subject == "odometry" for one in contradictions)
    if not is_rotated and seen.forward is not None and abs(seen.forward[2]) >= max(ACROSS, *np.abs(seen.forward[:2])):
        what = "the odometry is not that of the body: it moves along the body's z axis, which is up"
        remedy = "name the frame of the poses: --odometry-frame camera (z forward), imu or lidar"
        yield Advice("fault", what, remedy)
    lags = {name: one.lag_s for name in SENSORS if (one := getattr(seen, name)) is not None and one.lag_s is not None}
    by_motion = [*_clocks(lags), *(Advice("fault", one.what, one.remedy) for one in contradictions)]
    yield from by_motion
    if seen.overlay is not None:
        yield from _overlaid(seen.overlay, bool(by_motion))


def _overlaid(overlay: Overlay, is_known: bool) -> Iterator[Advice]:
    """Yield the largest error by its limit, as it causes apparent errors of the others; unless it `is_known`."""
    turn, scale, units = overlay.turn_deg, overlay.scale, np.array([FINE_DEG, FINE_SCALE, FINE_S])
    sizes = np.abs(np.array([float(np.linalg.norm(turn)), scale - 1, overlay.lag_s])) / units
    bounds, worst = SURE * overlay.deviations / units, int(sizes.argmax())
    seen = "by stereo and LiDAR on the same surfaces"
    if sizes[worst] <= max(bounds[worst], 1):
        pass
    elif worst == 1:
        what = f"stereo depth is {scale:.3g} times that of the LiDAR: the baseline is wrong by this factor"
        remedy = f"divide the baseline of the calibration, or P[3] of the right camera_info, by {scale:.3f}"
        yield Advice("fault", what, remedy)
    elif worst == 0 and not is_known:
        what = f"{seen}, the mounting is wrong: rotating the LiDAR by {describe_turn(turn)} corrects it"
        yield Advice("warning", what, "correct body_T_lidar or body_T_camera of the calibration")
    elif not is_known:
        what = f"{seen}, the LiDAR's clock is about {-overlay.lag_s:+.3f} s off the camera's"
        yield Advice("warning", what, "correct the stamps in the drivers (PTP, or a constant): no parameter does")
    for bound, name in zip(bounds, ("mounting to 1 deg", "baseline to 1 %", "clock to 20 ms"), strict=True):
        if bound > 2:
            what = f"the recording does not determine the {name}"
            yield Advice("note", what, "record a longer drive with turns past rocks")


def _measurements(seen: SensorReport) -> Iterator[Advice]:
    for name, contrast in (("left", seen.left_contrast), ("right", seen.right_contrast)):
        vary = f"the median standard deviation of grey values is {contrast:.1f}"
        if contrast < BLANK:
            remedy = f"check that the camera is not covered, and topics.{name}_image"
            yield Advice("fault", f"the {name} images are empty: {vary}", remedy)
        elif contrast < DIM:
            yield Advice("warning", f"the {name} images have little contrast: {vary}", "correct exposure and gain")
    if seen.returns < FEW_RETURNS:
        remedy = "a place needs some thousands: merge scans, or check min_intensity and max_height_m of the calibration"
        yield Advice("warning", f"scans have {seen.returns:.0f} returns in the median", remedy)
    if seen.intensity_max == 0:
        yield Advice("warning", "all intensities are 0, so the descriptor has none", "publish a field named intensity")


def _clocks(lags: dict[str, float]) -> Iterator[Advice]:
    off = {name: lag for name, lag in lags.items() if abs(lag) >= LAG_S}
    if off and len(lags) == 2 and abs(lags["lidar"] - lags["camera"]) < LAG_S:
        what = f"the odometry's clock is about {lags['lidar']:+.1f} s off those of camera and LiDAR"
        yield Advice("fault", what, "correct its stamps: frames take their poses from it")
        return
    for name, lag in off.items():
        what = f"the {SENSORS[name]}'s clock is about {-lag:+.1f} s off the odometry's, by its motion"
        yield Advice("fault", what, "correct the stamps in its driver (PTP, or a constant): no parameter does")


_CAUSES = (about_truth, _gaps, _inputs, _pairs, lambda about: about_sensors(about.sensors), _disparity)
_EFFECTS = (_graph, _absolute, _closures, _unjudged, _map, _stated_errors, _speed, _end)


def look_first(about: JudgedRun) -> list[Advice]:
    """Return every finding: causes before their effects, the worst of each kind first, and notes at the end."""
    kinds = [[finding for rule in rules for finding in rule(about)] for rules in (_CAUSES, _EFFECTS)]
    worst_first = [one for found in kinds for one in sorted(found, key=lambda one: SEVERITIES.index(one.severity))]
    return sorted(worst_first, key=lambda one: one.severity == "note")


Mark = Literal["good", "warn", "bad"]
USELESS = 3
"""Exit status of a complete run whose inputs could not give any result."""


@dataclass(frozen=True, slots=True)
class RunVerdict:
    """Sentence for the user, its mark in the style sheet, and the exit status of the command."""

    sentence: str
    mark: Mark
    exit_code: int = 0


def conclude(about: JudgedRun, findings: list[Advice]) -> RunVerdict:
    """Return the verdict: green only with a closure found, or without any revisit."""
    sentence = ", ".join(filter(None, (_found(about), _used(about)))) + _errors(about) + "."
    closed, warnings = bool(about.run.closures), [finding for finding in findings if finding.severity != "note"]
    first = f"{_capital(warnings[0].what)}. " if warnings else ""
    if any(finding.severity == "fault" for finding in warnings):
        return RunVerdict(first + sentence, "bad", 0 if closed else USELESS)
    if not closed and about.covered[0] and not about.any_heading[0]:
        return RunVerdict(f"No place was revisited. {sentence}", "warn" if warnings else "good")
    return RunVerdict(first + sentence, "good" if closed and not warnings else "warn")


def _found(about: JudgedRun) -> str:
    if about.run.truth is None or (about.covered[1] and not about.covered[0]):
        reason = "there is no ground truth" if about.run.truth is None else "no ground truth for this time"
        return f"{len(about.run.closures)} loop closures; {reason} to judge them by"
    true = int(about.closures.is_true.sum())
    return f"{true} true and {len(about.closures) - true} false loop closures at {about.any_heading[0]} revisits"


def _used(about: JudgedRun) -> str:
    """Return the number of closures that the graph used, and the states of the others."""
    states = _states(about)
    total, accepted, pending = states.total(), states[State.ACCEPTED], states[State.PENDING]
    if not total:
        return ""
    others = (pending, "pending"), (total - accepted - pending, "rejected")
    rest = [f"{count} {word}" for count, word in others if count]
    used = "all of them" if accepted == total else f"{accepted or 'none'} of them"
    return f"the graph used {used}" + (f" ({', '.join(rest)})" if rest else "")


def _errors(about: JudgedRun) -> str:
    before, after = about.ate_odometry_m, about.ate_optimized_m
    if before is None or after is None:
        return ""
    return f"; trajectory error (ATE, rigidly aligned) {before:.2f} m by odometry, {after:.2f} m optimised"


def _capital(text: str) -> str:
    is_name = not text.split(" ", 1)[0].isalpha()  # of a parameter or a file
    return text if is_name else text[:1].upper() + text[1:]
