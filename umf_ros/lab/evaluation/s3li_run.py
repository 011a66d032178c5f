"""S3LI from the published files to figures: every sequence replayed, judged by satellites, in three protocols."""

from __future__ import annotations

import json
import math
import shutil
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
from dataclasses import replace
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray
from scipy.stats import binomtest

from umf_ros.bags.presets import settings_for
from umf_ros.bags.reader import open_bag
from umf_ros.bags.trajectories import read_odometry, read_rtklib
from umf_ros.core.config import Loop, Settings, load_preset
from umf_ros.core.errors import UmfError, one_line
from umf_ros.core.geometry import Array, heading
from umf_ros.core.io import read_values, write_atomically
from umf_ros.core.trajectory import Trajectory
from umf_ros.embedding import make_embedder
from umf_ros.lab.datasets.s3li import ETNA_TEST, headed, load_data_frame, read_toolkit
from umf_ros.lab.datasets.s3li_folder import (
    Pair,
    S3liFolder,
    S3liSequence,
    StereoFile,
    contradictions,
    image_key,
    read_pairs,
    read_stereo,
    truth_of,
)
from umf_ros.lab.evaluation.bag_run import sequence_set
from umf_ros.lab.evaluation.results import TextTable
from umf_ros.lab.evaluation.retrieval import THESIS_RULE, Mask, loop_closure, rank
from umf_ros.lab.imported import write_recording
from umf_ros.lab.importing import FORMATS
from umf_ros.lab.program import replay
from umf_ros.lab.simulation.twin_files import LEAST_OVERLAP, view_overlap
from umf_ros.runs.findings import look_first
from umf_ros.runs.reader import read_run
from umf_ros.runs.truth import JudgedRun, clock_offset, find_revisits, judge_run
from umf_ros.sensors.calibration import calibration_of

Record = dict[str, Any]
"""Figures of one sequence, or of several; None for what could not be measured."""

MPRF_APART_S = 100.0
"""A query retrieves nothing that is nearer in time (MPRF, `time_threshold`)."""
FIXED = 1
"""Quality of positions that relative poses are judged by: a float solution is off by decimetres."""
ENOUGH_FIXED = 0.5
NOISE = {"pose_graph__odometry_sigma_m": 0.1, "pose_graph__odometry_sigma_deg": 5.0}
"""Of trajectories that are off by 94 m after the crater's kilometre: the defaults, of a tenth of that drift, let the
graph refuse the one revisit that would set it right (measured on the twin)."""


def wilson(hits: int, count: int) -> tuple[float, float]:
    """95 % interval of a share [Wilson 1927]; 0 to 1 of nothing."""
    if not count:
        return 0.0, 1.0
    found = binomtest(hits, count).proportion_ci(method="wilson")
    return float(found.low), float(found.high)


def recall_of_places(
    stamps: NDArray[np.int64], poses: Array, path_length_m: Array, descriptors: Array, gaps: Loop
) -> tuple[int, int]:
    """R@1 of the thesis: queries whose most similar earlier keyframe is their place, and queries that have one.

    A place is within 12 m and 30 deg [UMF 5.1.2]; earlier is what the gaps of a loop closure allow.

    Args:
        stamps: (N,) ns.
        poses: (N, 4, 4) true poses, with headings.
        path_length_m: (N,).
        descriptors: (N, D) of unit length.
        gaps: in time and along the path.
    """
    task = loop_closure(stamps, poses, path_length_m, gaps, rule=THESIS_RULE)
    ranking = rank(descriptors @ descriptors.T, task.admissible)
    hits = ranking.hits(task.positive)[task.answerable, :1]
    return int(hits.sum()), len(hits)


