"""Five sessions on one hard world in one map, and ten cold starts in it.

    python benchmarks/accuracy/sessions.py --json sessions.json               # five test worlds, some hours
    python benchmarks/accuracy/sessions.py --quick --seed 20001 --json F      # three short sessions, four cold starts
    python benchmarks/accuracy/sessions.py --both-ways --seed 20001           # every second session the other way round
    python benchmarks/accuracy/sessions.py --what initial --quick --lidar-only --seed 20001
    python benchmarks/accuracy/sessions.py --what cloud --quick --lidar-only --seed 20001
    python benchmarks/accuracy/sessions.py --what grow --quick --seed 20001  # a map that grows where one localises

Every session drives a part of one way of 100 m by a route, light and noise of its own; the world repeats itself
(aliasing 1.0), and all clocks start at the same second. Recordings and maps stay in `--work` and are taken up again.
A seed is a world; recordings are seeds + 1, + 2, and so on; the rover that wakes up drives the one after the last.
Starts are spread over the drive of a visitor over the whole way, where the map has half of the ground that it sees.
With `--both-ways`, every second session and the rover that wakes up drive in the opposite direction, and it wakes up in
the map of the other sessions, all driven against its direction. The LiDAR is 70 degrees wide. `--lidar-only` leaves out
the images, which take most of the time. With `--what grow`, a map is made of the first session; the second and third
localise in it with `localization.update`, and the fourth localises in the map of the first alone and in the grown one;
prints and writes of both `keyframes`, those with a true closure (`closed`), and `wrong` closures.

With `--what cloud`, the cloud of the map (`map.ply`) is imported along the trajectories of its sessions, and visitors
in both directions wake up there: keyframes until the pose was known, None where it was not, and how many starts were
ever `wrong`. With `--what initial`, the same of cold starts with an initial pose: right (off by a click: .3 m, 5 deg),
wrong by 5 m, by 200 m, the last pose of a run, and that of a run elsewhere (kidnapped).

Prints and writes, over all worlds:
- `wrong_between`: closures between sessions that the map believes and the truth refutes (0.5 m, 5 deg);
- `ate_before_m`: error of each session's odometry, every one aligned to the truth by itself, rms over sessions;
- `ate_joint_m`: error of all sessions, aligned to the truth once; of the worst world, as is every other mean below;
- `relocalised_of_10`: cold starts that knew their pose within 20 keyframes, per ten; `relocalised_wrong`: those that
  ever claimed a pose more than 1 m or 5 deg from the truth; `relocalise_keyframes_median`: keyframes until they knew;
- `crispness_before`, `crispness_after`: median thickness in m of surfaces that several sessions saw, by odometry from
  each session's true start in the map and by the joint graph; the less, the crisper.
"""

from __future__ import annotations

import json
import shutil
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np

from umf_ros.absolute.measurement import AbsoluteMeasurement
from umf_ros.bags.frames import FrameReader
from umf_ros.bags.presets import settings_for
from umf_ros.bags.reader import open_bag
from umf_ros.bags.trajectories import read_ground_truth
from umf_ros.core.config import Settings
from umf_ros.core.frames import Frame
from umf_ros.core.geometry import Array, align, cubes, evenly, heading, make_pose, relative, rotation_angle, transform
from umf_ros.core.trajectory import Trajectory, write_tum
from umf_ros.detector import LoopDetector, make_detector_embedder
from umf_ros.lab.program import parser_of, replay, umf, write_figures
from umf_ros.lab.scan_files import read_points
from umf_ros.lab.simulation.bag_writer import BagWriter
from umf_ros.lab.simulation.families import FAMILIES
from umf_ros.lab.simulation.presets import SESSION, SESSION_LOOP_M, Preset, gentle_loop
from umf_ros.lab.simulation.relief import Relief
from umf_ros.lab.simulation.route import Walker
from umf_ros.lab.simulation.simulator import Simulator, record
from umf_ros.lab.simulation.world import TEST
from umf_ros.localizer import Localizer
from umf_ros.map_poses import MIN_SIGMAS, InitialPose, MapPoses, PoseHint
from umf_ros.maps.joint_graph import JointMap, solve
from umf_ros.maps.map_folder import MapFolder, MapSession
from umf_ros.maps.mapping import Opening, add_session, grow, match_session, replay_session, unmatched
from umf_ros.maps.outputs import write_results
from umf_ros.runs.reader import read_run
from umf_ros.runs.truth import PLACE_ANGLE_DEG, PLACE_RADIUS_M, absolute_trajectory_error, judge_closures
from umf_ros.runs.writer import with_places
from umf_ros.sensors.decode import OdometrySample
from umf_ros.sensors.sessions import OdometrySessionSplitter

