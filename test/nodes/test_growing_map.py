"""The live front-end with `localization.update` over real DDS: the map grows at ~/save and at the end."""

from __future__ import annotations

import json
from pathlib import Path

from processes import Process, call_service, wait_until
from std_srvs.srv import Trigger
from vlp16_rover import CALIBRATION, Vlp16Rover

from umf_ros.core.config import Settings
from umf_ros.maps.map_folder import MapFolder
from umf_ros.maps.mapping import grow

MODULE = "umf_ros.nodes.loop_closure_node"


def keyframes_of(folder: Path) -> int:
    """Number of keyframes by the summary that the node writes every second."""
    path = folder / "summary.json"
    return json.loads(path.read_text())["keyframes"] if path.is_file() else 0


def test_what_localising_sees_becomes_a_session_at_save_and_at_the_end(ros_context: None, tmp_path: Path) -> None:
    (tmp_path / "rig.yaml").write_text(CALIBRATION)
    common = "embedding.method:=thumbnail", f"calibration:={tmp_path / 'rig.yaml'}", "qos.reliability:=reliable"
    rig, before, after = Vlp16Rover(), tmp_path / "before", tmp_path / "after"
    mapping = f"results_dir:={before}", f"database.path:={before / 'places.sqlite'}"
    localising = "mode:=localization", f"map:={tmp_path / 'map'}", "localization.update:=true"
    first = Process(MODULE, tmp_path / "first.log", *common, *mapping)
    second: Process | None = None
    try:
        rig.until_heard(first)
        rig.drive(5.0, pause_s=0.2)
        assert first.interrupt() == 0, first.output
        target = MapFolder.open_or_create(tmp_path / "map", Settings())
        session, _ = grow(target.path, before)
        assert session is not None and session.places >= 4

        second = Process(MODULE, tmp_path / "second.log", *common, *localising, f"results_dir:={after}")
        rig.until_heard(second)
        rig.drive(5.0, 1_700_001_000, pause_s=0.2)  # no keyframe is dropped
        assert wait_until(lambda: keyframes_of(after) >= 4, 60.0)  # a busy machine is behind
        answer = call_service(rig, Trigger, "/loop_closure_node/save", Trigger.Request())
        assert answer.success and "sessions" in answer.message, answer.message
        saved = MapFolder.open(target.path).sessions
        assert len(saved) == 2 and saved[1].places >= 4
        rig.drive(5.0, start_s=1_700_001_006)
        assert second.interrupt() == 0, second.output
        sessions = MapFolder.open(target.path).sessions
        assert len(sessions) == 3 and sessions[2].first_ns > sessions[1].last_ns
    finally:
        first.kill()
        if second is not None:
            second.kill()
        rig.destroy_node()


def test_without_a_folder_of_results_there_is_nowhere_to_keep_what_is_seen(tmp_path: Path) -> None:
    arguments = "mode:=localization", f"map:={tmp_path}", "localization.update:=true", "dataset:=simulated"
    process = Process(MODULE, tmp_path / "node.log", "embedding.method:=thumbnail", *arguments)
    try:
        assert wait_until(lambda: process.exit_code == 1, 60.0)
    finally:
        process.kill()
    assert process.output.splitlines()[-1].startswith("umf: localization.update needs results_dir")
