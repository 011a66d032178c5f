from __future__ import annotations

import threading
import time

from processes import wait_until

from umf_ros.nodes.process import Worker


class HeldUp:
    """A worker that waits in its first item until the gate opens."""

    def __init__(self, queue_size: int) -> None:
        self.gate, self.started = threading.Event(), threading.Event()
        self.done: list[int] = []
        self.worker: Worker[int] = Worker(self._work, lambda _: None, queue_size)
        self.worker.submit(0)
        self.started.wait()

    def _work(self, item: int) -> None:
        self.started.set()
        self.gate.wait()
        self.done.append(item)


def test_items_are_done_in_order() -> None:
    done: list[int] = []
    worker: Worker[int] = Worker(done.append, lambda _: None, queue_size=100)
    for i in range(50):
        worker.submit(i)
    worker.close()
    assert done == list(range(50)) and worker.dropped == 0


def test_a_late_worker_drops_the_oldest_and_counts() -> None:
    late = HeldUp(queue_size=3)
    for item in range(1, 11):
        late.worker.submit(item)
    late.gate.set()
    late.worker.close()
    assert late.done == [0, 8, 9, 10] and late.worker.dropped == 7


def test_a_needed_item_is_never_dropped_once_it_is_taken() -> None:
    """A step that is queued once at a time would never be queued again."""
    late = HeldUp(queue_size=3)
    assert late.worker.submit(1, needed=True)
    for item in range(2, 11):
        assert late.worker.submit(item)
    assert late.worker.submit(11, needed=True) and late.worker.submit(12, needed=True)
    assert not late.worker.submit(13) and not late.worker.submit(14, needed=True)
    late.gate.set()
    late.worker.close()
    assert late.done == [0, 1, 11, 12] and late.worker.dropped == 11
    assert not late.worker.submit(15, needed=True)


def test_an_item_that_waits_is_not_queued_again() -> None:
    late = HeldUp(queue_size=3)
    for item in (0, 1, 1, 2, 1):
        assert late.worker.submit(item, needed=True, once=True)  # 0 is in hand: it waits once more
    late.gate.set()
    late.worker.close()
    assert late.done == [0, 0, 1, 2] and late.worker.dropped == 0


def test_submitting_never_waits_for_the_work() -> None:
    gate = threading.Event()
    worker: Worker[int] = Worker(lambda _: gate.wait() and None, lambda _: None, queue_size=2)
    submitted = threading.Thread(target=lambda: [worker.submit(i) for i in range(1000)])
    submitted.start()
    submitted.join(timeout=10)
    assert not submitted.is_alive()
    gate.set()
    worker.close()


def test_an_error_is_reported_and_the_thread_lives_on() -> None:
    errors: list[Exception] = []
    done: list[int] = []

    def work(item: int) -> None:
        if item == 1:
            raise ValueError("no")
        done.append(item)

    worker: Worker[int] = Worker(work, errors.append, queue_size=9)
    for i in range(3):
        worker.submit(i)
    worker.close()
    assert done == [0, 2] and str(errors[0]) == "no"


def test_nothing_is_taken_after_closing() -> None:
    done: list[int] = []
    worker: Worker[int] = Worker(done.append, lambda _: None, queue_size=9)
    worker.close()
    worker.submit(1)
    time.sleep(0.01)
    assert done == []


def test_closing_waits_for_the_item_in_hand() -> None:
    late = HeldUp(queue_size=9)
    threading.Timer(0.1, late.gate.set).start()
    late.worker.close()
    assert late.done == [0]


def test_what_is_left_when_closing_takes_too_long_is_counted() -> None:
    late = HeldUp(queue_size=9)
    for item in range(1, 4):
        late.worker.submit(item)
    late.worker.close(timeout_s=0.01)
    assert late.worker.dropped == 4  # the one in hand may not be done either
    late.gate.set()
    assert wait_until(lambda: late.done == [0])


def test_an_error_in_one_item_does_not_hide_those_of_others() -> None:
    told: list[str] = []
    worker: Worker[int] = Worker(lambda item: 1 // 0 if item % 2 else None, lambda e: told.append(str(e)), 9)
    for item in range(6):
        worker.submit(item)
    worker.close()
    assert len(told) == 3 and "zero" in told[0]
