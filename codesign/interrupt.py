"""Ctrl-C ends a run between two steps, where its state is whole; a second Ctrl-C ends it at once."""

import os
import signal
import threading
from collections.abc import Callable

NOTICE = b"\nStopping after this step; press Ctrl-C again to stop at once.\n"


class Interruption:
    """Turns SIGINT into a request that a loop answers at its next safe point.

    Outside a loop, and at the second signal, KeyboardInterrupt is raised at once and nothing is saved: what
    was saved before still stands.
    """

    def __init__(self):
        self.requested = False
        self.in_loop = False
        self.save: Callable[[], object] | None = None
        self._earlier = None

    def __enter__(self) -> "Interruption":
        # signal handlers belong to the main thread; in another one Ctrl-C never arrives
        if threading.current_thread() is threading.main_thread():
            self._earlier = signal.signal(signal.SIGINT, self._handle)
        return self

    def __exit__(self, *_: object) -> None:
        if self._earlier is not None:
            signal.signal(signal.SIGINT, self._earlier)

    def _handle(self, signum, frame):
        if self.requested or not self.in_loop:
            raise KeyboardInterrupt
        self.requested = True
        os.write(2, NOTICE)  # print is not safe in a signal handler

    def safe_point(self) -> None:
        """Called by a loop after each whole step: saves and raises KeyboardInterrupt when Ctrl-C was
        pressed."""
        if self.requested:
            if self.save is not None:
                self.save()
            raise KeyboardInterrupt
