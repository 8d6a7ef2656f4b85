"""drjit and Mitsuba for one thread at a time.

Where two threads are in drjit at once, recordings read what is freed, and the threads wait for one
another for ever:
drjit's locks spin, so one that waits keeps Python's lock, while the other frees a tensor of torch
that drjit held last, which gives Python's lock up for a moment. So whatever calls drjit is
``exclusive``; a tensor that drjit reads is kept until its arrays are gone; and no garbage is
collected meanwhile, since that frees anything. Waiting for the lock here gives Python's lock up,
and what holds it waits for no other thread.
"""

import gc
import os
import threading
import traceback
from contextlib import ContextDecorator
from typing import Any

from torch import Tensor

from codesign.errors import BackendError

FORKED = (
    "this process was forked from one that had used drjit, whose threads are not in it; start such processes with "
    "'spawn' (DataLoader: multiprocessing_context='spawn'), or fork before the first kernel, trace or scene."
)


class Exclusive(ContextDecorator):
    """``with exclusive:`` and ``@exclusive``, as often inside one another as one likes. Arrays of
    drjit that read tensors (``keep``) do not outlive the outermost."""

    def __init__(self) -> None:
        self._lock = threading.RLock()
        self._kept: list[Tensor] = []
        self._depth = 0
        self._collects = True
        self._used = False
        self._forked = False
        if hasattr(os, "register_at_fork"):
            os.register_at_fork(
                before=lambda: self._lock.acquire(),
                after_in_parent=lambda: self._lock.release(),
                after_in_child=self._in_child,
            )

    def __enter__(self) -> "Exclusive":
        self._lock.acquire()
        if self._forked:
            self._lock.release()
            raise BackendError(FORKED)
        if self._depth == 0:
            self._used = True
            self._collects = gc.isenabled()
            gc.disable()
        self._depth += 1
        return self

    def __exit__(self, kind: Any, error: BaseException | None, trace: Any) -> None:
        # frames of an error would keep arrays until someone forgets it, outside
        traceback.clear_frames(trace)
        self._depth -= 1
        if self._depth == 0:
            self._kept.clear()
            if self._collects:
                gc.enable()
        self._lock.release()

    def keep(self, tensor: Tensor) -> Tensor:
        """The tensor itself, which lives until the outermost ends."""
        self._kept.append(tensor)
        return tensor

    def _in_child(self):
        self._lock = threading.RLock()
        self._forked = self._used


exclusive = Exclusive()
