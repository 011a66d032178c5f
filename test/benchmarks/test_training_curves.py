"""The curves of training runs, read from their logs."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from sources import ROOT

LOG = "step,seconds,total,recall1,recall1_untrained\n25,60,0.5,0.4,0.3\n50,120,0.4,{last},0.3\n"
SCRIPT = ROOT / "benchmarks" / "accuracy" / "training_curves.py"


@pytest.mark.parametrize(
    ("last", "row"),
    [
        (0.45, "| netvlad | 50 | 2 | 30.0 | 45.0 | +15.0 | yes |"),
        (0.35, "| netvlad | 50 | 2 | 30.0 | 40.0 | +10.0 | no |"),
    ],
)
def test_a_curve_begins_with_the_untrained_self(last: float, row: str, tmp_path: Path) -> None:
    (tmp_path / "netvlad").mkdir()
    (tmp_path / "netvlad" / "log.csv").write_text(LOG.format(last=last))
    picture = tmp_path / "curves.png"
    command = [sys.executable, str(SCRIPT), str(tmp_path), "--picture", str(picture)]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=60)
    assert done.stdout.splitlines()[-1] == row
    assert picture.stat().st_size > 5000
