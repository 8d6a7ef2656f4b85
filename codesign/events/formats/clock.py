"""Hardware clocks of few bits that start again at zero, and values that hold until the next word changes
them."""

import numpy as np


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
