"""Evaluate on listed sets of places."""

from __future__ import annotations

import csv
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from pydantic import Field, ValidationError

from umf_ros.core.config import Group, Settings, Verification, problems
from umf_ros.core.errors import ConfigError, UmfError
from umf_ros.core.frames import Frame, Image, Points, StereoCamera
from umf_ros.core.geometry import transform
from umf_ros.core.io import read_yaml
from umf_ros.embedding import Embedder, check_inputs, make_embedder
from umf_ros.lab.evaluation.results import EvaluationReport, Figures, Scores, TextTable, percent, rounded, score
from umf_ros.lab.evaluation.retrieval import (
    Mask,
    PlaceCollection,
    RetrievalTask,
    rank,
    rerank_all,
    with_words,
    word_similarity,
)
from umf_ros.lab.scan_files import SUFFIXES, read_picture, read_scan
from umf_ros.sensors.calibration import Calibration, load_calibration

IMAGES = (".png", ".jpg", ".jpeg", ".pgm", ".bmp", ".tif", ".tiff")
RERANKER = "ransac both"


class PlaceSet(Group):
    """One set of a list."""

    name: str = Field(min_length=1, description="begins the names of its figures")
    queries: Path = Field(description="folder of what is asked for")
    references: Path = Field(description="folder of what is searched")
    truth: Path = Field(description='CSV of "query,reference,reference,..." by index in sorted order')
    kind: Literal["image", "scan"] = Field(description="what the folders hold")
    calibration: Path | None = Field(None, description="of the sensor; null: image plane and axes as they are")

    def frames(self, folder: Path, calibration: Calibration | None) -> list[Frame]:
        """The images or scans of a folder in the order of their names, stamped by their numbers.

        Raises:
            UmfError: the folder holds none, or one of them cannot be read.
        """
        suffixes = IMAGES if self.kind == "image" else SUFFIXES
        files = sorted(path for path in folder.glob("*") if path.suffix.lower() in suffixes)
        if not files:
            raise UmfError(f"{folder} holds no {self.kind} ({', '.join(suffixes)})")
        make = _image_frame if self.kind == "image" else _scan_frame
        return [make(file, number, calibration) for number, file in enumerate(files)]


class PlaceScores(NamedTuple):
    """Results of one set.

    Attributes:
        name: of the set.
        references: how many there are.
        plain: by the global descriptor, and by words where the method has local vectors of images.
        reranked: by local features too; None of a method that has none.
        parts: by the descriptor alone, "network", and by the words alone; empty where there are no words.
    """

    name: str
    references: int
    plain: Scores
    reranked: Scores | None
    parts: Mapping[str, Scores]

    @property
    def flat(self) -> Figures:
        """The figures by their published names; None for what could not be measured."""
        figures = ("recall1", "recall5", "auc_pr", "recall_at_precision1")
        values = {name: getattr(self.plain, name) for name in figures}
        values |= {f"recall1_{name}": part.recall1 for name, part in self.parts.items()}
        values["recall1_reranked"] = self.reranked.recall1 if self.reranked else float("nan")
        return rounded({f"{self.name}.{name}": value for name, value in values.items()})


def read_place_sets(listing: Path) -> list[PlaceSet]:
    """The sets of a list, their paths made absolute.

    Raises:
        ConfigError: the file cannot be read or is no such list.
    """
    content = read_yaml(listing)
    if not isinstance(content, list) or not content:
        raise ConfigError(f"{listing}: expected a list of place sets")
    try:
        sets = [PlaceSet.model_validate(entry) for entry in content]
    except ValidationError as error:
        raise ConfigError(f"{listing}: {problems(error)}") from None
    names = [one.name for one in sets]
    if len(set(names)) < len(names):
        raise ConfigError(f"{listing}: two sets have one name")
    return [_below(listing.parent, one) for one in sets]


def score_places(
    places: PlaceSet, embedder: Embedder, settings: Verification, report: Callable[[], None] = lambda: None
) -> PlaceScores:
    """Ask every query of a set for its references.

    Args:
        places: the set, its paths absolute.
        embedder: any method.
        settings: of the reranking.
        report: called after every frame and every reranked query.

    Raises:
        UmfError: something of the set is missing or damaged.
    """
    frames, task = read_set(places)
    found = PlaceCollection(embedder)
    for frame in frames:
        found.add(frame)
        report()
    descriptors, asked, references = found.descriptors("fused"), len(task.queries), len(task.references)
    network = descriptors[task.queries] @ descriptors[task.references].T
    ours, theirs = found.keyframes[:asked], found.keyframes[asked:]
    words = word_similarity(ours, theirs)
    similarity = with_words(network, words, ours)
    ranking = rank(similarity)
    plain = score(task, ranking)
    parts = {name: score(task, rank(one)) for name, one in (("network", network), ("words", words)) if words.any()}
    if not any(keyframe.embedding.image or keyframe.embedding.cloud for keyframe in found.keyframes):
        return PlaceScores(places.name, references, plain, None, parts)
    reranking = rerank_all(ours, theirs, ranking, similarity, settings, report)
    return PlaceScores(places.name, references, plain, score(task, reranking.after(RERANKER)), parts)


