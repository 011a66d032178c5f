"""Synchronisation of measurements into frames."""

from __future__ import annotations

import logging
from collections import Counter, deque
from collections.abc import Callable, Collection
from dataclasses import dataclass, field, replace
from typing import Any

from umf_ros.core.config import Sync
from umf_ros.core.errors import MessageError
from umf_ros.core.frames import Frame, StereoCamera
from umf_ros.sensors.assembly import Anchor, OdometryBuffer, ScanJoiner, ScanLimits, WholeScan, assemble
from umf_ros.sensors.calibration import Calibration, SensorWindow
from umf_ros.sensors.decode import Cloud
from umf_ros.sensors.sessions import ODOMETRY, Input, SessionClock, StampedInput

_log = logging.getLogger(__name__)

INPUTS: tuple[Input, ...] = ("left", "right", "cloud", ODOMETRY)

_SENSORS: dict[Input, str] = {"left": "camera", "right": "camera", "cloud": "lidar"}

STEREO_SLOP_NS = 17_000_000
"""Exposures of a pair carry the same stamp; half a period at 30 Hz separates neighbouring pairs."""

SILENCE_NS = 5_000_000_000
"""An input without a message in this much stream time counts as absent."""


SURPLUS = "surplus"
"""Reason of images that are nearest to no scan; no fault, as cameras are faster than LiDARs."""


@dataclass(slots=True)
class InputCounter:
    """Messages of one input; the dropped ones by reason. Those that are neither used nor dropped are waiting."""

    received: int = 0
    used: int = 0
    dropped: Counter[str] = field(default_factory=Counter)

    @property
    def lost(self) -> int:
        """Messages dropped for a reason that should not happen."""
        return self.dropped.total() - self.dropped[SURPLUS]


class ImageBuffer:
    """The latest images of one camera, in the order of their stamps."""

    def __init__(self, size: int, counter: InputCounter) -> None:
        self._size = size
        self._counter = counter
        self._images: deque[StampedInput] = deque()
        self._used_ns: set[int] = set()
        self.newest_ns: int | None = None

    def add(self, image: StampedInput) -> None:
        """Append an image; the oldest leaves a full buffer."""
        if len(self._images) == self._size:
            self._forget("queue full")
        self._images.append(image)
        self.newest_ns = image.stamp_ns

    def passed(self, stamp_ns: int) -> bool:
        """Return whether no later image can be nearer to the stamp than the buffered ones."""
        return self.newest_ns is not None and self.newest_ns >= stamp_ns

    def nearest(self, stamp_ns: int, slop_ns: int) -> StampedInput | None:
        """Return the image nearest to a stamp, or None when it is further than the slop; the earlier of two equals."""
        nearest = min(self._images, key=lambda image: abs(image.stamp_ns - stamp_ns), default=None)
        return nearest if nearest and abs(nearest.stamp_ns - stamp_ns) <= slop_ns else None

    def use(self, image: StampedInput | None) -> None:
        """Count an image as used, the first time."""
        if image is not None and image.stamp_ns not in self._used_ns:
            self._used_ns.add(image.stamp_ns)
            self._counter.used += 1

    def forget_before(self, stamp_ns: int) -> None:
        """Delete older images."""
        while self._images and self._images[0].stamp_ns < stamp_ns:
            self._forget(SURPLUS)

    def clear(self) -> None:
        """Delete all images."""
        self.forget_before(2**63)
        self.newest_ns = None

    def _forget(self, reason: str) -> None:
        image = self._images.popleft()
        if image.stamp_ns in self._used_ns:
            self._used_ns.remove(image.stamp_ns)
        else:
            self._counter.dropped[image.fault or reason] += 1


