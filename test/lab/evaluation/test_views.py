"""Views from files and recordings become keyframes, each once."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from recordings import CALIBRATION, CLOUD, ODOMETRY, START_NS, cloud, odometry, scan, traverse, write_mcap
from submaps_drives import Drive, drive, rough_ground

from umf_ros.baselines.handcrafted import ThumbnailEmbedder
from umf_ros.core.config import Verification
from umf_ros.core.errors import CalibrationError, ConfigError, UmfError
from umf_ros.core.frames import Embedding, Frame
from umf_ros.core.geometry import invert, make_pose, relative, transform
from umf_ros.core.trajectory import Trajectory
from umf_ros.lab.evaluation import place_views
from umf_ros.lab.evaluation.comparison import Comparer, judge
from umf_ros.lab.evaluation.place_views import PlaceView, ViewReader
from umf_ros.lab.scan_files import SensorFileError
from umf_ros.verification import Verifier


class CountingEmbedder(ThumbnailEmbedder):
    """Keeps what it was asked to embed."""

    def __init__(self) -> None:
        super().__init__()
        self.frames: list[Frame] = []

    def embed(self, frame: Frame) -> Embedding:
        self.frames.append(frame)
        return super().embed(frame)


@pytest.fixture
def here(tmp_path: Path) -> Path:
    rng = np.random.default_rng(1)
    np.save(tmp_path / "scan.npy", rng.uniform(-20, 20, (400, 4)).astype(np.float32))
    cv2.imwrite(str(tmp_path / "left.png"), rng.integers(0, 255, (48, 64, 3), np.uint8))
    (tmp_path / "calibration.yaml").write_text(CALIBRATION.replace("min_intensity: 15", ""))
    write_mcap(tmp_path / "drive.mcap", traverse(3.0))
    return tmp_path


def test_a_scan_alone_is_in_the_body_frame(here: Path) -> None:
    embedder = CountingEmbedder()
    keyframe = ViewReader(embedder).keyframe(PlaceView(str(here / "scan.npy")))
    (frame,) = embedder.frames
    np.testing.assert_array_equal(frame.points, np.load(here / "scan.npy")[:, :3])
    np.testing.assert_array_equal(keyframe.body_T_lidar, np.eye(4))


def test_with_a_calibration_images_belong_to_it(here: Path) -> None:
    embedder = CountingEmbedder()
    source = ViewReader(embedder, calibration=here / "calibration.yaml")
    image = str(here / "left.png")
    source.keyframe(PlaceView(str(here / "scan.npy"), image, image))
    (frame,) = embedder.frames
    assert frame.left is not None and frame.right is not None and frame.points is not None
    assert frame.camera.fx == 60


def test_a_view_without_what_the_method_reads_is_refused(here: Path) -> None:
    source = ViewReader(CountingEmbedder(), method="netvlad")
    with pytest.raises(ConfigError, match=r"netvlad reads images alone, and .*scan\.npy has none"):
        source.keyframe(PlaceView(str(here / "scan.npy")))
    source.keyframe(PlaceView("", str(here / "left.png")))


def test_without_one_they_are_left_aside_and_it_says_so_once(here: Path) -> None:
    told: list[str] = []
    embedder = CountingEmbedder()
    source = ViewReader(embedder, warn=told.append)
    for right in ("", "other.png"):
        source.keyframe(PlaceView(str(here / "scan.npy"), str(here / "left.png"), right))
    assert [frame.left for frame in embedder.frames] == [None, None]
    assert told == ["images beside a scan are not used without a calibration"]


def test_a_view_in_many_pairs_is_embedded_once(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(place_views, "CACHED_KEYFRAMES", 2)
    embedder = CountingEmbedder()
    source = ViewReader(embedder, calibration=here / "calibration.yaml")
    one, two = PlaceView(str(here / "scan.npy")), PlaceView("", str(here / "left.png"))
    three = PlaceView(str(here / "drive.mcap@1"))
    for view in (one, two, one, one, two):
        source.keyframe(view)
    assert len(embedder.frames) == 2
    source.keyframe(three)  # no room: the one that was not used for longest goes
    source.keyframe(two)
    assert len(embedder.frames) == 3
    source.keyframe(one)
    assert len(embedder.frames) == 4


def test_a_recording_is_read_once_for_all_that_is_expected_of_it(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    opened: list[Path] = []
    really_open = place_views.open_bag

    def count(path: Path) -> object:
        opened.append(path)
        return really_open(path)

    monkeypatch.setattr(place_views, "open_bag", count)
    source = ViewReader(ThumbnailEmbedder(), calibration=here / "calibration.yaml")
    asked = [PlaceView(f"{here}/drive.mcap@{second}") for second in (2, 0.5, 1, 0.5, 99)]
    source.expect(asked)
    stamps = [source.keyframe(view).stamp_ns for view in asked[:4]]
    assert len(opened) == 1
    assert stamps[1] == stamps[3] and stamps[1] < stamps[2] < stamps[0]
    with pytest.raises(UmfError, match="no frame within a second of 99"):
        source.keyframe(asked[4])
    assert len(opened) == 1
    source.keyframe(PlaceView(f"{here}/drive.mcap@1.2"))  # not expected
    assert len(opened) == 2


@pytest.mark.parametrize(
    ("view", "text"),
    [
        (PlaceView(), "neither a scan nor a left image"),
        (PlaceView("", "", "left.png"), "neither a scan nor a left image"),
        (PlaceView("nowhere.pcd"), "cannot read .*nowhere.pcd"),
        (PlaceView("", "nowhere.png"), "cannot read .*nowhere.png"),
        (PlaceView("nowhere.mcap@1"), "there is no recording .*nowhere.mcap"),
        (PlaceView("drive.mcap@soon"), "drive.mcap@soon: 'soon' is neither"),
        (PlaceView("drive.mcap@1", "left.png"), "drive.mcap@1 brings its own images"),
        (PlaceView("calibration.yaml@1"), "calibration.yaml"),
    ],
)
def test_what_cannot_be_read_is_said_every_time(here: Path, view: PlaceView, text: str) -> None:
    source = ViewReader(ThumbnailEmbedder(), calibration=here / "calibration.yaml")
    there = PlaceView(*(str(here / name) if name else "" for name in (view.scan, view.left, view.right)))
    for _ in range(2):
        with pytest.raises(UmfError, match=text):
            source.keyframe(there)


@pytest.mark.parametrize("change", [lambda points: points * 1000, lambda points: points + 1e5], ids=["mm", "map"])
def test_a_scan_in_another_unit_or_frame_is_none(here: Path, change: Callable[[np.ndarray], np.ndarray]) -> None:
    np.save(here / "scan.npy", change(np.load(here / "scan.npy")))
    with pytest.raises(SensorFileError, match=r"scan\.npy has no return within reach: expected metres"):
        ViewReader(ThumbnailEmbedder()).keyframe(PlaceView(str(here / "scan.npy")))


def test_a_calibration_that_cannot_be_read_is_said_at_once(here: Path) -> None:
    with pytest.raises(CalibrationError, match="cannot read"):
        ViewReader(ThumbnailEmbedder(), calibration=here / "nowhere.yaml")


def test_a_data_set_names_its_calibration(here: Path) -> None:
    embedder = CountingEmbedder()
    cv2.imwrite(str(here / "left.png"), np.zeros((512, 688), np.uint8))
    ViewReader(embedder, calibration=Path("simulated")).keyframe(PlaceView("", str(here / "left.png")))
    assert embedder.frames[0].camera.fx > 300


def recorded(path: Path, outing: Drive, with_odometry: bool) -> Path:
    """The way there and back as a recording of a LiDAR and odometry."""
    body_T_lidar = make_pose([[0, 1, 0], [-1, 0, 0], [0, 0, 1]], [0.2, 0.0, 0.6])
    entries = []
    for one in outing.keyframes:
        stamp = START_NS + one.stamp_ns
        records = scan(transform(invert(body_T_lidar), one.points.astype(float)))
        entries += [(CLOUD, stamp + 2_000_000, cloud(stamp, records))]
    if with_odometry:
        odom = Trajectory.rising((START_NS + one.stamp_ns, one.odom_T_body) for one in outing.keyframes)
        moments = np.arange(odom.stamps_ns[0], odom.stamps_ns[-1] + 1, 50_000_000)
        for moment, pose in zip(moments.tolist(), odom.at(moments, np.inf)[0], strict=True):
            entries += [(ODOMETRY, moment + 1_000_000, odometry(moment, pose))]
    return write_mcap(path, sorted(entries, key=lambda entry: entry[1]))


@pytest.mark.parametrize("with_odometry", [True, False])
def test_frames_seen_from_opposite_sides_by_a_narrow_lidar_are_compared_as_submaps(
    tmp_path: Path, with_odometry: bool
) -> None:
    outing = drive(rough_ground(5))
    (tmp_path / "calibration.yaml").write_text(CALIBRATION.replace("offset_s: 0.1", "offset_s: 0.0"))
    bag = recorded(tmp_path / "drive.mcap", outing, with_odometry)
    there, back, near = 18, len(outing.keyframes) - 18, 22
    source = ViewReader(ThumbnailEmbedder(), calibration=tmp_path / "calibration.yaml")
    views = [PlaceView(f"{bag}@{START_NS + outing.keyframes[row].stamp_ns}") for row in (there, back, near)]
    source.expect(views)
    comparer = Comparer(source, Verification())
    row = comparer.compare(*views[:2])
    assert row["accepted"] == with_odometry
    if with_odometry:
        true = relative(outing.truth[there], outing.truth[back])
        assert np.hypot(row["x"] - true[0, 3], row["y"] - true[1, 3]) < 0.5 and abs(row["qz"]) > 0.99
    # submaps of neighbours hold the same scans: they are compared by their own
    alone = judge(Verifier(Verification()), source.keyframe(views[0]), source.keyframe(views[2]))
    assert comparer.compare(views[0], views[2])["probability"] == pytest.approx(alone.probability, abs=1e-6)
