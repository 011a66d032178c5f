"""The verdict about two views alone: without odometry, without memory."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from umf_ros.comparison.views import KeyframeSource, PlaceView
from umf_ros.core.config import Verification
from umf_ros.core.errors import SensorFileError, UmfError
from umf_ros.core.frames import Candidate, Keyframe, LoopClosure
from umf_ros.verification import Verdict, Verifier

NO_CALIBRATION = "no calibration: images alone give no pose without one"
NO_DEPTH = "no depth: images without a scan or a right image give no metric pose"


@dataclass(frozen=True, slots=True)
class Comparison:
    """What is known about two views.

    Attributes:
        reason: why they are not the same place, or "accepted".
        similarity: cosine similarity of the descriptors.
        probability: that the best pose is right; None without one.
        closure: `match_T_query` with its covariance, where they are the same place.
        milliseconds: that verification took; reading and embedding, which many pairs share, are not in it.
    """

    reason: str
    similarity: float
    probability: float | None = None
    closure: LoopClosure | None = None
    milliseconds: float = 0.0


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
        blind = verdict.closure is None and not any(_has_depth(keyframe) for keyframe in keyframes)
        return Comparison(
            reason=NO_DEPTH if blind else verdict.reason,
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


def judge(verifier: Verifier, match: Keyframe, query: Keyframe) -> Verdict:
    """The verdict about one pair of keyframes: the way between them and earlier pairs are left out."""
    match, query = (
        replace(keyframe, stamp_ns=stamp_ns, odom_T_body=None, path_length_m=float("nan"), session=0)
        for stamp_ns, keyframe in enumerate((match, query), 1)
    )
    verifier.reset()
    return verifier.verify(query, [(Candidate(0, match.stamp_ns, similarity_of(match, query)), match)])[0]


def similarity_of(match: Keyframe, query: Keyframe) -> float:
    """Cosine similarity of the descriptors."""
    return float(query.embedding.descriptor @ match.embedding.descriptor)


def _has_depth(keyframe: Keyframe) -> bool:
    image = keyframe.embedding.image
    return bool(len(keyframe.points)) or (image is not None and bool(np.isfinite(image.points).any()))
