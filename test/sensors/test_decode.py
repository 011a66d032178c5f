from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from recordings import POINT, START_NS, camera_info, cloud, drive, image, make, odometry, scan

from umf_ros.core.errors import MessageError
from umf_ros.sensors.decode import GreyRange, decode_camera_info, decode_cloud, decode_image, decode_pose, stamp_ns

POINTS = np.array([[1.0, 5.0, 0.5], [-2.0, 8.0, 1.0], [0.3, 12.0, -1.0]])


def kind_of(decode: Any, *messages: Any) -> str:
    with pytest.raises(MessageError) as caught:
        decode(*messages)
    assert "\n" not in str(caught.value)
    return caught.value.kind


def test_stamp_keeps_every_nanosecond() -> None:
    assert stamp_ns(image(START_NS + 123_456_789, np.zeros((2, 2), np.uint8))) == START_NS + 123_456_789


@pytest.mark.parametrize(("sec", "nanosec"), [(2**31 - 1, 2**32 - 1), (2**31 - 1, 10**9), (-1, 0), (0, 0)])
def test_a_stamp_that_cannot_be_sent_on_is_refused(sec: int, nanosec: int) -> None:
    with pytest.raises(MessageError) as caught:
        stamp_ns(SimpleNamespace(header=SimpleNamespace(stamp=SimpleNamespace(sec=sec, nanosec=nanosec))))
    assert caught.value.kind == "stamp"


def test_message_without_a_stamp_is_refused() -> None:
    assert kind_of(stamp_ns, image(0, np.zeros((2, 2), np.uint8))) == "stamp"


def test_grey_image_comes_back_as_it_is(rng: np.random.Generator) -> None:
    pixels = rng.integers(0, 255, (48, 64), np.uint8)
    assert (decode_image(image(0, pixels)) == pixels).all()
    assert (decode_image(image(0, pixels, "8UC1")) == pixels).all()


def test_padding_at_the_end_of_rows_is_left_out(rng: np.random.Generator) -> None:
    padded = rng.integers(0, 255, (48, 80), np.uint8)
    assert (decode_image(image(0, padded, width=64)) == padded[:, :64]).all()


@pytest.mark.parametrize(("order", "is_bigendian"), [("<u2", 0), (">u2", 1)])
def test_mono16_keeps_the_upper_byte(order: str, is_bigendian: int) -> None:
    pixels = np.array([[0, 255, 256, 65535]], order)
    assert decode_image(image(0, pixels, "mono16", is_bigendian=is_bigendian)).tolist() == [[0, 0, 1, 255]]


@pytest.mark.parametrize("bits", [8, 10, 12, 14, 16])
def test_bits_of_16_are_those_that_the_images_use(bits: int, rng: np.random.Generator) -> None:
    """And the same for all images: neither a dark one nor a hot pixel changes the brightness."""
    grey, full = GreyRange(), rng.integers(0, 2**bits, (48, 64)).astype("<u2")
    expected = full >> (bits - 8)
    assert (decode_image(image(0, full, "mono16"), grey) == expected).all()
    dark, hot = full // 8, np.where(np.arange(64) + np.arange(48)[:, None] == 5, 65535, full).astype("<u2")
    assert (decode_image(image(0, dark, "16UC1"), grey) == dark >> (bits - 8)).all()
    png = cv2.imencode(".png", full)[1].tobytes()
    assert (decode_image(SimpleNamespace(format="mono16; png compressed", data=png), grey) == expected).all()
    hot[1:] = full[1:]
    assert (decode_image(image(0, hot, "mono16"), grey)[1:] == expected[1:]).all()


def test_a_thermal_image_far_from_zero_has_contrast(rng: np.random.Generator) -> None:
    counts = rng.integers(29_000, 31_000, (48, 64)).astype("<u2")
    grey = GreyRange()
    first = decode_image(image(0, counts, "mono16"), grey)
    assert np.ptp(first) > 100 and 100 < first.mean() < 155
    assert (decode_image(image(0, counts, "mono16"), grey) == first).all()


def test_black_images_of_16_bits_are_black() -> None:
    assert not decode_image(image(0, np.zeros((4, 4), "<u2"), "mono16")).any()


