"""A whole drive: its clocks, what it repeats, and what it refuses."""

from __future__ import annotations

import resource
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from umf_ros.core.errors import ConfigError, OutputError
from umf_ros.lab.datasets.simulated import SimulatedWorld
from umf_ros.lab.simulation.bag_writer import BagWriter
from umf_ros.lab.simulation.camera import ahead
from umf_ros.lab.simulation.families import FAMILIES
from umf_ros.lab.simulation.lidar import PERIOD_NS
from umf_ros.lab.simulation.presets import DEMO, first_samples
from umf_ros.lab.simulation.route import SETTINGS, plan_passes
from umf_ros.lab.simulation.simulator import START_NS, Simulator, record
from umf_ros.lab.simulation.survey import Survey, save, shard_plan, write_shard


def test_scans_follow_each_other_and_images_keep_near_them(drive):
    assert np.unique(np.diff(drive.scan_stamps_ns)).tolist() == [PERIOD_NS]
    assert drive.scan_stamps_ns[0] == START_NS
    assert drive.scan_stamps_ns[-1] + PERIOD_NS <= START_NS + drive.duration_s * 1e9
    images = np.array([exposure.stamp_ns for exposure in drive.exposures])
    assert len(images) == len(drive.scan_stamps_ns) and np.abs(images - drive.scan_stamps_ns).max() <= 9_000_000
    assert images.min() >= START_NS and len(set(images - drive.scan_stamps_ns)) > 5


def test_images_come_at_the_rate_that_was_asked_for(night):
    stamps = np.array([exposure.stamp_ns for exposure in night.exposures])
    assert np.diff(stamps) == pytest.approx(1e9 / 30, abs=2)
    assert [exposure.number for exposure in night.exposures] == list(range(len(stamps)))
    assert len(stamps) == 81  # the last 0.3 s belong to the last scan
    assert 0.9 < np.mean([exposure.right for exposure in night.exposures]) <= 1


def test_the_sun_moves_on_as_far_as_the_preset_says(drive):
    suns = [drive.sun(START_NS + int(second * 1e9)) for second in np.linspace(0, drive.motion.duration_s, 9)]
    steps = [(later.azimuth_deg - sooner.azimuth_deg) % 360 for sooner, later in pairwise(suns)]
    assert all(0 <= step < 20 for step in steps)
    assert sum(steps) == pytest.approx(DEMO.sun_deg, abs=0.5)


def test_a_measurement_does_not_depend_on_what_was_asked_before(drive):
    numbers = [3, 0, 5, 3, 1]
    one_by_one = {number: drive.scan(number) for number in numbers}
    with ThreadPoolExecutor(3) as pool:
        for number, scan in zip(numbers, ahead(pool, drive.scan, numbers), strict=True):
            assert np.array_equal(scan.points, one_by_one[number].points)
            assert np.array_equal(scan.ambient, one_by_one[number].ambient)


def test_both_eyes_and_every_exposure_have_their_own_noise(drive):
    first, second = drive.exposures[:2]
    left, again = drive.picture(first), drive.picture(first)
    right, later = drive.picture(first, right=True), drive.picture(second)
    assert np.array_equal(left.image, again.image)
    sky = np.logical_and.reduce([picture.semantic == 255 for picture in (left, right, later)])
    noise = [picture.image[sky].astype(float) for picture in (left, right, later)]
    noise = [values - values.mean() for values in noise]
    assert abs(np.corrcoef(np.diff(noise[0]), np.diff(noise[1]))[0, 1]) < 0.2
    assert abs(np.corrcoef(np.diff(noise[0]), np.diff(noise[2]))[0, 1]) < 0.2


def test_the_odometry_covers_the_recording_and_not_less(drive):
    times = drive.odometry.times_s
    assert times[0] == 0 and np.diff(times) == pytest.approx(0.04)
    assert times[-1] >= drive.duration_s - 0.05


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        ({"seed": -5}, "seed -5"),
        ({"seed": 2**32}, "seed 4294967296"),
        ({"family": "venus"}, "unknown family 'venus'"),
        ({"aliasing": -0.1}, "aliasing -0.1"),
        ({"image_rate_hz": 0.0}, "image rate 0 Hz"),
        ({"image_rate_hz": 31.0}, "image rate 31 Hz"),
        ({"duration_s": float("nan")}, "duration nan"),
    ],
)
def test_impossible_drives_are_refused(arguments, word):
    with pytest.raises(ConfigError, match=word):
        Simulator(DEMO, **({"seed": 1} | arguments))


