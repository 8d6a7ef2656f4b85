"""The words of Prophesee's RAW files.

EVT 2.0: 32 bits, one event each, with the low six bits of its time; time-high words carry the other
28. EVT 3.0: 16 bits that each change one part of the state (time, row, column base) or emit events
from it, one or up to twelve at once. Hardware clocks of few bits start again at zero, and values
hold until the next word changes them.

Source: Prophesee Metavision documentation, "EVT 2.0 Format", "EVT 3.0 Format".
"""

import numpy as np

from codesign.errors import FileFormatError

# triggers, counters and what continues them: no events of pixels
OTHER_TYPES = (0x7, 0xA, 0xE, 0xF)
EVT2_WORD = np.dtype("<u4")
EVT2_LOOP_US = 2**34
EVT2_HIGH = 0x8  # a word with the high bits of the time
EVT2_TYPES = (0x0, 0x1, EVT2_HIGH, *OTHER_TYPES[1:])
EVT3_WORD = np.dtype("<u2")
EVT3_LOOP_US = 2**24
EVT3_LIMIT_US = EVT3_LOOP_US * 2**20  # loops are told, four words each: 8 MB at most
ADDR_Y = 0x0
ADDR_X = 0x2
BASE_X = 0x3
VECT_12 = 0x4
VECT_8 = 0x5
TIME_LOW = 0x6
TIME_HIGH = 0x8
EVT3_TYPES = (ADDR_Y, ADDR_X, BASE_X, VECT_12, VECT_8, TIME_LOW, TIME_HIGH, *OTHER_TYPES)
STEP = np.array([12 if kind == VECT_12 else 8 if kind == VECT_8 else 0 for kind in range(16)])
LOAD = np.array([0xFF if kind == VECT_8 else 0xFFF for kind in range(16)], np.uint16)
BITS = [[bit for bit in range(12) if mask >> bit & 1] for mask in range(4096)]
BIT_COUNT = np.array([len(bits) for bits in BITS], np.uint8)
BIT_START = np.cumsum(BIT_COUNT, dtype=np.int64) - BIT_COUNT
BIT_LIST = np.array([bit for bits in BITS for bit in bits], np.int32)


