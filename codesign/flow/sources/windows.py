"""Where the windows of a recording lie, and where it has gaps."""

from typing import TypeVar

import numpy as np

from codesign.errors import DomainError
from codesign.events.columns import EventColumns
from codesign.flow.sources.packet import EMPTY, GAP, PacketOptions

Choice = TypeVar("Choice")
Window = tuple[int, int]
WHOLE_S = 0.1  # a recording up to this long is one packet unless windows are asked for
# otherwise
WINDOW_S = 0.02
PACKETS = 10
# a gap: no event of the whole sensor for so long, and for so many times the mean time between events
GAP_US = 10_000
GAP_EVENTS = 100


def windows(
    held: EventColumns, whole: Window, start_us: int, options: PacketOptions, in_turn: bool
) -> tuple[list[Window], dict[str, int]]:
    """Windows whose times no truth tells, and how many were left out by which fault.

    The whole of a short recording; otherwise some, one after the other where a start or flows are given
    (``in_turn``), else spread evenly.
    """
    asked = options.window_s is not None or options.events is not None or options.count is not None
    if not asked and options.start_s is None and whole[1] - whole[0] <= WHOLE_S * 1e6:
        return [whole], {}
    if options.events is not None:
        first = int(np.searchsorted(held.t_us, start_us))
        starts = range(first, len(held) - options.events + 1, options.events)
        if not starts:
            raise DomainError(
                f"{len(held) - first} events follow the start; windows of {options.events} need more."
            )
        ends = ((int(held.t_us[k]), int(held.t_us[k + options.events - 1])) for k in starts)
        possible = [(t0, max(t1, t0 + 1)) for t0, t1 in ends]
    else:
        in_turn = in_turn or options.start_s is not None
        length_us = round((options.window_s or min(WINDOW_S, (whole[1] - whole[0]) * 1e-6)) * 1e6)
        number = (whole[1] - start_us) // length_us if length_us > 0 else 0
        if number < 1:
            raise DomainError(
                f"the recording lasts {(whole[1] - whole[0]) * 1e-6:.6f} s; no window of {length_us * 1e-6:g} s "
                "fits behind the start."
            )
        possible = [(start_us + k * length_us, start_us + (k + 1) * length_us) for k in range(number)]
    kept, left_out = without(possible, held, options.skip)
    count = options.count or PACKETS
    return (kept[:count] if in_turn else spread(kept, count)), left_out


def without(
    possible: list[Window], held: EventColumns, skip: tuple[str, ...]
) -> tuple[list[Window], dict[str, int]]:
    """The windows without those that ``skip`` names (EMPTY, GAP), and how many these were."""
    left_out = {}
    ends = np.array(possible, np.int64).reshape(-1, 2)
    few = np.searchsorted(held.t_us, ends[:, 1] + 1) == np.searchsorted(held.t_us, ends[:, 0])
    for fault, bad in ((EMPTY, few), (GAP, across(possible, gaps(held.t_us)))):
        if fault in skip:
            left_out[fault] = int(bad.sum())
            few = few[~bad]
            possible = [window for window, one in zip(possible, bad, strict=True) if not one]
    if not possible:
        raise DomainError(f"no window is left: {', '.join(f'{n} {name}' for name, n in left_out.items())}.")
    return possible, left_out


def gaps(t_us: np.ndarray) -> np.ndarray:
    """Times without any event [N, 2], microseconds: at least 10 ms, and 100 times the mean time between events."""
    least_us = max(GAP_US, GAP_EVENTS * float(t_us[-1] - t_us[0]) / max(len(t_us) - 1, 1)) if len(t_us) else 0
    at = np.flatnonzero(np.diff(t_us) > least_us)
    return np.stack([t_us[at], t_us[at + 1]], -1)


def across(possible: list[Window], empty_us: np.ndarray) -> np.ndarray:
    """[N] whether at least half of each window lies in gaps [M, 2]."""
    ends = np.array(possible, np.int64).reshape(-1, 1, 2)
    common = np.minimum(ends[..., 1], empty_us[:, 1]) - np.maximum(ends[..., 0], empty_us[:, 0])
    return 2 * np.maximum(common, 0).sum(1) >= (ends[:, 0, 1] - ends[:, 0, 0])


def covers(whole: Window, span: Window) -> bool:
    """Whether a window lies within the times of events; a tenth of it may lie beside, where nothing may have
    happened."""
    slack = (span[1] - span[0]) / 10
    return whole[0] - slack <= span[0] and span[1] <= whole[1] + slack


def spread(choices: list[Choice], count: int | None) -> list[Choice]:
    """Evenly spread members of a list, at most ``count``."""
    if not count or len(choices) <= count:
        return choices
    return [choices[k] for k in np.linspace(0, len(choices) - 1, count).round().astype(int)]
