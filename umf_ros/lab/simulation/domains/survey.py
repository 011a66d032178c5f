"""Domains: a LiDAR in a kind of place on a mount, and the scans that it takes there with their true poses.

A new mount is a row in `MOUNTS`, a new kind of place a class and a row in `PLACES`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Protocol, cast

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from umf_ros.core.geometry import Array, interpolate, make_pose, transform
from umf_ros.lab.simulation.domains.indoors import Corridor, Rooms, Rows, Tunnel
from umf_ros.lab.simulation.domains.outdoors import Landscape, Plain, Quarry, Trees
from umf_ros.lab.simulation.domains.scanners import SCANNERS, Scanner, Sweep, stamp_moment, sweep
from umf_ros.lab.simulation.domains.solids import Scene
from umf_ros.lab.simulation.domains.street import Street
from umf_ros.lab.simulation.motion_sensors import Drift, drifted
from umf_ros.lab.simulation.relief import Relief
from umf_ros.lab.simulation.route import Setting, plan_passes, stand
from umf_ros.lab.simulation.world import World, check_seed


@dataclass(frozen=True, slots=True)
class Mount:
    """Where the LiDAR sits on its carrier, and how the carrier moves.

    Attributes:
        height_m: of the LiDAR above the ground.
        tilt_deg: largest roll and pitch of the LiDAR, drawn once per world.
        speed_m_s: of the carrier.
        sway_deg: amplitude of the carrier's rolling and pitching while it drives.
        calibrated: whether scans come in the upright body frame on the ground, rather than the LiDAR's own.
        sway_hz: about how often it rolls and pitches in a second.
    """

    height_m: float
    tilt_deg: float
    speed_m_s: float
    sway_deg: float
    calibrated: bool
    sway_hz: float = 1.0

    def body_T_lidar(self, rng: np.random.Generator) -> Array:
        """Pose of the LiDAR on one carrier."""
        roll, pitch = np.radians(self.tilt_deg) * rng.uniform(-1, 1, 2)
        return make_pose(Rotation.from_euler("ZYX", [0.0, pitch, roll]).as_matrix(), [0.0, 0.0, self.height_m])

    def sway(self, time_s: float, phase: float) -> Array:
        """The carrier's rolling and pitching (4, 4) at a time, about its place on the ground."""
        cycle = 2 * np.pi * (self.sway_hz * time_s + phase)
        roll, pitch = np.radians(self.sway_deg) * np.array([np.sin(1.1 * cycle), np.sin(0.8 * cycle + 1)])
        return make_pose(Rotation.from_euler("ZYX", [0.0, pitch, roll]).as_matrix(), np.zeros(3))


MOUNTS: dict[str, Mount] = {
    "rover": Mount(1.3, 0.0, 1.0, 0.5, calibrated=True),
    "low": Mount(0.3, 2.0, 0.5, 0.3, calibrated=False),
    "car": Mount(1.8, 1.0, 6.0, 0.3, calibrated=False),
    "mast": Mount(2.5, 5.0, 1.0, 1.0, calibrated=False),
    "tilted": Mount(1.0, 20.0, 1.0, 0.5, calibrated=False),
    "rolling": Mount(0.8, 3.0, 1.5, 4.0, calibrated=False),
    "legged": Mount(0.5, 2.0, 0.8, 4.0, calibrated=False, sway_hz=2.0),
}


ALIASING = 0.6  # of the landscapes: most of their rocks and lumps come again elsewhere


class Place(Protocol):
    """A world that a carrier can drive through more than once."""

    @property
    def trail(self) -> Array:
        """(N, 2) dense closed curve that stays clear, m."""

    @property
    def lateral_m(self) -> float:
        """How far beside the trail it can be driven."""

    def height(self, x: ArrayLike, y: ArrayLike) -> Array:
        """Height of the ground under points, m."""

    def scene(self, visit: int) -> Scene:
        """The scene of one visit: cars and chairs move between visits."""


@dataclass(frozen=True, slots=True)
class Kind:
    """One kind of place.

    Attributes:
        build: the place of a seed.
        scale: of distances, 1 in the open: indoors the same step shows another place sooner.
    """

    build: Callable[[int], Place]
    scale: float


def _landscape(seed: int, family: str) -> Landscape:
    return Landscape(World(seed, family, ALIASING))


