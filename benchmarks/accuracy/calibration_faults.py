"""Plants small faults of the calibration in simulated drives, and prints what the check of the sensors says.

    python benchmarks/accuracy/calibration_faults.py --seeds 20001:20006

A baseline that is 1 % too long, a LiDAR turned by 1 degree about another axis in each drive, scans stamped 20 ms late,
and none of them. A fault is named by the line that is about it; one that is said not to be told is counted apart.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from umf_ros.core.frames import Frame, ScanMotion
from umf_ros.core.geometry import make_pose, relative, transform
from umf_ros.lab.simulation.presets import find_preset
from umf_ros.lab.simulation.simulator import Simulator
from umf_ros.runs.findings import about_sensors
from umf_ros.sensors.assembly import twists
from umf_ros.sensors.sensor_check import DEPTH_EVERY, DEPTH_FRAMES, SensorCheck

FAULTS = {"none": "", "baseline 1 %": "baseline is wrong", "turn 1 deg": "mounting is wrong", "clock 20 ms": "clock is"}
"""Words of the line that is about a fault."""
LONGER, TURN_DEG, LATE_NS = 1.01, 1.0, 20_000_000
SWEEP_NS = 200_000_000


def drive(seed: int) -> tuple[Simulator, list[Frame]]:
    """A simulated drive, and its frames that the check lays over scans, with the true motion during each."""
    simulator, frames = Simulator(find_preset("demo"), seed), []
    for number in range(0, min(len(simulator.scan_stamps_ns), DEPTH_EVERY * DEPTH_FRAMES), DEPTH_EVERY):
        frame, exposure = simulator.scan_frame(number), simulator.exposures[number]
        left, right = simulator.stereo(exposure)
        span = np.stack([simulator.pose(frame.stamp_ns), simulator.pose(frame.stamp_ns + SWEEP_NS)])
        motion = replace(frame.motion or ScanMotion.none(0), rates=twists(span)[0] / SWEEP_NS * 1e9)
        frame = replace(frame, motion=motion, left=left.image, right=right.image if right else None)
        frames.append(placed(replace(frame, image_stamp_ns=exposure.stamp_ns), simulator, 0))
    return simulator, frames


def placed(frame: Frame, simulator: Simulator, late_ns: int) -> Frame:
    """The camera where the motion puts it, for scans that are stamped late."""
    moved = relative(simulator.pose(frame.stamp_ns + late_ns), simulator.pose(frame.image_stamp_ns or 0))
    return replace(frame, body_T_camera=moved @ simulator.calibration.body_T_camera)


def planted(frames: list[Frame], simulator: Simulator, name: str, axis: int) -> Iterator[Frame]:
    """The frames with a fault."""
    turn = Rotation.from_rotvec(np.radians(TURN_DEG) * np.eye(3)[axis]).as_matrix()
    for frame in frames:
        about = frame.body_T_lidar[:3, 3]
        if name == "baseline 1 %":
            yield replace(frame, camera=replace(frame.camera, baseline=LONGER * frame.camera.baseline))
        elif name == "turn 1 deg" and frame.points is not None:
            yield replace(frame, points=transform(make_pose(turn, about - turn @ about), frame.points))
        else:
            yield placed(frame, simulator, LATE_NS if name == "clock 20 ms" else 0)


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", default="20001:20006", help="seeds of the drives, as first:last+1")
    seeds = range(*map(int, parser.parse_args().seeds.split(":")))
    named = unsure = alarms = 0
    print("| seed | planted | named | said |\n|---|---|---|---|")
    for seed in seeds:
        simulator, frames = drive(seed)
        for name, word in FAULTS.items():
            check = SensorCheck()
            for frame in planted(frames, simulator, name, seed % 3):
                check.compare_depths(frame)
            found = list(about_sensors(check.report(None)))
            told = [one.what for one in found if one.severity != "note"]
            is_named = bool(word) and any(word in line for line in told)
            named, alarms = named + is_named, alarms + bool(told and not is_named)
            unsure += bool(word) and not is_named and any("does not determine" in one.what for one in found)
            verdict = "yes" if is_named else "no" if word else "-"
            print(f"| {seed} | {name} | {verdict} | {'; '.join(told) or '-'} |", flush=True)
    count = len(seeds) * (len(FAULTS) - 1)
    print(f"\n{named} of {count} named, {unsure} not told, {alarms} false alarms; {len(seeds)} without a fault")
    sys.exit(named + unsure < count or alarms > 0)


if __name__ == "__main__":
    main()
