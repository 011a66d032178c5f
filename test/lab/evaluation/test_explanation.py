from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from command_line import umf

from umf_ros.core.config import Verification
from umf_ros.core.errors import OutputError
from umf_ros.lab.evaluation.comparison import Explanation, draw, explain
from umf_ros.lab.simulation.scenes import landscape, pose_at, take

GROUND = landscape(20)


def explained(same: bool) -> Explanation:
    query = take(GROUND, pose_at(GROUND, -14.0, 1.2, 6.0), 100.0)
    ground = GROUND if same else landscape(77)
    return explain(query, take(ground, pose_at(ground, -15.0, 0.0, 0.0), 10.0), Verification())


def test_same_place_is_explained_by_contributions_that_add_up() -> None:
    found = explained(same=True)
    assert found.verdict.startswith("accepted")
    odds = sum(found.contributions.values())
    assert found.best is not None and found.best.probability == pytest.approx(1 / (1 + np.exp(-odds)))
    assert found.contributions["bias"] < 0 < found.contributions["terrain_score"]
    assert len(found.pixels) > 10


def test_other_place_is_rejected_with_its_numbers() -> None:
    found = explained(same=False)
    assert found.verdict.startswith("rejected")
    assert found.best is None or found.best.measurements["residual_m"] > 0.01


def test_picture_is_written_with_and_without_images_and_pose(tmp_path: Path) -> None:
    found = explained(same=True)
    image = np.full((found.query.camera.height, found.query.camera.width), 120, np.uint8)
    draw(found, image, None, tmp_path / "pair.png")
    nothing = replace(found, best=None, contributions={}, pixels=np.empty((0, 4), np.float32))
    draw(nothing, None, None, tmp_path / "nothing.png")
    for name in ("pair.png", "nothing.png"):
        picture = cv2.imread(str(tmp_path / name))
        assert picture is not None and picture.std() > 10
    assert nothing.verdict == "rejected: no pose fits"


def test_unwritable_picture_is_one_clear_error(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="cannot write"):
        draw(explained(same=True), None, None, tmp_path / "missing" / "pair.png")


@pytest.mark.parametrize("text", ["soon", "-3", "nan"])
def test_moments_that_are_none_are_refused(tmp_path: Path, text: str) -> None:
    ended = umf("explain", tmp_path, "--", text, "1.0")
    assert ended.status == 2 and text in ended.text
