"""Errors and the text of others in them."""

from __future__ import annotations

import pytest

from umf_ros.core.errors import MessageError, UmfError, printable


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("plain name", "plain name"),
        ("naïve Ünïcode 场景", "naïve Ünïcode 场景"),
        ("\x1b[2J\x1b[31mred", r"\x1b[2J\x1b[31mred"),
        ("a\nERROR [x]: forged\r\n", "a ERROR [x]: forged"),
        ("\x9b31m", r"\x9b31m"),
        ("\u202egnp.exe", r"\u202egnp.exe"),
        ("bell\a and \x00", r"bell\x07 and \x00"),
    ],
)
def test_text_from_outside_controls_no_terminal_and_forges_no_line(text: str, shown: str) -> None:
    assert printable(text) == shown
    assert str(UmfError(text)) == str(MessageError("kind", text)) == shown
