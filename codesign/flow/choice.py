"""Flow whose prior, levels, model and clock are chosen by how well the bins agree along it, zero
flow among the candidates.

A flow that is right carries every bin to the same signed picture. The agreement r of a flow is the
correlation of pairs of blurred bins read along it, at least two bins apart, since neighbours share
events. Events scattered at random have r = 0 along any flow, with a variance that their density
tells; no flow gains by squeezing events together, since r is relative to what is read. Twice the
likelihood gained over zero flow is about n log((1 - r0^2) / (1 - r^2)), n the inverse of that
variance.
"""

import math
from dataclasses import replace
from typing import Any, NamedTuple, cast

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, max_pool2d

from codesign.flow.lk.estimate import check_slopes, check_start, descended, field
from codesign.flow.lk.lanes import Grid
from codesign.flow.lk.level import along_path, blurred_to, weighed_down
from codesign.flow.lk.path import Path
from codesign.flow.warp import pixel_grid, read_at
from codesign.types import EventVolume, FlowField

BLUR_PX = 1.0
LEAST_SHARE = 0.3  # of the pixels that must stay in the image, for a flow to be compared
TINY = 1e-12
SOME = 0.02  # variance of a pixel's share, squared events, where nothing was seen
WIDE: dict[str, Any] = {"prior_px": 20.0, "levels_px": (8.0, 4.0, 2.0, 1.0)}
COARSE: dict[str, Any] = {"model": "affine", "prior_px": 8.0, "levels_px": (8.0, 4.0, 2.0)}
NARROW: dict[str, Any] = {"model": "affine"}
# local fields, by whether to reach far
OPTIONS: dict[bool, dict[str, Any]] = {False: {}, True: WIDE}
CLOCKS = {False: "time", True: "turn"}
TURNED = 0.95  # factor on 1 - r from which on events are the clock
FAR = 0.9  # and the wide prior is taken
FEW = 25.0  # nats over zero flow at which half of the flow is believed
# bodies before still ground, logistic: extent of what agrees, logarithms of the share of the cells
# that hold it and of how much worse shifts of places explain it than one affine field, 1; fitted to
# scenes.windows.sets, other seeds
BODIES = (-5.85, -2.79, -9.29, -6.8)
MOST = 0.5  # of the third
SURE = 0.6  # probability from which on they are taken for such
MOVES = 5.0  # deviations of scattered events from which on a pixel belongs to one
NOISE = 2.0  # and below which it says nothing of where they are
CELL = 8  # px; places that shift by themselves, and half of the widest gap within a body
EDGE = 1  # px that the blur carries evidence beyond a body
LEAST = 1e-3


class Agreed(NamedTuple):
    """alike: [B] the agreement r. sure: [B] inverse of its variance for scattered events. z:
    [B, H, W] of the pixels' share in it, over its deviation for scattered events; empty where not
    asked for."""

    alike: Tensor
    sure: Tensor
    z: Tensor


class Agreement:
    """The bins of a volume, blurred, and how well they agree along flows. No gradient."""

    @torch.no_grad()
    def __init__(self, volume: EventVolume) -> None:
        counts = volume.counts.detach()
        signed, _, kept = weighed_down(counts)
        self.signed = _blurred(signed, BLUR_PX)
        self.events = _blurred(counts.sum(1) * kept[:, None], BLUR_PX)
        self.apart = min(2, signed.shape[1] - 1)

    @torch.no_grad()
    def along(self, flow: Tensor, way: Path, sure: bool = False) -> Agreed:
        """Agreement along a flow [B, 2, H, W] px per way, on the pixels of the start."""
        place = (way.place - way.start[:, None]).to(flow)
        at = pixel_grid(*flow.shape[2:], flow) + place[:, :, None, None, None] * flow[:, None]
        last = torch.tensor([flow.shape[3], flow.shape[2]]).to(flow)[:, None, None] - 0.5
        inside = ((at >= -0.5) & (at <= last)).all(2).all(1)
        inside = inside & (inside.to(flow).mean((1, 2), keepdim=True) > LEAST_SHARE)
        images = torch.stack([self.signed, self.events] if sure else [self.signed], 2)
        read = read_at(images.flatten(0, 1), at.flatten(0, 1)).reshape(images.shape)
        read = read * inside[:, None, None]
        found = read[:, :, 0] * way.direction.to(flow)[:, :, None, None]
        size = found.square().sum((2, 3)).sqrt()
        product, most = self._pairs(found), self._pairs(size)
        alike = product.sum((1, 2)) / (most + TINY)
        if not sure:
            return Agreed(alike, alike.new_empty(0), alike.new_empty(0))
        events = self._pairs(read[:, :, 1]).clamp_min(0)
        variance = events / (8 * math.pi * BLUR_PX**2)
        return Agreed(
            alike, most.square() / (variance.sum((1, 2)) + TINY), product / (variance + SOME).sqrt()
        )

    def _pairs(self, bins):
        """Sum of the products of bins [B, n, ...] that are ``apart`` or more."""
        apart = [bins[:, lag:] * bins[:, :-lag] for lag in range(self.apart, bins.shape[1])]
        return torch.cat(apart, 1).sum(1)