WITHIN_KEYFRAMES = 20
CLOUD_STARTS = 10
"""Cold starts of each visitor in an imported map."""
STAY = 59
"""Scans after a start of which the map has to have the ground, too."""
WRONG_M, WRONG_DEG = 1.0, 5.0
OVERLAP_M = 20.0
Stream = list[Frame | OdometrySample | AbsoluteMeasurement]


@dataclass(frozen=True)
class Size:
    """How much is driven: sessions, seconds of each (None: the whole route), cold starts, and whether with images."""

    sessions: int
    duration_s: float | None
    starts: int
    images: bool = True


FULL, QUICK = Size(5, None, 10), Size(3, 40.0, 4)


def drive_back(relief: Relief, rng: np.random.Generator) -> Walker:
    """The way of all sessions, in the opposite direction; the preset's length cuts it."""
    loop = gentle_loop(relief, SESSION_LOOP_M, np.random.default_rng(0))[::-1]
    return Walker(np.roll(loop, int(rng.integers(len(loop))), axis=0), rng).forward(150, lateral_m=0.7)


BACK = replace(SESSION, plan=drive_back)
ROUND_BACK = replace(BACK, length_m=150)


def simulated(work: Path, world: int, number: int, size: Size, preset: Preset = SESSION) -> Path:
    """The recording of a session, simulated unless it is there."""
    path = work / f"s{number}{'' if preset is SESSION else '_back'}.mcap"
    if not path.exists():
        family = FAMILIES[world % len(FAMILIES)]
        simulator = Simulator(preset, world + number, size.duration_s, None, family, 1.0, world)
        if not size.images:
            simulator.exposures = []
        with BagWriter(path) as bag:
            record(simulator, bag, workers=1)
    return path


def mapped(path: Path, recordings: list[Path]) -> tuple[MapFolder, JointMap, dict[str, Any]]:
    """The map of all recordings, of which those that are in it already are not replayed again."""
    opening = Opening()
    folder = MapFolder.open_or_create(path, opening.settings(open_bag(recordings[0])))
    known = {session.name for session in folder.sessions}
    for recording in recordings:
        if recording.stem not in known:
            replay_session(recording, opening, folder.folder_of(recording.stem))
            add_session(folder, recording.stem, recording)
    for session in unmatched(folder):
        list(match_session(folder, session))
    joint = solve(folder)
    return folder, joint, write_results(folder, joint)


def truth_of(recording: Path) -> Trajectory:
    truth = read_ground_truth(open_bag(recording))
    assert truth is not None
    return truth


def judge(joint: JointMap, truths: dict[str, Trajectory], summary: dict[str, Any]) -> dict[str, Any]:
    """Closures, trajectories and crispness of one map held against the truth."""
    true = [truths[one.session.name].at(one.stamps)[0] for one in joint.sessions]
    placed = np.concatenate([one.poses[:, :3, 3] for one in joint.sessions])
    odometry = [
        absolute_trajectory_error(one.odometry[:, :3, 3], poses[:, :3, 3])
        for one, poses in zip(joint.sessions, true, strict=True)
        if one.joined
    ]
    believed = joint.accepted_between()
    return {
        "sessions": len(joint.sessions),
        "joined": summary["joined"],
        "overlapping_apart": overlapping_apart(joint, truths),
        "closures_between": len(believed),
        "wrong_between": wrong_closures(joint, truths, [c for c in believed]),
        "wrong_between_published": wrong_closures(joint, truths, [v.closure for v in joint.between]),
        "closures_between_published": len(joint.between),
        "ate_before_m": float(np.sqrt(np.mean(np.square(odometry)))),
        "ate_joint_m": absolute_trajectory_error(placed, np.concatenate([poses[:, :3, 3] for poses in true])),
        "crispness_before": summary["thickness_m"]["before"],
        "crispness_after": summary["thickness_m"]["after"],
    }


