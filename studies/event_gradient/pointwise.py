"""What an optimiser sees: the derivative at one or two places, against steps of several widths. Where it equals small
differences at the same place, what is missing over a wider step is the curvature of the mean counts themselves."""

from codesign import events
from studies.event_gradient import compare
from studies.event_gradient.case import DIRECTIONS, FEW, SECTIONS, times
from studies.event_gradient.judge import Judge
from studies.event_gradient.topic import Asked, Topic

SENSORS = (
    ("0.15/0.15", 0.15, 0.15, "exact"),
    ("0.17/0.23", 0.17, 0.23, "exact"),
    ("0.17/0.23 play", 0.17, 0.23, "play"),
)
RATE_HZ = 240
MANY = 256  # beginnings: a small step moves few counts
WIDTHS = (24, 12, 4)  # of a step with two places, in sections
NEAR = 0.01  # half of the smallest step, around one place


def jobs(quick):
    sensors = [sensor[0] for sensor in SENSORS]
    every = [(sensors[0], direction.name) for direction in (FEW[-1:] if quick else DIRECTIONS)]
    return every if quick else every + [(name, direction.name) for name in sensors[1:] for direction in FEW]


def measure(cases, sensor_name, name):
    direction = next(d for d in DIRECTIONS if d.name == name)
    on, off, gradient = next(sensor[1:] for sensor in SENSORS if sensor[0] == sensor_name)
    t_s = times(RATE_HZ)
    layer = compare.of_layer(lambda frames, t_s: events.memory(frames, on, off, gradient=gradient)[0])
    sensor = events.SensorModel(on, off)
    truth = compare.of_judge(Judge(sensor))
    near = compare.of_judge(Judge(sensor, MANY))
    found = {width: [] for width in WIDTHS}
    close = []
    for case in cases:
        ends = case.along(RATE_HZ, direction)
        inner = range(1, SECTIONS)
        slopes = {k: compare.derivative(layer, ends[k], (ends[k + 1] - ends[k - 1]) / 2, t_s) for k in inner}
        for width, mine in found.items():
            for first in range(0, SECTIONS, max(width, SECTIONS // 2)):  # one or two steps of each width
                slope = (slopes[first + width // 4] + slopes[first + 3 * width // 4]) / 2 * width
                difference = compare.blocks(truth(ends[first + width], t_s) - truth(ends[first], t_s))
                mine.append(compare.Pair(slope.double(), difference.double()))
        for s in (-0.5, 0.5):
            before, here, after = (case.frames(RATE_HZ, direction, s + NEAR * k) for k in (-1, 0, 1))
            slope = compare.derivative(layer, here, after - before, t_s)
            close.append(compare.Pair(slope, compare.blocks(near(after, t_s) - near(before, t_s))))
    yield compare.row((sensor_name, name, "1 place", f"1/{1 / NEAR:.0f}"), close)
    for width, mine in found.items():
        yield compare.row((sensor_name, name, "2 places", f"1/{SECTIONS // width}"), mine)


def asked(row):
    """Two places where all thresholds are equal, and one place of an exact gradient."""
    if row.names[2] == "2 places":
        return Asked(0.9) if row.names[0] == SENSORS[0][0] else None
    return None if row.names[0].endswith("play") else Asked(0.99, (0.95, 1.05))


TOPIC = Topic(
    "What an optimiser sees",
    f"The memory layer's derivative at one or two places of a step, {RATE_HZ} frames per second; the whole step moves the "
    "picture by two pixels, over textures with periods from seven. At one place it is set beside the difference over a "
    f"hundredth of the step around it, of {MANY} beginnings: what is missing there is the layer's own error.",
    ("thresholds ON/OFF", "direction", "derivative at", "width of the step"),
    jobs,
    measure,
    asked,
    "pointwise",
)
