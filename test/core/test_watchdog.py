"""A process that stands still ends with the stacks of its threads; one that makes progress goes on."""

from __future__ import annotations

import signal
import subprocess
import sys
import textwrap
import time

import pytest
from processes import ENVIRONMENT

BUSY_LOCK = "import re; re.match('(a+)+$', 'a' * 64 + 'b')"
"""Holds the interpreter lock for longer than any test waits."""


def ended(code: str, timeout_s: float = 60.0) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", textwrap.dedent(code)]
    return subprocess.run(command, env=ENVIRONMENT, capture_output=True, text=True, timeout=timeout_s, check=False)


HOW = {"time.sleep(99)": 1, BUSY_LOCK: -signal.SIGALRM}
"""Exit status of a process that stands still like this."""


IN_MAIN = """
with watchdog.watching(1.0):
    stands_still(1)
"""
IN_WORKER = """
with watchdog.watching(1.0):
    worker = Worker(stands_still, print, 1)
    worker.submit(1)
    while True:
        watchdog.feed()
        time.sleep(0.05)
"""


@pytest.mark.parametrize("stand_still", HOW)
@pytest.mark.parametrize("program", [IN_MAIN, IN_WORKER], ids=["main thread", "worker while the main thread feeds"])
def test_a_thread_that_stands_still_ends_the_process(program: str, stand_still: str) -> None:
    head = "import time\nfrom umf_ros.core import watchdog\nfrom umf_ros.nodes.process import Worker\n"
    done = ended(f"{head}def stands_still(item): {stand_still}\nwatchdog.GRACE_S = 1{program}")
    assert done.returncode == HOW[stand_still]
    assert "in stands_still" in done.stderr


@pytest.mark.parametrize("ends", [False, True])
def test_time_in_which_the_process_is_suspended_is_no_standstill(ends: bool) -> None:
    code = f"""
        import threading, time
        from umf_ros.core import watchdog
        def work():
            with watchdog.task("worker"):
                time.sleep(99 if {ends} else 1.2)
        with watchdog.watching(2.0):
            thread = threading.Thread(target=work, daemon=True)
            thread.start()
            print("works", flush=True)
            for _ in range(50):
                watchdog.feed()
                time.sleep(0.1)
            thread.join()
        print("done")
    """
    command = [sys.executable, "-c", textwrap.dedent(code)]
    process = subprocess.Popen(command, env=ENVIRONMENT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert process.stdout is not None and process.stdout.readline() == "works\n"
    for _ in range(2):
        process.send_signal(signal.SIGSTOP)
        time.sleep(3.0)
        process.send_signal(signal.SIGCONT)
        time.sleep(0.3)
    out, error = process.communicate(timeout=60.0)
    if ends:  # one that stands still after it went on is ended as ever
        assert process.returncode == 1 and error.startswith("umf: worker is stalled") and "in work" in error
    else:
        assert (process.returncode, out, error) == (0, "done\n", "")


def test_progress_keeps_the_process_alive_and_leaving_disarms_it() -> None:
    done = ended("""
        import time
        from umf_ros.core import watchdog
        with watchdog.watching(1.0):
            for _ in range(40):
                watchdog.feed()
                with watchdog.task("short"):
                    time.sleep(0.05)
        watchdog.feed()
        time.sleep(1.5)
        print("done")
    """)
    assert (done.returncode, done.stdout, done.stderr) == (0, "done\n", "")


def test_long_work_may_ask_for_patience() -> None:
    done = ended("""
        import threading, time
        from umf_ros.core import watchdog
        def settle():
            with watchdog.task("worker"), watchdog.task("settling", 30.0):
                time.sleep(2.5)
        with watchdog.watching(1.0):
            thread = threading.Thread(target=settle)
            thread.start()
            while thread.is_alive():
                watchdog.feed()
                time.sleep(0.05)
        with watchdog.watching(1.0), watchdog.watching(30.0):
            time.sleep(1.5)
        print("done")
    """)
    assert (done.returncode, done.stdout) == (0, "done\n"), done.stderr
