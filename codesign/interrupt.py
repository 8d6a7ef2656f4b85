"""Ctrl-C, and SIGTERM of a batch system, end a run between two steps, where its state is whole; a
second one ends it at once."""

import os
import select
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

NOTICE = b"\nStopping after this step; press Ctrl-C again to stop at once.\n"
SIGNALS = (signal.SIGINT, signal.SIGTERM)


@contextmanager
def written_out() -> Iterator[None]:
    """A command whose reader went away (``| head``) ends without a traceback, with exit code
    141."""
    try:
        yield
        sys.stdout.flush()
    except SystemExit:
        with written_out():  # what --help printed
            pass
        raise
    except BrokenPipeError:
        if not _reader_gone(sys.stdout.fileno()):
            raise
        # for the last flush of the interpreter
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise SystemExit(128 + 13) from None


def _reader_gone(handle):
    if not hasattr(select, "poll"):  # Windows
        return True
    poll = select.poll()
    poll.register(handle, 0)
    return any(event & select.POLLERR for _, event in poll.poll(0))


class Interruption:
    """Turns SIGINT and SIGTERM into a request that a loop answers at its next safe point.

    Outside a loop, and at the second signal, KeyboardInterrupt is raised at once and nothing is
    saved: what was saved before still stands. ``exit_code`` is that of the signal (130, 143);
    ``raised``: whether that error was, which a library that is being loaded may turn into another.
    """

    def __init__(self):
        self.requested = self.raised = False
        self.in_loop = False
        self.exit_code = 128 + signal.SIGINT
        self.save: Callable[[], object] | None = None
        self._earlier = {}
        self._process = os.getpid()

    def __enter__(self) -> "Interruption":
        # signal handlers belong to the main thread; in another one signals never arrive
        if threading.current_thread() is threading.main_thread():
            self._earlier = {number: signal.signal(number, self._handle) for number in SIGNALS}
        return self

    def __exit__(self, *_: object) -> None:
        for number, earlier in self._earlier.items():
            signal.signal(number, earlier)
        self._earlier = {}

    def _handle(self, signum, frame):
        # a worker that was forked: its pool ends it
        if signum == signal.SIGTERM and os.getpid() != self._process:
            signal.signal(signum, signal.SIG_DFL)
            os.kill(os.getpid(), signum)
            return
        self.exit_code = 128 + signum
        if self.requested or not self.in_loop:
            self.raised = True
            raise KeyboardInterrupt
        self.requested = True
        os.write(2, NOTICE)  # print is not safe in a signal handler

    def safe_point(self) -> None:
        """Called by a loop after each whole step: saves and raises KeyboardInterrupt when a signal
        asked for it."""
        if self.requested:
            if self.save is not None:
                self.save()
            raise KeyboardInterrupt
