"""The memory layer with unequal thresholds: textures and curves, pixels without and with a history, the exact gradient
of the mean count beside the play."""

import itertools

from codesign import events
from studies.event_gradient import case, compare, curves
from studies.event_gradient.case import DIRECTIONS, FEW, times
from studies.event_gradient.judge import Judge
from studies.event_gradient.topic import Asked, Topic

PAIRS = ((0.1, 0.3), (0.155, 0.172), (0.17, 0.23))
GRADIENTS = ("exact", "play")
BEGINNINGS = ("no history", "history")
ASKED = Asked(0.99, (0.95, 1.05))
SECTIONS = (
    48  # up to 240 frames per second: a threshold of 0.1 has more kinks, and 24 leave a cosine of 0.985
)


def maps(on, off, beginning, gradient):
    """Derivative and truth of a sensor's counts, as the pair that ``compare.pairs`` takes."""
    judge = Judge(events.SensorModel(on, off))

    def layer(frames, t_s):
        return events.memory(frames, on, off, gradient=gradient)[0]

    makers = [
        lambda observe: compare.of_layer(layer, observe),
        lambda observe: compare.of_judge(judge, observe),
    ]
    return [compare.with_history(make) if beginning == "history" else make(compare.parts) for make in makers]


def jobs(quick):
    rates = (60,) if quick else (60, 240, 1000)
    return [
        (on, off, beginning, rate_hz, gradient)
        for on, off in PAIRS[: 1 if quick else None]
        for beginning in BEGINNINGS
        for rate_hz in rates
        for gradient in GRADIENTS[: 2 if rate_hz == 240 else 1]
    ]


def measure(cases, on, off, beginning, rate_hz, gradient):
    layer, truth = maps(on, off, beginning, gradient)
    sections = SECTIONS if rate_hz <= 240 else case.SECTIONS
    for direction in DIRECTIONS if rate_hz == 240 else FEW:
        found = compare.pairs(cases, rate_hz, direction, layer, truth, sections)
        yield compare.row((f"{on}/{off}", gradient, beginning, direction.name, f"{rate_hz}fps"), found)


def curve_jobs(quick):
    pairs = PAIRS[: 1 if quick else None]
    kinds = list(curves.KINDS)[:: 3 if quick else 1]
    return [(*pair, *rest) for pair, *rest in itertools.product(pairs, BEGINNINGS, kinds, GRADIENTS)]


def measure_curves(cases, on, off, beginning, kind, gradient, rate_hz=240):
    layer, truth = maps(on, off, beginning, gradient)
    for parameter in curves.PARAMETERS:
        found = [
            compare.pair(curves.along(kind, rate_hz, parameter, one.seed), times(rate_hz), layer, truth)
            for one in cases
        ]
        yield compare.row((f"{on}/{off}", gradient, beginning, kind, parameter), found)


TEXT = (
    "Without a history a pixel's level begins anywhere from half a threshold below its memorised level to half a "
    "threshold above. With one it comes from far above or far below, turns anywhere near its first level, and goes to it; "
    "the layer is given the same frames. The exact gradient is that of the mean count itself, whose slopes beat against "
    "the thresholds: over some dozens of places and few pixels that is noise. The play is smooth, and off where swings are small."
)
TOPIC = Topic(
    "Unequal thresholds: textures",
    TEXT,
    ("thresholds ON/OFF", "gradient", "beginning", "direction", "frames per second"),
    jobs,
    measure,
    lambda row: ASKED if row.names[1] == "exact" else None,
    "thresholds",
)
CURVES = Topic(
    "Unequal thresholds: curves",
    TEXT
    + " Ramps, turns, sines, random walks and moving edges, 240 frames per second; their amplitude, their phase, and "
    "the step behind the first frame.",
    ("thresholds ON/OFF", "gradient", "beginning", "curve", "parameter"),
    curve_jobs,
    measure_curves,
    lambda row: ASKED if row.names[1] == "exact" else None,
    "curves",
)