def wrong_closures(joint: JointMap, truths: dict[str, Trajectory], closures: list[Any]) -> int:
    """How many closures the truth refutes."""
    true = partial(true_pose, [one.session for one in joint.sessions], truths)
    judged = [judge_closures([c], true(c.query_stamp_ns)[None], true(c.match_stamp_ns)[None])[0] for c in closures]
    return sum(not one.is_true for one in judged)


def true_pose(sessions: list[MapSession], truths: dict[str, Trajectory], map_ns: int) -> Array:
    """The true pose (4, 4) at a stamp of the map; a session that grew the map is named after its run."""
    session = next(one for one in sessions if one.covers(map_ns))
    return truths[session.name.removeprefix("run_")].at(np.array([map_ns - session.shift_ns]))[0][0]


def overlapping_apart(joint: JointMap, truths: dict[str, Trajectory]) -> int:
    """Pairs of sessions that drive the same way for 20 m or more, of which one is not in the map."""
    joined = {one.session.name: one.joined for one in joint.sessions}
    names = list(joined)
    pairs = [(a, b) for i, a in enumerate(names) for b in names[:i] if not (joined[a] and joined[b])]
    return sum(shared_m(truths[a], truths[b]) >= OVERLAP_M for a, b in pairs)


def shared_m(one: Trajectory, other: Trajectory) -> float:
    """Metres of the one's way on which the other was near and looked the same way, or the opposite one."""
    again = sees_again(one.poses, other.poses) | sees_again(one.poses, other.poses, np.pi)
    steps = np.linalg.norm(np.diff(one.poses[:, :3, 3], axis=0), axis=1)
    return float(steps[again[1:]].sum())