def unwrapped(ticks, loop):
    """Count the loops of a clock.

    A fall by three quarters of the loop or more is a new loop; a smaller fall is time going back,
    which the caller judges. (A single wrong bit changes a reading by at most half a loop, so it
    never passes for a new one.)

    Args:
      ticks: [N] int64 readings, 0 to loop - 1.
      loop: number of readings.
    Returns: [N] int64 readings plus ``loop`` for each new loop so far.
    """
    falls = np.zeros(len(ticks), np.int64)
    np.cumsum(ticks[1:] - ticks[:-1] <= -(loop // 4) * 3, out=falls[1:])
    return ticks + falls * loop


def held(starts, values, count):
    """The last value given before each event; and how many events precede them all.

    Args:
      starts: [M] rising numbers of the events that follow each value.
      values: [M].
      count: number of events.
    """
    first = int(starts[0]) if len(starts) else count
    return np.repeat(values, np.diff(starts, append=count)), first


def check_types(path, kind, known, name):
    """Raise FileFormatError for words of a type that an encoding reserves."""
    strange = ~np.isin(np.arange(16), known)[kind]
    if bool(strange.any()):
        at = int(np.argmax(strange))
        raise FileFormatError(
            f"{path}: word {at} has type {kind[at]:#x}, which {name} reserves; the file is damaged or not "
            f"{name}."
        )


def evt2_decoded(path, words):
    """Events of EVT 2.0: 32-bit words, one event each, with the low six bits of its time; time-high
    words carry the other 28.

    Args:
      path: for messages.
      words: [N] uint32.
    Returns: t_us, x, y, p (0 or 1) in file order, and the number of events before the first
      time-high word, which have no time and are left out.
    Raises: FileFormatError for a word of a reserved type.
    """
    kind = (words >> 28).astype(np.uint8)
    check_types(path, kind, EVT2_TYPES, "EVT 2.0")
    is_event = kind <= 1
    where = np.flatnonzero(is_event)
    at = np.flatnonzero(kind == EVT2_HIGH)
    starts = np.cumsum(is_event)[at]
    high = unwrapped((words[at] & 0xFFFFFFF).astype(np.int64), 2**28)
    t_us, untimed = held(starts, high << 6, len(where))
    event = words[where[untimed:]].astype(np.int64)
    return t_us + (event >> 22 & 0x3F), event >> 11 & 0x7FF, event & 0x7FF, event >> 28, untimed


def evt2_encoded(t_us, x, y, p):
    """EVT 2.0 words of ordered events.

    The first word sets the clock to zero: Prophesee's reader takes the first time-high word off all
    times.
    """
    high = t_us >> 6
    word = np.stack(
        (
            EVT2_HIGH << 28 | high,
            (p > 0).astype(np.int64) << 28 | (t_us & 0x3F) << 22 | x << 11 | y,
        ),
        axis=1,
    )
    present = np.stack((np.diff(high, prepend=0) != 0, np.ones_like(high, dtype=bool)), axis=1)
    return np.insert(word[present], 0, [EVT2_HIGH << 28] * bool(len(t_us))).astype(EVT2_WORD)


def evt3_decoded(path, words):
    """Events of EVT 3.0 words.

    Args:
      path: for messages.
      words: [N] uint16.
    Returns: t_us, x, y, p (0 or 1) in file order, and the number of events before the first word
      that gives their time, row or column base; they are left out.
    Raises: FileFormatError for a word of a reserved type, and for a vector that leaves the 11 bits
      of a column.
    """
    kind = (words >> 12).astype(np.uint8)
    check_types(path, kind, EVT3_TYPES, "EVT 3.0")
    load = words & 0xFFF
    is_vector = (kind == VECT_12) | (kind == VECT_8)
    emits = is_vector | (kind == ADDR_X)
    # emitted: how many words have emitted events up to each
    where = np.flatnonzero(emits)
    emitted = np.cumsum(emits)
    column, mask, on, lost = _columns(kind, load, is_vector, where, emitted)
    at, since_us = _times(kind, load)
    t_us, untimed = held(emitted[at], since_us, len(where))
    at = np.flatnonzero(kind == ADDR_Y)
    row, rowless = held(emitted[at], load[at] & 0x7FF, len(where))
    first = max(untimed, rowless)
    lost += int(BIT_COUNT[mask[:first]].sum(dtype=np.int64))
    t_us = t_us[first - untimed :]
    row = row[first - rowless :]
    column = column[first:]
    mask = mask[first:]
    on = on[first:]
    count = BIT_COUNT[mask].astype(np.intp)
    last = np.cumsum(count)
    total = int(last[-1]) if last.size else 0
    bit = np.arange(total) + np.repeat(BIT_START[mask] - (last - count), count)
    x = np.repeat(column, count) + BIT_LIST[bit]
    if x.size and int(x.max()) > 0x7FF:
        raise FileFormatError(
            f"{path}: a vector of EVT 3.0 reaches column {int(x.max())}; columns end at 2047; the file is "
            "damaged."
        )
    return np.repeat(t_us, count), x, np.repeat(row, count), np.repeat(on, count), lost


def _times(kind, load):
    """Positions of time words from the first time-high word on, and the time from each on."""
    at = np.flatnonzero((kind == TIME_LOW) | (kind == TIME_HIGH))
    is_high = kind[at] == TIME_HIGH
    first = np.argmax(is_high) if is_high.any() else len(at)
    at, is_high = at[first:], is_high[first:]
    if not at.size:
        return at, at
    ordinal = np.cumsum(is_high) - 1
    high = unwrapped(load[at[is_high]].astype(np.int64), 4096)
    low_at = np.maximum.accumulate(np.where(is_high, -1, np.arange(len(at))))
    # a new high part starts its low part at zero until a time-low word says more; a repeated one
    # leaves it
    moved = is_high & (np.diff(high[ordinal], prepend=-1) != 0)
    moved_at = np.maximum.accumulate(np.where(moved, np.arange(len(at)), -1))
    return at, (high[ordinal] << 12) + np.where(low_at > moved_at, load[at[low_at]], 0)


def _columns(kind, load, is_vector, where, emitted):
    """First column, mask of columns and polarity of each emitting word, and how many events of
    vectors are left out for want of a base."""
    vector = is_vector[where]
    kind_there = kind[where]
    load_there = load[where]
    # columns that vectors have moved the base by, before each emitting word
    passed = np.concatenate(([0], np.cumsum(STEP[kind_there])))
    at = np.flatnonzero(kind == BASE_X)
    base, baseless = held(emitted[at], (load[at] & 0x7FF) - passed[emitted[at]], len(where))
    on, _ = held(emitted[at], load[at] >> 11, len(where))
    base, on = (np.concatenate((np.zeros(baseless, values.dtype), values)) for values in (base, on))
    column = np.where(vector, base + passed[:-1], load_there & 0x7FF)
    mask = np.where(vector, load_there & LOAD[kind_there], np.uint16(1))
    lost = int((BIT_COUNT[mask[:baseless]] * vector[:baseless]).sum(dtype=np.int64))
    mask[:baseless] *= ~vector[:baseless]
    return column, mask, np.where(vector, on, load_there >> 11), lost


def evt3_encoded(t_us, x, y, p):
    """EVT 3.0 words of ordered events, one column word per event.

    The first word sets the clock to zero: Prophesee's reader takes the first time-high word off all
    times. Each half loop that passes is told by its last and the next reading, so that no silence
    hides a loop and no jump is as long as those that readers take for damage (faery: 4094 of 4096
    readings).
    """
    high_moved = np.diff(t_us >> 12, prepend=0) != 0
    moved = np.diff(t_us, prepend=-1) != 0
    word = np.stack(
        (
            TIME_HIGH << 12 | t_us >> 12 & 0xFFF,
            TIME_LOW << 12 | t_us & 0xFFF,
            y,
            ADDR_X << 12 | (p > 0).astype(np.int64) << 11 | x,
        ),
        axis=1,
    )
    present = np.stack(
        (high_moved, moved, np.diff(y, prepend=-1) != 0, np.ones_like(moved)), axis=1
    )
    count = present.sum(axis=1)
    halves = np.diff(t_us // (EVT3_LOOP_US // 2), prepend=0)
    passed = 0x800 * np.arange(1, int(halves.sum()) + 1)  # high part at the start of each half
    told = TIME_HIGH << 12 | np.stack((passed - 1, passed), axis=1).ravel() & 0xFFF
    words = np.insert(word[present], np.repeat(np.cumsum(count) - count, 2 * halves), told)
    return np.insert(words, 0, [TIME_HIGH << 12] * bool(len(t_us))).astype(EVT3_WORD)


# version -> type of a word, end of the times that are written, from words and to words
ENCODINGS = {
    2: (EVT2_WORD, EVT2_LOOP_US, evt2_decoded, evt2_encoded),
    3: (EVT3_WORD, EVT3_LIMIT_US, evt3_decoded, evt3_encoded),
}
