"""The curves of training runs, read from their logs."""

from __future__ import annotations

from pathlib import Path

import pytest
from training_curves import draw, main, read_curve

LOG = "step,seconds,total,recall1,recall1_untrained\n25,60,0.5,0.4,0.3\n50,120,0.4,{last},0.3\n"


@pytest.mark.parametrize(("last", "climbs"), [(0.6, True), (0.35, False)])
def test_a_curve_begins_with_the_untrained_self(tmp_path: Path, last: float, climbs: bool) -> None:
    (tmp_path / "netvlad").mkdir()
    (tmp_path / "netvlad" / "log.csv").write_text(LOG.format(last=last))
    curve = read_curve(tmp_path / "netvlad" / "log.csv")
    assert (curve.name, curve.steps, curve.minutes) == ("netvlad", [0, 25, 50], 2.0)
    assert curve.recall1 == [0.3, 0.4, last] and curve.climbs is climbs


def test_the_table_tells_gains(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "netvlad").mkdir()
    (tmp_path / "netvlad" / "log.csv").write_text(LOG.format(last=0.45))
    main(tmp_path, tmp_path / "curves.png")
    assert "| netvlad | 50 | 2 | 30.0 | 45.0 | +15.0 | yes |" in capsys.readouterr().out
    assert (tmp_path / "curves.png").stat().st_size > 5000
    draw([read_curve(tmp_path / "netvlad" / "log.csv")], tmp_path / "again.png")
