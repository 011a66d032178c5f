from __future__ import annotations

import numpy as np
import pytest
from command_line import umf

from umf_ros.core.errors import OutputError
from umf_ros.core.geometry import invert, transform
from umf_ros.lab.simulation.camera import resized
from umf_ros.lab.simulation.presets import first_samples
from umf_ros.lab.simulation.route import SETTINGS, plan_passes
from umf_ros.lab.simulation.survey import Survey, contact_sheet, save, shard_plan, write_shard


@pytest.fixture(scope="module")
def survey(drive) -> Survey:
    trail = drive.world.relief.trail
    passes = plan_passes(trail, ("first", "offset"), SETTINGS["hard"], 60.0, seed=2)
    return Survey(drive.world, passes, drive.calibration)


@pytest.fixture(scope="module")
def shard(survey, tmp_path_factory):
    path = tmp_path_factory.mktemp("shards") / "world.npz"
    short = Survey(survey.world, first_samples(survey.passes, len(survey.passes[0].path) + 2), survey.calibration)
    write_shard(path, short, "hard")
    return np.load(path)


def test_a_shard_holds_what_training_needs(shard):
    count = len(shard["images"])
    assert shard["images"].shape == (count, 224, 224) and shard["images"].dtype == np.uint8
    assert shard["points"].dtype == np.float16 and shard["points"].shape[::2] == (count, 4)
    assert shard["depth"].shape == (count, 56, 56)
    assert shard["world_T_body"].shape == (count, 4, 4)
    assert shard["pass_index"].tolist() == sorted(shard["pass_index"].tolist()) and shard["pass_index"][-1] == 1
    assert shard["labels"].tolist() == ["first", "offset"] and str(shard["family"]) == "etna"


def test_points_of_a_shard_are_returns_in_the_body_frame(shard):
    points = shard["points"].astype(float)
    real = np.isfinite(points).all(2)
    assert real.any(1).all() and (points[real][:, 3] > 15).all()
    assert (points[real][:, 0] > 0).all()  # the LiDAR looks ahead
    assert all((~row[row.argmin() :]).all() for row in real if not row.all())  # the padding is at the end


def test_points_and_depth_of_a_shard_agree(shard):
    """Float16 and 16 pixels per cell of depth: within 3 % in the median."""
    from umf_ros.core.frames import StereoCamera

    names = ("width", "height", "fx", "fy", "cx", "cy", "baseline")
    full = StereoCamera(*(shard[name].item() for name in names))
    camera = resized(full, 224, 224)
    errors = []
    for points, depth in zip(shard["points"].astype(float), shard["depth"].astype(float), strict=True):
        body = points[np.isfinite(points).all(1), :3]
        seen = transform(invert(shard["body_T_camera"]), body)
        u = np.round((camera.fx * seen[:, 0] / seen[:, 2] + camera.cx - 2) / 4).astype(int)
        v = np.round((camera.fy * seen[:, 1] / seen[:, 2] + camera.cy - 2) / 4).astype(int)
        inside = (u >= 0) & (u < 56) & (v >= 0) & (v < 56)
        errors.append(np.abs(depth[v[inside], u[inside]] / seen[inside, 2] - 1))
    assert np.median(np.concatenate(errors)) < 0.03


def test_samples_do_not_depend_on_the_number_of_workers(survey):
    samples = [next(survey.samples(workers)) for workers in (1, 3)]
    assert np.array_equal(samples[0].image, samples[1].image)
    assert np.array_equal(samples[0].points, samples[1].points)


def test_an_unwritable_shard_is_one_clear_line(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="cannot write"):
        save(tmp_path / "file" / "shard.npz", {"a": np.zeros(3)})


def test_plans_mix_families_and_are_mostly_hard():
    plans = [shard_plan(seed) for seed in range(48)]
    assert len({family for family, _ in plans}) == 8
    assert sum(setting == "hard" for _, setting in plans) == 32


def test_a_contact_sheet_shows_24_frames_and_6_scans(survey, tmp_path):
    import cv2

    contact_sheet(survey, tmp_path / "sheet.png")
    sheet = cv2.imread(str(tmp_path / "sheet.png"))
    assert sheet.shape == (4 * 256 + 416, 6 * 344, 3)
    tiles = sheet[: 4 * 256].reshape(4, 256, 6, 344, 3).astype(float).std(axis=(1, 3, 4))
    assert (tiles > 5).all()


def test_worlds_are_simulated_at_once_and_existing_ones_are_kept(tmp_path):
    command = ("simulate", "--shards", tmp_path, "--worlds", "3:5", "--every", "80")
    assert umf(*command).status == 0
    worlds = [tmp_path / f"world_0000{seed}.npz" for seed in (3, 4)]
    one, other = (np.load(path)["images"] for path in worlds)
    assert len(one) >= 2 and len(other) >= 2 and not np.array_equal(one[0], other[0])
    written = [path.stat().st_mtime_ns for path in worlds]
    assert umf(*command).status == 0
    assert [path.stat().st_mtime_ns for path in worlds] == written
