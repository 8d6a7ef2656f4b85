"""Flow errors as the field defines them. Conventions are in each docstring and in
docs/flow_metrics.md, since published code disagrees.

Flows are [..., 2, H, W] pixels per window, masks [..., H, W] bool. Every mean runs over the masked
pixels of all samples together.
"""

import torch
from torch import Tensor

from codesign.checks import check, check_number
from codesign.errors import DomainError, ShapeError
from codesign.flow.checks import check_field, check_volume
from codesign.flow.contrast import nearest_images, stream_tracks
from codesign.types import EventStream, EventVolume, FlowField


def endpoint_error(flow: Tensor, truth: Tensor) -> Tensor:
    """Length of the difference of two flows [..., 2, H, W] -> [..., H, W] px."""
    flow, truth = _check(flow, truth)
    # its gradient at zero error is 0, not NaN
    return torch.linalg.vector_norm(flow - truth, dim=-3)


def _check(flow, truth):
    for value, name in ((flow, "the flow"), (truth, "the truth")):
        check(value, "...>=0", name)
    if flow.shape != truth.shape or flow.ndim < 3 or flow.shape[-3] != 2 or not flow.numel():
        raise ShapeError(
            f"flows must both be [..., 2, H, W]; got {tuple(flow.shape)} and {tuple(truth.shape)}."
        )
    # squares in half precision overflow
    wider = torch.promote_types(torch.promote_types(flow.dtype, truth.dtype), torch.float32)
    return flow.to(wider), truth.to(wider)


def _known(flow, truth, mask):
    """Both, the truth as the flow where it is masked: NaN there would reach the gradient."""
    flow, truth = _check(flow, truth)
    if mask is not None:
        check(mask, (*truth.shape[:-3], *truth.shape[-2:]), "the mask", (torch.bool,))
        truth = torch.where(mask[..., None, :, :], truth, flow.detach())
    return flow, truth


def _masked(values, mask):
    """The values under the mask, flat; a non-finite one would count as no outlier, so it is
    refused."""
    if mask is not None:
        check(mask, tuple(values.shape), "the mask", (torch.bool,))
        if not bool(mask.any()):
            raise DomainError(
                "the mask selects no pixel, so the error is undefined; check the valid and event masks."
            )
        values = values[mask]
    finite = values.detach().isfinite()
    if not bool(finite.all()):
        raise DomainError(
            f"the flow error is NaN or infinite at {int((~finite).sum())} of {finite.numel()} pixels; mask "
            "pixels without true flow, and check the estimate."
        )
    return values.flatten()


def aee(flow: Tensor, truth: Tensor, mask: Tensor | None = None) -> Tensor:
    """Average endpoint error, px. Source: Baker et al., IJCV 2011.

    >>> truth = torch.tensor([3.0, 4.0])[:, None, None].expand(2, 8, 8)
    >>> float(aee(torch.zeros(2, 8, 8), truth))
    5.0
    """
    return _masked(endpoint_error(*_known(flow, truth, mask)), mask).mean()


def zero_flow_error(truth: Tensor, mask: Tensor | None = None) -> Tensor:
    """Average endpoint error of the estimate "nothing moves", px: the mean true length, which every
    error should be compared with."""
    return aee(torch.zeros_like(check(truth, "...>=0", "the truth")), truth, mask)


def outlier_percent(
    flow: Tensor,
    truth: Tensor,
    mask: Tensor | None = None,
    pixels: float = 3.0,
    share: float = 0.05,
) -> Tensor:
    """Share of pixels, in percent, whose endpoint error is above ``pixels`` AND above ``share`` of
    the true length (KITTI 2015: 3 px and 5 %).

    >>> truth = torch.full((2, 1, 4), 100.0)
    >>> float(outlier_percent(truth + torch.tensor([0.0, 2.0, 5.0, 9.0]), truth))  # 7.1 px is 5 % of 141 px
    25.0
    """
    error = endpoint_error(flow, truth)
    check_number(pixels, "pixels", 0.0)
    check_number(share, "share", 0.0)
    length = _check(flow, truth)[1].square().sum(-3).sqrt()
    error = _masked(error, mask)
    length = _masked(length, mask)
    return 100 * ((error > pixels) & (error > share * length)).to(error.dtype).mean()


def npe(flow: Tensor, truth: Tensor, pixels: float, mask: Tensor | None = None) -> Tensor:
    """Share of pixels, in percent, whose endpoint error is above ``pixels`` (DSEC's 1PE, 2PE, 3PE;
    what event papers on MVSEC call outliers is ``pixels=3``).

    >>> error = torch.tensor([0.0, 0.5, 1.5, 4.0]).expand(2, 1, 4) * torch.tensor([1.0, 0.0])[:, None, None]
    >>> float(npe(error, torch.zeros(2, 1, 4), pixels=1.0))
    50.0
    """
    error = _masked(endpoint_error(flow, truth), mask)
    check_number(pixels, "pixels", 0.0)
    return 100 * (error > pixels).to(error.dtype).mean()


