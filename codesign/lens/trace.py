"""Sequential ray trace: the numbers of a lens, rays in, rays out. The kernel is in kernel.py."""

import math
from collections.abc import Callable
from dataclasses import dataclass, fields, replace

import torch
from torch import Tensor
from torch.nn.functional import pad
from torch.utils.checkpoint import checkpoint

from codesign.backend import run_kernel
from codesign.checks import check_finite, check_whole
from codesign.errors import DomainError, ShapeError
from codesign.lens.kernel import FORWARD, GRAZING, Kernel, Status, Works


@dataclass(frozen=True)
class PlateAt:
    """A phase plate on a plane of a lens, for one wavelength; ``trace`` sends rays through it.

    look: points [N, 2] mm -> phase [N] rad, its slope [N, 2] rad/mm, whether the plate reaches
      there [N] bool.
    gap: the surface it follows, -1 before the first. after_mm: from that surface's vertex (from the
      first where gap is -1). mm_per_rad: optical path of a radian.
    """

    look: Callable[[Tensor], tuple[Tensor, Tensor, Tensor]]
    gap: int
    after_mm: float | Tensor
    mm_per_rad: float

    def reversed(self, thickness_mm: Tensor) -> "PlateAt":
        """The plate in the reversed lens, whose thicknesses [S] were these."""
        inner = 0 <= self.gap < len(thickness_mm) - 1
        after = thickness_mm[self.gap] - self.after_mm if inner else -self.after_mm
        return replace(self, gap=len(thickness_mm) - 2 - self.gap, after_mm=after)


LONGEST = 16  # surfaces of one kernel
SEGMENT = 8


@dataclass(frozen=True)
class Prescription:
    """Numbers the kernel needs, for one wavelength. Tensors of one dtype and device; gradients flow
    to all of them.

    curvature_per_mm, thickness_mm, conic, semi_aperture_mm: [S]. asphere: [S, A], coefficients of
      r^2, r^4, ...
    index: [S + 1], the first before the first surface. soft_edge_mm: full width of the smooth edge
      of the apertures.
    path_mm: [S, P], optical path added by a diffractive phase, coefficients of r^2, r^4, ...;
      efficiency: product of its efficiencies.
    decentre_mm, tilt_rad: [S, 2] each. mirrors: S booleans; the axis is unfolded behind a mirror
      (see Surface).
    inner_semi_aperture_mm: S numbers, radii of central obstructions (0: none).
    borders_glass: S booleans, surfaces whose index step may change: where the step is 0 today, a
      derivative to ``index`` still needs the refraction. False for a surface in air, whose step
      stays 0.
    to_plane: whether rays go on to the plane behind the last thickness, or end on the last surface
      itself.
    plate: a phase plate between the surfaces, or None; of no concern to ``trace_surfaces``, see
      ``trace``.
    """

    curvature_per_mm: Tensor
    thickness_mm: Tensor
    conic: Tensor
    asphere: Tensor
    index: Tensor
    semi_aperture_mm: Tensor
    soft_edge_mm: float
    path_mm: Tensor
    decentre_mm: Tensor
    tilt_rad: Tensor
    mirrors: tuple[bool, ...]
    inner_semi_aperture_mm: tuple[float, ...]
    borders_glass: tuple[bool, ...]
    efficiency: float = 1.0
    to_plane: bool = True
    plate: PlateAt | None = None

    def reversed(self, last_gap_mm: Tensor) -> "Prescription":
        """The same lens seen from the image side; ``last_gap_mm`` is the distance of the plane
        where the rays end."""
        gaps = torch.cat([self.thickness_mm[:-1].flip(0), last_gap_mm.reshape(1)])
        # a mirror faces the light from either way
        turn = torch.tensor(
            [1.0 if mirror else -1.0 for mirror in self.mirrors],
            dtype=gaps.dtype,
            device=gaps.device,
        )
        shapes = {
            "curvature_per_mm": (turn * self.curvature_per_mm).flip(0),
            "asphere": (turn[:, None] * self.asphere).flip(0),
            "tilt_rad": (turn[:, None] * self.tilt_rad).flip(0),
        }
        same = {
            name: getattr(self, name).flip(0)
            for name in ("conic", "index", "semi_aperture_mm", "path_mm", "decentre_mm")
        }
        return replace(
            self,
            thickness_mm=gaps,
            mirrors=self.mirrors[::-1],
            inner_semi_aperture_mm=self.inner_semi_aperture_mm[::-1],
            plate=self.plate and self.plate.reversed(self.thickness_mm),
            borders_glass=self.borders_glass[::-1],
            **shapes,
            **same,
        )

    def until(self, surface: int) -> "Prescription":
        """The part of the lens up to a surface (counted from 0), where rays end unbent."""
        part = self.part(0, surface + 1)
        keep = torch.arange(surface + 1, device=self.path_mm.device) < surface
        return replace(
            part,
            path_mm=part.path_mm * keep[:, None],
            mirrors=(*self.mirrors[:surface], False),
            borders_glass=(*self.borders_glass[:surface], False),
            index=self.index[[*range(surface + 1), surface]],
            to_plane=False,
            plate=self.plate if self.plate and self.plate.gap < surface else None,
        )

    def part(self, first: int, stop: int) -> "Prescription":
        """The surfaces from ``first`` to before ``stop``, without a plate."""
        whole = ("index", "soft_edge_mm", "efficiency", "to_plane", "plate")
        rows = {
            f.name: getattr(self, f.name)[first:stop] for f in fields(self) if f.name not in whole
        }
        return replace(self, **rows, index=self.index[first : stop + 1], plate=None)

    def opened(self, surface: int) -> "Prescription":
        """The same lens with one aperture that clips nothing: rays that are placed on the stop are
        not to be weighed by its edge."""
        apertures = self.semi_aperture_mm.clone()
        apertures[surface] = 1e6
        return replace(self, semi_aperture_mm=apertures)

    def to(self, dtype: torch.dtype) -> "Prescription":
        """The same numbers in another precision; gradients flow through."""
        return self._each(lambda tensor: tensor.to(dtype))

    def detached(self) -> "Prescription":
        """The same numbers without gradients."""
        return self._each(Tensor.detach)

    def _each(self, change):
        return replace(
            self,
            **{
                f.name: change(getattr(self, f.name))
                for f in fields(self)
                if torch.is_tensor(getattr(self, f.name))
            },
        )


