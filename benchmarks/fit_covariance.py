"""Fit the covariance of scans to recordings, through the whole pipeline, and to the domains.

python benchmarks/fit_covariance.py BAG... [--folder FOLDER] [--kept FOLDER] [--leave-out] [--out FILE]

The recordings have a ground truth with orientations; `umf simulate` makes them, of validation seeds. Of the model's
file only the covariance of scans is written; what is accepted does not depend on it. A recording takes as long as
`umf replay`; with `--kept` what was found is kept for the next fit.
"""

from __future__ import annotations

import json
import pickle
from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from domain_pairs import QUICK, SAME, TURNED, pairs_of, places_of
from rich.console import Console

from umf_ros.bags.frames import FrameReader
from umf_ros.bags.presets import settings_for
from umf_ros.bags.reader import open_bag
from umf_ros.bags.trajectories import read_ground_truth
from umf_ros.core.config import EmbeddingSettings
from umf_ros.core.errors import BagError
from umf_ros.core.frames import Keyframe
from umf_ros.core.geometry import Array, relative, rotation_angle
from umf_ros.detector import LoopDetector, make_detector_embedder
from umf_ros.embedding import make_embedder
from umf_ros.lab.fit.covariance import PoseSample, fit_scan_covariance, honesty, sample_of
from umf_ros.lab.simulation.domains import DOMAINS, Domain
from umf_ros.lab.simulation.world import VALIDATION
from umf_ros.verification.measurement import SCAN
from umf_ros.verification.prepared_scan import PreparedScan
from umf_ros.verification.scan_alignment import align_scans

RIGHT_M, RIGHT_DEG = 1.0, 5.0
NEAR_M = 0.1  # from so far the domains' pairs are aligned: it is the covariance that is fitted, not the search
WEIGHT = 3.0  # of a recording against a domain: it has all that a rover meets
DEFAULT_OUT = Path(__file__).parent.parent / "config" / "verification" / "calibration.json"
Groups = dict[str, list[PoseSample]]


def main(
    bags: Annotated[list[Path], typer.Argument(help="recordings with ground truth")],
    folder: Annotated[Path | None, typer.Option(help="keeps the domains' simulated scans")] = None,
    kept: Annotated[Path | None, typer.Option(help="keeps what was found in recordings and domains")] = None,
    leave_out: Annotated[bool, typer.Option(help="judge every recording by a fit to the others")] = False,
    out: Annotated[Path, typer.Option(help="the acceptance model whose covariance is replaced")] = DEFAULT_OUT,
) -> None:
    """Fit, and print how honest the model is about every recording and domain."""
    console = Console()
    groups: Groups = {}
    for domain in DOMAINS:
        groups[domain.name] = remembered(kept, domain.name, partial(in_domain, domain, folder))
    for bag in bags:
        groups[bag.stem] = remembered(kept, bag.stem, partial(in_recording, bag))
    weights = {bag.stem: WEIGHT for bag in bags}
    model = fit_scan_covariance(groups, weights)
    for name, samples in groups.items():
        console.print(f"{name:28} n {len(samples):4}  nees {{:5.1f}}  inside {{:.3f}}".format(*honesty(samples, model)))
    for bag in bags if leave_out else []:
        others = {name: samples for name, samples in groups.items() if name != bag.stem}
        figures = honesty(groups[bag.stem], fit_scan_covariance(others, weights))
        console.print(f"left out {bag.stem:19} nees {{:5.1f}}  inside {{:.3f}}".format(*figures))
    content = json.loads(out.read_text(encoding="utf-8"))
    content["covariance"][SCAN] = {name: float(f"{value:.4g}") for name, value in asdict(model).items()}
    content["fitted_with"]["covariance of scans"] = f"python benchmarks/fit_covariance.py on {len(bags)} recordings"
    out.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
    console.print(f"{content['covariance'][SCAN]}\nwrote {out}")


def in_recording(bag: Path) -> Iterator[PoseSample]:
    """The right closures of a recording."""
    recording = open_bag(bag)
    settings = settings_for(recording, None, "auto")
    truth = read_ground_truth(recording)
    if truth is None or not truth.has_orientation:
        raise BagError(f"{bag} holds no ground truth with orientations")
    detector = LoopDetector(settings, make_detector_embedder(settings))
    remembered: dict[int, Keyframe] = {}
    for frame in FrameReader(recording, settings):
        detection = detector.process(frame)
        if detection.keyframe is None:
            continue
        remembered[frame.stamp_ns] = detection.keyframe
        for closure in detection.closures:
            stamps = np.array([closure.query_stamp_ns, closure.match_stamp_ns])
            (query, match), known = truth.at(stamps)
            if known.all():
                pair = remembered[closure.match_stamp_ns], detection.keyframe
                yield from right_sample(*pair, closure.match_T_query, relative(match, query))


def in_domain(domain: Domain, folder: Path | None) -> list[PoseSample]:
    """Pairs of one domain, aligned from near their true poses."""
    rng = np.random.default_rng(VALIDATION[0])
    seeds = range(VALIDATION[0], VALIDATION[0] + QUICK.worlds)
    places = places_of(domain, seeds, QUICK, folder, make_embedder(EmbeddingSettings(threads=1)))
    samples: list[PoseSample] = []
    for pair in pairs_of(places, domain, rng):
        if pair.kind in (SAME, TURNED):
            guess = pair.match_T_query.copy()
            guess[:3, 3] += NEAR_M * rng.standard_normal(3)
            samples += right_sample(pair.match.keyframe, pair.query.keyframe, guess, pair.match_T_query)
    return samples


def right_sample(match: Keyframe, query: Keyframe, guess: Array, true: Array) -> list[PoseSample]:
    """The sample of a pair, none where its alignment is wrong or there is nothing to align."""
    scans = PreparedScan(match.points), PreparedScan(query.points)
    if not all(scan.usable for scan in scans):
        return []
    alignment = align_scans(*scans, guess)
    gap = relative(true, alignment.pose)
    right = np.linalg.norm(gap[:3, 3]) < RIGHT_M and np.degrees(rotation_angle(gap)) < RIGHT_DEG
    return [sample_of(match, query, alignment, true)] if right else []


def remembered(folder: Path | None, name: str, find: Callable[[], Iterable[PoseSample]]) -> list[PoseSample]:
    """What an earlier call left in the folder, else what is found now."""
    path = None if folder is None else folder / f"{name}.samples.pkl"
    if path is not None and path.exists():
        samples: list[PoseSample] = pickle.loads(path.read_bytes())
        return samples
    found = list(find())
    if path is not None:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(pickle.dumps(found))
    return found


if __name__ == "__main__":
    typer.run(main)
