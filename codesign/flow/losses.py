"""Losses to learn flow with: from true flow, from the events alone, and from frames.

Every loss is a mean over the samples of a batch of a mean over the pixels of the sample, so that
equal shares of a batch, on several machines, average to the loss of the whole. They are smooth (C1)
in the flow unless the docstring says otherwise. Non-finite predictions show as a non-finite loss.
"""

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from codesign.checks import check, check_kind, check_number, check_positive
from codesign.errors import DomainError, ShapeError
from codesign.flow.checks import check_field
from codesign.flow.contrast import (
    area_change,
    sharpness,
    smooth_image,
    still_image,
    volume_tracks,
    warp_jacobian,
)
from codesign.flow.warp import pixel_grid, read_at
from codesign.types import EventVolume, FlowField

# (time, weight): start, middle and end of the window, as in Shiba et al., ECCV 2022, sec. 3.2
REFERENCES = (
    (0.0, 0.25),
    (0.5, 0.5),
    (1.0, 0.25),
)
PUBLISHED = (1e-3, 0.45)  # epsilon and exponent of EV-FlowNet's losses
PRIOR_PX = 8.0  # of a prediction that claims a confidence only
FLOOR_PX = 0.05  # deviation added to every claim, in squares
SLOWEST_PX = 1.0  # motion that errors are shares of, at least
# sharpness, (events per pixel)^2, far below that of any scene: no events count as sharp as at zero
# flow
_FAINT = 1e-6
# area changes from _FOLD to _FREE count in full; folds count 0, no event counts more than _MOST
_FOLD = 0.2
_FREE = 1.5
_MOST = 2.5


def charbonnier(squared: Tensor, epsilon: float, exponent: float = 0.5) -> Tensor:
    """(s + epsilon^2)^exponent - epsilon^(2 exponent) of squared lengths s: 0 at 0 to rounding,
    smooth, s^exponent far away. Source: Charbonnier et al., ICIP 1994; Sun et al., IJCV 2014."""
    epsilon = check_positive(epsilon, "epsilon")
    return (squared + epsilon**2) ** exponent - epsilon ** (2 * exponent)


def supervised_loss(
    predictions: Sequence[FlowField],
    truth: FlowField,
    gamma: float = 0.8,
    epsilon: float = 0.01,
    unit_per_px: float | Tensor = 1.0,
) -> Tensor:
    """Charbonnier loss on the endpoint error of a list of predictions, coarse or early first.

    Args:
      predictions: list of n FlowField [B, 2, H, W], all at full resolution.
      truth: FlowField of the same size.
      gamma: prediction i counts gamma^(n - 1 - i), scaled so that the weights sum to 1.
      epsilon: width of the parabola at 0, in the unit of the error.
      unit_per_px: what one pixel is worth, a number or [B]: 1 for an error in px,
        ``relative_unit(truth)`` for parts of the motion of the sample.
    Returns: scalar. Only valid pixels of the truth count. A sample without any counts 0, its place
      in the mean of the batch included, so that the denominator does not depend on how a batch is
      split.
    Gradient: flow_px of the predictions.
    Raises: ShapeError.
    Source: the weights are those of Teed and Deng, RAFT, ECCV 2020, sec. 3.4.

    >>> valid = torch.ones(1, 8, 8, dtype=torch.bool)
    >>> still, right = (FlowField(torch.full((1, 2, 8, 8), v), valid, 0.1) for v in (0.0, 3.0))
    >>> round(float(supervised_loss([still, still], right)), 2), float(supervised_loss([right], right))
    (4.23, 0.0)
    """
    unit = _per_sample(unit_per_px, check_field(truth, "the truth").flow_px)
    return _over_predictions(
        predictions,
        truth,
        gamma,
        lambda field, error: charbonnier(error.square().sum(1) * unit.square(), epsilon),
    )


def laplace_loss(
    predictions: Sequence[FlowField],
    truth: FlowField,
    gamma: float = 0.8,
) -> Tensor:
    """Negative log likelihood of the error under the covariance that each prediction claims for
    itself, for errors with long tails: a density that falls as exp(-sqrt(3) m), less its constant.

    Args:
      predictions, truth, gamma: as in supervised_loss. Each prediction has covariance_px2, or else
        confidence c, read as the share of the prior that the events have removed: variance 64 px^2
        (1 - c) per axis.
    Returns: scalar, sqrt(3) m + ln det S / 2 with m^2 = e^T S^-1 e, over the valid pixels as in
      supervised_loss; S is the claim and 0.05 px in squares, so that no claim is exact and the loss
      stays bounded below. Of all densities exp(-k m) of two components this one has the covariance
      S. A pixel far off pulls no harder than one at a deviation; where little is claimed errors
      count less, so what nothing can be known of leaves the rest alone. Another unit only shifts
      it.
    Gradient: flow_px, covariance_px2 or confidence; smooth below a hundredth of a deviation.
    Raises: ShapeError; DomainError for a prediction with neither claim, and for a covariance that
      is not positive semidefinite.
    Source: Ilg et al., Uncertainty estimates and multi-hypotheses networks for optical flow, ECCV
      2018, for the likelihood; the covariance follows from the integral of m^3 exp(-k m) over that
      of m exp(-k m), 6 / k^2 = 2.
    """

    def nll(field, error):
        squared, log_determinant = _distance(field, error)
        return math.sqrt(3) * (squared + 1e-4).sqrt() + log_determinant / 2

    return _over_predictions(predictions, truth, gamma, nll)


