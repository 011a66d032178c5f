"""Maps of clouds of other programs: views rendered out of them, and rovers with a LiDAR alone that localise there."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import laspy
import numpy as np
import pytest
from command_line import umf
from conftest import make_frame
from ground import yard_scan

from umf_ros.core.config import Settings, load_settings
from umf_ros.core.errors import UmfError
from umf_ros.core.geometry import Array, make_pose, relative, rotation_angle, transform
from umf_ros.core.trajectory import Trajectory, write_tum
from umf_ros.detector import LoopDetector, make_detector_embedder
from umf_ros.lab.scan_files import read_points
from umf_ros.map_poses import MapPoses, hint_of
from umf_ros.maps.cloud import VirtualLidar, along, standing, thinned
from umf_ros.maps.outputs import CLOUD, write_points

YARD = 10


def turned(x: float, y: float, yaw_deg: float, z: float = 0.0) -> Array:
    yaw = np.radians(yaw_deg)
    rotation = [[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]]
    return make_pose(np.array(rotation), [x, y, z])


def yard() -> Array:
    """(N, 3) points of a yard, seen from several places."""
    poses = [turned(x, y, 0) for x in (-8, 0, 8) for y in (-6, 6)]
    return np.concatenate([transform(pose, yard_scan(YARD, pose).astype(float)) for pose in poses])


def write_cloud(path: Path, points: Array) -> Path:
    cloud = np.zeros(len(points), CLOUD)
    cloud["point"] = points
    write_points(path, cloud)
    return path


def flat(half_m: float = 20.0) -> Array:
    xy = np.stack(np.meshgrid(*[np.arange(-half_m, half_m, 0.2)] * 2), axis=-1).reshape(-1, 2)
    return np.column_stack([xy, np.zeros(len(xy))])


def wall(x: float) -> Array:
    y, z = np.meshgrid(np.arange(-6, 6, 0.1), np.arange(0, 4, 0.1))
    return np.column_stack([np.full(y.size, x), y.ravel(), z.ravel()])


def test_a_wall_hides_what_is_behind_it_and_the_field_of_view_ends() -> None:
    cloud = np.concatenate([flat(), wall(5.0), wall(9.0)])
    seen = transform(turned(0, 0, 0, 1.2), VirtualLidar().see(cloud, turned(0, 0, 0, 1.2)))
    ahead = (np.abs(seen[:, 1]) < 3) & (seen[:, 0] > 0)
    assert (np.abs(seen[ahead, 0] - 5) < 0.05).sum() > 1000  # the first wall
    assert (seen[ahead, 0] > 6).mean() < 0.03  # little leaks through it
    assert (seen[:, 0] < -10).sum() > 300  # open ground far behind
    narrow = VirtualLidar(width_deg=70.0).see(cloud, turned(0, 0, 180, 1.2))
    assert len(narrow) and (np.abs(np.arctan2(narrow[:, 1], narrow[:, 0])) <= np.radians(35) + 1e-6).all()


def test_places_are_a_metre_apart_and_look_along_a_path_without_rotations() -> None:
    poses = np.stack([turned(0.1 * step, 0.1 * step, 0) for step in range(101)])
    found = along(Trajectory(np.arange(101), poses, has_orientation=False))
    steps = np.linalg.norm(np.diff(found[:, :3, 3], axis=0), axis=1)
    assert np.allclose(steps, 1.0, atol=0.15)
    assert np.allclose(np.arctan2(found[:, 1, 0], found[:, 0, 0]), np.pi / 4)
    with pytest.raises(UmfError, match="3 poses within 1 m"):
        along(Trajectory(np.arange(3), poses[:3]))


def test_a_rover_stands_on_ground_not_in_walls_or_on_steps() -> None:
    high = flat(6.0) + np.array([30.0, 0.0, 3.0])  # a roof, with nothing that leads there
    found = standing(np.concatenate([flat(), wall(5.0), high]), 1.2)
    assert len(found) > 200 and np.allclose(found[np.abs(found[:, 0, 3]) < 18, 2, 3], 1.2, atol=0.01)
    in_wall = (np.floor(found[:, 0, 3] / 2) == 2) & (np.abs(found[:, 1, 3]) < 6)
    assert not in_wall.any()
    with pytest.raises(UmfError, match="where a rover can stand"):
        standing(wall(5.0), 1.2)


@pytest.fixture(scope="module")
def imported(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A map of the yard, by a command, in both directions of a trajectory."""
    folder = tmp_path_factory.mktemp("cloud")
    cloud = write_cloud(folder / "yard.ply", yard())
    poses = np.stack([turned(x, 0.0, 0.0, 1.0) for x in np.arange(-8, 8.1, 0.5) if not 2 < x < 5])  # with a gap
    write_tum(folder / "poses.tum", Trajectory(np.arange(len(poses)) * 10**9, poses))
    (folder / "config.yaml").write_text("embedding: {method: solid}\n")
    done = umf(
        *("map", "import-cloud", cloud, "--trajectory", folder / "poses.tum"),
        *("--config", folder / "config.yaml", "--out", folder / "map"),
    )
    assert done.status == 0, done.err
    summary = json.loads((folder / "map" / "summary.json").read_text())["closures_between"]
    assert "30 places of a cloud, seen in 2 directions" in done.out and summary["accepted"] == summary["found"] == 15
    return folder / "map"


def settings_in(folder: Path) -> Settings:
    return load_settings(mode="localization", map=str(folder), embedding__method="solid")


