"""What a lens must be to exist: limits on thicknesses, gaps, angles, length, glass and rays, as
smooth penalties and as a report.

    limits = Limits(glass_centre_mm=1.0, glass_edge_mm=1.0, air_gap_mm=0.2, track_mm=70.0)
    found = evaluate(lens, limits)
    loss = spot + penalty(found)
    print(report(found))

Every Constraint is a value, a bound and a side. Its penalty is (violation / scale)^2: zero with
zero slope where it holds, so values and slopes are continuous. Surfaces are counted from 1.
"""

from collections.abc import Collection, Iterator
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from codesign.errors import DomainError
from codesign.lens.design.hits import rim_rays, surface_hits
from codesign.lens.distance import PARALLEL
from codesign.lens.geolens import GeoLens
from codesign.lens.surface import sag_mm


@dataclass(frozen=True)
class Constraint:
    """One limit on one figure of a lens.

    value: scalar tensor with its gradient. at_least: True for value >= bound, False for value <=
      bound.
    scale: the violation that costs a penalty of 1, in the unit of the value. can_bind: False where
      the bound is also the best value there is (no failed ray), so that it holds or is violated but
      never binds.
    """

    name: str
    value: Tensor
    bound: float
    at_least: bool
    scale: float
    unit: str
    can_bind: bool = True

    @property
    def slack(self) -> Tensor:
        """How far the value stays inside its bound, in its unit; negative when violated.
        Differentiable."""
        return self.value - self.bound if self.at_least else self.bound - self.value

    @property
    def violation(self) -> Tensor:
        """max(0, -slack), in its unit."""
        return (-self.slack).clamp_min(0)

    @property
    def row(self) -> Tensor:
        """violation / scale: a residual for least squares."""
        return self.violation / self.scale

    @property
    def penalty(self) -> Tensor:
        """(violation / scale)^2, dimensionless."""
        return self.row.square()

    def state(self, tolerance: float = 1e-3) -> str:
        """One of "violated", "binds" (within tolerance * scale of its bound on either side) and
        "free"."""
        share = float(self.slack.detach()) / self.scale
        if self.can_bind and abs(share) <= tolerance:
            return "binds"
        return "free" if share >= 0 else "violated"  # NaN is violated


@dataclass(frozen=True)
class Limits:
    """What to hold; None leaves a figure free. Lengths in mm, angles in degrees.

    glass_centre_mm, glass_centre_most_mm: centre thickness of glass. glass_edge_mm: thickness of
      glass at the semi-aperture.
    air_gap_mm: least air between neighbouring surfaces anywhere within the semi-aperture, the axis
      included.
    track_mm: most length from the first vertex to the image. back_focus_mm: least distance from the
      last surface to the image.
    incidence_deg: most angle of incidence of any rim or chief ray of ``fields_rad``. steepness:
      most semi-aperture over radius (1 is a hemisphere).
    rays: whether every rim and chief ray of ``fields_rad`` must arrive.
    at_m: distance of the object whose rays count, metres from the entrance pupil, or several; inf
      is parallel light.
    scale_mm, scale_deg: violations that cost 1.
    """

    glass_centre_mm: float | None = None
    glass_centre_most_mm: float | None = None
    glass_edge_mm: float | None = None
    air_gap_mm: float | None = None
    track_mm: float | None = None
    back_focus_mm: float | None = None
    incidence_deg: float | None = None
    steepness: float | None = None
    rays: bool = False
    fields_rad: tuple[float, ...] = ()
    scale_mm: float = 0.5
    scale_deg: float = 5.0
    at_m: float | tuple[float, ...] = PARALLEL

    def __post_init__(self) -> None:
        if (self.incidence_deg is not None or self.rays) and not self.fields_rad:
            raise DomainError(
                "limits on angles of incidence and on rays need fields_rad, the field angles whose rays "
                "count; for example (0.0, 0.35)."
            )
        if not (self.scale_mm > 0 and self.scale_deg > 0):
            raise DomainError(
                f"scales of violations must be positive, got {self.scale_mm} mm and {self.scale_deg} degrees."
            )


def gap_mm(lens: GeoLens, heights: Tensor, semi_aperture_mm: Tensor | None = None) -> Tensor:
    """Distance along the axis between neighbouring surfaces, [S - 1, H] mm, at ``heights`` [H],
    shares of the larger of their semi-apertures."""
    a = lens.semi_aperture_mm if semi_aperture_mm is None else semi_aperture_mm
    y = torch.maximum(a[:-1], a[1:])[:, None] * heights

    def sag(rows):
        return sag_mm(
            y,
            lens.curvature_per_mm[rows, None],
            lens.conic[rows, None],
            [k[:, None] for k in lens.asphere[rows].unbind(1)],
        )

    # behind a mirror its shape is seen from the other side
    side = y.new_tensor([-1.0 if mirror else 1.0 for mirror in lens.mirrors[:-1]])[:, None]
    return lens.thickness_mm[:-1, None] + sag(slice(1, None)) - side * sag(slice(None, -1))


def evaluate(
    lens: GeoLens,
    limits: Limits,
    semi_aperture_mm: Tensor | None = None,
) -> list[Constraint]:
    """All constraints that ``limits`` asks for, a list of Constraint.

    Args:
      semi_aperture_mm: [S] where edges and gaps are measured (may carry a gradient); the lens's own
        when left out. See hits for semi-apertures sized by rays.
    Raises: DomainError for a limit on gaps or edges of surfaces that are tilted, or not on one axis.
    Gradient: to every lens tensor the figure depends on. A least gap has that of its narrowest
      place.
    """
    apertures = lens.semi_aperture_mm if semi_aperture_mm is None else semi_aperture_mm
    parts = _lengths(lens, limits, apertures), _rays(lens, limits)
    return [
        Constraint(name, value, bound, at_least, *scale)
        for part in parts
        for name, value, bound, at_least, *scale in part
        if bound is not None
    ]


