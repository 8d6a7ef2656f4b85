"""Gradients of what stands behind the frames of a scene: event counts, spiking neurons, and flow by
closed form and by a network."""

import warnings
from collections.abc import Iterator
from functools import cache

import torch
from torch import Tensor

from codesign import events, flow
from codesign.grad import Row, certify
from codesign.grad.modules import by_group
from studies.gradient_flow.certificates import picture, scenes
from studies.gradient_flow.certificates.picture import BINS, THETA, TOLERANCE
from studies.gradient_flow.certificates.scenes import T_S

SENSOR = events.SensorModel(theta_on=0.2, theta_off=0.25, theta_sigma=0.03, cutoff_hz=100.0)
LEARNT = {
    "threshold ON": "theta_on",
    "threshold OFF": "theta_off",
    "threshold spread": "theta_sigma",
    "bandwidth": "cutoff_hz",
}
WEIGHTS = 10_000
SAMPLES = 64  # per pixel of the frames
FINER = 8  # steps of the spiking neurons per frame interval
GRAIN = 0.01  # of the frames
LADDER = (1e-4, 1e-5, 1e-6)


def certify_events(name: str, directions: int) -> Iterator[tuple[str, Row]]:
    """(junction, row) of smooth counts of a scene's frames, behind a bandwidth and with scattered
    thresholds: to the sensor's values, each by itself, and to the frames."""
    image = _frames(name)
    layer = events.layer("counts", SENSOR, learn=tuple(LEARNT.values()))
    weight = picture.smooth_weight(len(T_S) - 1, 2)
    groups = {name: f"learnt.raw.{field}" for name, field in LEARNT.items()}
    fn, params = by_group(layer, lambda call: (weight * call(image, T_S)).mean(), groups)
    light = {"frames": image}
    for row in (
        *_certified(fn, params, {}, None),
        *_certified(
            lambda p: (weight * layer(p["frames"], T_S)).mean(), light, _lengths(light), directions
        ),
    ):
        yield "event counts", row


def certify_spikes(name: str, directions: int) -> Iterator[tuple[str, Row]]:
    """(junction, row) of the smooth twin of spiking neurons that are driven by a scene's log
    levels."""
    level = events.lin_log(_frames(name)).flatten(1)
    fine = torch.nn.functional.interpolate(
        level.T[None], (len(T_S) - 1) * FINER + 1, mode="linear", align_corners=True
    )
    step = fine[0].T.diff(dim=0)
    drive = torch.stack((step, -step), 1)
    scale = events.drive_scale(drive, theta=THETA, tau_s=4.0, response="alpha", share=0.2)
    params = {
        "threshold": torch.tensor(THETA, dtype=torch.float64),
        "time constant of the response": torch.tensor(4.0, dtype=torch.float64),
        "time constant of the reset": torch.tensor(2.0, dtype=torch.float64),
        "drive": scale * drive,
    }
    weight = torch.randn(
        len(drive), 2, 1, generator=torch.Generator().manual_seed(4), dtype=torch.float64
    )

    how = {"response": "alpha", "coupled": True, "through_reset": "full", "smooth": True}

    def fn(p):
        theta, tau_s, tau_r, driven = p.values()
        given = {"theta": theta, "tau_s": tau_s, "tau_r": tau_r}
        spikes, _, _ = events.srm(driven, **given, **how, surrogate=events.Laplace.unit(THETA))
        return (weight * spikes).mean()

    with warnings.catch_warnings():
        # of gradients that grow over long times: these are short
        warnings.filterwarnings("ignore", "max rho", RuntimeWarning)
        found = _certified(fn, params, _lengths(params), directions)
    for row in found:
        yield "spiking neurons", row


def certify_flow(name: str, directions: int) -> Iterator[tuple[str, Row]]:
    """(junction, row) of the flow of a scene's smooth counts: of the closed form to the counts, and
    of a network to the counts and to all its weights."""
    counts = events.soft_counts(_frames(name), THETA, THETA)
    weight = picture.smooth_weight(1, 2)
    net = flow.FlowNetEvents.with_weights(WEIGHTS, bins=BINS, seed=0).double()

    def volume(change=0.0):
        return events.from_counts(counts * (1 + change), T_S, BINS)

    def solved(p):
        return (weight * picture.closed_form(counts * (1 + p["counts"]))).mean()

    def estimated(p):
        return (weight * net(volume(p["counts"])).flow_px).mean()

    by_weights, weights = by_group(
        net, lambda call: (weight * call(volume()).flow_px).mean(), {"network weights": ""}
    )
    # shares of themselves: counts cannot be negative
    change = {"counts": torch.zeros_like(counts)}
    shares = {"counts": counts.numel() ** 0.5}
    for junction, fn, params, scales in (
        ("closed-form flow", solved, change, shares),
        ("network flow", estimated, change, shares),
        ("network flow", by_weights, weights, _lengths(weights)),
    ):
        for row in _certified(fn, params, scales, directions):
            yield junction, row


def _certified(fn, params, scales, directions):
    options = {"scales": scales, "directions": directions}
    return certify(fn, params, ladder=LADDER, tolerance=TOLERANCE, **options)


def _lengths(params):
    return {name: float(value.norm()) for name, value in params.items()}


@cache
def _frames(name) -> Tensor:
    """Frames of a scene, with grain: no level stands still, where counts have a kink."""
    with torch.no_grad():
        image = picture.frames(name, scenes.point(), SAMPLES, 0, "interior")
    draw = torch.Generator().manual_seed(6)
    return image * (1 + GRAIN * torch.randn(image.shape, generator=draw, dtype=image.dtype))
