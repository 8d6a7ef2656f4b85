"""Time surfaces: how long ago the last event was, per pixel and polarity, as exp(-(t_ref - t_last) / tau); 0
where none was yet."""

from collections.abc import Sequence

import torch
from torch import Tensor

from codesign.errors import DomainError, ShapeError, check_finite
from codesign.events.entry import Times, check_counts, check_times
from codesign.events.stream import check_stream
from codesign.events.volumes.traces import check_tau, segments
from codesign.types import EventStream

NEVER_US = torch.iinfo(torch.int64).min


def surface_from_stream(
    stream: EventStream, at_us: Tensor | Sequence[int], tau_s: float, *, dtype: torch.dtype = torch.float32
) -> Tensor:
    """Time surface of a stream at given times.

    Args:
      stream: EventStream.
      at_us: [K] reference times, whole microseconds, strictly increasing. Events at a reference time belong
        to it, later ones do not.
      tau_s: time in which the surface fades to 1/e, seconds, > 0.
    Returns: [K, 2, H, W] in 0 to 1, ON first; the difference of times is taken in whole microseconds, so
      epoch times lose nothing.
    Gradient: none (timestamps are integers); ``surface_from_times`` has one.
    Raises: DomainError for reference times that are not whole or do not increase, and for tau.
    Source: Lagorce et al., HOTS, PAMI 2017, eq. 2 and 3.
    """
    tau_s = check_tau(tau_s)
    check_stream(stream)
    height = stream.height_px
    width = stream.width_px
    last_us = torch.full((2 * height * width,), NEVER_US, device=stream.t_us.device)
    surfaces = []
    for time_us, (cell, t_us) in segments(stream, at_us):
        last_us.scatter_reduce_(0, cell, t_us, "amax")
        fired = last_us != NEVER_US
        age_us = torch.where(fired, time_us - torch.where(fired, last_us, time_us), 0)
        surfaces.append(
            torch.where(fired, torch.exp(age_us.to(torch.float64) / (-1e6 * tau_s)), 0.0)
            .to(dtype)
            .reshape(2, height, width)
        )
    return torch.stack(surfaces)


def surface_from_times(
    t_s: Tensor,
    x: Tensor,
    y: Tensor,
    p: Tensor,
    height_px: int,
    width_px: int,
    at_s: Tensor | Sequence[float],
    tau_s: float,
) -> Tensor:
    """Time surface of events whose times are real numbers, such as analytic crossing times.

    Args:
      t_s: [N] floating-point times, seconds, in any order. x, y: [N] int64 column and row. p: [N] +1 or -1.
      height_px, width_px: sensor size. at_s: [K] reference times, seconds, strictly increasing. tau_s:
        seconds, > 0.
    Returns: [K, 2, H, W] of the type of t_s, ON first.
    Gradient: t_s: surface / tau for the last event of a pixel, 0 for the others (where two events are last
      together, to one of them).
    Raises: ShapeError when lengths differ; DomainError for times that are not finite, events outside the
      sensor, another polarity, and for tau.
    Numerics: give times relative to the start of a recording; float64 epoch times are exact to 0.2 us.
    """
    tau_s = check_tau(tau_s)
    if not (t_s.ndim == 1 and t_s.shape == x.shape == y.shape == p.shape) or not t_s.is_floating_point():
        given = [(str(v.dtype), list(v.shape)) for v in (t_s, x, y, p)]
        raise ShapeError(
            f"t_s, x, y, p are {given}; four lists of equal length are needed, t_s of floating-point seconds."
        )
    check_finite(t_s, "t_s")
    if any(values.is_floating_point() for values in (x, y, p)):
        raise DomainError("x, y and p hold fractions; tensors of whole numbers are needed.")
    outside = (x < 0) | (x >= width_px) | (y < 0) | (y >= height_px) | (p.abs() != 1)
    if bool(outside.any()):
        at = int(outside.nonzero()[0])
        raise DomainError(
            f"event {at} is x {int(x[at])}, y {int(y[at])}, p {int(p[at])}; x below {width_px}, y below "
            f"{height_px}, and polarity +1 or -1 are allowed."
        )
    order = torch.argsort(t_s.detach(), stable=True)
    times_s = t_s[order]
    cell = (((p < 0).long() * height_px + y) * width_px + x)[order]
    rank = torch.arange(len(order), device=cell.device)
    surfaces = []
    for time_s in check_times(at_s).tolist():
        seen = int(
            torch.searchsorted(
                times_s.detach(), torch.tensor(time_s, dtype=t_s.dtype, device=t_s.device), right=True
            )
        )
        last = torch.full((2 * height_px * width_px,), -1, device=cell.device).scatter_reduce_(
            0, cell[:seen], rank[:seen], "amax"
        )
        fired = (last >= 0).nonzero().flatten()
        surface = torch.zeros(last.shape, dtype=t_s.dtype, device=t_s.device).index_put(
            (fired,), torch.exp((times_s[last[fired]] - time_s) / tau_s)
        )
        surfaces.append(surface.reshape(2, height_px, width_px))
    return torch.stack(surfaces)


def surface_from_counts(counts: Tensor, t_s: Times, tau_s: float) -> Tensor:
    """Time surface after every frame interval, from hard or soft counts.

    The events of an interval of length d sit at its middle. With m = min(count, 1): S <- (1 - m) S exp(-d /
    tau) + m exp(-d / (2 tau)). Whole counts give the surface of such events exactly; a count between 0 and 1
    is the share of an event, and mixes the two.

    Args:
      counts: [T-1, 2, ..., H, W] counts >= 0, ON first. t_s: [T] seconds, strictly increasing. tau_s:
        seconds, > 0.
    Returns: [T-1, 2, ..., H, W]; entry k belongs to t_s[k + 1].
    Gradient: counts up to and including 1; none above, where one more event moves no last time.
    Raises: ShapeError, DomainError as ``from_counts``; DomainError for negative counts and for tau.
    """
    tau_s = check_tau(tau_s)
    check_counts(counts, non_negative=True)
    fade = torch.exp(check_times(t_s, len(counts) + 1).diff() / -tau_s).tolist()
    share = counts.clamp(max=1)
    surface = torch.zeros_like(counts[0])
    surfaces = []
    for now, factor in zip(share, fade, strict=True):
        surface = (1 - now) * surface * factor + now * factor**0.5
        surfaces.append(surface)
    return torch.stack(surfaces)