@dataclass(frozen=True)
class TraceResult:
    """Rays on the plane behind the last thickness.

    position_mm: [N, 3] relative to the plane's centre (z = 0). direction: [N, 3] unit.
      optical_path_mm: [N].
    weight: [N] product of the soft aperture edges; 0 for failed rays. deficit: [N] >= 0,
      dimensionless.
    packed_status: [N] int, status, hard mask and failed surface packed into one number; read
      them by their names.
    """

    position_mm: Tensor
    direction: Tensor
    optical_path_mm: Tensor
    weight: Tensor
    packed_status: Tensor
    deficit: Tensor

    @property
    def status(self) -> Tensor:
        """What became of each ray, [N] int, see Status."""
        return self.packed_status & 3

    @property
    def inside(self) -> Tensor:
        """The hard mask: whether each ray lies within every clear aperture it reached and outside
        every obstruction, [N] bool."""
        return (self.packed_status & 4) != 0

    @property
    def failed_surface(self) -> Tensor:
        """First surface (from 0) where each ray failed, S where it failed to leave forwards, -1 if
        nowhere, [N] int."""
        return self.packed_status >> 3


def check_rays(origin_mm: Tensor, direction: Tensor) -> None:
    """Raise ShapeError unless both are [N >= 1, 3]; DomainError for origins that are not finite or
    directions that are not unit vectors."""
    for label, value in (("origin_mm", origin_mm), ("direction", direction)):
        if value.ndim != 2 or value.shape[1] != 3 or value.shape[0] == 0:
            raise ShapeError(f"{label} must be [N >= 1, 3], got {tuple(value.shape)}.")
    if origin_mm.shape != direction.shape:
        raise ShapeError(
            f"{origin_mm.shape[0]} origins but {direction.shape[0]} directions were given; give one of "
            "each per ray."
        )
    if not all(map(math.isfinite, _range(origin_mm, lambda rows: rows))):
        check_finite(origin_mm, "origin_mm")
    ones = direction.new_ones(3)
    shortest, longest = _range(direction, lambda rows: torch.mv(rows.square(), ones))
    if not (shortest > 0.9998 and longest < 1.0002):
        raise DomainError(
            f"direction: squared lengths lie between {shortest:.6g} and {longest:.6g}; give finite unit "
            "vectors (torch.nn.functional.normalize)."
        )


