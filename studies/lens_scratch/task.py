"""A 50 mm f/5 triplet of 40 degrees from plane plates: variables, residuals, limits, and the
judge."""

import dataclasses
import math

import torch

from codesign import lens
from codesign.errors import DomainError
from codesign.lens import WAVELENGTH_UM, GeoLens, Glass, Surface
from codesign.lens.analysis import field_rays, pupil_grid
from codesign.lens.design.constraints import Constraint, Limits, evaluate, rows
from codesign.lens.design.hits import paraxial_semi_aperture_mm, traced_semi_aperture_mm
from codesign.lens.solves import focus_paraxial, hold_efl

EFL_MM = 50.0
PUPIL_MM = 10.0
HALF_FIELD = math.radians(20.0)
GLASSES = ("N-SK16", "F2", "N-SK16")
STOP = 3  # the rear of the middle element, as in the published lens
LINES = ("F", "d", "C")
JUDGED_FIELDS = (0.0, 0.7 * HALF_FIELD, HALF_FIELD)
SPOT_UNIT_MM = 0.01  # an RMS spot of this size makes a residual of 1
# of differences, 12 evaluations (the reverse mode needs a pass per ray): rays move by some 1e-5 mm,
# with 1e-15 mm rounding
STEPS = torch.tensor([1e-7] * 5 + [1e-5] * 6, dtype=torch.float64)
LIMITS = Limits(
    glass_centre_mm=1.0,
    glass_centre_most_mm=8.0,
    glass_edge_mm=1.0,
    air_gap_mm=0.2,
    track_mm=75.0,
    back_focus_mm=30.0,
    steepness=0.85,
)
JUDGED_LIMITS = dataclasses.replace(LIMITS, incidence_deg=60.0, rays=True, fields_rad=JUDGED_FIELDS)
# a penalty gives way a little, so the optimiser holds limits that are tighter by this much
SPARE_MM = 0.05
LEAST = ("glass_centre_mm", "glass_edge_mm", "air_gap_mm", "back_focus_mm")
MOST = ("glass_centre_most_mm", "track_mm")
CONSTRAINT_WEIGHT = 3.0
HALF_PUPIL = pupil_grid(8)[pupil_grid(8)[:, 0] > 0]  # the other half is its mirror image


@dataclasses.dataclass(frozen=True)
class Stage:
    """A part of the way: shares of the aperture and of the field, the spectral lines, and the most
    steps."""

    aperture: float
    field: float
    lines: tuple[str, ...]
    steps: int


@dataclasses.dataclass(frozen=True)
class Verdict:
    """What a design is worth: RMS spots in um at JUDGED_FIELDS, in F, d, C together; its limits;
    whether every ray passes."""

    geo: GeoLens
    spots_um: tuple[float, ...]
    limits: tuple[Constraint, ...]
    rays_pass: bool

    @property
    def mean_um(self):
        return sum(self.spots_um) / len(self.spots_um)

    @property
    def good(self):
        """Whether every ray passes and every limit holds."""
        return self.rays_pass and all(c.state() != "violated" for c in self.limits)


