"""A loss on flow: what the closed form estimates from the volume of a layer's events, beside what it estimates from
the hard sensor's, by the number of frame intervals."""

import itertools

import torch

from codesign import events, flow
from studies.event_gradient import compare
from studies.event_gradient.case import CONTRAST, DEPTH, FOCUS, SHIFT_X, times
from studies.event_gradient.judge import Judge
from studies.event_gradient.topic import Asked, Topic

THETA = 0.15
REFERENCE_HZ = 1000
END_S = 0.04  # of the window: three pixels of motion
BINS = 5
INTERVALS = (8, 40)
BEGINNINGS = 48  # of all pixels together
DIRECTIONS = (CONTRAST, FOCUS, SHIFT_X, DEPTH)


def quarters(field):
    """Mean flow [2, 4] of the quarters of the picture, px per window."""
    _, height, width = field.shape
    return field.reshape(2, 2, height // 2, 2, width // 2).mean((2, 4)).flatten(1)


def of_layer(frames, t_s):
    layer = events.layer("memory", events.SensorModel(THETA, THETA), learn=())
    return quarters(flow.estimate_lk(layer.volume(frames, t_s, BINS)).flow_px[0])


def of_stream(stream):
    volume = events.from_stream(stream, 0, round(END_S * 1e6), BINS)
    return quarters(flow.estimate_lk(volume).flow_px[0])


def jobs(quick):
    if quick:
        return [(INTERVALS[0], FOCUS.name)]
    return [(count, direction.name) for count in INTERVALS for direction in DIRECTIONS]


def measure(cases, count, name):
    direction = next(d for d in DIRECTIONS if d.name == name)
    kept = round(END_S * REFERENCE_HZ) + 1
    t_s = times(REFERENCE_HZ)[:kept]
    few = torch.arange(0, kept, (kept - 1) // count)
    judge = Judge(events.SensorModel(THETA, THETA), BEGINNINGS)
    found = []
    for case in cases:
        ends = case.along(REFERENCE_HZ, direction)[:, :kept]
        low, high = (judge.mean_of_streams(end, t_s, of_stream) for end in (ends[0], ends[-1]))
        slope = sum(
            derivative((first + second)[few] / 2, (second - first)[few], t_s[few])
            for first, second in itertools.pairwise(ends)
        )
        found.append(compare.Pair(slope.double() / 2, (high - low).double() / 2))
    yield compare.row((f"{count} intervals", name), found)


def derivative(frames, tangent, t_s):
    """[2, 4] derivative of the quarters' flow along a tangent of the frames."""
    frames = frames.clone().requires_grad_()
    numbers = of_layer(frames, t_s)
    grads = [torch.autograd.grad(one, frames, retain_graph=True)[0] for one in numbers.flatten()]
    return torch.stack([(grad * tangent).sum() for grad in grads]).reshape(numbers.shape)


TOPIC = Topic(
    "Flow of the volume",
    f"Mean flow of the picture's quarters, estimated in closed form from a volume of {BINS} bins over {1e3 * END_S:.0f} ms. "
    f"The hard sensor sees {REFERENCE_HZ} frames per second and gives single events; the memory layer sees fewer frames.",
    ("frames", "direction"),
    jobs,
    measure,
    lambda row: Asked(0.97) if row.names[0] == "8 intervals" else None,
    "flow",
)
