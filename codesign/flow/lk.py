"""Closed-form event flow: coarse-to-fine Bayesian least squares on event volumes.

The signed event rate of a moving texture moves with it, so the volume obeys V_t + u V_x + v V_y = 0 (Lucas
and Kanade, 1981, with event rate in place of intensity). The volume is warped back along the current flow;
per pixel, the regression of the bins over time gives V_t and their mean gives V_x, V_y; all pixels together
pull at the parameters of an affine or quadratic field (lk_level). A Gaussian prior on the field (lk_field)
holds against the pull, which is weighed by the noise that scattered events put into it, so that few events
mean small steps, and the spread of what is left is returned with the flow.
"""

from collections.abc import Sequence

import torch

from codesign.errors import DomainError, ShapeError
from codesign.flow import lk_field, lk_level
from codesign.flow.checks import check_count, check_number, check_volume, shown
from codesign.types import EventVolume, FlowField


def estimate_lk(
    volume: EventVolume,
    model: str = "affine",
    prior_px: float = 3.0,
    levels_px: Sequence[float] = (4.0, 2.0, 1.0),
    steps: int = 3,
    noise_floor: float = 0.02,
) -> FlowField:
    """Flow over the volume's interval, with its uncertainty.

    Args:
      volume: EventVolume, counts [B, 2, bins >= 2, H >= 2, W >= 2]. Hot pixels are weighed down
        (lk_level.cool).
      model: "constant", "affine" or "quadratic" field over the image.
      prior_px: standard deviation expected of each component of the flow at the image centre, px per
        interval; weak evidence leaves the flow near zero.
      levels_px: Gaussian blur of the volume, coarse to fine. steps: Gauss-Newton steps at each.
      noise_floor: least noise assumed, relative to that of a Poisson volume with these counts; matters for
        counts without quantisation or noise.
    Returns: FlowField on the pixels of the start of the interval: flow_px [B, 2, H, W] px per interval;
      covariance_px2 [B, 3, H, W] of its error by
      the posterior of the parameters; confidence [B, H, W] = 1 - trace(covariance) / trace(prior covariance), in
      0..1;
      valid is False for samples without
      events, whose flow and confidence are 0 and whose covariance is the prior's.
    Gradient: counts, of flow, covariance and confidence.
    Raises: ShapeError, DomainError.
    Cost: linear in pixels and bins; a level of blur s works on a grid of spacing 2^floor(log2 s) px.

    >>> from codesign.flow.export import evenly_timed
    >>> y, x = torch.meshgrid(torch.arange(48.0), torch.arange(64.0), indexing="ij")
    >>> times = (0.0, 0.25, 0.5, 0.75, 1.0)
    >>> rate = torch.stack([torch.sin((x - 2 * t) / 4) + torch.sin((y - t) / 5) for t in times])
    >>> counts = torch.stack([rate.clamp(min=0), (-rate).clamp(min=0)])[None]
    >>> estimate_lk(evenly_timed(counts)).flow_px[0, :, 24, 32].round(decimals=0).tolist()
    [2.0, 1.0]
    """
    counts = check_volume(volume, least_bins=2)
    if not isinstance(model, str) or model not in lk_field.TERMS:
        raise DomainError(f"flow model '{model}' is unknown; choose one of {', '.join(lk_field.TERMS)}.")
    check_number(prior_px, "prior_px", above=0.0)
    check_number(noise_floor, "noise_floor", 0.0)
    steps = check_count(steps, "steps", 1)
    if not isinstance(levels_px, Sequence) or not levels_px or isinstance(levels_px, str):
        raise DomainError(
            f"levels_px is {shown(levels_px)}; a list of blurs in pixels, coarse to fine, is needed."
        )
    for blur_px in levels_px:
        check_number(blur_px, "a blur of levels_px", above=0.0)
    batch, _, _, height, width = counts.shape
    if min(height, width) < 2:
        raise ShapeError(
            f"an event volume of {height} x {width} pixels has no slopes both ways; give at least 2 x 2."
        )
    shape = lk_field.Polynomials(model, height, width, prior_px, counts.device)
    one = torch.eye(2 * shape.terms, dtype=torch.float64, device=counts.device)
    found = one.new_zeros(batch, 2 * shape.terms)  # in units of the prior: parameters = unit found
    parameters = counts.new_zeros(batch, 2 * shape.terms)
    precision = one.expand(batch, -1, -1)
    times, rate, density = lk_level.signed_rate(volume)
    for blur_px in levels_px:
        level = lk_level.Level(rate, density, times, shape, blur_px, noise_floor)
        for _ in range(steps):
            evidence, pull = level.evidence(parameters)
            precision = one + evidence
            change = torch.linalg.solve(precision, pull - found)
            moved = shape.mean_square(change @ shape.unit.T)
            found = (
                found + change * (1 + moved / (2 * blur_px) ** 2).rsqrt()[:, None]
            )  # no step beyond the reach of the linearisation
            parameters = (found @ shape.unit.T).to(counts)
    flow, places = shape.at_start(parameters)
    spread = shape.unit @ torch.linalg.inv(precision) @ shape.unit.T
    covariance = shape.covariance(spread.to(counts), places)
    widest = shape.covariance((shape.unit @ shape.unit.T).to(counts)[None], places)
    confidence = 1 - (covariance[:, 0] + covariance[:, 2]) / (widest[:, 0] + widest[:, 2])
    confidence = confidence.clamp(0, 1)  # rounding alone leaves them
    valid = (counts.detach().sum((1, 2, 3, 4)) > 0)[:, None, None].expand(batch, height, width)
    return FlowField(flow, valid, float(volume.collected_s.sum()), confidence, covariance)