def _plates():
    """Three plane plates; thicknesses are put in later."""
    media = [Glass.named(GLASSES[i // 2]) if i % 2 == 0 else None for i in range(6)]
    surfaces = [
        Surface(math.inf, 1.0, medium, 10.0, is_stop=i == STOP) for i, medium in enumerate(media)
    ]
    return GeoLens(
        surfaces, PUPIL_MM, name="from-scratch", half_field_deg=math.degrees(HALF_FIELD)
    ).freeze()


PLATES = _plates()


def draw_start(generator):
    """Variables of plates that are plane but for radii of some two metres: glass 1.5 to 6 mm, air 1
    to 12 mm, in focus."""
    curvature = 5e-4 * torch.randn(5, generator=generator, dtype=torch.float64)
    low = torch.tensor([1.5, 1.0, 1.5, 1.0, 1.5], dtype=torch.float64)
    wide = torch.tensor([4.5, 11.0, 4.5, 11.0, 4.5], dtype=torch.float64)
    thickness = low + wide * torch.rand(5, generator=generator, dtype=torch.float64)
    return torch.cat([curvature, thickness, torch.zeros(1, dtype=torch.float64)])


def build(variables):
    """The lens at variables [11]: curvatures 1..5 (per mm), thicknesses 1..5 (mm), defocus (mm).
    Raises:
    DomainError when it has no focal length."""
    curvature = torch.cat([variables[:5], torch.zeros_like(variables[:1])])
    thickness = torch.cat([variables[5:10], torch.ones_like(variables[:1])])
    held = hold_efl(
        PLATES.replace(curvature_per_mm=curvature, thickness_mm=thickness), EFL_MM, surface=5
    )
    return focus_paraxial(held, defocus_mm=variables[10])


def residuals_of(stage, fields=4):
    """The function of variables to residuals of a stage: ray errors in F, d, C about each field's
    mean point, failed rays, limits.

    The squares of the ray errors sum to the mean square spot over fields and lines, in units of
    SPOT_UNIT_MM.
    """
    angles = [stage.field * HALF_FIELD * k / (fields - 1) for k in range(fields)]
    pupil = HALF_PUPIL * stage.aperture
    least = {name: getattr(LIMITS, name) + SPARE_MM for name in LEAST}
    most = {name: getattr(LIMITS, name) - SPARE_MM for name in MOST}
    tight = dataclasses.replace(LIMITS, **least, **most)

    def residuals(variables):
        try:
            geo = build(variables)
        except DomainError:
            return variables.new_full((1,), math.nan)  # no focal length: a failed step
        rays = [field_rays(geo, a, pupil) for a in angles]
        origin, direction = (torch.cat(part) for part in zip(*rays, strict=True))
        traced = [geo.trace(origin, direction, WAVELENGTH_UM[line]) for line in stage.lines]
        # [fields, lines, M, 2]
        position = torch.stack([out.position_mm[:, :2].reshape(fields, -1, 2) for out in traced], 1)
        arrived = torch.stack([(out.status == 0).reshape(fields, -1) for out in traced], 1)
        # x is symmetric, so its mean over the whole pupil is 0
        centre = position[..., 1].mean((1, 2), keepdim=True)
        error = (
            torch.stack([position[..., 0], position[..., 1] - centre], -1)
            * arrived[..., None]
            / (SPOT_UNIT_MM * arrived.numel() ** 0.5)
        )
        failed = torch.cat([out.deficit for out in traced]) * (600 / arrived.numel() ** 0.5)
        apertures = paraxial_semi_aperture_mm(geo, HALF_FIELD * max(stage.field, 0.5), margin=0.1)
        return torch.cat(
            [error.reshape(-1), failed, CONSTRAINT_WEIGHT * rows(evaluate(geo, tight, apertures))]
        )

    return residuals


def polychromatic_spots_um(geo, lines=LINES, grid=32):
    """RMS distance from the mean point of all rays of all lines, um, per judged field. Infinite
    where a ray of the full pupil fails."""
    with torch.no_grad():
        found = [lens.spots(geo, JUDGED_FIELDS, WAVELENGTH_UM[line], grid) for line in lines]
    position = torch.cat([p for p, _ in found], 1)
    arrived = torch.cat([w for _, w in found], 1)
    spread = (position - position.mean(1, keepdim=True)).square().sum(2).mean(1).sqrt() * 1e3
    return tuple(torch.where(arrived.bool().all(1), spread, math.inf).tolist())


def judge(variables):
    """Verdict on variables, with semi-apertures sized by traced rays of the full field and pupil
    plus 5 %; None when it is no lens at all."""
    try:
        geo = build(variables)
        made = geo.replace(
            semi_aperture_mm=traced_semi_aperture_mm(geo, (*JUDGED_FIELDS, -HALF_FIELD))
        ).scaled(1)
    except DomainError:
        return None
    made.freeze()
    spots = polychromatic_spots_um(made)
    return Verdict(
        made, spots, tuple(evaluate(made, JUDGED_LIMITS)), all(map(math.isfinite, spots))
    )