def estimate(volume: EventVolume, start_px: Tensor | None = None) -> FlowField:
    """Flow over the volume's interval, with its uncertainty, where nothing is known of scene,
    motion and sensor.

    Chosen for each sample by the agreement of the bins: time or events as the clock, or a motion
    that turns back once (``net_share`` tells); a local field with the prior of ``estimate_lk`` or a
    wide one for motions of many pixels; and zero flow, towards which all shrinks where it explains
    the events as well. Where few places give nearly all events and do not move as one, they are
    taken for bodies before still ground, and there is no flow beyond their outlines.

    Args:
      volume, start_px: as of ``estimate_lk``; with fewer than 4 bins little can be told apart.
    Returns: as of ``estimate_lk``. The covariance takes in how far the candidates are apart, and
      what was shrunk.
    Gradient: counts, as of ``estimate_lk``, through what was chosen; none through the choice.
    Raises: ShapeError, DomainError.
    Cost: forward 4 times a local field (docs/flow_closed_form.md); where a gradient is asked for,
      one field more.

    >>> import torch
    >>> from codesign.flow.export import evenly_timed
    >>> y, x = torch.meshgrid(torch.arange(48.0), torch.arange(64.0), indexing="ij")
    >>> rate = torch.stack([torch.sin((x - 2 * t) / 4) + torch.sin((y - t) / 5) for t in torch.linspace(0, 1, 6)])
    >>> counts = torch.stack([rate.clamp(min=0), (-rate).clamp(min=0)])[None]
    >>> estimate(evenly_timed(counts)).flow_px[0, :, 24, 32].round(decimals=0).tolist()
    [2.0, 1.0]
    """
    counts = check_slopes(volume)
    start = None if start_px is None else check_start(start_px, counts)
    with torch.no_grad():
        chosen = _chosen(replace(volume, counts=counts.detach()), start)
    found = chosen.found
    if torch.is_grad_enabled() and counts.requires_grad:  # once more, what was chosen alone
        found = _followed(volume, chosen, start)
    believed = chosen.believed
    return replace(
        found,
        flow_px=believed[:, None] * found.flow_px,
        confidence=believed * cast(Tensor, found.confidence),
        covariance_px2=cast(Tensor, found.covariance_px2) + chosen.apart,
    )


def _followed(volume, chosen, start):
    """The fields that were chosen, with their gradients."""
    parts = []
    places = []
    for turned, far in ((False, False), (False, True), (True, False), (True, True)):
        these = ((chosen.turned == turned) & (chosen.far == far)).nonzero()[:, 0]
        if len(these):
            part = replace(volume, counts=volume.counts[these])
            path = along_path(part, CLOCKS[turned])
            from_px = None if start is None else start[these]
            parts.append(
                field(part, path[0], *descended(part, path, **OPTIONS[far], start_px=from_px))
            )
            places.append(these)
    order = torch.cat(places).argsort()
    names = ("flow_px", "valid", "confidence", "covariance_px2", "net_share")
    joined = {name: torch.cat([getattr(part, name) for part in parts])[order] for name in names}
    return replace(parts[0], **joined)


class _Chosen(NamedTuple):
    """found: the fields chosen, without gradient. turned, far: [B] bool. believed: [B, H, W] share
    of the flow. apart: [B, 3, H, W] what is added to the claim."""

    found: FlowField
    turned: Tensor
    far: Tensor
    believed: Tensor
    apart: Tensor