@pytest.mark.parametrize(
    ("encoding", "channel"), [("rgb16", 0), ("bgr16", 2), ("rgba16", 0), ("bgra16", 2), ("16UC3", 2), ("16UC4", 2)]
)
def test_colours_of_16_bits(encoding: str, channel: int) -> None:
    pixels = np.zeros((4, 6, 4 if encoding in ("rgba16", "bgra16", "16UC4") else 3), "<u2")
    pixels[..., channel] = 4000
    grey = decode_image(image(0, pixels, encoding, width=6))
    assert np.abs(grey.astype(int) - 0.299 * 250).max() <= 1


@pytest.mark.parametrize(
    ("encoding", "channel"), [("8UC3", 2), ("8UC4", 2), ("rgb8", 0), ("bgr8", 2), ("rgba8", 0), ("bgra8", 2)]
)
def test_red_weighs_the_same_in_every_colour_order(encoding: str, channel: int) -> None:
    pixels = np.zeros((4, 6, 4 if "a" in encoding or "4" in encoding else 3), np.uint8)
    pixels[..., channel] = 200
    grey = decode_image(image(0, pixels, encoding, width=6))
    assert grey.shape == (4, 6)
    assert np.abs(grey.astype(int) - 0.299 * 200).max() <= 1


@pytest.mark.parametrize("pattern", ["rggb", "bggr", "gbrg", "grbg"])
@pytest.mark.parametrize(("colour", "weight"), [("r", 0.299), ("g", 0.587), ("b", 0.114)])
def test_bayer_patterns_start_at_the_upper_left(pattern: str, colour: str, weight: float) -> None:
    tile = np.array([200 if cell == colour else 0 for cell in pattern], np.uint8).reshape(2, 2)
    for mosaic, bits in ((tile, 8), (tile.astype("<u2") * 16, 16)):  # 200, and 3200 of 4095
        grey = decode_image(image(0, np.tile(mosaic, (10, 10)), f"bayer_{pattern}{bits}"))
        assert np.abs(grey[4:-4, 4:-4].astype(int) - weight * 200).max() <= 2


@pytest.mark.parametrize(
    ("changes", "kind"),
    [
        ({"encoding": "nv12"}, "encoding"),
        ({"encoding": "16SC1"}, "encoding"),
        ({"width": 0}, "size"),
        ({"height": 0}, "size"),
        ({"step": 63}, "step"),
        ({"width": 65}, "step"),
        ({"height": 49}, "truncated"),
        ({"height": 47}, "step"),
        ({"data": np.zeros(100, np.uint8)}, "truncated"),
        ({"data": np.zeros(0, np.uint8)}, "truncated"),
    ],
)
def test_bad_image_is_refused_by_kind(changes: dict[str, Any], kind: str) -> None:
    assert kind_of(decode_image, image(0, np.zeros((48, 64), np.uint8), **changes)) == kind


def test_refused_encoding_is_named() -> None:
    with pytest.raises(MessageError, match="'nv12'"):
        decode_image(image(0, np.zeros((4, 4), np.uint8), "nv12"))


def test_cloud_of_the_cube_1() -> None:
    decoded = decode_cloud(cloud(0, scan(POINTS, intensity=77, duration_ns=200_000_000)))
    assert decoded.points.dtype == np.float32
    assert np.allclose(decoded.points, POINTS)
    assert decoded.intensity is not None and decoded.intensity.tolist() == [77, 77, 77]
    assert decoded.time_offset_ns is not None and decoded.time_offset_ns.tolist() == [0, 100_000_000, 200_000_000]


def test_pulses_without_a_return_and_points_that_are_not_finite_are_left_out() -> None:
    angles = np.linspace(-0.5, 0.5, 200)
    nowhere = scan(np.stack([np.sin(angles), np.cos(angles), 0 * angles], 1).astype(np.float32), intensity=0)
    bad = scan(np.array([[np.nan, 1, 1], [1, np.inf, 1], [0, 0, 0]]))
    records = np.concatenate([nowhere, scan(POINTS), bad])
    records["point_time_offset"] = np.arange(len(records))
    decoded = decode_cloud(cloud(0, records))
    assert np.allclose(decoded.points, POINTS)
    assert decoded.time_offset_ns is not None and decoded.time_offset_ns.tolist() == [200, 201, 202]
    assert len(decode_cloud(cloud(0, nowhere)).points) == 0


