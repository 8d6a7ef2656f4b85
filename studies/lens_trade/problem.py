"""A lens to be designed within limits: its variables, its spots over field, depth and colour, and its limits as rows.

Both designers of the trade study, by spots and by flow, work on the same variables of the same problem.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from codesign import lens
from codesign.errors import DomainError
from codesign.grad.jacobian import by_differences
from codesign.lens import WAVELENGTH_UM, GeoLens
from codesign.lens.analysis import pupil_grid
from codesign.lens.analysis.rays import source_rays
from codesign.lens.design import Tolerances, focus_paraxial, focus_rays, hold_efl
from codesign.lens.design.constraints import Constraint, Limits, evaluate, rows
from codesign.lens.design.hits import paraxial_semi_aperture_mm
from codesign.lens.design.tolerance import errors_of, perturbed
from codesign.lens.hold_efl import holding_surface
from studies.lens_opt.task import PITCH_MM

LINES = ("F", "d", "C")
NEAR_M, FAR_M = 0.3, 5.0
# three Gauss-Legendre nodes over the logarithm of distance, in which depths are even
DEPTHS_M = tuple(
    math.sqrt(NEAR_M * FAR_M) * (FAR_M / NEAR_M) ** (t / 2) for t in (-math.sqrt(0.6), 0.0, math.sqrt(0.6))
)
DEPTH_SHARES = (5 / 18, 8 / 18, 5 / 18)
FIELDS = (0.0, 0.4, 0.7, 1.0)
HALF_PUPIL = pupil_grid(8)[pupil_grid(8)[:, 0] > 0]  # the other half is its mirror image
BOTH_SIDES = (-1.0, -0.5, 0.0, 0.5, 1.0)  # fields of a lens with errors, which has no symmetry
WHOLE_PUPIL = pupil_grid(6)
LIMIT_WEIGHT = 3.0
FAILED_WEIGHT = 30.0  # pixels per deficit of a ray that fails
STEP = 1e-6  # of the differences, relative to curvatures and thicknesses in focal lengths
PRESSED = 5.0  # a limit is near when its slack is below this many tenths of its scale
MARGIN = 0.1  # of semi-apertures beyond the paraxial beams


@dataclass(frozen=True)
class Weights:
    """What a spot designer makes of fields and depths: weights of the mean square spot.

    field: the corner's weight over the centre's, quadratic between. near: power of the dioptres.
    """

    field: float = 1.0
    near: float = 0.0

    def table(self, fields: tuple[float, ...] = FIELDS) -> Tensor:
        """[depths, fields], sum 1."""
        field = torch.tensor([1 + (self.field - 1) * h * h for h in fields], dtype=torch.float64)
        depth = torch.tensor(
            [s * d**-self.near for s, d in zip(DEPTH_SHARES, DEPTHS_M, strict=True)], dtype=torch.float64
        )
        return depth[:, None] * field / (field.sum() * depth.sum())


FLAT = Weights()


@dataclass(frozen=True)
class Problem:
    """One design task: glasses and stop of ``template``, focal length and aperture held, limits.

    half_field_rad: half diagonal of the sensor in object space. made: errors of manufacture that every lens gets, or
    None. Variables [2 S - 1]: curvatures times the focal length (all but the one that holds it), thicknesses but the
    last over it, and the film's place behind the paraxial focus of parallel light over it.
    """

    template: GeoLens
    half_field_rad: float
    limits: Limits
    made: Tolerances | None = None

    @cached_property
    def efl_mm(self) -> float:
        return float(self.template.first_order().efl_mm)

    @property
    def fno(self) -> float:
        return self.efl_mm / self.template.entrance_pupil_diameter_mm

    @cached_property
    def holds(self) -> int:
        return holding_surface(self.template)

    def variables(self, geo: GeoLens) -> Tensor:
        """Variables of a lens of this template."""
        c = geo.curvature_per_mm.detach()
        defocus = geo.thickness_mm[-1].detach() - geo.first_order().bfl_mm.detach()
        free = torch.cat([c[: self.holds], c[self.holds + 1 :]]) * self.efl_mm
        return torch.cat(
            [free, torch.cat([geo.thickness_mm[:-1].detach(), defocus.reshape(1)]) / self.efl_mm]
        )

    def lens(self, x: Tensor) -> GeoLens:
        """The lens at variables; its semi-apertures follow the paraxial beams.

        Raises: DomainError where there is none.
        """
        n = len(self.template.surfaces)
        c = x[: n - 1] / self.efl_mm
        curvature = torch.cat([c[: self.holds], torch.zeros_like(c[:1]), c[self.holds :]])
        thickness = torch.cat([x[n - 1 : 2 * n - 2] * self.efl_mm, torch.ones_like(x[:1])])
        shaped = self.template.replace(curvature_per_mm=curvature, thickness_mm=thickness)
        geo = focus_paraxial(hold_efl(shaped, self.efl_mm, self.holds), defocus_mm=x[-1] * self.efl_mm)
        with torch.no_grad():
            reach = paraxial_semi_aperture_mm(geo, self.half_field_rad, MARGIN)
        return geo.replace(semi_aperture_mm=reach)

    def manufactured(self, geo: GeoLens, seed: int) -> GeoLens:
        """The lens with errors of manufacture drawn by ``seed``, refocused as far as it lost its best focus."""
        if self.made is None:
            return geo
        errors = errors_of(geo, self.made)
        draw = torch.randn(len(errors), generator=torch.Generator().manual_seed(seed), dtype=geo.dtype)
        faulty = perturbed(geo, errors, draw)
        fields = tuple(h * self.half_field_rad for h in BOTH_SIDES)
        shift = focus_rays(faulty, fields).thickness_mm[-1] - focus_rays(geo, fields).thickness_mm[-1]
        return faulty.replace(
            thickness_mm=torch.cat([faulty.thickness_mm[:-1], (geo.thickness_mm[-1] + shift).reshape(1)])
        )

    def spot_rows(self, geo: GeoLens, weights: Weights, whole: bool = False) -> tuple[Tensor, Tensor]:
        """Ray errors about the mean of each depth and field over all colours, [depths, fields, M, 2], whose squares sum
        to the weighted mean square spot in pixels^2; and what the rays that fail lack, [K].

        whole: for a lens without symmetry.
        """
        fields = BOTH_SIDES if whole else FIELDS
        pupil = WHOLE_PUPIL if whole else HALF_PUPIL
        tangent = math.tan(self.half_field_rad)
        angles = [math.atan(h * tangent) for h in fields]
        rays = source_rays(geo, angles, pupil, DEPTHS_M)
        start, direction = rays.origin_mm.reshape(-1, 3), rays.direction.reshape(-1, 3)
        traced = [geo.trace(start, direction, WAVELENGTH_UM[line]) for line in LINES]
        shape = (len(DEPTHS_M), len(fields), len(pupil), 2)
        film = torch.cat([out.position_mm[:, :2].reshape(shape) for out in traced], 2)
        arrived = torch.cat([(out.status == 0).reshape(shape[:3]) for out in traced], 2)[..., None]
        seen = film if whole else film[..., 1:]  # the mirrored half brings the mean of x to 0
        centre = (seen * arrived).sum(2, keepdim=True) / arrived.sum(2, keepdim=True).clamp_min(1)
        if not whole:
            centre = torch.nn.functional.pad(centre, (1, 0))
        scale = (weights.table(fields) / film.shape[2]).sqrt() / PITCH_MM
        failed = torch.cat([out.deficit for out in traced]) * (FAILED_WEIGHT / arrived.numel() ** 0.5)
        return (film - centre) * arrived * scale[..., None, None], failed

    def spots_px(self, geo: GeoLens) -> Tensor:
        """RMS spots [depths, fields], pixels."""
        errors, _ = self.spot_rows(geo, FLAT)
        return (errors.square().sum((2, 3)) / FLAT.table()).sqrt()

    def rms_px(self, geo: GeoLens, weights: Weights = FLAT) -> float:
        """Root of the weighted mean square spot, pixels."""
        return float(self.spot_rows(geo, weights)[0].detach().norm())

    def constraints(self, geo: GeoLens) -> list[Constraint]:
        return evaluate(geo, self.limits, geo.semi_aperture_mm)

    def limit_rows(self, geo: GeoLens) -> Tensor:
        return LIMIT_WEIGHT * rows(self.constraints(geo))

    def violation(self, geo: GeoLens) -> float:
        """Largest violation of a limit, in its unit."""
        return max(float(c.violation.detach()) for c in self.constraints(geo))

    def residuals(self, weights: Weights, draws: tuple[int, ...] = ()) -> Callable[[Tensor], Tensor]:
        """Function of variables to residuals of the spot designer: ray errors of the lens, or of the lenses that errors
        of manufacture make of it, failed rays, limits; NaN where there is no lens."""

        def function(x):
            try:
                geo = self.lens(x)
                faulty = [self.manufactured(geo, seed) for seed in draws] or [geo]
                parts = [part for g in faulty for part in self.spot_rows(g, weights, bool(draws))]
                optics = torch.cat([part.reshape(-1) for part in parts]) / len(faulty) ** 0.5
                return torch.cat([optics, self.limit_rows(geo)])
            except DomainError:
                return x.new_full((1,), math.nan)

        return function

    def modes(self, x: Tensor) -> Tensor:
        """[V, V] principal modes of what a change does at x: a unit of each moves the rays by a pixel RMS, or a limit
        that is near by a tenth of its scale, or no variable by more than 0.05."""

        def effects(v):
            geo = self.lens(v)
            slack = torch.stack([c.slack / (0.1 * c.scale) for c in self.constraints(geo)])
            return torch.cat([self.spot_rows(geo, FLAT)[0].reshape(-1), slack.clamp_max(PRESSED)])

        with torch.no_grad():
            moved = by_differences(STEP)(effects, x, effects(x))
        power, directions = torch.linalg.eigh(moved.T @ moved)
        return directions * torch.minimum(power.clamp_min(1e-30).rsqrt(), 0.05 / directions.abs().amax(0))


def scaled_triplet(efl_mm: float, fno: float, half_field_deg: float) -> GeoLens:
    """The published triplet at another size and aperture, frozen."""
    published = lens.load("cooke-triplet")
    surfaces = published.scaled(efl_mm / published.first_order().efl_mm.item()).to_surfaces()
    return GeoLens(surfaces, efl_mm / fno, name="triplet", half_field_deg=half_field_deg).freeze()
