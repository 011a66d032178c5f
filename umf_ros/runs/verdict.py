"""The most important sentence about a run, its colour, and whether the command that made it failed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from umf_ros.pose_graph.closures import State
from umf_ros.runs.findings import PENDING, ExaminedRun
from umf_ros.runs.inputs import Advice

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
