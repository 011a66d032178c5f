"""Pictures of a run: matches joined at the right pixels, trajectories in their colours."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from umf_ros.runs.report import (
    MAX_LINES,
    ODOMETRY,
    OPTIMISED,
    RIGHT,
    TRUTH,
    UNJUDGED,
    WRONG,
    draw_match,
    plot_trajectories,
)

HEIGHT, WIDTH = 120, 160
MARGIN, GAP = 34, 6
QUERY, MATCH = np.full((HEIGHT, WIDTH), 90, np.uint8), np.full((HEIGHT, WIDTH), 150, np.uint8)


def coloured(picture: np.ndarray) -> np.ndarray:
    return np.ptp(picture.astype(int), axis=2) > 40


def test_both_images_stand_side_by_side_below_the_caption() -> None:
    picture = draw_match(QUERY, MATCH, np.empty((0, 4)), "0.5 m apart")
    assert picture.shape == (HEIGHT + MARGIN, 2 * WIDTH + GAP, 3) and picture.dtype == np.uint8
    assert (picture[MARGIN:, :WIDTH] == 90).all() and (picture[MARGIN:, WIDTH + GAP :] == 150).all()
    assert (picture[MARGIN:, WIDTH : WIDTH + GAP] == 255).all()
    assert (picture[:MARGIN] < 100).any() and not coloured(picture).any()


@pytest.mark.parametrize("pixels", [(20.0, 30.0, 100.0, 80.0), (0.0, 0.0, 159.0, 119.0), (150.4, 10.6, 5.0, 110.0)])
def test_a_line_joins_the_feature_in_both_images(pixels: tuple[float, float, float, float]) -> None:
    picture = coloured(draw_match(QUERY, MATCH, np.array([pixels]), ""))
    u, v, match_u, match_v = (round(value) for value in pixels)
    start, end = np.array([u, v + MARGIN]), np.array([match_u + WIDTH + GAP, match_v + MARGIN])
    for part in np.linspace(0, 1, 41):
        x, y = np.round(start + part * (end - start)).astype(int)
        assert picture[max(y - 1, 0) : y + 2, max(x - 1, 0) : x + 2].any(), (x, y)
    # and nothing is drawn away from the line and its ends
    rows, columns = np.nonzero(picture)
    direction = (end - start) / np.linalg.norm(end - start)
    offset = np.stack([columns, rows], 1) - start
    assert np.abs(offset @ [-direction[1], direction[0]]).max() <= 5


def test_a_smaller_match_is_scaled_to_the_query() -> None:
    picture = draw_match(QUERY, np.full((HEIGHT // 2, WIDTH // 2), 150, np.uint8), np.empty((0, 4)), "")
    assert (picture[MARGIN:, WIDTH + GAP :] == 150).all()


def test_of_many_inliers_a_spread_subset_is_drawn() -> None:
    tall = np.full((600, WIDTH), 90, np.uint8)
    v = np.arange(600.0)
    many = np.stack([np.full(600, 5.0), v, np.full(600, 150.0), v], axis=1)
    middle = coloured(draw_match(tall, tall, many, ""))[MARGIN:, WIDTH // 2]
    lines = np.flatnonzero(np.diff(middle.astype(int), prepend=0) == 1)
    assert len(lines) == MAX_LINES
    assert lines[0] == 0 and lines[-1] >= 595 and np.diff(lines).max() <= 12


def bgr(colour: str) -> tuple[int, ...]:
    return tuple(int(colour[i : i + 2], 16) for i in (5, 3, 1))


def shows(path: Path, colour: str) -> int:
    picture = cv2.imread(str(path)).astype(int)
    return int((np.abs(picture - bgr(colour)).max(axis=2) < 12).sum())


def circle(radius_m: float) -> np.ndarray:
    angle = np.linspace(0, 6, 200)
    return np.stack([radius_m * np.cos(angle), radius_m * np.sin(angle), 0 * angle], axis=1)


CURVES = [("ground truth", TRUTH, circle(20)), ("odometry", ODOMETRY, circle(24)), ("optimised", OPTIMISED, circle(21))]
ENDS = np.array([[[-15, y, 0], [15, y, 0]] for y in (-8, 0, 8)], float)


def test_every_curve_and_kind_of_closure_has_its_colour(tmp_path: Path) -> None:
    plot_trajectories(tmp_path / "a.png", CURVES, ENDS, [True, False, None])
    for colour in (TRUTH, ODOMETRY, OPTIMISED, RIGHT, WRONG, UNJUDGED):
        assert shows(tmp_path / "a.png", colour) > 20, colour


@pytest.mark.parametrize(
    ("verdicts", "shown", "hidden"),
    [([True] * 3, RIGHT, (WRONG, UNJUDGED)), ([False] * 3, WRONG, (RIGHT, UNJUDGED)), ([None] * 3, UNJUDGED, (WRONG,))],
)
def test_closures_are_drawn_by_their_verdict(
    tmp_path: Path, verdicts: list[bool | None], shown: str, hidden: tuple[str, ...]
) -> None:
    plot_trajectories(tmp_path / "a.png", CURVES[:1], ENDS, verdicts)
    assert shows(tmp_path / "a.png", shown) > 20
    assert [shows(tmp_path / "a.png", colour) for colour in hidden] == [0] * len(hidden)


def test_without_any_trajectory_there_is_an_empty_picture(tmp_path: Path) -> None:
    plot_trajectories(tmp_path / "a.png", [], np.empty((0, 2, 3)), [])
    assert cv2.imread(str(tmp_path / "a.png")) is not None
