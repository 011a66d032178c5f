"""The one path of odometry into a pose graph, live and offline."""

from __future__ import annotations

from typing import TYPE_CHECKING

from umf_ros.geometry import Array
from umf_ros.sensors.sessions import ODOMETRY, Arrival, Reset, SessionClock

if TYPE_CHECKING:
    from umf_ros.pose_graph.pose_graph import PoseGraph


class OdometryFeed:
    """Gives a graph every odometry message, in sessions.

    The live back-end hears the odometry on its topic, the replay reads it from the recording: both use this class,
    so the same messages give the same chains.

    Attributes:
        newest_ns: latest stamp of the running session, -1 before its first.
        dropped: messages that were out of line, and wrong.
    """

    def __init__(self, graph: PoseGraph) -> None:
        self.newest_ns = -1
        self.dropped = 0
        self._graph = graph
        self._clock = SessionClock()

    def take(self, stamp_ns: int, odom_T_body: Array) -> Reset | None:
        """Take one message, (4, 4); returns why a new session has begun with it, None when it goes on."""
        ruling = self._clock.take(Arrival(ODOMETRY, stamp_ns, odom_T_body))
        self.dropped += len(ruling.dropped)
        if ruling.reset is not None:
            self._graph.begin_session()
            self.newest_ns = -1
        for one in ruling.usable:  # late ones too: the graph sorts them in
            self._graph.add_odometry(one.stamp_ns, one.value)
            self.newest_ns = max(self.newest_ns, one.stamp_ns)
        return ruling.reset