def _range(rows, function):
    """Least and largest value of a function of rows [N, 3], in blocks that stay in the cache; NaN
    where there is one."""
    found = torch.stack(
        [torch.stack(torch.aminmax(function(part))) for part in rows.detach().split(65_536)]
    )
    return found[:, 0].min().item(), found[:, 1].max().item()


def trace_surfaces(prescription: Prescription, origin_mm: Tensor, direction: Tensor) -> TraceResult:
    """Trace rays from points relative to the first vertex to the plane behind the last thickness.

    Args: origin_mm [N, 3], direction [N, 3] unit, both of the prescription's dtype.
    Returns: TraceResult.
    Gradient: position, direction, optical path, weight and deficit, to rays and to every tensor of
      the prescription.
    Lenses of more than LONGEST surfaces are traced in segments, each a kernel of its own: the time
      to compile one grows with the square of its length, and segments alike share one.
    """
    p = prescription
    count = origin_mm.shape[0]
    if len(p.mirrors) > LONGEST:
        return _in_segments(p, origin_mm, direction)
    edge = max(p.soft_edge_mm, 1e-6)
    # its value matters, or its derivative is wanted
    conics = [p.conic.requires_grad or k != 0 for k in p.conic.tolist()]
    index = p.index.tolist()
    refracts = [
        a != b or (varies and p.index.requires_grad)
        for a, b, varies in zip(index[:-1], index[1:], p.borders_glass, strict=True)
    ]
    moved = [any(row) for row in torch.cat([p.decentre_mm, p.tilt_rad], 1).tolist()]
    if p.decentre_mm.requires_grad or p.tilt_rad.requires_grad:
        moved = [True] * len(moved)
    works = [
        Works(*of)
        for of in zip(
            conics,
            _active(p.asphere),
            refracts,
            p.mirrors,
            _active(p.path_mm),
            moved,
            map(bool, p.inner_semi_aperture_mm),
            strict=True,
        )
    ]
    kernel = Kernel(tuple(works), p.asphere.shape[1], p.path_mm.shape[1], p.to_plane)
    ratio = p.index[:-1] / p.index[1:]
    per_mm2 = 0.5 / (edge * p.semi_aperture_mm)  # slope of the apertures' edges in r^2
    columns = [
        origin_mm,
        direction,
        p.curvature_per_mm,
        p.thickness_mm,
        p.conic,
        p.index,
        ratio,
        per_mm2,
        p.semi_aperture_mm.square() * per_mm2 + 0.5,
        p.asphere,
    ]
    if kernel.special:
        inner = p.curvature_per_mm.new_tensor(p.inner_semi_aperture_mm)
        columns += [
            p.path_mm,
            p.decentre_mm,
            p.tilt_rad.cos(),
            p.tilt_rad.sin(),
            0.5 / (edge * inner.clamp_min(1e-6)),
            0.5 - inner * (0.5 / edge),
        ]
    found = TraceResult(*run_kernel(kernel, columns, [(count, 3), (count, 3), *[(count,)] * 4]))
    return found if p.efficiency == 1 else replace(found, weight=found.weight * p.efficiency)


def _in_segments(p, origin_mm, direction):
    """Trace through SEGMENT surfaces at a time, from vertex plane to vertex plane."""
    count = len(p.mirrors)

    def segment(first):
        stop = min(first + SEGMENT, count)
        efficiency = 1.0 if first else p.efficiency
        return replace(
            p.part(first, stop), to_plane=p.to_plane or stop < count, efficiency=efficiency
        )

    found = trace_surfaces(segment(0), origin_mm, direction)
    for first in range(SEGMENT, count, SEGMENT):
        found = joined(found, trace_surfaces(segment(first), *onward(found)), first)
    return found