PLACES: dict[str, Kind] = {
    "corridor": Kind(Corridor, 0.5),
    "rooms": Kind(Rooms, 0.4),
    "street": Kind(Street, 1.0),
    "orchard": Kind(partial(Trees, regular=True), 0.8),
    "woods": Kind(partial(Trees, regular=False), 0.8),
    "quarry": Kind(Quarry, 1.0),
    "etna": Kind(partial(_landscape, family="etna"), 1.0),
    "moon": Kind(partial(_landscape, family="moon"), 1.0),
    "canyon": Kind(partial(_landscape, family="canyon"), 1.0),
    "dunes": Kind(partial(_landscape, family="dunes"), 1.0),
    "snow": Kind(partial(Plain, lander=False), 1.0),
    "lander": Kind(partial(Plain, lander=True), 0.8),
    "tunnel": Kind(partial(Tunnel, features=True), 0.5),
    "smooth_tunnel": Kind(partial(Tunnel, features=False), 0.5),
    "warehouse": Kind(partial(Rows, plants=False), 0.7),
    "greenhouse": Kind(partial(Rows, plants=True), 0.6),
}


SWING_DEG = 8.0  # how far a revisit's heading swings to either side
TILT_DEG = 1.0  # of the ground under single wheels
FIRST, SAME_WAY, OTHER_WAY = "first", "offset", "opposite"


@dataclass(frozen=True, slots=True)
class Domain:
    """One combination, each by its name in `SCANNERS`, `PLACES` and `MOUNTS`.

    Attributes:
        sensor: LiDAR.
        place: kind of place.
        mount: how the LiDAR is carried.
        revisited_by: the LiDAR of later visits where it is another one.
    """

    sensor: str
    place: str
    mount: str
    revisited_by: str = ""

    @property
    def name(self) -> str:
        """Sensor, place and mount."""
        sensors = f"{self.sensor}+{self.revisited_by}" if self.revisited_by else self.sensor
        return f"{sensors}-{self.place}-{self.mount}"

    @property
    def scale(self) -> float:
        """Of distances in this kind of place, 1 in the open."""
        return PLACES[self.place].scale

    @property
    def scanner(self) -> Scanner:
        """The LiDAR of the first visit."""
        return SCANNERS[self.sensor]

    @property
    def query_scanner(self) -> Scanner:
        """The LiDAR of later visits."""
        return SCANNERS[self.revisited_by or self.sensor]


@dataclass(frozen=True, slots=True)
class DomainScan:
    """One scan of a survey.

    Attributes:
        sweep: points, intensity and times; points in the body frame of a calibrated mount, else in the LiDAR's own.
        world_T_body: (4, 4) true pose of that frame at the scan's stamp.
        world_T_lidar: (4, 4) true pose of the LiDAR then.
        label: first, offset (again, the same way) or opposite.
        odom_T_body: (4, 4) the same by odometry, which begins anew with each label.
        path_length_m: driven since the label's first scan.
    """

    sweep: Sweep
    world_T_body: Array
    world_T_lidar: Array
    label: str
    odom_T_body: Array | None = None
    path_length_m: float = float("nan")


DOMAINS: tuple[Domain, ...] = (
    Domain("cube1", "etna", "rover"),
    Domain("cube1", "quarry", "tilted"),
    Domain("cube1", "street", "rover"),
    Domain("spin16", "corridor", "rolling"),
    Domain("spin16", "orchard", "rover"),
    Domain("spin16", "dunes", "mast"),
    Domain("spin64", "street", "car"),
    Domain("spin64", "woods", "mast"),
    Domain("spin64", "canyon", "rover"),
    Domain("spin128", "quarry", "rolling"),
    Domain("spin128", "rooms", "rolling"),
    Domain("spin128", "moon", "tilted"),
    Domain("solid360", "street", "tilted"),
    Domain("solid360", "corridor", "low"),
    Domain("solid360", "rooms", "tilted"),
    Domain("rosette70", "street", "car"),
    Domain("rosette70", "orchard", "rolling"),
    Domain("rosette70", "corridor", "low"),
)
"""The combinations that the benchmarks run and that the decision is fitted to; any other can be surveyed too."""

STRANGE_DOMAINS: tuple[Domain, ...] = (
    Domain("mid360", "woods", "legged"),
    Domain("spin32_20hz", "warehouse", "legged"),
    Domain("rotating2d", "rooms", "low"),
    Domain("spin16", "snow", "mast"),
    Domain("spin32", "snow", "rolling"),
    Domain("spin16", "tunnel", "rolling"),
    Domain("spin16", "smooth_tunnel", "rolling"),
    Domain("solid360", "greenhouse", "rover"),
    Domain("spin64", "greenhouse", "low"),
    Domain("cube1", "lander", "rover"),
    Domain("spin64", "quarry", "rover", revisited_by="cube1"),
)
"""Combinations that nothing is fitted to."""


