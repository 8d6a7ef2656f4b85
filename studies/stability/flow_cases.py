"""Hard cases of the closed-form flow: no events, one, motion too small to see, large, or back
again. A texture moves in front of smooth counts; all of it brightens, so that events come whatever
the motion."""

import math
from functools import cache, partial

import torch

from codesign import events, flow
from codesign.types import EventVolume
from studies.stability.case import SPOILT, Case, Span, nothing, spoilt

SIDE_PX = 48
TIMES_S = torch.linspace(0, 0.1, 31, dtype=torch.float64)
STEP_PX = 1e-3


def estimate(counts, **options):
    """Flow of counts [2, bins, H, W] that come evenly in time."""
    edges = torch.linspace(0, 0.1, counts.shape[1] + 1, dtype=torch.float64)
    volume = EventVolume(counts[None], (edges[1:] + edges[:-1]) / 2, edges.diff())
    return flow.estimate_lk(volume, **options)


def volume_of(place_of, dtype, bins=5, brightens=0.0):
    """Smooth counts of a texture whose point under pixels (x, y) at a share of the time is
    ``place_of(x, y, share)``."""
    across = torch.arange(SIDE_PX, dtype=dtype) - (SIDE_PX - 1) / 2
    x, y = torch.meshgrid(across, across, indexing="xy")
    levels = [
        (1 + brightens * share) * texture(*place_of(x, y, share))
        for share in (TIMES_S / TIMES_S[-1]).to(dtype)
    ]
    counts = events.soft_counts(60 * torch.stack(levels).exp(), 0.2, 0.2)
    return events.from_counts(counts, TIMES_S, bins)


def texture(x, y):
    """Log light of fine texture: waves of 6 to 14 px in all directions."""
    return sum(
        0.15
        * torch.cos(2 * math.pi * (x * math.cos(k * 2.4) + y * math.sin(k * 2.4)) / (6 + k) + k * k)
        for k in range(9)
    )


def drift(shift_px):
    """Mean flow to the right of a texture that drifts, less that of one at rest."""
    moving, still = (
        flow.estimate_lk(
            volume_of(lambda x, y, t, s=s: (x - s * t, y), shift_px.dtype, brightens=0.2),
            "constant",
        )
        for s in (shift_px, 0 * shift_px)
    )
    return (moving.flow_px[0, 0] - still.flow_px[0, 0]).mean()


@cache
@torch.no_grad()
def drift_per_px():
    step = torch.tensor(STEP_PX, dtype=torch.float64)
    return (drift(step) - drift(-step)) / (2 * STEP_PX)


def small_drift(shift_px):
    """The flow of rest, and its slope times the motion."""
    return shift_px * drift_per_px()


def zoomed(zoom):
    """Endpoint error over that of zero flow, as asked of fine textures."""
    volume = volume_of(lambda x, y, t: (x / (1 + zoom * t), y / (1 + zoom * t)), zoom.dtype)
    across = torch.arange(SIDE_PX).to(zoom) - (SIDE_PX - 1) / 2
    truth = zoom * torch.stack(torch.meshgrid(across, across, indexing="xy"))
    found = flow.estimate_lk(volume).flow_px[0]
    return (found - truth).norm(dim=0).mean() / truth.norm(dim=0).mean()


def out_and_back(estimator, shift_px):
    """Mean flow, out in the first two thirds of the time, half back in the last; over the shift."""

    def place(x, y, share):
        return x - shift_px * (1.5 * share - 3 * (share - 2 / 3).clamp(min=0)), y

    return estimator(volume_of(place, shift_px.dtype, bins=9)).flow_px[0].mean((1, 2)) / shift_px


def half_of_it(shift_px):
    """Half of the way out is left, within 0.17 of that."""
    return torch.tensor([0.5, 0.0])


def one_event(amount):
    """One event's picture is its mirror image: no flow in its pixel."""
    counts = torch.zeros(2, 5, 9, 9).to(amount)
    counts[0, 2, 4, 4] = amount
    return estimate(counts).flow_px[0, :, 4, 4]


def no_events(counts):
    """No flow, not valid, no confidence, no slope."""
    field = estimate(counts)
    valid = field.valid[0].to(counts).expand(2, 6, 8)
    return torch.cat([field.flow_px[0], valid, field.confidence.to(counts)])


def mirrored(counts):
    return estimate(counts.flip(-1)).flow_px[0]


def mirrored_flow(counts):
    """Mirrored events flow mirrored."""
    across, down = estimate(counts).flow_px[0].flip(-1)
    return torch.stack([-across, down])


def too_few(counts):
    """Counts of 1e-320 to 1e-39 say nothing: no flow."""
    return estimate(counts).flow_px


def refused(place, kind):
    """NaN or infinity anywhere in the counts is refused."""
    return estimate(spoilt(place.new_ones(2, 5, 6, 8), place, kind)).flow_px


SHAPE = (2, 5, 6, 8)
COUNTS, ZEROS = {"counts": Span(0, 4, SHAPE)}, {"counts": Span(0, 0, SHAPE)}
TINY = {"counts": Span(1e-320, 1e-39, SHAPE, log=True)}
SMALL, SHIFT = ({"shift_px": Span(*ends)} for ends in ((-5e-4, 5e-4), (1, 4)))
ZOOM = {"zoom": Span(0.1, 0.3)}
EXACT, SYMMETRIC, LINEAR = (0.0, 0.0, 0.0), (1e-10, 1e-9, 1e-3), (0.01, 0.01, 0.05)
ASKED = (0.17, 0.17, 1e-3)  # error over that of zero flow, of fine textures
HALF = {"learn": (), "unit": 0.5, "slow": True}
UNTURNED = (
    '`estimate_lk(clock="events")` reads a way that hardly turns, 0.89 to 1 of it net instead of a '
    "third, and takes one wave of the texture for the next. `flow.estimate` reads the turn (the "
    "case beside this one)."
)
by_events, by_choice = (
    partial(out_and_back, e) for e in (partial(flow.estimate_lk, clock="events"), flow.estimate)
)
CASES = [
    Case("zero events", "flow", ZEROS, no_events, nothing, EXACT),
    Case("one event", "flow", {"amount": Span(1, 1)}, one_event, nothing),
    Case("denormals", "flow", TINY, too_few, nothing, learn=()),
    Case("flow below 1e-3 px", "flow", SMALL, drift, small_drift, LINEAR, unit=5e-4, slow=True),
    Case("zoom of 0.3", "flow", ZOOM, zoomed, nothing, ASKED, ()),
    Case("out and half back", "flow", SHIFT, by_events, half_of_it, ASKED, known=UNTURNED, **HALF),
    Case("out and half back", "chosen flow", SHIFT, by_choice, half_of_it, ASKED, **HALF),
    Case("mirrored shapes", "flow", COUNTS, mirrored, mirrored_flow, SYMMETRIC, slow=True),
    Case("NaN or infinity", "flow", SPOILT, refused, "event volume must be finite"),
]
