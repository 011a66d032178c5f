"""Surveys: poses are those the scans were taken from."""

from __future__ import annotations

import numpy as np
import open3d as o3d
import pytest
from scipy.spatial.transform import Rotation

from umf_ros.core.errors import ConfigError
from umf_ros.core.geometry import heading, transform, wrap_angle
from umf_ros.lab.simulation.domains import DOMAINS, STRANGE_DOMAINS, Domain, survey
from umf_ros.lab.simulation.domains.scanners import SCANNERS
from umf_ros.lab.simulation.domains.survey import MOUNTS, PLACES

SEED = 10_003


def off(place, scans):
    """Median distance of each scan's points from what there was to see, when seen from its true pose."""
    visits = {"first": 0, "offset": 1, "opposite": 2}
    gaps = []
    for scan in scans:
        points = transform(scan.world_T_body, scan.sweep.points.astype(float)).astype(np.float32)
        gap = place.scene(visits[scan.label]).rays.compute_distance(o3d.core.Tensor.from_numpy(points)).numpy()
        gaps.append(float(np.median(gap)))
    return np.array(gaps)


@pytest.mark.parametrize(
    "domain",
    [
        Domain("spin16", "street", "tilted"),
        Domain("rosette70", "quarry", "rover"),
        Domain("cube1", "corridor", "low"),
        Domain("mid360", "lander", "legged"),
        Domain("spin32_20hz", "warehouse", "legged"),
        Domain("rotating2d", "rooms", "low"),
        Domain("spin16", "snow", "mast"),
        Domain("spin16", "tunnel", "rolling"),
        Domain("spin16", "quarry", "rover", revisited_by="cube1"),
    ],
    ids=lambda domain: domain.name,
)
def test_scans_lie_on_the_place_at_their_true_poses(domain):
    place = PLACES[domain.place].build(SEED)
    scans = survey(domain, SEED, 8.0, 40.0, place)
    assert off(place, scans).max() < 0.05


def test_without_times_the_motion_stays_in_the_scan_and_the_pose_is_that_of_its_middle():
    domain = Domain("spin64", "street", "car")
    place = PLACES["street"].build(SEED)
    assert np.median(off(place, survey(domain, SEED, 8.0, 40.0, place))) < 0.15


def test_every_visit_covers_the_same_stretch_and_the_last_one_goes_back():
    scans = survey(Domain("spin16", "corridor", "low"), SEED, 2.0, 60.0)
    first, again, back = ([s for s in scans if s.label == label] for label in ("first", "offset", "opposite"))
    for others, turn in ((again, 0.0), (back, np.pi)):
        for scan in others[2:-2]:
            away = [np.linalg.norm(scan.world_T_lidar[:3, 3] - one.world_T_lidar[:3, 3]) for one in first]
            nearest = first[int(np.argmin(away))]
            assert min(away) < 1.3
            gap = wrap_angle(heading(scan.world_T_body) - heading(nearest.world_T_body) - turn)
            assert abs(np.degrees(gap)) < 60  # less would be too much to ask in the corners


@pytest.mark.parametrize("sensor", ["rosette70", "solid360"])
def test_a_narrow_sensor_is_sent_back_as_one_that_sees_all_around_is(sensor):
    scans = survey(Domain(sensor, "corridor", "low"), SEED, 8.0, 40.0)
    assert {scan.label for scan in scans} == {"first", "offset", "opposite"}


def test_the_same_seed_gives_the_same_scans():
    domain = Domain("solid360", "rooms", "rolling")
    one, two = (survey(domain, SEED, 10.0, 40.0) for _ in range(2))
    for a, b in zip(one, two, strict=True):
        assert np.array_equal(a.sweep.points, b.sweep.points)
        assert np.array_equal(a.world_T_body, b.world_T_body)


def test_a_tilted_sensor_is_tilted_and_a_calibrated_one_upright():
    tilts = []
    for seed in range(4):
        scan = survey(Domain("spin16", "corridor", "tilted"), seed, 30.0, 60.0)[0]
        tilts.append(np.degrees(np.arccos(scan.world_T_body[2, 2])))
    assert max(tilts) > 6
    upright = survey(Domain("spin16", "corridor", "rover"), SEED, 30.0, 60.0)[0]
    assert upright.world_T_lidar[2, 3] - upright.world_T_body[2, 3] == pytest.approx(1.3, abs=0.02)
    assert np.degrees(np.arccos(upright.world_T_body[2, 2])) < 5


def test_the_benchmarks_domains_exist_and_use_every_sensor_place_and_mount():
    every = (*DOMAINS, *STRANGE_DOMAINS)
    assert len(DOMAINS) >= 12
    assert len(STRANGE_DOMAINS) >= 8
    assert len({domain.name for domain in every}) == len(every)
    assert {domain.sensor for domain in every} == set(SCANNERS)
    assert {domain.place for domain in every} == set(PLACES)
    assert {domain.mount for domain in every} == set(MOUNTS)


def test_a_place_may_be_revisited_by_another_sensor():
    domain = Domain("spin64", "street", "rover", revisited_by="cube1")
    assert domain.name == "spin64+cube1-street-rover"
    first, *others = (
        [scan.sweep for scan in survey(domain, SEED, 10.0, 40.0) if scan.label == label]
        for label in ("first", "offset", "opposite")
    )
    for sweep in first:
        assert sweep.offset_s is None  # spin64 has no times
        assert sweep.points[:, 0].min() < -3
    for sweep in others[0] + others[1]:
        assert sweep.offset_s.max() > 0.15
        assert sweep.points[:, 0].min() > 0


def test_a_legged_robot_rolls_and_pitches_by_degrees_about_twice_a_second():
    mount, times = MOUNTS["legged"], np.arange(0, 10, 0.01)
    angles = np.array([Rotation.from_matrix(mount.sway(time, 0.2)[:3, :3]).as_euler("ZYX")[1:] for time in times])
    assert np.degrees(np.abs(angles).max(axis=0)) == pytest.approx([4, 4], abs=0.3)
    crossings = (np.diff(np.sign(angles), axis=0) != 0).sum(axis=0)
    assert (crossings / 20 > 1.5).all()
    assert (crossings / 20 < 2.5).all()
    scans = survey(Domain("spin32_20hz", "corridor", "legged"), SEED, 10.0, 60.0)
    assert [scan.world_T_lidar[2, 3] for scan in scans] == pytest.approx([0.5] * len(scans), abs=0.02)


def test_a_negative_seed_is_refused():
    with pytest.raises(ConfigError, match="seed -1"):
        survey(Domain("spin16", "corridor", "low"), -1, 8.0, 40.0)
