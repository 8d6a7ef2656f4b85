"""EVT 2.0: 32-bit words, one event each, with the low six bits of its time; time-high words carry the other
28.

Source: Prophesee Metavision documentation, "EVT 2.0 Format".
"""

import numpy as np

from codesign.errors import FileFormatError
from codesign.events.formats.prophesee import held, unwrapped

WORD = np.dtype("<u4")
LOOP_US = 2**34
LIMIT_US = LOOP_US  # readers disagree on how loops are counted, so none is written
TIME_HIGH = 0x8
OTHER_TYPES = (0xA, 0xE, 0xF)  # triggers, counters and what continues them: no events of pixels
LAST_HIGH = 2**28 - 1


def decoded(path, words):
    """Events of EVT 2.0 words.

    Args: path: for messages. words: [N] uint32.
    Returns: t_us, x, y, p (0 or 1) in file order, and the number of events before the first time-high word,
      which have no time and are left out.
    Raises: FileFormatError for a word of a reserved type.
    """
    kind = (words >> 28).astype(np.uint8)
    is_event = kind <= 1
    is_time = kind == TIME_HIGH
    strange = ~(is_event | is_time | np.isin(kind, OTHER_TYPES))
    if bool(strange.any()):
        at = int(np.argmax(strange))
        raise FileFormatError(
            f"{path}: word {at} has type {kind[at]:#x}, which EVT 2.0 reserves; the file is damaged or not "
            "EVT 2.0."
        )
    where = np.flatnonzero(is_event)
    at = np.flatnonzero(is_time)
    starts = np.cumsum(is_event)[at]
    high = unwrapped((words[at] & LAST_HIGH).astype(np.int64), LAST_HIGH + 1)
    t_us, untimed = held(starts, high << 6, len(where))
    event = words[where[untimed:]].astype(np.int64)
    return t_us + (event >> 22 & 0x3F), event >> 11 & 0x7FF, event & 0x7FF, event >> 28, untimed


def encoded(t_us, x, y, p):
    """EVT 2.0 words of ordered events.

    The first word sets the clock to zero: Prophesee's reader takes the first time-high word off all times.
    """
    high = t_us >> 6
    word = np.stack(
        (TIME_HIGH << 28 | high, (p > 0).astype(np.int64) << 28 | (t_us & 0x3F) << 22 | x << 11 | y), axis=1
    )
    present = np.stack((np.diff(high, prepend=0) != 0, np.ones_like(high, dtype=bool)), axis=1)
    return np.insert(word[present], 0, [TIME_HIGH << 28] * bool(len(t_us))).astype(WORD)