def precision_of_pairs(
    keys: Sequence[str], stamps_s: Array, descriptors: Array, pairs: Sequence[Pair]
) -> tuple[Mask, Mask]:
    """P@1 of MPRF: (N,) whether the most similar image is a pair of the list, (N,) whether the list has one at all.

    Nothing nearer than 100 s is retrieved, nor is it a match.

    Args:
        keys: names of the N images, as `image_key` gives them.
        stamps_s: (N,) s.
        descriptors: (N, D) of unit length.
        pairs: the toolkit's.
    """
    row_of = {key: row for row, key in enumerate(keys)}
    true = np.zeros((len(keys), len(keys)), bool)
    for query, match, _ in pairs:
        rows = row_of.get(image_key(query)), row_of.get(image_key(match))
        if rows[0] is not None and rows[1] is not None:
            true[rows] = True
    apart = np.abs(stamps_s[:, None] - stamps_s[None]) >= MPRF_APART_S
    true &= apart
    ranking = rank(descriptors @ descriptors.T, apart)
    return np.asarray(ranking.hits(true)[:, :1].any(axis=1)), np.asarray(true.any(axis=1))


def replay_sequence(one: S3liSequence, folder: Path) -> Record:
    """Replay a sequence with the odometry that is there and judge it by the satellites.

    Raises:
        UmfError: a file of it is damaged.
    """
    started = time.monotonic()
    folder.mkdir(parents=True, exist_ok=True)
    notes: list[str] = []
    recording, settings, odometry = _open(one, folder, notes)
    detector, _ = replay(recording, settings, folder, odometry, warn=notes.append, report=_progress)
    run, check = read_run(folder), detector.sensors
    found, truth = truth_of(one, recording.start_ns, recording.end_ns), None
    if found:
        truth = found[1]
        with suppress(UmfError):  # none of them is fixed
            fixed = read_rtklib(found[0], FIXED)
            truth = fixed if fixed.at(run.stamps)[1].mean() >= ENOUGH_FIXED else truth
    about = replace(judge_run(replace(run, truth=truth), recording), sensors=check.report(odometry or run.odometry))
    if found and (ahead_s := clock_offset(odometry, found[1])):
        off = f"{abs(ahead_s):.1f} s {'later' if ahead_s > 0 else 'earlier'}"
        late = f"the odometry fits the satellites' positions {off} than their stamps say"
        notes.append(f"{late}: is {found[0].name} in GPS time? its figures are not to be trusted")
    overlay = about.sensors.overlay
    notes += [one.line for one in look_first(replace(about, missed=[])) if one.severity != "note"]
    record = judged_record(about, odometry)
    minutes = round((time.monotonic() - started) / 60, 2)
    return record | {"warnings": notes, "minutes": minutes, "stereo_scale": overlay and _number(overlay.scale)}


def _open(one: S3liSequence, folder: Path, notes: list[str]) -> tuple[Any, Settings, Trajectory | None]:
    source = one.recording
    if source is None:
        assert one.export is not None
        source = folder / "export.mcap"
        config = write_recording(FORMATS["vslam-lab"][0](one.export), source, lambda done: None)
        recording = open_bag(source)
        settings = settings_for(recording, config, "auto")
    else:
        recording = open_bag(source)
        calibration = write_calibration(one, folder, notes)
        settings = settings_for(recording, None, one.dataset, calibration=calibration and str(calibration), **NOISE)
    odometry = read_odometry(one.odometry, "imu", settings) if one.odometry else None
    return recording, settings, odometry


def write_calibration(one: S3liSequence, folder: Path, notes: list[str]) -> Path | None:
    """Write the calibration of a sequence with the intrinsics of its own files; None where it has none.

    Contradictions go to the notes.
    """
    if not one.calibrations:
        return None
    files: list[StereoFile] = [read_stereo(path) for path in one.calibrations]
    values = read_values(load_preset(one.dataset).calibration)
    launch_m = float(np.linalg.norm(values["raw_camera"]["left_T_right"]["translation"]))
    notes += contradictions(files, [path.name for path in one.calibrations], launch_m)
    path = folder / "calibration.yaml"
    write_atomically(path, yaml.safe_dump(values | files[0].entries(), sort_keys=False))
    return path


