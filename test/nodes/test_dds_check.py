"""The check that messages pass between two participants."""

from __future__ import annotations

import pytest

from umf_ros.nodes import diagnostics


def test_two_participants_exchange_an_image(capsys: pytest.CaptureFixture[str]) -> None:
    diagnostics.main()
    assert "an image arrived after" in capsys.readouterr().out


def test_images_that_do_not_arrive_are_one_clear_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(diagnostics, "DDS_TIMEOUT_S", 0.0)
    with pytest.raises(SystemExit) as ended:
        diagnostics.main()
    # text as the status: Python writes it to stderr and exits with 1
    told = "no message arrived", "publisher and subscriber did not find each other"
    assert ended.value.code in [f"{fault} within 0 s" for fault in told]
