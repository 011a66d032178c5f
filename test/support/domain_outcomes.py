"""Decisions on the pairs of a domain, counted."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from umf_ros.core.frames import LoopClosure
from umf_ros.core.geometry import Array
from umf_ros.lab.simulation.domains.pairs import ELSEWHERE, SAME, TURNED, ScanPair, is_wrong
from umf_ros.runs.truth import normalised_errors, pose_error, share_inside


@dataclass
class Outcome:
    """Decisions on one domain's pairs; `left_out`: those of a model that was fitted without the domain."""

    name: str
    pairs: dict[str, int] = field(default_factory=lambda: dict.fromkeys((SAME, TURNED, ELSEWHERE), 0))
    right: dict[str, int] = field(default_factory=lambda: dict.fromkeys((SAME, TURNED, ELSEWHERE), 0))
    wrong: dict[str, int] = field(default_factory=lambda: dict.fromkeys((SAME, TURNED, ELSEWHERE), 0))
    errors: list[Array] = field(default_factory=list)
    covariances: list[Array] = field(default_factory=list)
    verify_ms: list[float] = field(default_factory=list)
    by_submaps: int = 0
    left_out: Outcome | None = None

    def judge(self, pair: ScanPair, closure: LoopClosure | None, by_submaps: bool = False) -> None:
        """Count one verdict."""
        self.pairs[pair.kind] += 1
        if closure is None:
            return
        self.by_submaps += by_submaps
        elsewhere = pair.query.world != pair.match.world  # within one world, distant places may well share a view
        if elsewhere or is_wrong(closure.match_T_query, pair.match_T_query):
            self.wrong[pair.kind] += 1
            return
        self.right[pair.kind] += 1
        self.errors.append(pose_error(closure.match_T_query, pair.match_T_query))
        self.covariances.append(closure.covariance)

    def share(self, kind: str) -> float:
        """Share of the pairs of a kind that were rightly accepted."""
        return self.right[kind] / self.pairs[kind] if self.pairs[kind] else float("nan")

    @property
    def figures(self) -> dict[str, Any]:
        """The domain's own figures."""
        errors, covariances = np.array(self.errors), np.array(self.covariances)
        inside = share_inside(normalised_errors(errors, covariances)) if self.errors else float("nan")
        return {
            "pairs": sum(self.pairs.values()),
            "accepted": sum(self.right.values()) + sum(self.wrong.values()),
            "wrong": sum(self.wrong.values()),
            "wrong_elsewhere": self.wrong[ELSEWHERE],
            "wrong_left_out": sum(self.left_out.wrong.values()) if self.left_out else 0,
            "recall_left_out": self.left_out.share(SAME) if self.left_out else float("nan"),
            "recall": self.share(SAME),
            "turned_recall": self.share(TURNED),
            "inside_95": inside,
            "by_submaps": self.by_submaps,
            "verify_ms": float(np.median(self.verify_ms)) if self.verify_ms else float("nan"),
        }


def summary(outcomes: list[Outcome]) -> dict[str, float]:
    """The figures over all domains; means and worst are of the domains, whatever their size."""
    recall = [outcome.share(SAME) for outcome in outcomes]
    inside = [outcome.figures["inside_95"] for outcome in outcomes]
    turned = [sum(outcome.right[TURNED] for outcome in outcomes), sum(outcome.pairs[TURNED] for outcome in outcomes)]
    known = [value for value in inside if np.isfinite(value)]
    return {
        "accepted": sum(outcome.figures["accepted"] for outcome in outcomes),
        "wrong": sum(outcome.figures["wrong"] for outcome in outcomes),
        "wrong_left_out": sum(outcome.figures["wrong_left_out"] for outcome in outcomes),
        "recall_mean": float(np.mean(recall)),
        "recall_worst": float(np.min(recall)),
        "inside_95_mean": float(np.mean(known)) if known else float("nan"),
        "inside_95_worst": float(np.min(known)) if known else float("nan"),
        "turned_recall": turned[0] / max(turned[1], 1),
        "verify_ms": float(np.median(np.concatenate([outcome.verify_ms for outcome in outcomes]))),
    }
