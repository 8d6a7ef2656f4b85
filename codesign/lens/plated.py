"""Rays through a lens with a phase plate: traced up to the plate's plane, turned by its slope, traced on."""

from dataclasses import replace

import torch
from torch import Tensor
from torch.nn.functional import pad

from codesign.lens.kernel import FORWARD, GRAZING
from codesign.lens.trace import PlateAt, Prescription, Status, TraceResult, joined, onward
from codesign.lens.trace import trace as trace_surfaces


def trace(prescription: Prescription, origin_mm: Tensor, direction: Tensor) -> TraceResult:
    """``trace.trace`` for a lens that may hold a plate. At the plate a ray gains its phase as optical path, and
    its direction across the axis, times index, gains the slope of that path: the local grating equation.

    Gradient: also to the plate. Rays that leave a plate beyond its rim MISS; those it turns beyond a right angle
      are TOTAL_REFLECTION.
    """
    p = prescription
    placed = p.plate
    if placed is None:
        return trace_surfaces(p, origin_mm, direction)
    gap = placed.gap
    last = p.thickness_mm.shape[0] - 1
    after = torch.as_tensor(placed.after_mm).to(p.thickness_mm)
    index = p.index[gap + 1]
    here = _turned(to_plate(p, placed, origin_mm, direction), placed, index, max(gap, 0))
    if gap == last:
        rest = straight(here.position_mm, here.direction, p.thickness_mm[last] - after, index)
    else:
        depth = after - p.thickness_mm[gap] if gap >= 0 else after
        at, safe = onward(here)
        at = torch.cat([at[:, :2], depth.expand(len(at), 1)], 1)
        rest = trace_surfaces(replace(p.part(gap + 1, last + 1), efficiency=1.0), at, safe)
    return joined(here, rest, gap + 1)


def to_plate(
    prescription: Prescription, placed: PlateAt, origin_mm: Tensor, direction: Tensor
) -> TraceResult:
    """Rays on the plane of a lens's plate, before it turns them; positions relative to the plate's centre."""
    p = prescription
    after = torch.as_tensor(placed.after_mm).to(p.thickness_mm)
    if placed.gap < 0:
        return straight(origin_mm, direction, after, p.index[0])
    gaps = torch.cat([p.thickness_mm[: placed.gap], after.reshape(1)])
    front = replace(p.part(0, placed.gap + 1), thickness_mm=gaps, to_plane=True)
    return trace_surfaces(front, origin_mm, direction)


def straight(origin_mm: Tensor, direction: Tensor, to_mm: Tensor, index: Tensor) -> TraceResult:
    """Rays on the plane z = ``to_mm``, without a surface on the way; positions relative to its centre."""
    forward = direction[:, 2] > FORWARD
    length = (to_mm - origin_mm[:, 2]) / torch.where(forward, direction[:, 2], 1)
    flat = pad(origin_mm[:, :2] + direction[:, :2] * length[:, None], (0, 1))
    deficit = torch.where(forward, 0, FORWARD - direction[:, 2])
    packed = torch.where(forward, -8, int(Status.MISS)).int() + 4
    return TraceResult(flat, direction, index * length, forward.to(flat.dtype), packed, deficit)


def _turned(rays, placed, index, surface):
    """Rays on the plate's plane as they leave it; what it stops failed at ``surface``, the one before."""
    phase, slope, reaches = placed.look(rays.position_mm[:, :2])
    across = rays.direction[:, :2] + slope * (placed.mm_per_rad / index)
    radicand = 1 - across.square().sum(1)
    alive = rays.status == Status.OK
    passes = radicand > GRAZING
    axial = torch.where(passes, radicand, 1).sqrt()
    good = alive & reaches & passes
    why = torch.where(reaches, int(Status.TOTAL_REFLECTION), int(Status.MISS))
    packed = torch.where(alive & ~good, 8 * surface + why + (rays.packed_status & 4), rays.packed_status)
    return replace(
        rays,
        direction=torch.where(good[:, None], torch.cat([across, axial[:, None]], 1), rays.direction),
        optical_path_mm=torch.where(
            good, rays.optical_path_mm + phase * placed.mm_per_rad, rays.optical_path_mm
        ),
        weight=torch.where(good, rays.weight, 0),
        packed_status=packed.int(),
        deficit=torch.where(alive & reaches & ~passes, GRAZING - radicand, rays.deficit),
    )
