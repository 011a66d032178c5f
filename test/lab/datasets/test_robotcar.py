from __future__ import annotations

import pickle
import sys
import types
from pathlib import Path

import cv2
import numpy as np
import pytest

from umf_ros.core.errors import UmfError
from umf_ros.lab.datasets.robotcar import read_evaluation, read_training
from umf_ros.lab.datasets.sample import label, places_of
from umf_ros.lab.evaluation.retrieval import ROBOTCAR_RULE, place_recognition

RUNS = ("2014-05-19-13-20-57", "2014-11-14-16-34-33")
FOLDER = "pointcloud_20m_10overlap"


def tuple_class(monkeypatch: pytest.MonkeyPatch) -> type:
    """MinkLoc++'s class, where its scripts have it."""
    module = types.ModuleType("datasets.oxford")

    class TrainingTuple:
        def __init__(self, **fields: object) -> None:
            self.__dict__.update(fields)

    TrainingTuple.__module__, TrainingTuple.__qualname__ = "datasets.oxford", "TrainingTuple"
    module.TrainingTuple = TrainingTuple
    monkeypatch.setitem(sys.modules, "datasets", types.ModuleType("datasets"))
    monkeypatch.setitem(sys.modules, "datasets.oxford", module)
    return TrainingTuple


def dump(path: Path, content: object) -> None:
    with path.open("wb") as stream:
        pickle.dump(content, stream, protocol=pickle.HIGHEST_PROTOCOL)


@pytest.fixture
def layout(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[Path, Path]:
    """Two drives along the same street, five submaps each, 10 m apart, the second 2 m to the east."""
    make = tuple_class(monkeypatch)
    root, images = tmp_path / "benchmark", tmp_path / "images"
    rng = np.random.default_rng(0)
    tuples, linked, evaluation = {}, {}, [{}, {}]
    for run, name in enumerate(RUNS):
        (root / "oxford" / name / FOLDER).mkdir(parents=True)
        (images / name).mkdir(parents=True)
        for row in range(5):
            stamp = 1_400_505_893_170_765 + run * 10**10 + row * 10**6
            relative = f"oxford/{name}/{FOLDER}/{stamp}.bin"
            rng.uniform(-1, 1, (4096, 3)).astype(np.float64).tofile(root / relative)
            position = np.array([5_735_000.0 + 10 * row, 620_000.0 + 2 * run])
            number = len(tuples)
            tuples[number] = make(
                id=number,
                timestamp=stamp,
                rel_scan_filepath=relative,
                positives=np.array([], int),
                non_negatives=np.array([], int),
                position=position,
            )
            linked[stamp] = [stamp + 40, stamp + 90]
            cv2.imwrite(str(images / name / f"{stamp + 40}.png"), np.full((240, 320, 3), 20 * row, np.uint8))
            evaluation[run][row] = {"query": relative, "northing": position[0], "easting": position[1]}
    dump(root / "training_queries_baseline.pickle", tuples)
    dump(root / "oxford_evaluation_query.pickle", evaluation)
    dump(images / "lidar2image_ndx.pickle", linked)
    return root, images


def test_training_tuples(layout: tuple[Path, Path]) -> None:
    sequence = read_training(*layout)
    assert len(sequence) == 10 and sequence.place == "oxford"
    assert sequence.pass_index.tolist() == [0] * 5 + [1] * 5
    # east, north; the cars drive north
    assert sequence.world_T_body[6, :3, 3].tolist() == [620_002.0, 5_735_010.0, 0.0]
    assert np.allclose(sequence.world_T_body[:, :3, 0], [0, 1, 0])
    sample = sequence.sample(6)
    assert sample.image is not None and sample.image.shape == (240, 320) and sample.image.mean() == 20


def test_submaps_lie_in_the_box_the_network_sees(layout: tuple[Path, Path]) -> None:
    points = read_training(*layout).sample(0).points
    assert points is not None and points.shape == (4096, 3) and points.dtype == np.float32
    assert points[:, 0].min() >= 0 and points[:, 0].max() <= 40 and np.abs(points[:, 1]).max() <= 20
    raw = np.fromfile(min((layout[0] / "oxford" / RUNS[0] / FOLDER).glob("*.bin")), np.float64).reshape(-1, 3)
    assert np.allclose(points, raw * 20 + [20, 0, 0], atol=1e-5)


def test_the_evaluation_set_and_its_rule(layout: tuple[Path, Path]) -> None:
    sequence = read_evaluation(*layout)
    task = place_recognition(sequence.world_T_body, sequence.pass_index, ROBOTCAR_RULE)
    # the same submap, 2 m off; its neighbours are 10.2 m off and neither
    assert task.positive.tolist() == np.eye(5, dtype=bool).tolist()
    places = (places_of(0, sequence.world_T_body[rows]) for rows in (task.queries, task.references))
    assert not label(*places, ROBOTCAR_RULE)[1].any()


def test_the_laser_alone(layout: tuple[Path, Path]) -> None:
    assert read_training(layout[0], None).sample(0).image is None


def test_a_submap_without_an_image_has_none(layout: tuple[Path, Path]) -> None:
    root, images = layout
    dump(images / "lidar2image_ndx.pickle", {})
    assert read_training(root, images).sample(0).image is None


def test_what_is_missing_or_wrong_is_named(layout: tuple[Path, Path]) -> None:
    root, images = layout
    path = min((root / "oxford" / RUNS[0] / FOLDER).glob("*.bin"))
    path.write_bytes(path.read_bytes()[:-8])
    with pytest.raises(UmfError, match=r"holds 12287 numbers instead of 4096 points"):
        read_training(root, images).sample(0)
    path.unlink()
    with pytest.raises(UmfError, match="cannot read"):
        read_training(root, images).sample(0)
    for picture in (images / RUNS[1]).glob("*.png"):
        picture.unlink()
    with pytest.raises(UmfError, match="No such file"):
        read_training(root, images).sample(7)
    dump(root / "training_queries_baseline.pickle", {0: {"northing": 1}})
    with pytest.raises(UmfError, match="holds no training tuples"):
        read_training(root, images)
    dump(root / "oxford_evaluation_query.pickle", [{0: {"query": "a"}}])
    with pytest.raises(UmfError, match="holds no evaluation set"):
        read_evaluation(root, images)
    with pytest.raises(UmfError, match="No such file"):
        read_evaluation(root, images, "database")
