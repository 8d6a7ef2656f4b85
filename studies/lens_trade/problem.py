"""A lens to be designed under limits: its variables, its spots over field, depth and colour, and its limits as rows.

Both designers of the trade study, by spots and by flow, work on the same variables of the same problem.
"""

import math
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from codesign import lens
from codesign.errors import DomainError
from codesign.grad.jacobian import by_differences
from codesign.lens import WAVELENGTH_UM, GeoLens
from codesign.lens.analysis import pupil_grid
from codesign.lens.design import hold_efl
from codesign.lens.design.constraints import Constraint, Limits, evaluate, rows
from codesign.lens.design.hits import paraxial_semi_aperture_mm
from codesign.lens.hold_efl import holding_surface

PITCH_MM = 18.5e-3  # of a DAVIS346
LINES = ("F", "d", "C")
NEAR_M, FAR_M = 0.3, 5.0
# three Gauss-Legendre nodes over log distance: depths are drawn even in the logarithm
DEPTHS_M = tuple(
    math.sqrt(NEAR_M * FAR_M) * (FAR_M / NEAR_M) ** (t / 2) for t in (-math.sqrt(0.6), 0.0, math.sqrt(0.6))
)
DEPTH_SHARES = (5 / 18, 8 / 18, 5 / 18)
FIELDS = (0.0, 0.4, 0.7, 1.0)
HALF_PUPIL = pupil_grid(8)[pupil_grid(8)[:, 0] > 0]  # the other half is its mirror image
LIMIT_WEIGHT = 3.0
STEP = 1e-6  # of the differences, relative to curvatures and thicknesses in focal lengths
NEAR = 5.0  # a limit is near when its slack is below this many tenths of its scale
MARGIN = 0.1  # of semi-apertures beyond the paraxial beams


@dataclass(frozen=True)
class Weights:
    """What a spot designer makes of fields and depths: weights of the mean square spot.

    field: the corner's weight over the centre's, quadratic between. near: power of the dioptres.
    """

    field: float = 1.0
    near: float = 0.0

    def table(self) -> Tensor:
        """[fields, depths], sum 1."""
        field = torch.tensor([1 + (self.field - 1) * h * h for h in FIELDS], dtype=torch.float64)
        depth = torch.tensor(
            [s * d**-self.near for s, d in zip(DEPTH_SHARES, DEPTHS_M, strict=True)], dtype=torch.float64
        )
        return (field[:, None] * depth) / (field.sum() * depth.sum())