def _chosen(volume, start):
    agreement = Agreement(volume)
    found = [along_path(volume, clock) for clock in CLOCKS.values()]
    missing = [
        1 - agreement.along(descended(volume, path, **COARSE)[0], path[0]).alike for path in found
    ]
    turned = missing[1] < TURNED * missing[0]
    straight, turning = (vars(path[0]) for path in found)
    way = Path(**{name: _where(turned, turning[name], straight[name]) for name in straight})
    path = way, *found[0][1:]
    fields = [descended(volume, path, **options, start_px=start) for options in ({}, WIDE, NARROW)]
    flows = [flow for flow, *_ in fields]
    local, wide, narrow = (agreement.along(flow, way, sure=True) for flow in flows)
    still = agreement.along(torch.zeros_like(flows[0]), way).alike
    far = 1 - wide.alike < FAR * (1 - local.alike)
    chosen = [_where(far, *pair) for pair in zip(fields[1], fields[0], strict=True)]
    best = Agreed(*(_where(far, *pair) for pair in zip(wide, local, strict=True)))
    nats = best.sure * (_unexplained(still) - _unexplained(best.alike)).clamp_min(0) / 2
    shrunk = (nats / (nats + FEW) * (best.alike > 0))[:, None, None]
    seen = local.z.clamp_min(0)[:, None]
    shifts = _blurred(seen * flows[0], CELL) / (_blurred(seen, CELL) + TINY)
    one = torch.minimum(1 - narrow.alike, torch.minimum(*missing))
    bodies = _bodies(local, 1 - agreement.along(shifts, way).alike, one)[:, None, None]
    ground = (bodies > SURE) & ~_enclosed(best.z > MOVES)
    believed = torch.where(ground, 0.0, shrunk.expand_as(best.z))
    doubt = believed * (1 - believed) + torch.where(ground, 1 - bodies, 0.0)
    apart = doubt[:, None] * _squared(chosen[0]) + sum(
        _squared(other - chosen[0]) for other in flows
    )
    found = field(volume, way, *chosen)
    return _Chosen(
        found, turned, far, believed, way.net.to(apart)[:, None, None, None].square() * apart
    )


def _unexplained(alike):
    """Logarithm of the share of the variance that an agreement leaves."""
    return (1 - alike.square()).clamp_min(LEAST / 10).log()


def _bodies(local, shifts, one):
    """Probability [B] that what agrees along the local field are bodies before still ground.
    shifts,
    one: [B] what shifts of places and one affine field leave of it."""
    cells = avg_pool2d(local.z.clamp_min(0)[:, None], CELL, ceil_mode=True)[:, 0]
    share = cells.sum((1, 2)).square() / (cells.square().sum((1, 2)) + TINY) / cells[0].numel()
    cells = avg_pool2d((local.z - NOISE).clamp_min(0).sqrt()[:, None], CELL, ceil_mode=True)[:, 0]
    weight = cells[:, None] / (cells.sum((1, 2)) + TINY)[:, None, None, None]
    place = pixel_grid(*cells.shape[1:], cells)
    off_middle = place - (weight * place).sum((2, 3), keepdim=True)
    extent = (weight * off_middle.square()).sum((1, 2, 3)).sqrt() / max(cells.shape[1:])
    worse = shifts.clamp_min(LEAST).log() - one.clamp_min(LEAST).log()
    parts = extent, share.clamp_min(LEAST).log(), worse.clamp(-MOST, MOST), torch.ones_like(worse)
    return torch.sigmoid(sum(weight * part for weight, part in zip(BODIES, parts, strict=True)))


def _enclosed(moves):
    """[B, H, W] bool: pixels among those that move, also within an outline, less the edge that the
    blur adds."""
    closed = max_pool2d(moves.float(), 2 * CELL + 1, 1, CELL)
    return max_pool2d(1 - closed, 2 * (CELL + EDGE) + 1, 1, CELL + EDGE) < 0.5


def _blurred(images, sigma_px):
    """[B, n, H, W] through a Gaussian."""
    return blurred_to(images, sigma_px, Grid(*images.shape[-2:]))


def _where(choice, one, other):
    """Of each sample the one or the other."""
    return torch.where(choice.reshape(-1, *[1] * (one.ndim - 1)), one, other)


def _squared(flow):
    """[B, 3, H, W] products (xx, xy, yy) of the components of a flow."""
    x, y = flow.unbind(1)
    return torch.stack([x * x, x * y, y * y], 1)