@pytest.mark.parametrize("yaw_deg", [4.0, 183.0])
def test_a_lidar_alone_is_localised_in_both_directions(imported: Path, yaw_deg: float) -> None:
    settings, known = settings_in(imported), MapPoses(imported).places
    detector, found = LoopDetector(settings, make_detector_embedder(settings)), []
    for step, x in enumerate((-3.3, -1.3, 0.8, 2.9)):
        pose = turned(x, 0.6, yaw_deg, 0.1)
        points = yard_scan(YARD, pose)
        frame = make_frame(10.0 + step, relative(turned(-3.3, 30.0, 77.0), pose))
        frame = replace(frame, points=points, intensity=np.ones(len(points), np.float32))
        for closure in detector.process(frame).closures:
            match = known.poses[np.flatnonzero(known.stamps_ns == closure.match_stamp_ns)[0]]
            found.append(relative(pose, match @ closure.match_T_query))
    detector.close()
    assert len(found) >= 3
    assert all(np.linalg.norm(gap[:3, 3]) < 0.3 and np.degrees(rotation_angle(gap)) < 2 for gap in found)


@pytest.mark.parametrize("told", ["-3.3 0.6 4", "1.7 0.6 4", "200 0 0"])
def test_an_initial_pose_is_verified_and_a_wrong_one_searched(imported: Path, told: str) -> None:
    settings, pose = settings_in(imported), turned(-3.3, 0.6, 4.0, 0.1)
    detector = LoopDetector(settings, make_detector_embedder(settings))
    detector.hint = hint_of(load_settings(mode="localization", map=str(imported), localization__initial_pose=told))
    points = yard_scan(YARD, pose)
    frame = replace(make_frame(10.0, np.eye(4)), points=points, intensity=np.ones(len(points), np.float32))
    detection, known = detector.process(frame), MapPoses(imported).places
    (closure,) = detection.closures
    match = known.poses[np.flatnonzero(known.stamps_ns == closure.match_stamp_ns)[0]]
    assert np.linalg.norm(relative(pose, match @ closure.match_T_query)[:3, 3]) < 0.3
    assert detector.hint is None
    assert (len(detection.verdicts) == 4) != told.startswith("200")  # the places near it, and no others
    detector.close()


def test_the_map_keeps_the_frame_of_the_cloud(imported: Path) -> None:
    poses = MapPoses(imported).places.poses
    assert len(poses) == 30 and np.allclose(poses[:, 1:3, 3], (0.0, 1.0), atol=1e-3)
    assert np.allclose(np.sort(poses[:15, 0, 3]), [*range(-8, 3), *range(5, 9)], atol=1e-3)


def test_a_trajectory_in_another_frame_and_a_folder_with_files_are_refused(tmp_path: Path, imported: Path) -> None:
    cloud = imported.parent / "yard.ply"
    far = np.stack([turned(1000.0 * x, 0.0, 5.0 * x, 1.0) for x in range(4)])  # the first is in the cloud
    write_tum(tmp_path / "far.tum", Trajectory(np.arange(4) * 10**9, far))
    config = ("--config", imported.parent / "config.yaml")
    done = umf("map", "import-cloud", cloud, "--trajectory", tmp_path / "far.tum", *config, "--out", tmp_path / "map")
    assert done.status == 1 and "6 of 8 views have fewer than 100 points: is the" in done.err
    assert not (tmp_path / "map").exists()
    before = (imported / "map.json").read_bytes()
    done = umf("map", "import-cloud", cloud, "--out", imported)
    assert done.status == 1 and "nothing was written" in done.err and (imported / "map.json").read_bytes() == before


def test_clouds_that_are_none_are_one_line(tmp_path: Path) -> None:
    good = write_cloud(tmp_path / "good.pcd", np.eye(3).repeat(100, axis=0) * np.linspace(1, 30, 300)[:, None])
    points = read_points(good)
    assert len(thinned(points, good)) > 200
    for suffix in ("las", "laz"):  # of a survey, far from the origin
        survey = laspy.create()
        survey.header.scales, survey.header.offsets = np.full(3, 1e-3), np.array([5e5, 4e6, 0.0])
        survey.xyz = points + survey.header.offsets
        survey.write(tmp_path / f"good.{suffix}")
        np.testing.assert_allclose(read_points(tmp_path / f"good.{suffix}"), survey.xyz, atol=1e-3)
    wrong = {"cut.pcd": good.read_bytes()[:-50], "none.ply": b"ply\n", "few.ply": b"", "cloud.las": b"LASF"}
    wrong["wide.pcd"] = write_cloud(tmp_path / "wide.pcd", 1e4 * points).read_bytes()
    for name, damaged in wrong.items():
        (tmp_path / name).write_bytes(damaged)
        done = umf("map", "import-cloud", tmp_path / name, "--out", tmp_path / "map")
        assert done.status == 1 and name in done.err and len(done.err.splitlines()) == 1, name
        assert not (tmp_path / "map").exists()
    away = Trajectory(np.arange(3), np.stack([turned(x, 900.0, 0) for x in (0, 1, 2)]))
    write_tum(tmp_path / "away.tum", away)
    done = umf("map", "import-cloud", good, "--out", tmp_path / "map", "--trajectory", tmp_path / "away.tum")
    assert done.status == 1 and "6 of 6 views have fewer than 100 points" in done.err
    assert not (tmp_path / "map").exists() and not list(tmp_path.glob(".map*"))  # the next import may go there