def test_nothing_is_left_of_an_interrupted_recording(drive, tmp_path):
    done: list[int] = []

    def stop(scans: int) -> None:
        done.append(scans)
        if scans == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt), BagWriter(tmp_path / "a.mcap") as bag:
        record(drive, bag, progress=stop)
    assert done == [1, 2] and list(tmp_path.iterdir()) == []


# shards


@pytest.fixture(scope="module")
def survey(drive) -> Survey:
    passes = plan_passes(drive.world.relief.trail, ("first", "opposite"), SETTINGS["easy"], 90.0, seed=2)
    size = len(passes[0].path)
    return Survey(drive.world, first_samples(passes, size + 2), drive.calibration)


@pytest.fixture(scope="module")
def shard(survey, tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("shards") / "deep" / "world_00031.npz"
    done: list[int] = []
    write_shard(path, survey, "easy", workers=1, progress=done.append)
    assert done == list(range(1, len(survey) + 1))
    return path


def test_a_shard_is_what_was_surveyed(survey, shard):
    content = np.load(shard)
    for row, (index, step) in enumerate([(0, 0), (0, 1)]):
        sample = survey.sample(index, step)
        assert np.array_equal(content["images"][row], sample.image)
        assert np.array_equal(content["points"][row, : len(sample.points)], sample.points)
        assert np.isnan(content["points"][row, len(sample.points) :].astype(float)).all()
        assert np.array_equal(content["depth"][row], sample.depth)
        assert content["sun"][row].tolist() == pytest.approx(list(sample.sun))
    poses = np.stack([survey.pose(0, step) for step in range(len(survey.passes[0].path))])
    np.testing.assert_allclose(content["world_T_body"][: len(poses)], poses, atol=1e-3)


def test_training_reads_what_the_simulator_wrote(survey, shard):
    world = SimulatedWorld(shard)
    assert (len(world), world.setting, world.family, world.seed) == (len(survey), "easy", "etna", 31)
    sample, written = world.sample(1), survey.sample(0, 1)
    assert np.array_equal(sample.image, written.image)
    assert np.array_equal(sample.points, written.points[:, :3].astype(np.float32))
    assert sample.camera.fx == survey.calibration.camera.fx
    assert np.array_equal(sample.body_T_camera, survey.calibration.body_T_camera)
    assert world.pass_index.tolist() == [0] * (len(survey) - 2) + [1, 1]


def test_an_interrupted_survey_leaves_nothing(survey, tmp_path):
    def stop(done: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_shard(tmp_path / "a.npz", survey, "easy", workers=1, progress=stop)
    assert list(tmp_path.iterdir()) == []


def test_a_full_disk_leaves_the_old_shard(tmp_path):
    path = tmp_path / "a.npz"
    save(path, {"a": np.arange(3)})
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, limits[1]))
    try:
        with pytest.raises(OutputError, match=r"cannot write .*a\.npz: File too large"):
            save(path, {"a": np.zeros(100_000)})
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert [file.name for file in tmp_path.iterdir()] == ["a.npz"]
    assert np.load(path)["a"].tolist() == [0, 1, 2]


def test_every_family_comes_in_both_settings():
    plans = [shard_plan(seed) for seed in range(len(FAMILIES) * 3)]
    assert {(family, setting) for family, setting in plans} == {(f, s) for f in FAMILIES for s in ("easy", "hard")}
    assert plans == [shard_plan(seed) for seed in range(len(FAMILIES) * 3)]


# the pool


def test_only_a_few_results_wait_to_be_taken():
    started: list[int] = []

    def work(task: int) -> int:
        started.append(task)
        return task

    with ThreadPoolExecutor(2) as pool:
        results = ahead(pool, work, iter(range(1000)), depth=3)
        assert [next(results) for _ in range(5)] == [0, 1, 2, 3, 4]
        assert len(started) <= 5 + 3
        results.close()


@pytest.mark.parametrize("count", [0, 1, 4, 5])
def test_few_tasks_are_done_all_the_same(count):
    with ThreadPoolExecutor(2) as pool:
        assert list(ahead(pool, str, range(count))) == [str(task) for task in range(count)]