def read_set(places: PlaceSet) -> tuple[list[Frame], RetrievalTask]:
    """The queries and then the references of a set, and which of them belong together.

    Raises:
        UmfError: something of the set is missing or damaged.
    """
    calibration = load_calibration(places.calibration) if places.calibration else None
    queries, references = (places.frames(folder, calibration) for folder in (places.queries, places.references))
    return [*queries, *references], _task(read_truth(places.truth, len(queries), len(references)))


def read_truth(path: Path, queries: int, references: int) -> Mask:
    """(queries, references) bool true matches; a query that no line names has none.

    Raises:
        UmfError: the file cannot be read, or a line is not of numbers of that many queries and references.
    """
    positive = np.zeros((queries, references), bool)
    try:
        lines = list(csv.reader(path.read_text(encoding="utf-8").splitlines()))
    except (OSError, UnicodeDecodeError) as error:
        raise UmfError(f"cannot read {path}: {error}") from None
    for number, line in enumerate(lines, 1):
        if not line:
            continue
        try:
            query, *true = (int(cell) for cell in line if cell.strip())
        except ValueError:
            raise UmfError(f'{path}, line {number}: expected "query,reference,reference,..."') from None
        if not 0 <= query < queries or any(not 0 <= index < references for index in true):
            raise UmfError(f"{path}, line {number}: there are {queries} queries and {references} references, from 0")
        positive[query, true] = True
    if not positive.any():
        raise UmfError(f"{path}: no query has a true match")
    return positive


def table_of(results: Sequence[PlaceScores]) -> TextTable:
    """A row per set."""
    alone = ["R@1 % network alone", "R@1 % words alone"]
    head = ["set", "queries", "references", *alone, "R@1 %", "R@5 %", "R@1 % reranked", "AUC-PR %", "R@100 % P"]
    rows = []
    for found in results:
        plain = found.plain
        again = percent(found.reranked.recall1) if found.reranked else "-"
        shares = map(percent, (plain.auc_pr, plain.recall_at_precision1))
        parts = [percent(found.parts[name].recall1) if found.parts else "-" for name in ("network", "words")]
        recalls = [*parts, percent(plain.recall1), percent(plain.recall5)]
        rows.append([found.name, str(plain.queries), str(found.references), *recalls, again, *shares])
    return head, rows


def _below(base: Path, places: PlaceSet) -> PlaceSet:
    paths = {name: base / getattr(places, name) for name in ("queries", "references", "truth")}
    if places.calibration:
        paths["calibration"] = base / places.calibration
    return places.model_copy(update=paths)


def _task(positive: Mask) -> RetrievalTask:
    """Sets say what is true, and nothing of distance and heading."""
    queries, references = (np.arange(count) for count in positive.shape)
    references = references + len(queries)
    everything, unknown = np.ones_like(positive), np.zeros(positive.shape)
    return RetrievalTask(queries, references, everything, positive, positive, unknown, unknown)


def _image_frame(file: Path, number: int, calibration: Calibration | None) -> Frame:
    image: Image = read_picture(file).astype(np.uint8)
    return _frame(number, _plane(image), calibration, left=_rectified(image, calibration))


def _rectified(image: Image, calibration: Calibration | None) -> Image:
    if calibration is None or calibration.rectifier is None:
        return image
    return calibration.rectifier.apply(image, 0)


def _scan_frame(file: Path, number: int, calibration: Calibration | None) -> Frame:
    cloud = read_scan(file)
    points = cloud.points
    if calibration is not None:
        points = transform(calibration.body_T_lidar, points).astype(np.float32)
    return _frame(number, StereoCamera(1, 1, 1, 1, 0, 0, 0), calibration, points=points, intensity=cloud.intensity)


def _plane(image: Image) -> StereoCamera:
    """A lens as wide as the picture: nothing is known of it, and nothing that is measured here depends on it."""
    height, width = image.shape
    return StereoCamera(width, height, width, width, width / 2 - 0.5, height / 2 - 0.5, 0.0)


def _frame(
    number: int,
    camera: StereoCamera,
    calibration: Calibration | None,
    left: Image | None = None,
    points: Points | None = None,
    intensity: Points | None = None,
) -> Frame:
    if calibration is None:
        return Frame(number, camera, np.eye(4), np.eye(4), left=left, points=points, intensity=intensity)
    mounting = calibration.body_T_camera, calibration.body_T_lidar
    known = camera if left is None else calibration.camera
    return Frame(number, known, *mounting, left=left, points=points, intensity=intensity)


TITLE = "Place recognition on still images and scans"


def evaluate_place_sets(listing: Path, settings: Settings, report: Callable[[str], None]) -> EvaluationReport:
    """Score one method on all sets of a list.

    Args:
        listing: YAML file of the sets.
        settings: of embedding and verification.
        report: called with the name of each set.

    Raises:
        ConfigError: no such list, or an unknown method.
        UmfError: something of a set is missing or damaged.
    """
    sets = read_place_sets(listing)
    embedder = make_embedder(settings.embedding, super_features=True, features=settings.verification.features)
    results = []
    for places in sets:
        report(places.name)
        check_inputs(settings.embedding.method, f"the set {places.name}", places.kind == "image", places.kind == "scan")
        results.append(score_places(places, embedder, settings.verification))
    figures = {name: value for found in results for name, value in found.flat.items()}
    notes = [f"{listing}, embedded by {embedder.name}. A match is true where the set says so."]
    return EvaluationReport(TITLE, notes, figures, {TITLE: table_of(results)})