@dataclass(frozen=True)
class Problem:
    """One design task: glasses and stop of ``template``, focal length and aperture held, limits.

    half_field_rad: half diagonal of the sensor in object space. Variables [2 S]: curvatures times the focal length
    (all but one, which holds it), thicknesses but the last over it, and the film's place behind the paraxial focus of
    parallel light over it.
    """

    template: GeoLens
    efl_mm: float
    half_field_rad: float
    limits: Limits

    @property
    def fno(self) -> float:
        return self.efl_mm / self.template.entrance_pupil_diameter_mm

    @property
    def count(self) -> int:
        return len(self.template.surfaces)

    @cached_property
    def holds(self) -> int:
        return holding_surface(self.template)

    def variables(self, geo: GeoLens) -> Tensor:
        """Variables [2 S - 1 + 1] of a lens of this template."""
        c = geo.curvature_per_mm.detach()
        defocus = geo.thickness_mm[-1].detach() - geo.first_order().bfl_mm.detach()
        return torch.cat(
            [
                torch.cat([c[: self.holds], c[self.holds + 1 :]]) * self.efl_mm,
                geo.thickness_mm[:-1].detach() / self.efl_mm,
                defocus.reshape(1) / self.efl_mm,
            ]
        )

    def lens(self, x: Tensor) -> GeoLens:
        """The lens at variables; its semi-apertures follow the paraxial beams. Raises: DomainError where there is none."""
        n = self.count
        c = x[: n - 1] / self.efl_mm
        curvature = torch.cat([c[: self.holds], torch.zeros_like(c[:1]), c[self.holds :]])
        thickness = torch.cat([x[n - 1 : 2 * n - 2] * self.efl_mm, torch.ones_like(x[:1])])
        geo = hold_efl(
            self.template.replace(curvature_per_mm=curvature, thickness_mm=thickness), self.efl_mm, self.holds
        )
        geo = lens.design.focus_paraxial(geo, defocus_mm=x[-1] * self.efl_mm)
        with torch.no_grad():
            reach = paraxial_semi_aperture_mm(geo, self.half_field_rad, MARGIN)
        return with_apertures(geo, reach)

    def spot_rows(self, geo: GeoLens, weights: Weights, lines: tuple[str, ...] = LINES) -> Tensor:
        """Ray errors about the mean of each field and depth over all colours, whose squares sum to the weighted mean
        square spot in pixels^2. NaN where a ray fails."""
        points = self._points()
        pupil = HALF_PUPIL.repeat(points.shape[0], 1)
        points = points.repeat_interleave(HALF_PUPIL.shape[0], 0)
        found = []
        for line in lines:
            film, _, passes = geo.film_points(points, pupil, WAVELENGTH_UM[line])
            found.append(torch.where(passes[:, None], film, math.nan))
        film = torch.stack(found, 1).reshape(len(FIELDS), len(DEPTHS_M), -1, 2)
        centre = film[..., 1].mean(2, keepdim=True)  # the mirrored half brings the mean of x to 0
        error = torch.stack([film[..., 0], film[..., 1] - centre], -1)
        scale = (weights.table() / film.shape[2]).sqrt() / PITCH_MM
        return (error * scale[:, :, None, None]).reshape(-1)

    def spots_px(self, geo: GeoLens) -> Tensor:
        """RMS spots [fields, depths], pixels."""
        flat = Weights()
        return (
            self.spot_rows(geo, flat).reshape(len(FIELDS), len(DEPTHS_M), -1).square().sum(2) / flat.table()
        ).sqrt()

    def constraints(self, geo: GeoLens) -> list[Constraint]:
        return evaluate(geo, self.limits, geo.semi_aperture_mm)

    def limit_rows(self, geo: GeoLens) -> Tensor:
        return LIMIT_WEIGHT * rows(self.constraints(geo))

    def violation(self, geo: GeoLens) -> float:
        """Largest violation of a limit, in units of its scale."""
        return max(float(c.violation.detach()) / c.scale for c in self.constraints(geo))

    def residuals(self, weights: Weights):
        """Function of variables to residuals of the spot designer; NaN where there is no lens."""

        def function(x):
            try:
                geo = self.lens(x)
                return torch.cat([self.spot_rows(geo, weights), self.limit_rows(geo)])
            except DomainError:
                return x.new_full((1,), math.nan)

        return function

    def modes(self, x: Tensor) -> Tensor:
        """[V, V] principal modes of what a change does at x: a unit of each moves the rays by a pixel RMS, or a limit
        that is near by a tenth of its scale, or no variable by more than 0.05."""

        def effects(v):
            geo = self.lens(v)
            pressed = [-c.slack / (0.1 * c.scale) for c in self.constraints(geo)]
            return torch.cat([self.spot_rows(geo, Weights()), torch.stack(pressed).clamp_min(-NEAR)])

        with torch.no_grad():
            moved = by_differences(STEP)(effects, x, effects(x))
        power, directions = torch.linalg.eigh(moved.T @ moved)
        reach = torch.minimum(power.clamp_min(1e-30).rsqrt(), 0.05 / directions.abs().amax(0))
        return directions * reach

    def _points(self):
        tangents = torch.tensor(FIELDS, dtype=torch.float64) * math.tan(self.half_field_rad)
        depths_mm = 1e3 * torch.tensor(DEPTHS_M, dtype=torch.float64)
        y = tangents[:, None] * depths_mm
        return torch.stack([torch.zeros_like(y), y, depths_mm.expand_as(y)], -1).reshape(-1, 3)


def with_apertures(geo: GeoLens, semi_aperture_mm: Tensor) -> GeoLens:
    """The lens with other semi-apertures [S] mm."""
    twin = geo.replace()
    twin._buffers["semi_aperture_mm"] = semi_aperture_mm
    return twin