def onward(rays: TraceResult) -> tuple[Tensor, Tensor]:
    """Origins and directions [N, 3] to trace on with; along the axis for rays that failed, which
    ``joined`` drops."""
    alive = rays.packed_status < 0
    if bool(alive.all()):
        return rays.position_mm, rays.direction
    axis = rays.direction.new_tensor([0.0, 0.0, 1.0])
    return rays.position_mm, torch.where(alive[:, None], rays.direction, axis)


def joined(front: TraceResult, rest: TraceResult, surfaces: int) -> TraceResult:
    """Rays through the first ``surfaces`` of a lens and then through the rest, as one
    TraceResult."""
    alive = front.packed_status < 0  # no surface where they failed
    packed = torch.where(
        rest.packed_status < 0, rest.packed_status, rest.packed_status + 8 * surfaces
    )
    packed = packed & (front.packed_status | ~4)  # inside both
    if bool(alive.all()):  # the same as below, in a third of the time
        return replace(
            rest,
            optical_path_mm=front.optical_path_mm + rest.optical_path_mm,
            weight=front.weight * rest.weight,
            packed_status=packed,
        )
    return TraceResult(
        torch.where(alive[:, None], rest.position_mm, front.position_mm),
        torch.where(alive[:, None], rest.direction, front.direction),
        torch.where(alive, front.optical_path_mm + rest.optical_path_mm, front.optical_path_mm),
        torch.where(alive, front.weight * rest.weight, 0),
        torch.where(alive, packed, front.packed_status),
        torch.where(alive, rest.deficit, front.deficit),
    )


def trace(prescription: Prescription, origin_mm: Tensor, direction: Tensor) -> TraceResult:
    """Trace rays through a lens that may hold a plate, see ``trace_surfaces``. At the plate a ray
    gains its phase as optical path, and its direction across the axis, times index, gains the slope
    of that path: the local grating equation.

    Gradient: also to the plate. Rays that leave a plate beyond its rim MISS; those it turns beyond
      a right angle are TOTAL_REFLECTION.
    """
    p = prescription
    placed = p.plate
    if placed is None:
        return trace_surfaces(p, origin_mm, direction)
    gap = placed.gap
    last = p.thickness_mm.shape[0] - 1
    after = torch.as_tensor(placed.after_mm).to(p.thickness_mm)
    index = p.index[gap + 1]
    here = _plate_turns(to_plate(p, placed, origin_mm, direction), placed, index, max(gap, 0))
    if gap == last:
        rest = straight(here.position_mm, here.direction, p.thickness_mm[last] - after, index)
    else:
        depth = after - p.thickness_mm[gap] if gap >= 0 else after
        at, safe = onward(here)
        at = torch.cat([at[:, :2], depth.expand(len(at), 1)], 1)
        # of all surfaces; those before the plate brought it where there are some
        efficiency = 1.0 if gap >= 0 else p.efficiency
        rest = trace_surfaces(replace(p.part(gap + 1, last + 1), efficiency=efficiency), at, safe)
    return joined(here, rest, gap + 1)


def at_surfaces(
    prescription: Prescription,
    origin_mm: Tensor,
    direction: Tensor,
) -> list[TraceResult]:
    """The rays on each surface [S], before it bends them; positions relative to where its vertex
    would lie on the axis, see ``across``."""
    count = len(prescription.mirrors)
    return [trace(prescription.until(i), origin_mm, direction) for i in range(count)]


def across(prescription: Prescription, surface: int, position_mm: Tensor) -> Tensor:
    """Places [N, 2] across a surface, in its own decentred and tilted axes, of points [N, 3] relative
    to its vertex on the axis of the lens."""
    shift, tilt = prescription.decentre_mm[surface], prescription.tilt_rad[surface]
    cosine, sine = tilt.cos(), tilt.sin()
    x, y = (position_mm[:, :2] - shift).unbind(1)
    z = position_mm[:, 2]
    depth = z * cosine[0] - y * sine[0]
    return torch.stack([x * cosine[1] - depth * sine[1], y * cosine[0] + z * sine[0]], 1)


