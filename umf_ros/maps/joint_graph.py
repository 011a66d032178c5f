"""The joint pose graph of a map: odometry of every session, closures within and between sessions."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from umf_ros.core.frames import LoopClosure
from umf_ros.core.geometry import Array
from umf_ros.core.trajectory import Trajectory
from umf_ros.durable_graph import feed
from umf_ros.maps.map_folder import BETWEEN, MapFolder, MapSession
from umf_ros.pose_graph.backend import PoseGraph
from umf_ros.pose_graph.closures import ClosureVerdict, State
from umf_ros.runs.run_file import read_closures, read_keyframes
from umf_ros.sensors.decode import OdometrySample

Stamps = NDArray[np.int64]


@dataclass(frozen=True)
class JointSession:
    """A recording in the solved map.

    Attributes:
        session: the recording.
        joined: whether closures connect it to the map's frame.
        stamps: (N,) of its keyframes with a pose in the map, ns of its own clock.
        poses: (N, 4, 4) `map_T_body` there.
        odometry: (N, 4, 4) `odom_T_body` there.
        path_length_m: of the whole drive by its odometry, also where it is not joined.
    """

    session: MapSession
    joined: bool
    stamps: Stamps
    poses: Array
    odometry: Array
    path_length_m: float


@dataclass(frozen=True)
class JointMap:
    """A solved map.

    Attributes:
        graph: of all sessions, on the map's clock.
        sessions: its recordings.
        within: verdicts on closures within a recording.
        between: verdicts on closures between two recordings.
        world: `world_T_map` and the origin on WGS 84; None without a reference.
    """

    graph: PoseGraph
    sessions: list[JointSession]
    within: list[ClosureVerdict]
    between: list[ClosureVerdict]
    world: tuple[Array, Array] | None

    def accepted_between(self) -> list[LoopClosure]:
        """Return accepted closures between recordings."""
        return [verdict.closure for verdict in self.between if verdict.state is State.ACCEPTED]


def solve(folder: MapFolder, edits: Mapping[tuple[int, int], State] | None = None) -> JointMap:
    """Build and settle the joint graph of a map from the run folders of its sessions.

    The same outlier rejection applies to closures within and between recordings: two unconnected sessions are joined
    once closures of several places are consistent with each other. Decisions by hand, `edits` or else those of the
    folder, go before.

    Raises:
        UmfError: a file of the map is missing or damaged, or an edit is about no closure of the map.
    """
    graph = PoseGraph(folder.settings.pose_graph)
    odometry: dict[str, list[OdometrySample]] = {}
    for number, session in enumerate(folder.sessions):
        if number:
            graph.begin_session()
        odometry[session.name], measurements = folder.inputs_of(session.name)
        feed(graph, (one._replace(stamp_ns=one.stamp_ns + session.shift_ns) for one in odometry[session.name]))
        for one in measurements:
            graph.add_absolute(replace(one, stamp_ns=one.stamp_ns + session.shift_ns))
    # after all odometry, as a closure may refer to any session
    for session in folder.sessions:
        run = folder.folder_of(session.name)
        within = [_shifted(one, session.shift_ns) for one in read_closures(run / "closures.csv")]
        graph.add_closures(within + read_closures(run / BETWEEN))
    for pair, state in (folder.edits() if edits is None else edits).items():
        graph.decide_by_hand(*pair, state)
    graph.settle()
    verdicts: tuple[list[ClosureVerdict], list[ClosureVerdict]] = ([], [])
    for verdict in graph.closures():
        ends = (verdict.closure.query_stamp_ns, verdict.closure.match_stamp_ns)
        query, match = (folder.session_at(stamp) for stamp in ends)
        verdicts[query is not match].append(verdict)
    sessions = [_placed(folder, session, graph, odometry[session.name]) for session in folder.sessions]
    return JointMap(graph, sessions, *verdicts, graph.world())


def _placed(folder: MapFolder, session: MapSession, graph: PoseGraph, odometry: list[OdometrySample]) -> JointSession:
    """Return a session with the poses of its keyframes in the solved map."""
    keyframes = read_keyframes(folder.folder_of(session.name) / "keyframes.csv")
    stamps, length_m = keyframes["stamp_ns"], np.ptp(np.nan_to_num(keyframes["path_length_m"])) if len(keyframes) else 0
    poses, known = graph.poses_at(stamps + session.shift_ns)
    own = Trajectory.rising((one.stamp_ns, one.odom_T_body) for one in sorted(odometry, key=lambda one: one.stamp_ns))
    by_odometry = own.at(stamps[known])[0] if own is not None else np.empty((0, 4, 4))
    return JointSession(session, bool(known.any()), stamps[known], poses[known], by_odometry, float(length_m))


def _shifted(closure: LoopClosure, shift_ns: int) -> LoopClosure:
    """Return a closure within a recording, on the map's clock."""
    query_ns, match_ns = closure.query_stamp_ns + shift_ns, closure.match_stamp_ns + shift_ns
    return replace(closure, query_stamp_ns=query_ns, match_stamp_ns=match_ns)