def survey(domain: Domain, seed: int, step_m: float, longest_m: float, place: Place | None = None) -> list[DomainScan]:
    """Drive a stretch of the place's trail, again the same way, and back.

    Args:
        domain: what to take along and where.
        seed: the place's number; see `seeds` for which are whose.
        step_m: between scans in the open, m; multiplied by the domain's scale.
        longest_m: length of the stretch, m; likewise.
        place: the place of this seed where it is at hand already.

    Raises:
        ConfigError: negative seed.
    """
    place = place or PLACES[domain.place].build(check_seed(seed))
    mount = MOUNTS[domain.mount]
    carrier = np.random.default_rng([seed, 51])
    body_T_lidar = mount.body_T_lidar(carrier)
    scans: list[DomainScan] = []
    for visit, label in enumerate((FIRST, SAME_WAY, OTHER_WAY)):
        visited: list[DomainScan] = []
        rng = np.random.default_rng([seed, 52, visit])
        scene, scanner = place.scene(visit), domain.scanner if label == FIRST else domain.query_scanner
        for world_T_body in _drive(place, label, (step_m * domain.scale, longest_m * domain.scale), rng):
            phase, start_s = rng.random(), rng.random()
            shaken = phase, start_s, float(rng.normal(0, 0.15))
            motion = SweepMotion(world_T_body, mount, scanner, shaken, body_T_lidar)
            found = sweep(scanner, scene, motion.world_T_lidar, rng)
            stamp = stamp_moment(scanner)
            lidar = motion.world_T_lidar(stamp)
            if mount.calibrated:
                points = transform(body_T_lidar, found.points)
                found = Sweep(points, found.intensity, found.offset_s)
                visited.append(DomainScan(found, motion.world_T_body(stamp), lidar, label))
            else:
                visited.append(DomainScan(found, lidar, lidar, label))
        scans += _with_odometry(visited, np.random.default_rng([seed, 53, visit]))
    return scans


def _with_odometry(scans: list[DomainScan], rng: np.random.Generator) -> Iterator[DomainScan]:
    """The scans of one visit with the odometry of a carrier that drifts as the rover does."""
    truth = np.stack([scan.world_T_body for scan in scans])
    poses, _ = drifted(truth, Drift(), rng)
    steps = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    for scan, pose, metres in zip(scans, poses, np.append(0.0, np.cumsum(steps)), strict=True):
        yield replace(scan, odom_T_body=pose, path_length_m=float(metres))


class SweepMotion:
    """The carrier drives, turns and sways during a scan."""

    def __init__(
        self,
        world_T_start: Array,
        mount: Mount,
        scanner: Scanner,
        chance: tuple[float, float, float],
        body_T_lidar: Array,
    ) -> None:
        self._start, self._mount, self._period_s = world_T_start, mount, scanner.period_s
        self._phase, self._start_s, turn_rad_s = chance
        self._body_T_lidar = body_T_lidar
        angle, way = turn_rad_s * scanner.period_s, mount.speed_m_s * scanner.period_s
        step = np.eye(4)
        step[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
        step[0, 3] = way
        self._end = world_T_start @ step

    def world_T_body(self, moment: float) -> Array:
        """Pose of the body at a moment of the scan, 0 to 1."""
        sway = self._mount.sway(self._start_s + moment * self._period_s, self._phase)
        return interpolate(self._start, self._end, moment) @ sway

    def world_T_lidar(self, moment: float) -> Array:
        """Pose of the LiDAR then."""
        return self.world_T_body(moment) @ self._body_T_lidar


def _drive(place: Place, label: str, stretch: tuple[float, float], rng: np.random.Generator) -> Iterator[Array]:
    """Poses of the body along the trail, for a revisit with offsets and swings of its own."""
    step_m, longest_m = stretch
    lateral = 0.0 if label == FIRST else place.lateral_m
    setting = Setting(lateral, SWING_DEG, 0.0, TILT_DEG, 0.0)
    trail = np.roll(place.trail, -int(rng.integers(max(int(step_m / 0.1), 1))), axis=0)
    drive = plan_passes(trail, (label,), setting, step_m, int(rng.integers(2**31)))[0]
    count = int(longest_m / step_m)
    chosen = slice(-count, None) if label == OTHER_WAY and count < len(drive.path) else slice(0, count)
    # anything with a height will do as ground
    ground = cast(Relief, place)
    x, y = drive.path[chosen].T
    yield from stand(ground, x, y, drive.yaw[chosen], drive.tilt[chosen])
