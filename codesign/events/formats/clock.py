"""Hardware clocks of few bits that start again at zero, and values that hold until the next word changes
them."""

import numpy as np

from codesign.errors import FileFormatError

LIMIT_LOOPS = 2**20  # of the clock, told in one file


def unwrapped(ticks, loop):
    """Count the loops of a clock.

    A fall by three quarters of the loop or more is a new loop; a smaller fall is time going back, which the
    caller judges. (A single wrong bit changes a reading by at most half a loop, so it never passes for a new
    one.)

    Args: ticks: [N] int64 readings, 0 to loop - 1. loop: number of readings.
    Returns: [N] int64 readings plus ``loop`` for each new loop so far.
    """
    falls = np.zeros(len(ticks), np.int64)
    np.cumsum(ticks[1:] - ticks[:-1] <= -(loop // 4) * 3, out=falls[1:])
    return ticks + falls * loop


def held(starts, values, count):
    """The last value given before each event; and how many events precede them all.

    Args: starts: [M] rising numbers of the events that follow each value. values: [M]. count: number of
      events.
    """
    first = int(starts[0]) if len(starts) else count
    return np.repeat(values, np.diff(starts, append=count)), first


def with_loops_told(words, starts, loops, last_reading, first_reading):
    """Put a word at the clock's last reading and one at its first ahead of the events that come loops later,
    so that no silence hides a loop.

    Args:
      words: [M] words of all events. starts: [N] index of each event's first word.
      loops: [N] int64 clock loops between each event and the one before it.
      last_reading, first_reading: the two words.
    Raises: FileFormatError when that would take more than LIMIT_LOOPS loops.
    """
    count = int(loops.sum())
    if count > LIMIT_LOOPS:
        raise FileFormatError(
            f"the clock of the format starts again {count} times between the events, {LIMIT_LOOPS} at most; "
            "write .npz instead."
        )
    if not count:
        return words
    return np.insert(
        words,
        np.repeat(starts, 2 * loops),
        np.tile(np.array([last_reading, first_reading], words.dtype), count),
    )
