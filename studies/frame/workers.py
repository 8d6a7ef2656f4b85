"""Calls in processes of their own, on this machine or on the nodes of a Ray cluster. A worker that
is killed is asked again; one that fails by itself ends all of them."""

import json
import os
import socket
import sys
from collections.abc import Callable, Generator, Mapping
from concurrent.futures import FIRST_COMPLETED, ThreadPoolExecutor, wait
from contextlib import contextmanager
from threading import Event
from typing import Any, TypeVar

import drjit
import torch

from codesign.errors import CodesignError
from codesign.optional import require
from studies.frame import bench

Key = TypeVar("Key")
TRIES = 3
PACE_S = 0.5
PATIENCE_S = 5.0  # with the head of a cluster
HERE = "here"  # a Ray of this machine's own, for the time of the calls


def with_threads(threads: int) -> None:
    """Leave so many threads to a process that works beside others; 0: as it is."""
    if threads:
        torch.set_num_threads(threads)
        drjit.set_thread_count(threads)


def in_processes(
    function: Callable[..., Any],
    calls: Mapping[Key, Mapping[str, Any]],
    processes: int,
    meanwhile: Callable[[], object] = lambda: None,
) -> Generator[tuple[Key, Any]]:
    """What a function of the top level of a module returns for the arguments of each call, in the
    order in which they are
    done: so many fresh processes at a time; ``meanwhile`` is called every PACE_S, and ends them all
    where it raises.

    Raises: CodesignError of a call that fails, or whose worker was killed TRIES times.
    """
    ending = Event()

    def tried(given):
        for _ in range(TRIES - 1):
            try:
                return bench.apart(function, **given)
            except bench.KilledError:
                if ending.is_set():
                    raise
        return bench.apart(function, **given)

    with ThreadPoolExecutor(processes) as pool:
        waiting = {pool.submit(tried, given): key for key, given in calls.items()}
        try:
            left = set(waiting)
            while left:
                done, left = wait(left, PACE_S, FIRST_COMPLETED)
                meanwhile()
                for each in done:
                    yield waiting[each], each.result()
        finally:
            ending.set()
            pool.shutdown(wait=False, cancel_futures=True)
            # those that have begun; one that is just being started is met by a later round
            while wait([each for each in waiting if not each.cancelled()], timeout=0.1).not_done:
                bench.end_running()


def on_cluster(
    function: Callable[..., Any], calls: Mapping[Key, Mapping[str, Any]], address: str
) -> Generator[tuple[Key, Any]]:
    """The same on a Ray cluster, a core a call. The package is installed on its nodes, at the same
    version.

    Args:
      address: of its head, "auto" for the one that this machine belongs to, HERE for one of its
        own.
    Raises: MissingPackageError without Ray; CodesignError where there is no cluster, or as
      ``in_processes``.
    """
    with _connected(address) as ray:
        name = bench.named(function)
        ask = ray.remote(num_cpus=1, max_retries=TRIES - 1, max_calls=1)(_asked)
        waiting = {ask.remote(name, json.dumps(dict(given))): key for key, given in calls.items()}
        while waiting:
            done, _ = ray.wait(list(waiting))
            for each in done:
                try:
                    yield waiting.pop(each), json.loads(ray.get(each))
                except ray.exceptions.RayError as error:
                    last = str(error).strip().splitlines()[-1][:300]
                    raise CodesignError(
                        f"a call of {name} failed on the cluster: {last}"
                    ) from error


def check_cluster(address: str) -> None:
    """Raise what ``on_cluster`` does where there is no such cluster, before anything is computed;
    "" is none to ask for."""
    if address == HERE:
        require("ray", "cluster", "a sweep over a cluster")
    elif address:
        with _connected(address):
            pass


@contextmanager
def _connected(address):
    """Ray, connected to a cluster."""
    ray = require("ray", "cluster", "a sweep over a cluster")
    environment = {"PYTHONPATH": os.pathsep.join(path or os.getcwd() for path in sys.path)}
    alone = address == HERE
    try:
        if ":" in address and "//" not in address:  # ray would try for minutes
            host, _, port = address.rpartition(":")
            socket.create_connection((host, int(port)), timeout=PATIENCE_S).close()
        ray.init(
            address="local" if alone else address,
            runtime_env={"env_vars": environment} if alone else None,
            include_dashboard=False if alone else None,
            log_to_driver=False,
            logging_level="ERROR",
        )
    except (OSError, ValueError, RuntimeError) as error:
        raise CodesignError(f"there is no Ray cluster at '{address}' ({error}).") from error
    try:
        yield ray
    finally:
        ray.shutdown()


def _asked(name, given):
    """On a node."""
    from studies.frame.bench import called

    return called(name, [], json.loads(given))