def test_returns_from_beyond_all_lidars_are_left_out() -> None:
    points = np.array([[5, 0, 0], [9000, 0, 0], [2e4, 0, 0], [0, 1e18, 0], [0, 0, 3e38]], np.float32)
    assert decode_cloud(cloud(START_NS, scan(points))).points[:, 0].tolist() == [5, 9000]


def test_a_real_return_one_metre_away_stays() -> None:
    assert len(decode_cloud(cloud(0, scan(np.array([[0.0, 1.0, 0.0]]), intensity=50))).points) == 1


def test_a_return_of_livox_one_metre_away_stays() -> None:
    rows = [(0.0, 1.0, 0.0, 50, 7), (0.0, 0.0, 0.0, 0, 8), (2.0, 0.0, 0.0, 0, 9)]
    points = [SimpleNamespace(x=x, y=y, z=z, reflectivity=r, offset_time=t) for x, y, z, r, t in rows]
    decoded = decode_cloud(SimpleNamespace(header=cloud(0, scan(POINTS)).header, points=points))
    assert decoded.points.tolist() == [[0, 1, 0], [2, 0, 0]]
    assert decoded.intensity is not None and decoded.intensity.tolist() == [50, 0]
    assert decoded.time_offset_ns is not None and decoded.time_offset_ns.tolist() == [7, 9]


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("kind", ["f4", "f8"])
def test_fields_are_read_by_name_and_type_in_any_order(order: str, kind: str) -> None:
    dtype = np.dtype([("ring", order + "u2"), ("z", order + kind), ("intensity", order + "f4"), ("x", order + kind)])
    records = np.zeros(3, np.dtype([*dtype.descr, ("y", order + kind)]))
    for axis, values in zip("xyz", POINTS.T, strict=True):
        records[axis] = values
    records["intensity"] = [20, 30, 40]
    decoded = decode_cloud(cloud(0, records))
    assert np.allclose(decoded.points, POINTS)
    assert decoded.intensity is not None and decoded.intensity.tolist() == [20, 30, 40]
    assert decoded.time_offset_ns is None


def test_only_coordinates_are_enough() -> None:
    records = np.zeros(3, [("x", "<f4"), ("y", "<f4"), ("z", "<f4")])
    records["y"] = [2, 3, 1]
    decoded = decode_cloud(cloud(0, records))
    # without an intensity, a range of exactly one metre is a pulse without a return
    assert decoded.points[:, 1].tolist() == [2, 3]
    assert decoded.intensity is None and decoded.time_offset_ns is None


def test_organised_cloud_with_padded_rows() -> None:
    records = np.concatenate([scan(POINTS), scan(POINTS + 1)])
    rows = [half.tobytes() + bytes(12) for half in (records[:3], records[3:])]
    data = np.frombuffer(b"".join(rows), np.uint8)
    decoded = decode_cloud(cloud(0, records, height=2, width=3, row_step=len(rows[0]), data=data))
    assert np.allclose(decoded.points, np.concatenate([POINTS, POINTS + 1]))


def test_empty_cloud_is_no_fault() -> None:
    assert len(decode_cloud(cloud(0, scan(np.empty((0, 3))))).points) == 0


@pytest.mark.parametrize(
    ("dtype", "changes", "kind"),
    [
        ([("x", "<f4"), ("y", "<f4")], {}, "fields"),
        (POINT, {"data": np.zeros(27, np.uint8)}, "truncated"),
        (POINT, {"width": 4}, "truncated"),
        (POINT, {"point_step": 24, "row_step": 72}, "step"),
        (POINT, {"height": 2, "width": 3, "row_step": 28}, "step"),
    ],
)
def test_bad_cloud_is_refused_by_kind(dtype: Any, changes: dict[str, Any], kind: str) -> None:
    assert kind_of(decode_cloud, cloud(0, np.ones(3, dtype), **changes)) == kind


def test_a_point_of_many_bytes_is_refused() -> None:
    wide = np.dtype({"names": ["x", "y", "z"], "formats": ["<f4"] * 3, "offsets": [0, 4, 8], "itemsize": 5000})
    assert kind_of(decode_cloud, cloud(START_NS, np.zeros(2, wide))) == "step"


def test_unknown_data_type_is_refused() -> None:
    message = cloud(0, scan(POINTS))
    message.fields[2].datatype = 99
    assert kind_of(decode_cloud, message) == "datatype"


