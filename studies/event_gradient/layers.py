"""Every layer with equal thresholds, by frame rate and direction; and how far its counts are off."""

from codesign import events
from studies.event_gradient import compare
from studies.event_gradient.case import DIRECTIONS, FEW, times
from studies.event_gradient.judge import Judge
from studies.event_gradient.topic import Asked, Topic

THETA = 0.15
RATES_HZ = (60, 240, 1000)
LAYERS = {
    "sigmoid": lambda frames, t_s: events.soft(frames, THETA),
    "dense": lambda frames, t_s: events.dense(frames, THETA, THETA)[0],
    "expected": lambda frames, t_s: events.expected(frames, THETA, THETA, 0.15)[0],
    "memory": lambda frames, t_s: events.memory(frames, THETA, THETA)[0],
}
# the others are loops of torch over frames: compared up to this rate, in few directions
FAST = ("sigmoid", "memory")
SLOW_HZ = 240
REFERENCE_HZ = 5000
COUNTED_HZ = (60, 240, 500, 1000)
ASKED = Asked(0.98, (0.9, 1.1))


def directions(quick):
    return FEW if quick else DIRECTIONS


def jobs(quick):
    rates = RATES_HZ[:2] if quick else RATES_HZ
    return [
        (layer, rate_hz, direction.name)
        for rate_hz in rates
        for direction in directions(quick)
        for layer in (LAYERS if rate_hz <= SLOW_HZ and direction in FEW and not quick else FAST)
    ]


def measure(cases, layer, rate_hz, name):
    direction = next(d for d in DIRECTIONS if d.name == name)
    judge = Judge(events.SensorModel(THETA, THETA))
    found = compare.pairs(cases, rate_hz, direction, compare.of_layer(LAYERS[layer]), compare.of_judge(judge))
    yield compare.row((layer, name, f"{rate_hz}fps"), found)


def count_errors(cases, rate_hz):
    """Sum of |difference| of counts per polarity and case over the total, against hard events at a high rate."""
    sensor = events.SensorModel(THETA, THETA)
    for layer, counts in LAYERS.items():
        off = 0.0
        total = 0.0
        for case in cases:
            truth = events.dense_counts(case.frames(REFERENCE_HZ), times(REFERENCE_HZ), sensor).sum((0, 2, 3))
            found = counts(case.frames(rate_hz), times(rate_hz)).sum((0, 2, 3))
            off += float((found - truth).abs().sum())
            total += float(truth.sum())
        yield compare.Row((layer, f"{rate_hz}fps"), {"count_error": off / total})


TOPIC = Topic(
    "Every layer with equal thresholds",
    "Contrast of the scene, focus of the lens, and the six components of the camera's pose, one by one.",
    ("layer", "direction", "frames per second"),
    jobs,
    measure,
    lambda row: ASKED if row.names[0] == "memory" else None,
)
COUNTS = Topic(
    "Counts",
    f"Signed sums hide nothing here: the error is the sum of |difference| of counts per polarity and sequence over the "
    f"total, against the hard sensor at {REFERENCE_HZ} fps.",
    ("layer", "frames per second"),
    lambda quick: [(rate_hz,) for rate_hz in (COUNTED_HZ[:2] if quick else COUNTED_HZ)],
    count_errors,
)