def relative_unit(truth: FlowField) -> Tensor:
    """[B] 1 / sqrt(mean squared length of the valid true flow + 1 px^2): turns an error in px into
    a share of the sample's motion. Gradient: none."""
    squared = _full(_known(truth).detach()).square().sum(1).flatten(1).sum(1) / truth.valid.flatten(
        1
    ).sum(1).clamp_min(1)
    return (squared + SLOWEST_PX**2).rsqrt()


def contrast_loss(volume: EventVolume, flow_px: Tensor) -> Tensor:
    """Contrast maximisation without event collapse: zero-flow sharpness of the events over their
    sharpness when warped.

    Args:
      volume: EventVolume, counts [B, 2, bins, H, W].
      flow_px: [B, 2, H, W] pixels per window.
    Returns: scalar mean over the batch of the weighted mean of the ratios at the times of
      REFERENCES; 1 for zero flow, less for flow that explains the events; 1 for a sample without
      events.
    Guard: an event counts as much as the warp stretches the area around it (from 0 where it folds
      or turns over to 2.5). Squeezing the events into less space then leaves the mean squared slope
      of their image unchanged (in two dimensions it is invariant under change of scale), so only
      alignment pays; and ratios are averaged, not sharpnesses, so that one very sharp image does
      not make up for blurred others. What leaves the image is lost, which costs sharpness.
    Gradient: counts and flow; 0 in both for an empty volume.
    Raises: as volume_tracks.
    Source: Shiba, Aoki, Gallego, Secrets of event-based optical flow, ECCV 2022, sec. 3.2; area
      change: Shiba et al., Sensors 2022, sec. 3.4.2, here as a weight.
    """
    tracks = volume_tracks(volume, flow_px, carry_steps=1)
    still = sharpness(still_image(volume.counts)) + _FAINT
    total = torch.zeros_like(still)
    for at, share in REFERENCES:
        stretch = _stretch(warp_jacobian(tracks, volume.counts.shape[2], at)).flatten(1)
        total = total + share * still / (sharpness(smooth_image(tracks, at, stretch)) + _FAINT)
    return total.mean()


def photometric_loss(frames: Tensor | None, flow_px: Tensor) -> Tensor:
    """Charbonnier difference between the start frame and the end frame read where the flow leads.

    Args:
      frames: [B, 2, H, W] intensity at the start and at the end, 0..255.
      flow_px: [B, 2, H, W] pixels per window.
    Returns: scalar, differences in units of 255. A pixel that leaves the image keeps its zero-flow
      difference, so that leaving never pays; over the last pixel before the border one blends into
      the other.
    Gradient: frames and flow; bilinear reading makes it piecewise smooth, with kinks where the flow
      leads to a pixel's centre line.
    Raises: ShapeError.
    Source: Zhu et al., EV-FlowNet, RSS 2018 (there pixels that leave are not treated); used by Lee
      et al., Spike-FlowNet, ECCV 2020.
    """
    flow_px = _full(flow_px)
    check(frames, tuple(flow_px.shape), "frames at start and end")
    height, width = flow_px.shape[2:]
    at = pixel_grid(height, width, flow_px) + flow_px
    last = flow_px.new_tensor([width - 1, height - 1])[:, None, None]
    start, end = (frames / 255).to(torch.promote_types(frames.dtype, flow_px.dtype)).split(1, 1)
    read = read_at(end, at.to(end))
    # 1 on the image, 0 from one pixel outside on
    depth = (torch.minimum(at, last - at) + 1).clamp(0, 1)
    inside = (depth.square() * (3 - 2 * depth)).prod(1, keepdim=True)
    moved, still = (charbonnier((image - start).square(), *PUBLISHED) for image in (read, end))
    return (inside * moved + (1 - inside) * still).mean()


def smoothness_loss(flow_px: Tensor) -> Tensor:
    """Charbonnier difference between the flows of neighbours in a row and in a column.

    Args:
      flow_px: [B, 2, H, W].
    Returns: scalar, the mean over rows plus the mean over columns. Gradient: flow.
    Raises: ShapeError.
    Source: Zhu et al., EV-FlowNet, RSS 2018.
    """
    flow_px = _full(flow_px)
    if min(flow_px.shape[2:]) < 2:
        raise ShapeError(
            f"a flow of {list(flow_px.shape[2:])} pixels has no neighbours both ways; give at least 2 x 2."
        )
    across, down = (flow_px.diff(dim=axis).square().sum(1) for axis in (3, 2))
    return charbonnier(across, *PUBLISHED).mean() + charbonnier(down, *PUBLISHED).mean()


