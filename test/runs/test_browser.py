"""The report in a real browser: what its script draws, wide and narrow, light and dark."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

import cv2
import numpy as np
import pytest
from finished_runs import BELOW, accepted, candidate, closure, examined, trajectory

from umf_ros.runs.findings import conclude, look_first
from umf_ros.runs.report import write_page
from umf_ros.runs.run_file import SCAN_UNIT_M, Picture
from umf_ros.runs.scene import build_scene, pairs_of
from umf_ros.verification import RejectReason

CHECKS = Path(__file__).with_name("page_checks.js")
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this machine")


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("page")
    closures = [closure(50, 10), closure(52, 12, error_m=0.9)]
    tested = [
        candidate(50, 10, None, **(BELOW | {"probability": 0.97})),
        candidate(52, 12, None, **(BELOW | {"probability": 0.93})),
        candidate(54, 14, RejectReason.IMPROBABLE, **BELOW),
    ]
    about = examined(folder, closures, tested, accepted(), trajectory(), missed=[54], ate=(1.0, 0.2))
    grey = np.random.default_rng(0).integers(0, 255, (48, 64), np.uint8)
    jpeg = cv2.imencode(".jpg", grey)[1].tobytes()
    scan = (np.random.default_rng(1).uniform(-10, 10, (50, 3)) / SCAN_UNIT_M).astype(np.int16)
    pictures = {int(stamp): Picture(int(stamp), jpeg, 64, 48, scan) for stamp in about.run.stamps}
    findings = look_first(about)
    inliers = {(closures[0].query_stamp_ns, closures[0].match_stamp_ns): np.array([[3.0, 4, 30, 20]])}
    write_page(about, conclude(about, findings), findings, build_scene(about, pairs_of(about), pictures, inliers))
    return folder / "report.html"


def browse(page: Path, folder: Path, *options: str, pair: str = "") -> str:
    command = [str(CHROMIUM), "--headless", "--no-sandbox", "--disable-gpu", f"--user-data-dir={folder / 'profile'}"]
    command += ["--virtual-time-budget=8000", "--hide-scrollbars", *options, f"file://{page}{pair}"]
    return subprocess.run(command, capture_output=True, encoding="utf-8", timeout=120, check=False).stdout


def text_of(dom: str, name: str) -> str:
    found = re.search(rf'id="{name}"[^>]*>(.*?)</(?:p|table)>', dom, re.S)
    assert found, name
    return re.sub(r"<[^>]+>", " ", found[1])


def test_the_script_runs_to_its_end_and_draws_everything(page: Path, tmp_path: Path) -> None:
    dom = browse(page, tmp_path, "--dump-dom")
    assert 'data-ready="yes"' in dom
    for name in ("trajectory", "timeline", "sweep", "errors", "scans-above", "bars"):
        part = dom[dom.index(f'id="{name}"') :]
        assert "main-svg" in part[:3000], name
    assert "false" in text_of(dom, "pair-title") and "FALSE: 0.90 m" in text_of(dom, "pair-facts")
    assert "2 closures, precision 50.0 %, recall 5.0 % (1 of 20 revisits)" in text_of(dom, "threshold-words")


def test_an_address_leads_to_a_pair_and_its_reasons(page: Path, tmp_path: Path) -> None:
    dom = browse(page, tmp_path, "--dump-dom", pair="#pair=2")
    assert text_of(dom, "pair-title").startswith("missed revisit: 54.0 s")
    facts = " ".join(text_of(dom, "pair-facts").split())
    assert "short in log-odds; lost by" in facts and "verification.min_probability: 0.600 adds 1 closures" in facts
    first = browse(page, tmp_path, "--dump-dom", pair="#pair=0")
    assert text_of(first, "views-caption").endswith("1 image features agree with the pose")


@pytest.mark.parametrize(("width", "dark"), [(1280, False), (1280, True), (390, False), (390, True)])
def test_it_fits_the_window_in_light_and_dark(page: Path, tmp_path: Path, width: int, dark: bool) -> None:
    """A frame of that width, for a browser's own window cannot be as narrow as a telephone."""
    frame = tmp_path / "frame.html"
    style = f"style='border:0' width={width} height=4000"
    frame.write_text(
        f"<body style='margin:0'><iframe {style} src='file://{page}'></iframe><script>{CHECKS.read_text()}</script>"
    )
    options = ["--allow-file-access-from-files", f"--window-size={max(width, 500)},4000"]
    options += [f"--blink-settings=preferredColorScheme={int(not dark)}"]
    seen = dict(re.findall(r'data-(\w+)="([^"]*)"', browse(frame, tmp_path, "--dump-dom", *options)))
    assert seen["overflow"] == "0" and (seen["table"] == "0" or width < 1280) and 20 < int(seen["head"]) < 120, seen
    assert int(seen["texts"]) > 60 and float(seen["weakest"]) >= 4.5, seen  # WCAG 2.1, AA
    browse(frame, tmp_path, f"--screenshot={tmp_path / 'page.png'}", *options)
    picture = cv2.imread(str(tmp_path / "page.png"))
    corner = picture[200:3800:50, 3 : width - 3 : 40].reshape(-1, 3).mean(axis=1)
    assert np.median(corner) < 60 if dark else np.median(corner) > 200
