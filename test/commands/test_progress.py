"""Ctrl-C during a run, and what is shown while it goes on."""

from __future__ import annotations

import io
import os
import signal
import sys
from collections.abc import Iterator

import numpy as np
import pytest
from conftest import make_keyframe
from rich.console import Console

from umf_ros.commands.console import WARNING, FrameProgress, stop_on_interrupt, telling_interrupts, undisturbed
from umf_ros.core.frames import Candidate, LoopClosure
from umf_ros.detector import Detection
from umf_ros.verification import Hypothesis

SIGNALS = signal.SIGINT, signal.SIGTERM


@pytest.fixture(autouse=True)
def handlers() -> Iterator[None]:
    """Handlers of Ctrl-C and SIGTERM outside of a run; they must be the same afterwards."""
    former = signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
    before = [signal.getsignal(number) for number in SIGNALS]
    yield
    assert [signal.getsignal(number) for number in SIGNALS] == before
    signal.signal(signal.SIGTERM, former)


def press_ctrl_c() -> None:
    os.kill(os.getpid(), signal.SIGINT)


@pytest.mark.parametrize("number", SIGNALS)
def test_the_first_signal_only_asks_for_an_end(number: int) -> None:
    done = 0
    with stop_on_interrupt() as interrupted:
        for step in range(10):
            if step == 3:
                os.kill(os.getpid(), number)
            done += 1
            if interrupted():
                break
    assert done == 4 and interrupted() == number


def test_the_second_ctrl_c_ends_at_once() -> None:
    with pytest.raises(KeyboardInterrupt), stop_on_interrupt() as interrupted:
        press_ctrl_c()
        assert interrupted()
        press_ctrl_c()
        pytest.fail("still here")


def test_without_ctrl_c_nothing_is_asked() -> None:
    with stop_on_interrupt() as interrupted:
        pass
    assert not interrupted()


def test_an_error_in_the_run_gives_ctrl_c_back() -> None:
    with pytest.raises(ZeroDivisionError), stop_on_interrupt():
        raise ZeroDivisionError
    with pytest.raises(KeyboardInterrupt):
        press_ctrl_c()


def test_sigterm_after_ctrl_c_ends_at_once() -> None:
    with pytest.raises(SystemExit), stop_on_interrupt():
        press_ctrl_c()
        os.kill(os.getpid(), signal.SIGTERM)
        pytest.fail("still here")


def test_nothing_interrupts_the_writing_of_results() -> None:
    written = []
    with undisturbed():
        for part in range(3):
            press_ctrl_c()
            os.kill(os.getpid(), signal.SIGTERM)
            written.append(part)
    assert written == [0, 1, 2]
    with pytest.raises(KeyboardInterrupt):
        press_ctrl_c()


def test_an_error_while_writing_gives_ctrl_c_back() -> None:
    with pytest.raises(ZeroDivisionError), undisturbed():
        raise ZeroDivisionError


def found(stamp_s: float, closures: int) -> Detection:
    stamp = round(stamp_s * 1e9)
    made = [LoopClosure(stamp, i, np.eye(4), np.eye(6)) for i in range(closures)]
    verdicts = [Hypothesis(i, Candidate(i, i, 0.9), closure=closure) for i, closure in enumerate(made)]
    return Detection(stamp, make_keyframe(stamp_s), verdicts)


def test_places_and_closures_are_counted_beside_the_bar() -> None:
    out = io.StringIO()
    with FrameProgress(Console(file=out, force_terminal=True, width=100)) as progress:
        progress.show(0.1, found(1, 0))
        progress.show(0.2, Detection(2))  # passed over: no place
        progress.show(0.5, found(3, 2))
        progress.show(1.0, found(4, 1))
    assert "3 places, 3 closures" in out.getvalue()


def test_what_the_graph_has_not_decided_is_pending() -> None:
    out = io.StringIO()
    counts = {"accepted": 2, "pending": 4, "rejected": 1}
    with FrameProgress(Console(file=out, force_terminal=True, width=140), lambda: counts) as progress:
        progress.show(0.5, found(3, 7))
    assert "1 places, 7 closures (2 in the graph, 4 pending, 1 rejected)" in out.getvalue()


def test_where_there_is_no_terminal_no_bar_is_drawn() -> None:
    out = io.StringIO()
    with FrameProgress(Console(file=out)) as progress:
        progress.show(0.5, found(1, 1))
    assert out.getvalue() == ""


@pytest.mark.parametrize("end", [KeyboardInterrupt, SystemExit])
def test_where_a_command_is_interrupted_it_says_what_is_left(end: type[BaseException]) -> None:
    out = io.StringIO()
    with pytest.raises(end), telling_interrupts(Console(file=out), "nothing was written"):
        raise end
    assert out.getvalue() == "Interrupted: nothing was written\n"


@pytest.mark.parametrize("text", ["runs[old]/a.mcap breaks off", "[/x] is no tag", "a line " + "that is long " * 20])
def test_warnings_are_printed_as_they_are(text: str) -> None:
    out = io.StringIO()
    Console(file=out, width=80).print(text, **WARNING)
    assert out.getvalue() == text + "\n"