def judged_record(about: JudgedRun, odometry: Trajectory | None) -> Record:
    """The figures of one run."""
    run, truth, closures = about.run, about.run.truth, about.closures
    record: Record = {"keyframes": len(run.stamps), "closures": len(run.closures)}
    record |= dict.fromkeys(("recall1", "precision1", "closures_true", "closures_false", "revisits", *LENGTHS))
    if truth is None or not about.covered[0]:
        return record
    poses, known = headed(truth, run.stamps, odometry if odometry is not None else run.odometry)
    stamps, path_length = run.stamps[known], run.keyframes["path_length_m"][known]
    if run.descriptors is not None:
        hits = recall_of_places(stamps, poses[known], path_length, run.descriptors[known], run.settings.loop)
        record |= {"recall1_hits": hits[0], "recall1_queries": hits[1], "recall1": _share(*hits)}
    true = int(closures.is_true.sum())
    sessions = run.keyframes["session"][known]
    again = find_revisits(stamps, poses[known], path_length, run.settings.loop, sessions=sessions)
    closed = again & np.isin(stamps, closures.query_stamp_ns[closures.is_true])
    overlapping = sum(_overlap(about, poses, one) > LEAST_OVERLAP for one in closures)
    record |= {"closures_true": true, "closures_false": len(closures) - true, "closures_judged": len(closures)}
    record |= {"closures_overlapping": overlapping, "revisits": int(again.sum()), "revisits_closed": int(closed.sum())}
    record["pose_error_m"] = _number(np.median(closures.translation_error_m)) if len(closures) else None
    ates = about.ate_odometry_m, about.ate_optimized_m
    return record | dict(zip(LENGTHS[1:], (None if one is None else _number(one) for one in ates), strict=True))


def _overlap(about: JudgedRun, poses: Array, closure: Any) -> float:
    rows = about.row(int(closure.query_stamp_ns)), about.row(int(closure.match_stamp_ns))
    if rows[0] is None or rows[1] is None:
        return 0.0
    camera = calibration_of(about.run.settings).camera
    fov_deg = float(2 * np.degrees(np.arctan(camera.width / 2 / camera.fx)))
    query, match = poses[rows[0]], poses[rows[1]]
    return view_overlap(query[:2, 3], float(heading(query)), match[:2, 3], float(heading(match)), fov_deg)


def embed_samples(one: S3liSequence, path: Path) -> tuple[list[str], Array, Array]:
    """Names, stamps (N,) in s and descriptors (N, D) of the toolkit's samples of a sequence, in its pickle at `path`.

    Raises:
        UmfError: the pickle or an image is missing or damaged.
    """
    table = load_data_frame(path)
    sequence = read_toolkit([path], path.parent.parent, one.dataset)
    embedder = make_embedder(Settings().embedding)
    found = []
    for number, frame in enumerate(sequence_set(sequence, THESIS_RULE).frames, 1):
        found.append(embedder.embed(frame).descriptor)
        _progress(number / len(sequence))
    return [image_key(str(name)) for name in table["img_path"]], table["time_stamp"].astype(float), np.stack(found)


_shared: Any = None


def _progress(done: float) -> None:
    if _shared is not None:
        _shared.value = done


def _share_progress(value: Any) -> None:
    global _shared
    _shared = value


def in_own_process(work: Callable[..., Any], *arguments: Any, report: Callable[[float], None]) -> Any:
    """Result of a function in a process of its own, whose death is one `UmfError`; `report` gets its progress."""
    context = get_context("spawn")
    value = context.Value("d", 0.0)
    with ProcessPoolExecutor(1, context, _share_progress, (value,)) as pool:
        future = pool.submit(work, *arguments)
        try:
            while not future.done():
                time.sleep(0.2)
                report(value.value)
            return future.result()
        except BrokenProcessPool:
            raise UmfError("its process died: too little memory?") from None
        except UmfError:
            raise
        except Exception as error:
            raise UmfError(f"an internal error, please report it: {one_line(error)}") from error