@pytest.mark.parametrize(
    ("part", "field", "value"),
    [("position", "x", np.nan), ("position", "z", np.inf), ("orientation", "w", 0.5), ("orientation", "y", np.nan)],
)
def test_pose_that_is_none_is_refused(part: str, field: str, value: float) -> None:
    message = odometry(START_NS, np.eye(4))
    setattr(getattr(message.pose.pose, part), field, value)
    assert kind_of(decode_pose, message.pose.pose) == "pose"


def test_camera_info_gives_the_pair() -> None:
    camera = decode_camera_info(camera_info(0, 579.5, (688, 512)), camera_info(0, 579.5, (688, 512), baseline=0.2))
    assert (camera.width, camera.height, camera.fx, camera.fy) == (688, 512, 579.5, 579.5)
    assert (camera.cx, camera.cy) == (344, 256)
    assert camera.baseline == pytest.approx(0.2)
    assert decode_camera_info(camera_info(0, 579.5, (688, 512))).baseline == 0


def test_camera_info_without_projection_uses_the_camera_matrix() -> None:
    camera = decode_camera_info(camera_info(0, 400.0, (640, 480), p=np.zeros(12)))
    assert (camera.fx, camera.cx, camera.cy) == (400, 320, 240)


@pytest.mark.parametrize("changes", [{"k": np.zeros(9), "p": np.zeros(12)}, {"width": 0}, {"p": np.full(12, np.nan)}])
def test_uncalibrated_camera_info_is_refused(changes: dict[str, Any]) -> None:
    assert kind_of(decode_camera_info, camera_info(0, 579.5, (688, 512), **changes)) == "camera_info"


def window(offset: tuple[int, int] = (0, 0), part: tuple[int, int] = (0, 0), binning: int = 0) -> dict[str, Any]:
    region = {"x_offset": offset[0], "y_offset": offset[1], "width": part[0], "height": part[1], "do_rectify": True}
    return {"binning_x": binning, "binning_y": binning, "roi": make("sensor_msgs/msg/RegionOfInterest", **region)}


@pytest.mark.parametrize(
    ("sensor", "focal", "centre", "changes", "size", "expected"),
    [
        ((1376, 1024), 1159.0, (688.0, 512.0), window(binning=2), None, (688, 512, 579.5, 344, 256)),
        # the Mako's driver
        ((1376, 1024), 579.5, (344.0, 256.0), window(binning=2), None, (688, 512, 579.5, 344, 256)),
        ((788, 572), 579.5, (384.0, 286.0), window((40, 30), (688, 512)), None, (688, 512, 579.5, 344, 256)),
        ((788, 572), 579.5, (384.0, 286.0), window((40, 30), (688, 512), 1), None, (688, 512, 579.5, 344, 256)),
        ((1576, 1144), 1159.0, (768.0, 572.0), window((80, 60), (1376, 1024), 2), None, (688, 512, 579.5, 344, 256)),
        ((688, 512), 579.5, (344.0, 256.0), window(part=(688, 512)), None, (688, 512, 579.5, 344, 256)),
        ((688, 512), 579.5, (344.0, 256.0), window((0, 256), (688, 256)), None, (688, 256, 579.5, 344, 0)),
        # flags of another mode than the images'
        ((688, 512), 579.5, (344.0, 256.0), window(binning=2), (688, 512), (688, 512, 579.5, 344, 256)),
    ],
)
def test_binning_and_region_are_those_of_rep_104(
    sensor: Any, focal: float, centre: Any, changes: Any, size: Any, expected: Any
) -> None:
    k = np.array([focal, 0, centre[0], 0, focal, centre[1], 0, 0, 1])
    p = np.insert(k.astype(float), [3, 6, 9], 0)
    right = p.copy()
    right[3] = -focal * 0.2
    infos = [camera_info(0, focal, sensor, **{"k": k, "p": one, **changes}) for one in (p, right)]
    camera = decode_camera_info(*infos, size)
    assert (camera.width, camera.height, camera.fx, camera.cx, camera.cy) == pytest.approx(expected)
    assert camera.fy == camera.fx and camera.baseline == pytest.approx(0.2)


def with_p(stereo: float, **places: float) -> Any:
    info = camera_info(0, 579.5, (688, 512), baseline=stereo)
    for place, value in places.items():
        info.p[int(place[1:])] = value
    return info