def _over_predictions(predictions, truth, gamma, per_pixel):
    check_positive(gamma, "gamma")
    if not isinstance(predictions, Sequence) or not predictions:
        raise ShapeError("no prediction was given; a list of at least one FlowField is needed.")
    target = _known(truth)
    weights = 0.0
    total = target.new_zeros(())
    for field in predictions:
        check_kind(field, FlowField, "a prediction")
        check(field.flow_px, tuple(target.shape), "the flow of a prediction")
        total = gamma * total + _valid_mean(
            per_pixel(field, _full(field.flow_px) - target), truth.valid
        )
        weights = gamma * weights + 1
    return total / weights


def _known(truth):
    """True flow, 0 where it is unknown: what is not valid may be NaN and must not reach the
    gradient."""
    check_field(truth, "the truth")
    return torch.where(truth.valid[:, None], truth.flow_px, 0.0)


def _valid_mean(values, valid):
    return ((values * valid).flatten(1).sum(1) / valid.flatten(1).sum(1).clamp_min(1)).mean()


def _per_sample(unit, flow):
    """[B, 1, 1], or [1, 1, 1] of a number."""
    if not isinstance(unit, torch.Tensor):
        unit = torch.tensor(check_number(unit, "unit_per_px", 0.0))
    if check(unit, "...>=0", "unit_per_px").shape not in ((), flow.shape[:1]):
        raise ShapeError(
            f"unit_per_px must be a number or [B] for a flow {list(flow.shape)}; got {list(unit.shape)}."
        )
    return unit.to(flow).reshape(-1, 1, 1)


def _distance(field, error):
    """m^2 = e^T S^-1 e and ln det S of errors [B, 2, H, W], S the claim + FLOOR_PX^2."""
    xx, xy, yy = _covariance(field)
    spare = FLOOR_PX**2
    # xx yy - xy^2 >= 0 apart from rounding; taken by itself it cannot cancel the floor's part of
    # the determinant
    determinant = spare**2 + spare * (xx + yy) + (xx * yy - xy.square()).clamp_min(0)
    u, v = error.unbind(1)
    squared = ((yy + spare) * u.square() - 2 * xy * u * v + (xx + spare) * v.square()) / determinant
    return squared, determinant.log()


def _covariance(field):
    full = torch.promote_types(field.flow_px.dtype, torch.float32)
    if field.covariance_px2 is None and field.confidence is None:
        raise DomainError(
            "a prediction has neither covariance_px2 nor confidence, so it has no likelihood; use "
            "supervised_loss, or an estimator that gives one."
        )
    batch, _, height, width = field.flow_px.shape
    if field.covariance_px2 is None:
        confidence = check(field.confidence, (batch, height, width), "confidence of a prediction")
        if not bool(((confidence >= 0) & (confidence <= 1)).all()):
            raise DomainError(
                "a confidence lies outside 0 to 1; 0 means nothing was seen, 1 a flow known exactly."
            )
        variance = PRIOR_PX**2 * (1 - confidence.to(full))
        return variance, torch.zeros_like(variance), variance
    claim = check(field.covariance_px2, (batch, 3, height, width), "covariance_px2 of a prediction")
    xx, xy, yy = claim.to(full).unbind(1)
    # rounding of the products
    slack = 1e-4 * xx * yy if xx.dtype == torch.float32 else 1e-9 * xx * yy
    if bool((xx < 0).any() | (yy < 0).any() | (xy.square() > xx * yy + slack).any()):
        raise DomainError(
            "covariance_px2 is not positive semidefinite somewhere (xx, yy >= 0 and xy^2 <= xx yy are "
            "needed); build it from a triangular factor."
        )
    return xx, xy, yy


def _stretch(jacobian):
    """Weight of events where a warp has this Jacobian: the area change, smoothly 0 where the warp
    folds or turns over and at most _MOST where it tears apart."""
    area = area_change(jacobian)
    upright = (jacobian[0] + jacobian[3]) / 2
    over = (area - _FREE).clamp_min(0)
    return (
        _rise(area)
        * _rise(upright)
        * (area - over + (_MOST - _FREE) * torch.tanh(over / (_MOST - _FREE)))
    )


def _rise(value):
    """Smooth step from 0 at 0 to 1 at _FOLD."""
    ramp = (value / _FOLD).clamp(0, 1)
    return ramp.square() * (3 - 2 * ramp)


def _full(flow_px):
    """The flow in at least single precision: places and squares in half precision would be far
    off."""
    check(flow_px, "B 2 H W", "the flow")
    return flow_px.to(torch.promote_types(flow_px.dtype, torch.float32))