def to_plate(
    prescription: Prescription, placed: PlateAt, origin_mm: Tensor, direction: Tensor
) -> TraceResult:
    """Rays on the plane of a lens's plate, before it turns them; positions relative to the plate's
    centre."""
    p = prescription
    after = torch.as_tensor(placed.after_mm).to(p.thickness_mm)
    if placed.gap < 0:
        return straight(origin_mm, direction, after, p.index[0])
    gaps = torch.cat([p.thickness_mm[: placed.gap], after.reshape(1)])
    front = replace(p.part(0, placed.gap + 1), thickness_mm=gaps, to_plane=True)
    return trace_surfaces(front, origin_mm, direction)


def straight(origin_mm: Tensor, direction: Tensor, to_mm: Tensor, index: Tensor) -> TraceResult:
    """Rays on the plane z = ``to_mm``, without a surface on the way; positions relative to its
    centre."""
    forward = direction[:, 2] > FORWARD
    length = (to_mm - origin_mm[:, 2]) / torch.where(forward, direction[:, 2], 1)
    flat = pad(origin_mm[:, :2] + direction[:, :2] * length[:, None], (0, 1))
    deficit = torch.where(forward, 0, FORWARD - direction[:, 2])
    packed = torch.where(forward, -8, int(Status.MISS)).int() + 4
    return TraceResult(flat, direction, index * length, forward.to(flat.dtype), packed, deficit)


def _plate_turns(rays, placed, index, surface):
    """Rays on the plate's plane as they leave it; what it stops failed at ``surface``, the one
    before."""
    phase, slope, reaches = placed.look(rays.position_mm[:, :2])
    across = rays.direction[:, :2] + slope * (placed.mm_per_rad / index)
    radicand = 1 - across.square().sum(1)
    alive = rays.status == Status.OK
    passes = radicand > GRAZING
    axial = torch.where(passes, radicand, 1).sqrt()
    good = alive & reaches & passes
    why = torch.where(reaches, int(Status.TOTAL_REFLECTION), int(Status.MISS))
    failed = 8 * surface + why + (rays.packed_status & 4)
    packed = torch.where(alive & ~good, failed, rays.packed_status)
    return replace(
        rays,
        direction=torch.where(
            good[:, None], torch.cat([across, axial[:, None]], 1), rays.direction
        ),
        optical_path_mm=torch.where(
            good, rays.optical_path_mm + phase * placed.mm_per_rad, rays.optical_path_mm
        ),
        weight=torch.where(good, rays.weight, 0),
        packed_status=packed.int(),
        deficit=torch.where(alive & reaches & ~passes, GRAZING - radicand, rays.deficit),
    )


def sum_over_chunks(function: Callable[..., Tensor], *rays: Tensor, rows: int = 262_144) -> Tensor:
    """Sum of ``function(*chunk)`` over chunks of rays, in bounded memory: a chunk is traced again
    when its gradient is due.

    Args: function of tensors [n, ...] -> tensor, such as a merit of traced rays; rays: tensors
      [N, ...] split together into ``rows`` at a time.
    Returns: the sum over chunks. Gradient: as if all were traced at once.
    Raises: ShapeError unless every tensor holds the same number of rays, at least one.
    """
    rows = check_whole(rows, "rows")
    counts = {len(r) if isinstance(r, Tensor) and r.ndim else 0 for r in rays}
    if len(counts) != 1 or 0 in counts:
        raise ShapeError(
            f"rays hold {sorted(counts)} rows; give tensors of the same number of rays, at least one."
        )
    first, *rest = zip(*(r.split(rows) for r in rays), strict=True)
    total: Tensor = checkpoint(function, *first, use_reentrant=False)  # pyright: ignore[reportAssignmentType]
    for part in rest:
        total = total + checkpoint(function, *part, use_reentrant=False)
    return total


def _active(table):
    """Number of polynomial terms to compute per surface: up to the last that is not zero, all when
    derivatives are wanted."""
    if table.requires_grad or not table.shape[1]:
        return [table.shape[1]] * table.shape[0]
    return [max((i + 1 for i, v in enumerate(row) if v != 0), default=0) for row in table.tolist()]