class Synchronizer:
    """Builder of one frame per scan from the nearest image and the odometry; without a LiDAR one per image.

    Add measurements as they come, input by input in the order of their stamps, and `pop` complete frames: every input
    has passed them. Only stamps decide, never the time of arrival: as long as no input lags behind another by more than
    `max_wait_s`, the same measurements give the same frames however their arrivals interleave. A frame that has waited
    longer is completed with the data at hand; an input that is silent for long is ignored until its next message.

    When a new session begins (see `SessionClock`), the waiting frames are completed with the data at hand, and all that
    cannot be compared with later measurements is deleted. Not thread-safe.

    Attributes:
        counters: used and dropped messages of each input.
        session: number of resets of the clock or the odometry so far.
    """

    def __init__(
        self,
        settings: Sync,
        calibration: Calibration,
        inputs: Collection[Input] = INPUTS,
        warn: Callable[[str], None] = _log.warning,
    ) -> None:
        """Wait for `inputs` only; "camera_info" among them: frames also wait for `use_camera`."""
        self.counters: dict[Input, InputCounter] = {name: InputCounter() for name in INPUTS}
        self._settings = settings
        self._calibration = calibration
        self._window: SensorWindow | None = None
        self._limits, self._joiner = ScanLimits(calibration, warn), ScanJoiner()
        if calibration.guesses:
            warn(f"the calibration holds guesses, measure them: {', '.join(calibration.guesses)}")
        self._inputs = set(inputs)
        self._absent: set[Input] = set()
        self._slop_ns = round(settings.slop_s * 1e9)
        self._max_wait_ns = round(settings.max_wait_s * 1e9)
        self._clock = SessionClock()
        self.session = 0
        self._left = ImageBuffer(settings.queue_size, self.counters["left"])
        self._right = ImageBuffer(settings.queue_size, self.counters["right"])
        self._odometry = OdometryBuffer(settings.odometry_buffer_s, settings.max_odometry_gap_s)
        self._anchors: deque[Anchor] = deque()
        self._frames: list[Frame] = []
        self._given_up_ns = -1  # images up to here come too late
        self._last_scan_ns = -1

    def use_camera(self, camera: StereoCamera) -> None:
        """Replace the intrinsics by those of a camera_info."""
        self._calibration = self._calibration.with_camera(camera)
        self._absent.add("camera_info")  # not waited for again

    def use_window(self, window: SensorWindow) -> None:
        """Expect images that show this window of a sensor, if the calibration is that of the sensor."""
        self._window = window

    @property
    def awaits_camera(self) -> bool:
        """Whether the first camera_info has to come before images can be used."""
        return not self._calibration.image_size[0] and self._awaits("camera_info")

    def use_mounting(self, poses: dict[str, Any]) -> None:
        """Replace poses of the sensors, `body_T_camera` or `body_T_lidar` by name."""
        if poses:
            lacks = tuple(one for one in self._calibration.lacks if f"body_T_{one}" not in poses)
            self._calibration = replace(self._calibration, lacks=lacks, **poses)

    def add(self, name: Input, stamp_ns: int, value: Any) -> None:
        """Add a measurement: an image as the camera sends it, (H, W) uint8; a `Cloud`; or a (4, 4) pose `odom_T_body`.

        Raises:
            MessageError: of kind "size" when the calibration is for other images.
        """
        if (sensor := _SENSORS.get(name)) in self._calibration.lacks:
            raise MessageError("transforms", f"the calibration has no body_T_{sensor}: add it, or leave out the topic")
        if name in ("left", "right") and self._window is not None:
            self._calibration = self._calibration.within(self._window, value.shape[::-1])
        expected = self._calibration.image_size
        if name in ("left", "right") and not expected[0]:
            raise MessageError("camera_info", "image before its camera_info, and no calibration is named")
        if name in ("left", "right") and value.shape[::-1] != expected:
            found = f"image of {value.shape[1]} x {value.shape[0]} pixels"
            raise MessageError("size", f"{found}, the calibration is for {expected[0]} x {expected[1]}")
        reset, messages = self._clock.take(StampedInput(name, stamp_ns, value))
        if reset is not None:
            self._end_session(reset.of_clock)
            self.session = self._clock.session
        self._add_decided(messages)

    def _add_decided(self, messages: list[StampedInput]) -> None:
        for one in messages:
            if one.fault:
                self.reject(one.name, one.fault)
                continue
            self.counters[one.name].received += 1
            self._absent.discard(one.name)
            self._use(one)
            self._build()

    def reject(self, name: Input, reason: str) -> None:
        """Count a message that could not be used at all; a camera_info like that is not waited for again."""
        if name in self.counters:
            self.counters[name].received += 1
            self.counters[name].dropped[reason] += 1
        else:
            self._absent.add(name)

    def pop(self) -> list[Frame]:
        """Return the frames completed since the last call, in the order of their stamps."""
        frames, self._frames = self._frames, []
        return frames

    def flush(self) -> list[Frame]:
        """Complete the waiting frames with the data at hand, at the end of the stream, and pop them."""
        self._add_decided(self._clock.finish())
        self._end_session()
        return self.pop()

    def _use(self, one: StampedInput) -> None:
        if one.name == "cloud":
            self._await(self._joiner.add(one.stamp_ns, one.value))
        elif one.name == ODOMETRY:
            self._odometry.add(one.stamp_ns, one.value)
            self.counters[one.name].used += 1
        else:
            buffer = self._left if one.name == "left" else self._right
            buffer.add(replace(one, fault="late") if one.stamp_ns <= self._given_up_ns else one)
            if one.name == "left" and ("cloud" not in self._inputs or self._is_silent("cloud", one.stamp_ns)):
                self._anchors.append(Anchor(one.stamp_ns, one.stamp_ns))

    def _await(self, scans: list[WholeScan]) -> None:
        """Let frames wait for the other inputs of whole scans."""
        for scan in scans:
            if scan.stamp_ns == self._last_scan_ns:  # of another LiDAR: one frame has one scan
                self.counters["cloud"].dropped["duplicate"] += scan.messages
                continue
            self._last_scan_ns = scan.stamp_ns
            key = scan.stamp_ns + round(self._calibration.lidar_time_offset_s * 1e9)
            self._anchors.append(Anchor(key, scan.stamp_ns, self._limits.apply(scan.cloud), scan.messages))

    def _end_session(self, of_clock: bool = True) -> None:
        """Complete the waiting frames with the data at hand; images are kept where the odometry alone was reset."""
        self._await(self._joiner.flush())
        while self._anchors:
            self._complete(self._anchors.popleft())
        self._odometry.clear()
        if of_clock:
            self._left.clear()
            self._right.clear()
            self._given_up_ns = self._last_scan_ns = -1

    def _build(self) -> None:
        """Complete the frames that lack no input, in order."""
        while self._anchors and self._is_complete(self._anchors[0]):
            anchor = self._anchors.popleft()
            self._complete(anchor)
            self._forget_before(anchor.stamp_ns)  # the scans to come are later than this one
        now_ns = self._sensed_ns
        if now_ns is not None:
            waiting_ns = self._joiner.first_ns
            self._forget_before(min(now_ns - self._max_wait_ns, now_ns if waiting_ns is None else waiting_ns))

    @property
    def _sensed_ns(self) -> int | None:
        """Latest stamp of the sensors: odometry may run ahead on another machine's clock."""
        return self._clock.newest_ns("left", "right", "cloud")

    def _forget_before(self, key_ns: int) -> None:
        """Delete the images that are too old for a frame at this key."""
        self._left.forget_before(key_ns - self._slop_ns)
        self._right.forget_before(key_ns - self._slop_ns - STEREO_SLOP_NS)

    def _is_complete(self, anchor: Anchor) -> bool:
        now_ns = self._sensed_ns
        if now_ns is not None and now_ns > anchor.stamp_ns + self._max_wait_ns:
            self._absent |= {name for name in self._inputs if self._is_silent(name, now_ns)}
            return True
        if len(self._anchors) >= self._settings.queue_size:
            return True
        if self._awaits("camera_info") or (self._awaits("left") and not self._left.passed(anchor.stamp_ns)):
            return False
        left = self._left.nearest(anchor.stamp_ns, self._slop_ns)
        if left and self._awaits("right") and not self._right.passed(left.stamp_ns):
            return False
        last_ns = max(anchor.stamp_ns, anchor.span_ns()[1], left.stamp_ns if left else 0)
        return not self._awaits("odometry") or self._odometry.passed(last_ns)

    def _awaits(self, name: Input) -> bool:
        return name in self._inputs and name not in self._absent

    def _is_silent(self, name: Input, now_ns: int) -> bool:
        """Return whether an input has been silent for long, by the stamps of the others."""
        newest_ns = self._clock.newest_ns(name)
        return now_ns - (self._clock.start_ns if newest_ns is None else newest_ns) > SILENCE_NS

    def _complete(self, anchor: Anchor) -> None:
        left = self._left.nearest(anchor.stamp_ns, self._slop_ns)
        right = self._right.nearest(left.stamp_ns, STEREO_SLOP_NS) if left else None
        if left is None and not self._left.passed(anchor.stamp_ns):
            self._given_up_ns = anchor.stamp_ns + self._slop_ns
        if not (self._count_scan(anchor.cloud, left, anchor.messages) if anchor.cloud is not None else left):
            return
        self._left.use(left)
        self._right.use(right)
        self._frames.append(assemble(anchor, left, right, self._odometry, self._calibration, self.session))

    def _count_scan(self, cloud: Cloud, left: StampedInput | None, messages: int) -> bool:
        """Count a scan as used or dropped; return whether there will be a frame."""
        counter = self.counters["cloud"]
        without_image = left is None and (self._settings.require_image or not len(cloud.points))
        if not len(cloud.points):
            counter.dropped["empty"] += messages
        elif without_image:
            counter.dropped["no image"] += messages
        else:
            counter.used += messages
        return not without_image