@pytest.mark.parametrize(
    ("right", "text"),
    [
        ({"stereo": 0.0}, "baseline of -?0 m"),
        ({"stereo": -0.2}, "baseline of -0.2 m, by its P.3. of 115.9"),
        ({"stereo": 0.2, "p3": -0.2}, "baseline of 0.0003451 m, by its P.3. of -0.2, which is -fx . metres"),
        ({"stereo": 0.2, "p0": 583.2}, "not of one rectified pair: fx 579.5, .* and fx 583.2"),
        ({"stereo": 0.2, "p2": 318.0}, "not of one rectified pair: .*cx 318.0"),
    ],
)
def test_pair_without_a_baseline_is_refused(right: dict[str, float], text: str) -> None:
    with pytest.raises(MessageError, match=text) as caught:
        decode_camera_info(camera_info(0, 579.5, (688, 512)), with_p(**right))
    assert caught.value.kind == "camera_info" and "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("left", "right", "text"),
    [
        ({"stereo": -0.2}, {"stereo": 0.0}, ""),  # the right camera is the origin
        ({"stereo": 0.2}, {"stereo": 0.2}, "0.2 m is taken as the baseline"),  # Gazebo
        ({"stereo": 0.0, "p1": -52.4}, {"stereo": 0.2, "p1": -52.4}, "not that of a rectified camera: P[1] is -52.4"),
    ],
)
def test_unusual_pairs_are_used_and_told(left: dict[str, float], right: dict[str, float], text: str) -> None:
    told: list[str] = []
    assert decode_camera_info(with_p(**left), with_p(**right), None, told.append).baseline == pytest.approx(0.2)
    assert len(told) == bool(text) and all(text in line for line in told)


def test_messages_of_rclpy_are_the_same(rng: np.random.Generator) -> None:
    from array import array

    from sensor_msgs.msg import Image, PointCloud2, PointField

    pixels = rng.integers(0, 255, (8, 6), np.uint8)
    message = Image(height=8, width=6, step=6, encoding="mono8", data=array("B", pixels.tobytes()))
    assert (decode_image(message) == pixels).all()
    records = scan(POINTS, duration_ns=100)
    fields = [
        PointField(name=field.name, offset=field.offset, datatype=field.datatype, count=1)
        for field in cloud(0, records).fields
    ]
    ros_cloud = PointCloud2(
        height=1, width=3, fields=fields, point_step=28, row_step=84, data=array("B", records.tobytes())
    )
    ours, theirs = decode_cloud(cloud(0, records)), decode_cloud(ros_cloud)
    assert (ours.points == theirs.points).all()
    assert (ours.time_offset_ns == theirs.time_offset_ns).all()


@pytest.mark.parametrize(("encoding", "place"), [("yuv422", 1), ("uyvy", 1), ("yuv422_yuy2", 0), ("yuyv", 0)])
def test_of_colours_in_pairs_the_brightness_is_taken(encoding: str, place: int) -> None:
    pixels = np.full((4, 6, 2), 200, np.uint8)
    pixels[..., place] = np.arange(24).reshape(4, 6)
    np.testing.assert_array_equal(decode_image(image(0, pixels, encoding)), np.arange(24).reshape(4, 6))


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("kind", ["f4", "f8"])
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 3e38, 1e20, 1e9, 65.6, -9999.0, 1e-40, 5e-324, 0.0])
def test_numbers_that_no_sensor_sends_raise_no_warning(kind: str, value: float) -> None:
    rng = np.random.default_rng(0)
    for times in ("t", "time", "timestamp"):
        names = ("x", "y", "z", "intensity", times)
        for name in names:
            for share in (0.1, 1.0):
                records = np.zeros(300, [(one, kind) for one in names])
                records["x"], records["y"], records["z"] = rng.uniform(5, 15, (3, 300))
                records[times] = np.linspace(0.0, 0.2, 300)
                with np.errstate(all="ignore"):
                    records[name][rng.random(300) < share] = value
                found = decode_cloud(cloud(START_NS, records))
                assert np.isfinite(found.points).all()
                assert found.time_offset_ns is None or np.abs(found.time_offset_ns).max(initial=0) < 10**9


@pytest.mark.filterwarnings("error")
def test_an_orientation_that_overflows_is_refused_without_a_warning() -> None:
    message = odometry(START_NS, drive(0.0))
    message.pose.pose.orientation.w = 1e300
    assert kind_of(decode_pose, message.pose.pose) == "pose"