class S3liRun:
    """Runs what is in a download, sequence by sequence.

    Attributes:
        records: figures by sequence.
        faults: lines about files that are damaged and belong to no replay.
    """

    def __init__(self, download: S3liFolder, out: Path, resume: bool = False) -> None:
        self._download, self._out, self._resume = download, out, resume
        self.records: dict[str, Record] = {}
        self.faults: list[str] = []

    def replay(self, one: S3liSequence, report: Callable[[float], None]) -> None:
        """Replay one sequence, or take its figures from an earlier run; a fault is its own."""
        folder = self._out / one.name
        kept = folder / "figures.json"
        record: Record = {"dataset": one.dataset, "status": "not replayed", "warnings": []}
        if self._resume and kept.is_file():
            record = json.loads(kept.read_text(encoding="utf-8"))
        elif one.recording is not None or one.export is not None:
            shutil.rmtree(folder, ignore_errors=True)  # what an earlier run has left
            try:
                record |= {"status": "done"} | in_own_process(replay_sequence, one, folder, report=report)
                write_atomically(kept, json.dumps(record, indent=2) + "\n")
            except UmfError as error:
                record["status"] = f"failed: {error}"
        self.records[one.name] = record

    def retrieve(self, dataset: str, report: Callable[[str, float], None]) -> list[str]:
        """MPRF's protocol over all samples of one data set; returns a line where there is nothing for it."""
        path = self._download.pairs.get(dataset)
        chosen = [one for one in self._download.sequences if one.dataset == dataset and one.pickle is not None]
        if path is None or not chosen:
            return [f"{dataset}: no list of overlapping pairs, or no pickles: MPRF's protocol is left out"]
        try:
            pairs = read_pairs(path)
        except UmfError as error:
            self.faults.append(str(error))
            return []
        found = {}
        for one in chosen:
            try:
                found[one.name] = in_own_process(embed_samples, one, one.pickle, report=partial(report, one.name))
            except UmfError as error:
                self.faults.append(f"{one.name}: {error}")
        if found:
            self._score(found, pairs)
        return []

    def _score(self, found: dict[str, tuple[list[str], Array, Array]], pairs: Sequence[Pair]) -> None:
        keys = [key for part in found.values() for key in part[0]]
        stamps, descriptors = (np.concatenate([part[place] for part in found.values()]) for place in (1, 2))
        right, answerable = precision_of_pairs(keys, stamps, descriptors, pairs)
        names = np.repeat(list(found), [len(part[0]) for part in found.values()])
        for name in found:
            hits, count = int((right & answerable & (names == name)).sum()), int((answerable & (names == name)).sum())
            self.records[name] |= {"precision1": _share(hits, count), "precision1_hits": hits}
            self.records[name] |= {"precision1_queries": count, "samples": int((names == name).sum())}


PUBLISHED = {("UMF R@1", "s3li-etna"): "73.5 (reranked 75.3)"}
PUBLISHED |= {("MPRF P@1", "s3li-etna"): "75.7", ("MPRF P@1", "s3li-vulcano"): "78.3"}
"""In per cent: [UMF table 5.7], on the real data, of its test split; MPRF's README."""
PROTOCOLS = (
    ("UMF R@1", "recall1_hits", "recall1_queries"),
    ("MPRF P@1", "precision1_hits", "precision1_queries"),
    ("MPRF P@1, all queries", "precision1_hits", "samples"),
    ("closures true by distance", "closures_true", "closures_judged"),
    ("closures true by overlap", "closures_overlapping", "closures_judged"),
    ("revisits closed", "revisits_closed", "revisits"),
)
"""Names of the shares, and their counts in the records."""
LENGTHS = ("pose_error_m", "ate_odometry_m", "ate_optimized_m")


