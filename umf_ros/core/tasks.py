"""Independent tasks spread over processes of this machine, or over a cluster by Ray."""

from __future__ import annotations

import logging
import socket
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
from multiprocessing import get_context
from typing import Any, TypeVar

from umf_ros.core.errors import UmfError, one_line

Task = TypeVar("Task")
Done = Callable[[int], None]
"""Callback that takes the number of finished tasks."""

ATTEMPTS = 3
"""Attempts at tasks that crash their workers, without one of them being finished."""
LOCAL = "local"


def spread(
    work: Callable[[Task], None],
    tasks: Sequence[Task],
    workers: int = 1,
    ray: str | None = None,
    done: Done = lambda count: None,
) -> None:
    """Run all tasks, in any order. A worker that dies is replaced, and its task restarted.

    Args:
        work: a function of a module, whose results are files.
        tasks: its arguments, one each; `work` is called again with one whose worker died.
        workers: processes; with one, all is done here. With Ray the cluster decides.
        ray: address of a cluster, whose machines see the same files and have this package; or `local`.
        done: called with the number of tasks that are done.

    Raises:
        UmfError: a task failed, or crashed its workers repeatedly; the other tasks are abandoned.
        ModuleNotFoundError: Ray is asked for and not installed.
    """
    if ray is not None:
        _by_ray(work, tasks, ray, workers, done)
    elif workers > 1:
        _by_processes(work, tasks, workers, done)
    else:
        for count, task in enumerate(tasks, 1):
            work(task)
            done(count)


def _by_processes(work: Callable[[Task], None], tasks: Sequence[Task], workers: int, done: Done) -> None:
    left, attempts = dict(enumerate(tasks)), ATTEMPTS
    while left and attempts:
        before = len(left)
        with ProcessPoolExecutor(min(workers, before), get_context("spawn")) as pool:
            running = {pool.submit(work, task): number for number, task in left.items()}
            try:
                for future in as_completed(running):
                    with suppress(BrokenProcessPool):  # all tasks that ran with it have to be restarted
                        future.result()
                        del left[running[future]]
                        done(len(tasks) - len(left))
            except BaseException:
                pool.shutdown(wait=False, cancel_futures=True)
                raise
        attempts -= len(left) == before
    if left:
        raise UmfError(f"{len(left)} tasks crashed their worker: too little memory?")


def _by_ray(work: Callable[[Task], None], tasks: Sequence[Task], address: str, workers: int, done: Done) -> None:
    import ray
    from ray.exceptions import RayError, RayTaskError

    quiet: dict[str, Any] = {"log_to_driver": False, "logging_level": logging.ERROR}
    try:
        if address == LOCAL:
            # Ray would give its workers the lowest priority
            as_here = {"worker_niceness": 0}
            ray.init(num_cpus=max(workers, 1), include_dashboard=False, _system_config=as_here, **quiet)
        else:
            _check_cluster(address)
            ray.init(address=address, **quiet)
    except (RayError, OSError, ValueError, RuntimeError) as error:
        raise UmfError(f"no Ray cluster at {address}: {one_line(error)}") from None
    try:
        remote = ray.remote(num_cpus=1, max_retries=ATTEMPTS - 1)(work)
        pending = [remote.remote(task) for task in tasks]
        while pending:
            finished, pending = ray.wait(pending)
            ray.get(finished)
            done(len(tasks) - len(pending))
    except RayTaskError as error:
        if isinstance(error.cause, UmfError):
            raise UmfError(str(error.cause)) from None
        raise
    except RayError as error:
        raise UmfError(f"Ray abandoned a task: {one_line(error)}") from None
    finally:
        ray.shutdown()


def _check_cluster(address: str) -> None:
    """Check that a cluster answers; Ray itself would try for minutes."""
    host, _, port = address.rpartition("://")[2].partition(":")
    if port.isdigit():
        socket.create_connection((host, int(port)), 5).close()