def sees_again(poses: Array, known: Array, turn_rad: float = 0.0) -> Any:
    """(N,) which of N poses lie within a place of any known one, in about its direction turned by an angle."""
    rows = known[:: max(1, len(known) // 500)]
    near = np.linalg.norm(poses[:, None, :3, 3] - rows[None, :, :3, 3], axis=-1) <= PLACE_RADIUS_M
    alike = np.cos(heading(poses)[:, None] - heading(rows)[None] - turn_rad) >= np.cos(np.radians(PLACE_ANGLE_DEG))
    return (near & alike).any(axis=1)


def cells(points: Array) -> Any:
    """(N,) numbers of the cells of half a metre in the plane that points (N, 3) lie in."""
    return cubes(points * [1.0, 1.0, 0.0], 0.5)


class Starts(NamedTuple):
    """Cold starts of a visitor: its stream, the rows where they begin, and what they need."""

    stream: Stream
    rows: list[int]
    detector: LoopDetector
    settings: Settings
    map_T_world: Array
    truth: Trajectory

    def true(self, row: int) -> Array:
        """The true pose in the map at a row."""
        return np.asarray(self.map_T_world @ self.truth.at(np.array([self.stream[row].stamp_ns]))[0][0])


def cold_starts(
    folder: MapFolder, joint: JointMap, truths: dict[str, Trajectory], visitor: Path, count: int, turn_rad: float
) -> Starts:
    """The cold starts of a visitor.

    All begin where a session of the map drove in the direction of the visitor, turned by an angle, and where the map
    has half of the ground that the visitor sees, then and 59 scans later: behind its first place, it may have none.
    """
    bag, truth = open_bag(visitor), truth_of(visitor)
    settings = settings_for(bag, None, "auto", mode="localization", map=str(folder.path))
    stream = list(FrameReader(bag, settings).stream())
    true = np.concatenate([truths[one.session.name].at(one.stamps)[0] for one in joint.sessions])
    placed = np.concatenate([one.poses for one in joint.sessions])
    map_T_world = align(true[:, :3, 3], placed[:, :3, 3])[0]
    frames = {row: np.asarray(item.points, float) for row, item in enumerate(stream) if isinstance(item, Frame)}
    poses, known = truth.at(np.array([stream[row].stamp_ns for row in frames], np.int64))
    mapped_cells = cells(read_points(folder.path / "map.ply"))
    seen = [cells(transform(map_T_world @ pose, points)) for pose, points in zip(poses, frames.values(), strict=True)]
    known &= sees_again(poses, true, turn_rad)
    known &= [bool(np.isin(one, mapped_cells).mean() > 0.5) for one in seen]
    usable = np.array(list(frames))[:-STAY][known[:-STAY] & known[STAY:]]
    rows = usable[evenly(len(usable), count)]
    detector = LoopDetector(settings, make_detector_embedder(settings))
    return Starts(stream, rows.tolist(), detector, settings, map_T_world, truth)


def wake(starts: Starts, row: int, initial: InitialPose | None = None) -> tuple[int | None, bool]:
    """Keyframes until one cold start knew its pose, None where it did not, and whether it was ever wrong."""
    detector, known = starts.detector, MapPoses(Path(starts.settings.map))
    detector.end_session()
    localizer = Localizer(known.places, starts.settings.pose_graph)
    if initial is not None:
        localizer.expect(initial)
    detector.hint = None if initial is None else PoseHint(known.places, initial).near
    feed, keyframes, found, wrong = OdometrySessionSplitter(localizer), 0, None, False
    since_ns = starts.stream[row].stamp_ns - 10**9
    before = [one for one in starts.stream[:row] if isinstance(one, OdometrySample) and one.stamp_ns > since_ns]
    for item in before + starts.stream[row:]:
        if isinstance(item, OdometrySample):
            feed.take(item.stamp_ns, item.odom_T_body)
        else:
            assert isinstance(item, Frame)  # localising uses no absolute measurements
            detection = detector.process(item)
            keyframes += detection.keyframe is not None
            for closure in detection.closures:
                localizer.add_closure(closure)
        estimate = localizer.estimate()
        if estimate is not None:
            found = keyframes if found is None else found
            true = starts.map_T_world @ starts.truth.at(np.array([estimate.stamp_ns]))[0][0]
            error = relative(true, estimate.map_T_body)
            wrong |= bool(np.linalg.norm(error[:3, 3]) > WRONG_M or np.degrees(rotation_angle(error)) > WRONG_DEG)
        if keyframes >= WITHIN_KEYFRAMES:
            break
    return found, wrong


def initial_poses(starts: Starts) -> dict[str, Any]:
    """Keyframes until each start with an initial pose knew its pose, by the kind of that pose, and wrong ones."""
    known, rng = MapPoses(Path(starts.settings.map)), np.random.default_rng(0)

    def given(row: int, off_m: float, off_rad: float) -> InitialPose:
        true, way = starts.true(row), rng.uniform(-np.pi, np.pi)
        x_m, y_m = true[:2, 3] + off_m * np.array([np.cos(way), np.sin(way)])
        return known.planar(x_m, y_m, float(heading(true)) + off_rad * float(rng.choice([-1.0, 1.0])))

    def last(pose: Array) -> InitialPose | None:
        with TemporaryDirectory() as folder:
            known.write_last(Path(folder), InitialPose(pose, np.diag(MIN_SIGMAS**2) / 25))
            return known.read_last(Path(folder))

    def furthest(row: int) -> Array:
        away = np.linalg.norm(known.places.poses[:, :3, 3] - starts.true(row)[:3, 3], axis=1)
        return np.asarray(known.places.poses[int(away.argmax())])

    rows, wrong, found = starts.rows, 0, dict[str, list[int | None]]()
    kinds: dict[str, list[InitialPose | None]] = {
        "none": [None for _ in rows],
        "right": [given(row, 0.3, np.radians(5)) for row in rows],
        "wrong by 5 m": [given(row, 5.0, 0.0) for row in rows],
        "wrong by 200 m": [given(row, 200.0, 0.0) for row in rows],
        "restart at the last pose": [last(starts.true(row)) for row in rows],
        "kidnapped": [last(furthest(row)) for row in rows],
    }
    for kind, initial in kinds.items():
        ends = [wake(starts, *one) for one in zip(rows, initial, strict=True)]
        found[kind] = [keyframes for keyframes, _ in ends]
        wrong += sum(is_wrong for _, is_wrong in ends)
    return {"keyframes": found, "wrong": wrong}


def in_cloud(folder: MapFolder, joint: JointMap, truths: dict[str, Trajectory], visitors: list[Path]) -> dict[str, Any]:
    """Keyframes until cold starts in the map of a cloud knew their pose, by visitor, and wrong ones.

    The first visitor drives in the direction of the sessions, the second against it.
    """
    out, found = folder.path.with_name("map_cloud"), dict[str, Any](wrong=0)
    if not (out / "map.json").exists():
        body_T_mast = make_pose(np.eye(3), [0.38, 0.0, 1.27])  # the LiDAR's place, with the axes of the body
        poses = np.concatenate([one.poses @ body_T_mast for one in joint.sessions])
        path = folder.path.with_name("poses.tum")
        write_tum(path, Trajectory(np.arange(len(poses)) * 10**9, poses))
        umf("map", "import-cloud", folder.path / "map.ply", "--trajectory", path, "--fov", "70", "--out", out)
    for visitor, turn_rad in zip(visitors, (0.0, np.pi), strict=True):
        starts = cold_starts(MapFolder.open(out), joint, truths, visitor, CLOUD_STARTS, turn_rad)
        ends = [wake(starts, row) for row in starts.rows]
        found[visitor.stem] = [keyframes for keyframes, _ in ends]
        found["wrong"] += sum(is_wrong for _, is_wrong in ends)
    return found


def run_world(world: int, size: Size, work: Path, both_ways: bool, what: str = "") -> dict[str, Any]:
    """All figures of one world."""
    work.mkdir(parents=True, exist_ok=True)
    if what == "grow":
        return grown(world, size, work)
    numbers = range(1, size.sessions + 1)
    every_second = BACK if both_ways else SESSION
    recordings = [simulated(work, world, number, size, (every_second, SESSION)[number % 2]) for number in numbers]
    truths = {recording.stem: truth_of(recording) for recording in recordings}
    folder, joint, summary = mapped(work / "map", recordings)
    (work / "visitors").mkdir(exist_ok=True)
    whole = size.sessions + 1, replace(size, duration_s=None)  # short ones may meet the map for some metres only
    visitor = simulated(work / "visitors", world, *whole, ROUND_BACK if both_ways else SESSION)
    if what == "cloud":
        visitors = [visitor, simulated(work / "visitors", world, *whole, ROUND_BACK)]
        return {"world": world, **in_cloud(folder, joint, truths, visitors)}
    known = mapped(work / "map_one_way", recordings[::2])[:2] if both_ways else (folder, joint)
    visits = cold_starts(*known, truths, visitor, size.starts, np.pi * both_ways)
    if what == "initial":
        return {"world": world, **initial_poses(visits)}
    starts = [wake(visits, row) for row in visits.rows]
    found = [keyframes for keyframes, _ in starts if keyframes is not None]
    return {
        "world": world,
        **judge(joint, truths, summary),
        "cold_starts": len(starts),
        "relocalised": len(found),
        "relocalised_wrong": sum(wrong for _, wrong in starts),
        "relocalise_keyframes": found,
    }


def grown(world: int, size: Size, work: Path) -> dict[str, Any]:
    """Keyframes, closed keyframes and wrong closures of a fourth session in a map of one session, and of three."""
    first, *later, visitor = (simulated(work, world, number, size) for number in range(1, 5))
    truths = {recording.stem: truth_of(recording) for recording in (first, *later, visitor)}
    still, growing = mapped(work / "map_still", [first])[0].path, work / "map_growing"
    for folder in (growing, *(work / f"run_{name}" for name in ("s2", "s3", "still", "growing"))):
        shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(still, growing)
    for recording in later:
        grow(growing, localised(recording, growing, work / f"run_{recording.stem}", update=True))
    figures: dict[str, Any] = {"world": world, "sessions": len(MapFolder.open(growing).sessions)}
    for name, folder in (("still", still), ("growing", growing)):
        run = read_run(localised(visitor, folder, work / f"run_{name}", update=False))
        sessions, judged = MapFolder.open(folder).sessions, []
        for closure in run.closures:
            query = truths[visitor.stem].at(np.array([closure.query_stamp_ns]))[0]
            match = true_pose(sessions, truths, closure.match_stamp_ns)[None]
            judged.append(judge_closures([closure], query, match)[0])
        right = {one.query_stamp_ns for one in judged if one.is_true}
        figures[name] = {
            "keyframes": len(run.stamps),
            "closed": len(right),
            "wrong": sum(not one.is_true for one in judged),
        }
    return figures


def localised(recording: Path, map_folder: Path, run: Path, update: bool) -> Path:
    """Localise a recording in a map; returns the run folder."""
    run.mkdir()
    bag = open_bag(recording)
    chosen = {"mode": "localization", "map": str(map_folder), "localization__update": update}
    settings = settings_for(bag, None, "auto", **chosen)
    stored = with_places(settings, run) if update else settings
    replay(bag, settings, run, stored=stored)
    return run


def summarise(worlds: list[dict[str, Any]]) -> dict[str, Any]:
    """The figures over all worlds: sums of counts, the worst of the errors, medians of the rest."""
    keyframes = [number for world in worlds for number in world["relocalise_keyframes"]]
    counts = ("sessions", "joined", "overlapping_apart", "closures_between", "wrong_between", "relocalised_wrong")
    crispness = {name: median(world[name] for world in worlds) for name in ("crispness_before", "crispness_after")}
    return {
        **{name: sum(world[name] for world in worlds) for name in counts},
        **{name: round(max(world[name] for world in worlds), 3) for name in ("ate_before_m", "ate_joint_m")},
        "relocalised_of_10": round(
            10 * sum(world["relocalised"] for world in worlds) / sum(world["cold_starts"] for world in worlds), 1
        ),
        "relocalise_keyframes_median": median(keyframes),
        **crispness,
        "worlds": worlds,
    }


def median(values: Any) -> float | None:
    known = [value for value in values if value is not None]
    return round(float(np.median(known)), 4) if known else None


def main() -> None:
    parser = parser_of(__doc__)
    parser.add_argument("--quick", action="store_true", help="three sessions of 40 s, four cold starts")
    parser.add_argument("--both-ways", action="store_true", help="sessions in both directions, cold starts against it")
    parser.add_argument("--what", choices=("", "initial", "cloud", "grow"), default="", help="other figures")
    parser.add_argument("--lidar-only", action="store_true", help="without images")
    parser.add_argument("--seed", type=int, help="seed of a single world")
    parser.add_argument("--work", type=Path, default=Path("results/sessions"), help="of recordings and maps")
    arguments = parser.parse_args()
    size = replace(QUICK if arguments.quick else FULL, images=not arguments.lidar_only)
    kind = ("quick" if arguments.quick else "full") + ("_both_ways" if arguments.both_ways else "")
    kind += "_lidar" if arguments.lidar_only else ""
    worlds = []
    for world in [arguments.seed] if arguments.seed is not None else range(TEST.start + 1, TEST.start + 51, 10):
        folder = arguments.work / f"{kind}_{world}"
        worlds.append(run_world(world, size, folder, arguments.both_ways, arguments.what))
        print(json.dumps(worlds[-1]), flush=True)
    figures = {"worlds": worlds} if arguments.what else summarise(worlds)
    print(json.dumps({name: value for name, value in figures.items() if name != "worlds"}, indent=2))
    write_figures(arguments.json, figures)


if __name__ == "__main__":
    main()