def penalty(constraints: Collection[Constraint]) -> Tensor:
    """Sum of the penalties; exactly 0 when all hold."""
    return rows(constraints).square().sum()


def rows(constraints: Collection[Constraint]) -> Tensor:
    """violation / scale of every constraint, [C]: residual rows for least squares whose squares sum
    to ``penalty``."""
    if not constraints:
        raise DomainError("there are no constraints; set at least one limit.")
    return torch.stack([c.row for c in constraints])


def active(constraints: Collection[Constraint], tolerance: float = 1e-3) -> list[Constraint]:
    """The constraints that are violated or bind (within tolerance * scale), the worst first."""
    found = [c for c in constraints if c.state(tolerance) != "free"]
    return sorted(found, key=lambda c: float(c.slack.detach()) / c.scale)


def report(constraints: Collection[Constraint], tolerance: float = 1e-3) -> str:
    """A printable table: every constraint with value, bound, slack and state, the tightest
    first."""
    ordered = sorted(constraints, key=lambda c: float(c.slack.detach()) / c.scale)
    lines = [("constraint", "value", "bound", "slack", "unit", "state")]
    for c in ordered:
        value, slack = float(c.value.detach()), float(c.slack.detach())
        bound = f"{'≥' if c.at_least else '≤'} {c.bound:g}"
        lines.append((c.name, f"{value:.4f}", bound, f"{slack:+.4f}", c.unit, c.state(tolerance)))
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    # names, units and states begin a column, numbers end it
    form = "  ".join(f"{{:{side}{width}}}" for side, width in zip("<>>><<", widths, strict=True))
    return "\n".join(form.format(*line).rstrip() for line in lines)


def is_glass(lens: GeoLens) -> list[bool]:
    """Whether each gap [S] is filled with more than air, judged by its index at the d line."""
    return [n > 1.001 for n in lens.index()[1:].tolist()]


# of a figure: name, value, bound or None, side, scale, unit, whether it can bind
LEAST, MOST = True, False


def _lengths(lens, limits, apertures) -> Iterator[tuple[Any, ...]]:
    """Thicknesses, gaps, lengths and steepness."""
    heights = torch.linspace(0, 1, 33, dtype=lens.dtype, device=apertures.device)
    gaps = gap_mm(lens, heights, apertures)
    lowest, edges = gaps.amin(1), gaps[:, -1]
    unit = limits.scale_mm, "mm"
    shift, tilt = lens.decentre_mm.detach(), lens.tilt_rad.detach()
    apart = ((shift[1:] != shift[:-1]) | (tilt[1:] != 0) | (tilt[:-1] != 0)).any(1).tolist()
    for i, filled in enumerate(is_glass(lens)[:-1]):
        where = f"between surfaces {i + 1} and {i + 2}"
        if filled:
            centre = lens.thickness_mm[i]
            yield f"centre of glass {where}", centre, limits.glass_centre_mm, LEAST, *unit
            yield f"centre of glass {where}", centre, limits.glass_centre_most_mm, MOST, *unit
            yield f"edge of glass {where}", edges[i], limits.glass_edge_mm, LEAST, *unit
        else:
            yield f"air {where}", lowest[i], limits.air_gap_mm, LEAST, *unit
        if (limits.glass_edge_mm if filled else limits.air_gap_mm) is not None and apart[i]:
            raise DomainError(
                f"{lens.name}: of surfaces {i + 1} and {i + 2} one is tilted or decentred against the other, and gaps and "
                "edges all round are not computed; centre it, or leave glass_edge_mm and air_gap_mm out."
            )
    yield "total track", lens.thickness_mm.sum(), limits.track_mm, MOST, *unit
    yield "back focus", lens.thickness_mm[-1], limits.back_focus_mm, LEAST, *unit
    steep = (lens.curvature_per_mm * apertures).abs() * (1 + lens.conic).clamp_min(1e-12).sqrt()
    for i, value in enumerate(steep.unbind(0)):
        yield f"steepness of surface {i + 1}", value, limits.steepness, MOST, 0.1, ""


def _rays(lens, limits) -> Iterator[tuple[Any, ...]]:
    if limits.incidence_deg is None and not limits.rays:
        return
    origin, direction = rim_rays(lens, limits.fields_rad, at_m=limits.at_m)
    if limits.incidence_deg is not None:
        hits = surface_hits(lens, origin, direction)
        sine = (1 - hits.cosine.clamp_max(1).square()).clamp_min(1e-12).sqrt()
        angle = torch.rad2deg(torch.atan2(sine, hits.cosine))
        # a ray that fails is the business of ``rays``
        worst = torch.where(hits.passed, angle, 0.0).amax(1)
        for i, value in enumerate(worst.unbind(0)):
            yield (
                f"incidence on surface {i + 1}",
                value,
                limits.incidence_deg,
                MOST,
                limits.scale_deg,
                "deg",
            )
    if limits.rays:
        # a radicand lacks the deficit: exactly 0 for a ray that passes
        deficit = lens.trace(origin, direction).deficit.sum()
        yield "deficit of rays that fail", deficit, 0.0, MOST, 0.1, "", False
