"""What every node of ours does alike: parameters, watched inputs, diagnostics and answers to services."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import QoSProfile

from umf_ros.errors import UmfError
from umf_ros.nodes.conversions import from_time
from umf_ros.nodes.diagnostics import InputWatch
from umf_ros.nodes.parameters import declare
from umf_ros.runs.folder import check_writable


class BaseNode(Node):
    """A node with the package's settings as its parameters, and a folder for results.

    Raises:
        ConfigError: a parameter is unknown, of the wrong type or out of range.
        OutputError: the folder for results cannot be written.
    """

    def __init__(self, name: str, results: str) -> None:
        """Declare the parameters; `results` says what the folder `results_dir` is for."""
        super().__init__(name, automatically_declare_parameters_from_overrides=True)
        self._settings, own = declare(self, results_dir=results)
        self._results = own["results_dir"]
        if self._results:
            check_writable(Path(self._results))
        self._watches: list[InputWatch] = []
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", 10)

    def _subscribe(self, name: str, kind: type, topic: str, take: Callable[[Any], None], qos: QoSProfile) -> None:
        """Hear an input of messages with a header, and watch it."""
        watch = InputWatch(self, name, topic)
        self._watches.append(watch)

        def receive(message: Any) -> None:
            watch.saw(from_time(message.header.stamp))
            take(message)

        def lose(event: Any) -> None:
            watch.lost += event.total_count_change

        events = SubscriptionEventCallbacks(message_lost=lose)
        self.create_subscription(kind, topic, receive, qos, event_callbacks=events)

    def _offer(self, kind: type, name: str, action: Callable[[Any], str]) -> None:
        """Offer a service that answers what `action` makes of the request; a `UmfError` is a refusal."""

        def answer(request: Any, response: Any) -> Any:
            try:
                response.success, response.message = True, action(request)
            except UmfError as error:
                response.success, response.message = False, str(error)
            return response

        self.create_service(kind, name, answer)

    def _diagnose(self, own: DiagnosticStatus) -> None:
        """Publish the node's own health and that of its inputs."""
        report = DiagnosticArray(status=[own, *(watch.status() for watch in self._watches)])
        report.header.stamp = self.get_clock().now().to_msg()
        for line in report.status:
            line.name = f"{self.get_name()}: {line.name}"
        self._diagnostics.publish(report)

    def _complain(self, error: Exception) -> None:
        self.get_logger().error(f"{type(error).__name__}: {error}", throttle_duration_sec=10.0)