def pooled(records: Sequence[Mapping[str, Any]]) -> Record:
    """The figures of several sequences together: shares of all that was asked, means of metres."""
    total: Record = {}
    for _, hits, count in PROTOCOLS:
        for name in (hits, count):
            total[name] = sum(int(record.get(name) or 0) for record in records)
    total["recall1"] = _share(total["recall1_hits"], total["recall1_queries"])
    total["precision1"] = _share(total["precision1_hits"], total["precision1_queries"])
    total["closures_false"] = sum(int(record.get("closures_false") or 0) for record in records)
    for name in LENGTHS:
        known = [record[name] for record in records if record.get(name) is not None]
        total[name] = _number(np.mean(known)) if known else None
    return total


def protocol_table(records: Mapping[str, Record]) -> TextTable:
    """Every protocol on every group of sequences, with its 95 % interval and what others published."""
    rows = []
    for title, dataset, names in _groups(records):
        total = pooled([records[name] for name in names])
        for protocol, hits, count in PROTOCOLS:
            low, high = wilson(total[hits], total[count])
            share = f"{100 * total[hits] / total[count]:.1f}" if total[count] else "-"
            interval = f"{100 * low:.1f} to {100 * high:.1f}" if total[count] else "-"
            published = PUBLISHED.get((protocol, dataset), "-")
            rows.append([f"{title}: {protocol}", share, interval, f"{total[hits]} of {total[count]}", published])
        for name in LENGTHS:
            values = [records[one][name] for one in names if records[one].get(name) is not None]
            label = f"{title}: {name[:-2].replace('_', ' ')}, m"
            rows.append([label, *_mean_with_interval(values), str(len(values)), "-"])
    return ["protocol", "%", "95 %", "of", "published"], rows


def _groups(records: Mapping[str, Record]) -> Iterator[tuple[str, str, list[str]]]:
    for dataset in ("s3li-etna", "s3li-vulcano"):
        names = [name for name, record in records.items() if record.get("dataset") == dataset]
        if names:
            yield dataset.removeprefix("s3li-").capitalize(), dataset, names
    split = [name for name in ETNA_TEST if name in records]
    if split:
        yield "Etna's test split", "s3li-etna", split
    yield "all", "", list(records)


def _mean_with_interval(values: Sequence[float]) -> tuple[str, str]:
    """Mean, and the interval that nineteen of twenty drawings of the sequences fall into."""
    if not values:
        return "-", "-"
    drawn = np.random.default_rng(0).choice(values, (2000, len(values))).mean(axis=1)
    low, high = np.quantile(drawn, (0.025, 0.975))
    return f"{np.mean(values):.2f}", f"{low:.2f} to {high:.2f}"


def sequence_table(records: Mapping[str, Record]) -> TextTable:
    """A row per sequence."""
    head = ["sequence", "R@1", "P@1", "true", "false", "closed", "ATE odometry m", "ATE optimised m", "min", "status"]
    rows = []
    for name, one in records.items():
        closed = f"{one['revisits_closed']} of {one['revisits']}" if one.get("revisits") is not None else "-"
        figures = [_cell(one.get(key)) for key in ("recall1", "precision1", "closures_true", "closures_false")]
        metres = [_cell(one.get(key)) for key in ("ate_odometry_m", "ate_optimized_m", "minutes")]
        rows.append([name, *figures, closed, *metres, str(one["status"]).partition(":")[0]])
    return head, rows


def _cell(value: Any) -> str:
    return "-" if value is None else f"{value:.2f}" if isinstance(value, float) else str(value)


def latex(table: TextTable) -> str:
    """A table for LaTeX."""
    head, *rows = (" & ".join(_escaped(cell) for cell in row) + r" \\" for row in (table[0], *table[1]))
    begin, end = rf"\begin{{tabular}}{{l{'r' * (len(table[0]) - 1)}}}", r"\end{tabular}"
    return "\n".join([begin, r"\toprule", head, r"\midrule", *rows, r"\bottomrule", end, ""])


def _escaped(text: str) -> str:
    return "".join(f"\\{one}" if one in "%_&#" else one for one in text)


def _share(hits: int, count: int) -> float | None:
    return round(hits / count, 4) if count else None


def _number(value: Any) -> float | None:
    return round(float(value), 4) if math.isfinite(value) else None
