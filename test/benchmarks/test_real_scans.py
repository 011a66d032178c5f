"""Reading a plain folder of scans, and counting what was made of it."""

from __future__ import annotations

import numpy as np
import pytest
from conftest import make_keyframe
from measurements import GOOD
from scipy.spatial.transform import Rotation

from benchmarks.accuracy.real_scans import RealPair, cropped, draw_pairs, read_pairs, summary
from umf_ros.core.frames import Candidate, LoopClosure
from umf_ros.core.geometry import make_pose
from umf_ros.sensors.decode import Cloud
from umf_ros.verification import Hypothesis


def test_pairs_are_read_with_their_pose_where_it_is_known(tmp_path):
    path = tmp_path / "pairs.csv"
    path.write_text(
        "match_scan,query_scan,same_place,x,y,z,qx,qy,qz,qw\na.npy,b.npy,1,1,2,3,0,0,0,1\nc.npy,d.npy,0,,,,,,,\n"
    )
    known, unknown = read_pairs(path)
    assert (known.match, known.query, known.same_place) == ("a.npy", "b.npy", True)
    assert known.match_T_query == pytest.approx(make_pose(np.eye(3), [1, 2, 3]))
    assert not unknown.same_place
    assert unknown.match_T_query is None


def test_cropping_leaves_a_view_ahead():
    cloud = Cloud(np.array([[5, 0, 1], [5, 4, 0], [-5, 0, 0]], np.float32), np.arange(3, dtype=np.float32))
    narrow = cropped(cloud, 36.0)
    assert narrow.points == pytest.approx(cloud.points[:1]) and narrow.intensity == pytest.approx([0])
    assert len(cropped(cloud, 180.0).points) == 3


def test_drawn_pairs_are_far_apart_and_half_of_them_alike(tmp_path):
    (tmp_path / "scans").mkdir()
    for number in range(60):
        np.save(tmp_path / "scans" / f"{number:03d}.npy", np.zeros((1, 3)))
    keyframes = {f"scans/{n:03d}.npy": make_keyframe(n, seed=n % 25) for n in range(60)}  # n and n + 25 look the same
    pairs = list(draw_pairs(tmp_path, keyframes.__getitem__, 40, 20))
    numbers = [(int(pair.match[6:9]), int(pair.query[6:9])) for pair in pairs]
    assert len(pairs) == 40
    assert all(query - match > 20 for match, query in numbers)
    alike = [query for match, query in numbers if (query - match) % 25 == 0]
    assert len(alike) >= sum(query >= 25 for _, query in numbers) / 2
    assert not any(pair.same_place for pair in pairs)


def test_true_false_and_misplaced_closures_are_told_apart():
    pose = make_pose(np.eye(3), [1.0, 0.0, 0.0])
    off = make_pose(np.eye(3), [2.5, 0.0, 0.0])

    def verdict(estimate):
        closure = None if estimate is None else LoopClosure(2, 1, estimate, np.eye(6) * 0.01)
        return Hypothesis(2, Candidate(0, 1, 0.5), GOOD, closure=closure)

    true, false = RealPair("a", "b", True, pose), RealPair("a", "c", False)
    unknown = RealPair("a", "d", True)
    figures = summary(
        [
            (true, verdict(pose)),
            (true, verdict(off)),
            (true, verdict(None)),
            (unknown, verdict(off)),
            (false, verdict(pose)),
            (false, verdict(None)),
        ]
    )
    counted = {key: figures[key] for key in figures if key.startswith(("true", "false"))}
    assert counted == {"true_pairs": 4, "true_accepted": 2, "true_misplaced": 1, "false_pairs": 2, "false_accepted": 1}
    assert figures["error_median_m"] == pytest.approx(0)
    assert figures["inside_95"] == 1


@pytest.mark.parametrize(("off_m", "inside"), [(0.0, 1.0), (0.3, 1.0), (1.0, 0.0)])
def test_closures_are_compared_among_themselves(off_m, inside):
    turned = make_pose(Rotation.from_euler("z", 70, degrees=True).as_matrix(), [2.0, 1.0, 0.0])
    there = {"ab": turned, "bc": turned, "ac": turned @ turned @ make_pose(np.eye(3), [off_m, 0, 0])}

    def verdict(pose):
        return Hypothesis(2, Candidate(0, 1, 0.5), GOOD, closure=LoopClosure(2, 1, pose, np.eye(6) * 0.01))

    figures = summary([(RealPair(*name, True, pose), verdict(pose)) for name, pose in there.items()])
    assert (figures["triangles"], figures["triangles_inside_95"]) == (1, inside)
