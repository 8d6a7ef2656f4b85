"""Hard cases of event layers and of the hard sensor: nothing to see, too much, too little, for long.

Most are one pixel before frames [T], and ON less OFF of it, in theory the change of its log level
over the threshold: truncated by the hard layers, as it is by the smooth one. Straight-through
slopes are those of the mean count, half an event behind the last turn.
"""

import math
from functools import partial

import torch

from codesign import events
from codesign.types import EventStream
from studies.stability.case import SPOILT, Case, Span, spoilt

MANY = 100_000
SECOND_US = 1_000_000
EXACT = (1e-12, 1e-9, 1e-5)


def memory(frames, theta):
    return _signed(events.memory(frames.reshape(-1, 1, 1), theta, theta)[0])


def smooth(frames, theta):
    return _signed(events.soft_counts(frames.reshape(-1, 1, 1), theta, theta))


def sensor(frames, theta):
    """Long recordings come in chunks of 1e4 frames."""
    return stream_of(frames, theta, chunks=max(1, len(frames) // 10_000)).p.sum().to(theta)


def _signed(counts):
    return (counts[:, 0] - counts[:, 1]).sum()


def stream_of(frames, theta, chunks=1, **options):
    """Events of the hard sensor in a second, which sees the frames in so many chunks."""
    model = events.SensorModel(float(theta), float(theta), **options)
    t_s = torch.linspace(0, 1, len(frames), dtype=torch.float64)
    state = events.SensorState()
    parts = zip(frames.reshape(-1, 1, 1).chunk(chunks), t_s.chunk(chunks), strict=True)
    return events.concatenate([events.simulate(*part, model, state=state) for part in parts])


def level(frame):
    """Log level: I ln(20) / 20 up to 20, ln I above."""
    return torch.where(frame <= 20, frame * math.log(20) / 20, frame.clamp(min=20).log())


def resting(theta, gray, nudge):
    return torch.stack([gray, gray, gray + nudge])


def rest(theta, gray, nudge):
    """Little or nothing changes: no hard event, and the slope of the log level."""
    return (level(gray.double() + nudge) - level(gray.double())) / theta


def rising(theta, thresholds, nudge, first=50.0, count=4):
    """Frames that brighten by half a threshold more than so many, the first and the last of them
    nudged by a share of themselves."""
    rise = (thresholds.floor() + 0.5) * theta.detach()
    share = torch.linspace(0, 1, count, dtype=torch.float64).to(theta)
    frames = first * (share * rise).exp()
    return torch.cat([frames[:1] * (1 + nudge[0]), frames[1:-1], frames[-1:] * (1 + nudge[1])])


def risen(theta, thresholds, nudge, **_):
    """The rise of the log level in thresholds, however many frames it takes."""
    rise = (thresholds.floor() + 0.5) * theta.detach()
    return (rise + nudge[1].log1p() - nudge[0].log1p()) / theta


def returning(theta, thresholds, share, nudge):
    """Up by half a threshold more than so many, and back to a quarter more than a share of them."""
    top, end = _turn(thresholds, share)
    heights = torch.stack([0 * top, top + 0.5, end + 0.25]) * theta.detach()
    return 50 * heights.exp() * (1 + nudge)


def returned(theta, thresholds, share, nudge):
    """What is left of the way out; of hard events one more, as the way back lags behind."""
    _, end = _turn(thresholds, share)
    return ((end + 0.25) * theta.detach() + nudge[2].log1p() - nudge[0].log1p()) / theta


def _turn(thresholds, share):
    top = thresholds.floor()
    return top, (share * top).floor().minimum(top - 1)


def counted(name, spans, frames, change, allowed=EXACT, turned=0, slow=False):
    """A case for every way to count ``frames``. change: of the log level in thresholds, in closed
    form; turned: by how much the hard count stands above it where it ends on the way down."""

    def seen(count, **numbers):
        return count(frames(**numbers), numbers["theta"])

    def hard(**numbers):
        return change(**numbers).detach().trunc() + turned

    def mean(**numbers):
        """Its pixels begin anywhere inside the threshold, and stay there where little changes."""
        found = change(**numbers)
        return found if turned or abs(float(found.detach())) > 0.5 else 0 * found.detach()

    hard.__doc__ = change.__doc__
    rows = (("memory", hard, mean), ("smooth counts", change, None), ("sensor", hard, None))
    return [
        Case(
            *(name, stage, spans, partial(seen, LAYERS[stage]), expected, allowed),
            learn=() if stage == "sensor" else ("theta", "nudge"),
            slopes=slopes,
            slow=slow,
        )
        for stage, expected, slopes in rows
    ]


def saturated(theta, every):
    """Events of 200 crossings at even times before a dead time half a crossing short of
    ``every``."""
    frames = rising(theta, 0 * theta + 200, theta.new_zeros(2))
    dead_s = (float(every.floor()) - 0.5) / 200.5
    return theta.new_tensor(len(stream_of(frames, theta, refractory_s=dead_s)))


def let_through(theta, every):
    """The first crossing, and each next one that the dead time has passed for."""
    return ((200 - 1) / every.floor()).floor() + 1


def only_event(theta, share):
    """Time in seconds of the event of a rise of a threshold over a share."""
    frames = torch.stack([50 + 0 * theta, 50 * (theta / share).exp()])
    return stream_of(frames, theta).t_us.to(theta) / SECOND_US


def crossing(theta, share):
    """The event comes where the level crosses, to the microsecond."""
    return share


def volume_of(times_s):
    """Three bins of either polarity, of ON events at these times of a second."""
    t_us = (times_s.double() * SECOND_US).round().long().sort().values
    place = torch.zeros_like(t_us)
    stream = EventStream(t_us, place, place, place + 1, 1, 1)
    return events.from_stream(stream, 0, SECOND_US, 3, dtype=times_s.dtype).counts.flatten()


def nearness(times_s):
    """Events are shared between the nearest bins, at 0, 1/2 and 1 s."""
    shares = (1 - (2 * times_s[:, None] - torch.arange(3)).abs()).clamp(min=0).sum(0)
    return torch.cat([shares, 0 * shares])


def refused(layer, place, kind):
    """NaN or infinity anywhere in the frames is refused."""
    return layer(spoilt(place.new_full((6,), 50.0), place, kind), place.new_tensor(0.2))


THETA, THRESHOLDS, NUDGE = Span(0.05, 0.4), Span(1, 20), Span(0, 0, (2,))
RISING = {"theta": THETA, "thresholds": THRESHOLDS, "nudge": NUDGE}
BRIGHT = RISING | {"first": Span(1e2, 1e30, log=True)}
DIM = RISING | {"theta": Span(1e-4, 1e-3, log=True), "thresholds": Span(100, 900)}
HIGH = {"theta": Span(2, 10), "gray": Span(50, 90), "nudge": Span(5, 50)}
TURN = RISING | {"thresholds": Span(2, 20), "share": Span(0, 0.99), "nudge": Span(0, 0, (3,))}
GRAYS = Span(21, 254), Span(0, 0), Span(255, 255), Span(1e-320, 1e-39, log=True)
NAMES = "flat scene", "black frames", "clipped frames", "denormals"
RESTING = [{"theta": THETA, "gray": gray, "nudge": Span(0, 0)} for gray in GRAYS]
LAYERS = {"memory": memory, "smooth counts": smooth, "sensor": sensor}
DEAD = {"theta": Span(0.01, 0.05), "every": Span(1, 60)}
ONE, AT_ONCE = {"theta": THETA, "share": Span(0.55, 0.95)}, {"times_s": Span(0, 1, (1,))}
# single levels near 4 are exact to 2.4e-7: of the smallest threshold; of a quarter of 0.05; over
# the slowest speed, 0.052 a second. Near 70 they are to 4e-6 of 0.05
FINE, TURNED, MICROSECOND = (1e-10, 1e-9, 3e-3), (1e-12, 1e-9, 1e-4), (1e-6, 0, 6e-6)
MANY_SUMMED = (1e-10, 1e-9, 6e-3)  # 1e5 numbers, each rounded by 6e-8 of the sum
CASES = [
    *[case for x in zip(NAMES, RESTING, strict=True) for case in counted(*x, resting, rest)],
    *counted("smallest thresholds", DIM, rising, risen, FINE),
    *counted("largest thresholds", HIGH, resting, rest),
    *counted("huge, tiny coordinates", BRIGHT, rising, risen, TURNED),
    *counted("turning point", TURN, returning, returned, TURNED, turned=1),
    *counted("1e5 frames", RISING, partial(rising, count=MANY), risen, MANY_SUMMED, slow=True),
    Case("sensor saturation", "sensor", DEAD, saturated, let_through, learn=()),
    Case("one event", "sensor", ONE, only_event, crossing, MICROSECOND, ()),
    Case("one event", "volume", AT_ONCE, volume_of, nearness, MICROSECOND, ()),
    *[
        Case("NaN or infinity", stage, SPOILT, partial(refused, layer), "frames must be finite")
        for stage, layer in LAYERS.items()
    ],
]