def angular_error_deg(flow: Tensor, truth: Tensor, mask: Tensor | None = None) -> Tensor:
    """Mean angle in space-time between (u, v, 1) and the truth, degrees (Barron et al., 1994), by
    atan2 for accuracy at small angles.

    >>> flow = torch.tensor([1.0, 0.0])[:, None, None].expand(2, 8, 8)
    >>> round(float(angular_error_deg(flow, torch.zeros(2, 8, 8))), 3)
    45.0
    """
    flow, truth = _known(flow, truth, mask)
    one = torch.ones_like(flow[..., :1, :, :])
    return _masked(
        torch.rad2deg(_angle(torch.cat([flow, one], -3), torch.cat([truth, one], -3))), mask
    ).mean()


def event_mask(volume: EventVolume) -> Tensor:
    """Pixels [B, H, W] with at least a part of an event of either polarity in the window."""
    return (check_volume(volume).detach() > 0).flatten(1, 2).any(1)


def masks(volume: EventVolume, truth: FlowField) -> dict[str, Tensor]:
    """The three masks that errors are reported under: {"valid", "events", "both"}, each [B, H, W]
    bool."""
    events = event_mask(volume)
    valid = check_field(truth, "the truth").valid
    if events.shape != valid.shape:
        raise ShapeError(
            f"volume and truth differ in size: {tuple(events.shape)} and {tuple(valid.shape)} pixels."
        )
    return {"valid": valid, "events": events, "both": valid & events}


def fwl(
    stream: EventStream,
    flow_px: Tensor,
    t0_us: int,
    t1_us: int,
    at: float = 1.0,
    carry_steps: int = 0,
) -> float:
    """Flow warp loss: variance of the image of warped events over its variance at zero flow. Above
    1 the flow makes the events sharper.

    Args:
      stream: EventStream.
      flow_px: [2, H, W] pixels from t0 to t1.
      t0_us, t1_us: whole microseconds, both ends included.
      at: time the events are moved to, 0 for t0, 1 for t1.
      carry_steps: see contrast; 0 gives each event the flow of its own pixel, as published.
    Returns: float. Polarities added, every event on its nearest pixel, variance over all pixels of
      the sensor. Events that leave the image count in the denominator only.
    Gradient: none. Raises: DomainError for an interval without events, or with equally many events
      on every pixel. Source: Stoffregen et al., ECCV 2020, sec. 4.1.
    """
    tracks = stream_tracks(
        stream, check(flow_px, "...>=0", "the flow").detach(), t0_us, t1_us, carry_steps
    )
    still, moved = (
        nearest_images(tracks, time)[0].double().sum(1).var(correction=0)
        for time in (tracks.time, at)
    )
    if float(still) == 0:
        raise DomainError(
            "every pixel has equally many events, so the variance at zero flow is 0 and FWL undefined; "
            "choose another interval."
        )
    return float(moved / still)


def rsat(
    stream: EventStream,
    flow_px: Tensor,
    t0_us: int,
    t1_us: int,
    carry_steps: int = 0,
) -> float:
    """Ratio of the squared average time stamps, warped to t1 over unwarped. Below 1 the flow aligns
    the events.

    Args: as fwl.
    Returns: float; of either image, the sum over pixels and polarities of the squared mean time
      (0 at t0, 1 at t1) over the number of pixels with events of any polarity. Every event on its
      nearest pixel; events that leave the image are lost from the warped one.
    Gradient: none. Raises: DomainError for an interval without events, or when all leave the image,
      or lie at t0. Source: Hagenaars et al., NeurIPS 2021.
    """
    tracks = stream_tracks(
        stream, check(flow_px, "...>=0", "the flow").detach(), t0_us, t1_us, carry_steps
    )
    squares = []
    for time in (tracks.time, 1.0):
        counts, mean_time = (image.double() for image in nearest_images(tracks, time))
        pixels = (counts.sum(1) > 0).sum()
        if int(pixels) == 0:
            raise DomainError(
                "the flow moves every event out of the image, so RSAT is undefined; check the flow's unit "
                "(pixels per window)."
            )
        squares.append(float(mean_time.square().sum() / pixels))
    if squares[0] == 0:
        raise DomainError(
            "all events lie at the start of the interval, so RSAT is undefined; choose another interval."
        )
    return squares[1] / squares[0]


def _angle(a, b):
    return torch.atan2(
        torch.linalg.vector_norm(torch.linalg.cross(a, b, dim=-3), dim=-3), (a * b).sum(-3)
    )
