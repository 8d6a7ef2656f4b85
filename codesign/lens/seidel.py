"""Third-order aberrations of each surface: the Seidel sums, and the first-order colour sums.

Conventions: wavefront coefficients in mm, positive where the wavefront is ahead of its reference
  sphere. With pupil and field coordinates rho and h that are 1 at the rims, the wavefront is
    S_I rho^4 / 8 + S_II h rho^3 cos / 2 + S_III h^2 rho^2 cos^2 / 2 + (S_III + S_IV) h^2 rho^2 / 4
    + S_V h^3 rho cos / 2. Undercorrected spherical aberration and the field curvature of a
    converging lens are positive. Field angles enter by their tangent.
Sources: Welford, Aberrations of Optical Systems, ch. 8 to 10 (spheres, aspheres, colour; S_V in the
  form without a quotient); Sweatt, JOSA 67 (1977), for diffractive surfaces as thin layers of
  infinite index.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from codesign.lens.distance import PARALLEL, one_distance, vergence_per_mm
from codesign.lens.geolens import GeoLens
from codesign.lens.glass import D_UM, WAVELENGTH_UM
from codesign.lens.paraxial import ParaxialRays, bending, paraxial_rays

NAMES = ("spherical", "coma", "astigmatism", "petzval", "distortion")


@dataclass(frozen=True)
class SeidelSums:
    """Contributions per surface, [S] mm of wavefront each: S_I spherical, S_II coma, S_III
    astigmatism, S_IV Petzval, S_V distortion, C_I axial and C_II lateral colour (between F and C).
    ``invariant_mm``: Lagrange invariant.
    """

    spherical: Tensor
    coma: Tensor
    astigmatism: Tensor
    petzval: Tensor
    distortion: Tensor
    axial_colour: Tensor
    lateral_colour: Tensor
    invariant_mm: Tensor

    @property
    def per_surface(self) -> Tensor:
        """[S, 5] mm: S_I to S_V of each surface."""
        return torch.stack([getattr(self, name) for name in NAMES], 1)

    @property
    def total(self) -> Tensor:
        """[5] mm: S_I to S_V of the lens."""
        return self.per_surface.sum(0)


def seidel_sums(
    lens: GeoLens,
    field_rad: float,
    wavelength_um: float = D_UM,
    at_m: float | Tensor = PARALLEL,
) -> SeidelSums:
    """SeidelSums of a lens for an object plane.

    Spheres, conics, the r^2 and r^4 asphere terms, mirrors, and the first two diffractive terms;
    decentres and tilts do not count.

    Args:
      field_rad: half field.
      wavelength_um: of the monochromatic sums; those of colour are between F and C.
      at_m: metres from the entrance pupil to the object, inf for parallel light; the pupil's
        diameter is the lens's at every distance.
    Gradient: to every lens tensor and to at_m. Raises: DomainError, see ``paraxial_rays`` and
      ``distance.vergence_per_mm``.
    """
    rays = paraxial_rays(lens, field_rad, wavelength_um, vergence_per_mm(lens, one_distance(at_m)))
    index = lens.index(wavelength_um)
    path = _column(lens.path_mm(wavelength_um), 0), _column(lens.path_mm(wavelength_um), 1)
    power = -2 * path[0]  # of the diffractive layer, in the medium before the surface
    curvature = lens.curvature_per_mm + 2 * _column(lens.asphere, 0)
    layer = _thin_layer(rays, index[:-1], curvature, power, path[1])
    sphere = _refraction(rays, index, lens.mirrors, curvature, power)
    # r^4 beyond the osculating sphere
    figure = (
        (1 + lens.conic) * lens.curvature_per_mm**3 / 8
        + _column(lens.asphere, 1)
        - curvature**3 / 8
    )
    plate = _plate(rays, 8 * figure * bending(index, lens.mirrors))
    monochromatic = {
        name: a + b + c for name, a, b, c in zip(NAMES, layer, sphere, plate, strict=True)
    }
    axial, lateral = _colour(lens, rays, index, curvature, power)
    return SeidelSums(
        **monochromatic, axial_colour=axial, lateral_colour=lateral, invariant_mm=rays.invariant_mm
    )


def _column(table, i):
    """Column i of [S, terms], zeros where there are fewer."""
    return table[:, i] if table.shape[1] > i else torch.zeros_like(table.sum(1))


def _invariants(rays, index, curvature, power):
    """Refraction invariants A and A_bar of the marginal and chief ray between a layer of ``power``
    and the surface behind it, [S] each."""
    reduced = [
        angle[:-1] * index[:-1] - y * power
        for angle, y in (
            (rays.marginal_angle, rays.marginal_height_mm),
            (rays.chief_angle, rays.chief_height_mm),
        )
    ]
    return [
        nu + index[:-1] * curvature * y
        for nu, y in zip(reduced, (rays.marginal_height_mm, rays.chief_height_mm), strict=True)
    ], reduced


def _refraction(rays: ParaxialRays, index, mirrors, curvature, power):
    """S_I to S_V of spheres. Behind a mirror n u keeps its value and n turns its sign, so that u /
    n = n u / n^2 is the unfolded one."""
    y = rays.marginal_height_mm
    y_bar = rays.chief_height_mm
    H = rays.invariant_mm
    (A, A_bar), (nu, _) = _invariants(rays, index, curvature, power)
    after = rays.marginal_angle[1:] / index[1:]
    jump = after - nu / index[:-1].square()  # of u / n
    mirror = torch.tensor(mirrors, device=index.device)
    jump_1 = torch.where(mirror, -2 / index[:-1], 1 / index[1:] - 1 / index[:-1])  # of 1 / n
    jump_2 = 1 / index[1:].square() - 1 / index[:-1].square()
    fifth = A_bar * y_bar * (A_bar * y + H) * curvature * jump_1 - A_bar**3 * y * jump_2
    return (
        -A * A * y * jump,
        -A * A_bar * y * jump,
        -A_bar * A_bar * y * jump,
        -H * H * curvature * jump_1,
        fifth,
    )


def _thin_layer(rays: ParaxialRays, n, curvature, power, path_r4):
    """S_I to S_V of a diffractive layer in a medium n: two surfaces around an infinite index, and
    the phase that differs from theirs in r^4."""
    y = rays.marginal_height_mm
    y_bar = rays.chief_height_mm
    H = rays.invariant_mm
    angle = rays.marginal_angle[:-1] * n
    chief = rays.chief_angle[:-1] * n
    A = angle + n * curvature * y
    A_bar = chief + n * curvature * y_bar
    B = A - y * power
    B_bar = A_bar - y_bar * power
    nu = angle - y * power
    scale = y / n.square()
    sums = [
        scale * (A * A * angle - B * B * nu),
        scale * (A * A_bar * angle - B * B_bar * nu),
        scale * (A_bar * A_bar * angle - B_bar * B_bar * nu),
    ]
    distortion = scale * (A_bar**3 - B_bar**3) + y_bar * curvature / n * (
        B_bar * (B_bar * y + H) - A_bar * (A_bar * y + H)
    )
    # two spheres have the path -power (r^2 / 2 + curvature^2 r^4 / 8); the phase has no such r^4
    # term of its own
    plate = _plate(rays, -8 * path_r4 - power * curvature.square())
    return [s + p for s, p in zip([*sums, torch.zeros_like(y), distortion], plate, strict=True)]


def _plate(rays, strength):
    """S_I to S_V of a plate whose wavefront is strength r^4 / 8."""
    y = rays.marginal_height_mm
    y_bar = rays.chief_height_mm
    return [
        strength * y**4,
        strength * y**3 * y_bar,
        strength * (y * y_bar).square(),
        torch.zeros_like(y),
        strength * y * y_bar**3,
    ]


def _colour(lens, rays, index, curvature, power):
    """C_I and C_II, [S] each: A y jump(dn / n) of the refraction, and y^2 times the spread of the
    diffractive power."""
    (A, A_bar), _ = _invariants(rays, index, curvature, power)
    y = rays.marginal_height_mm
    y_bar = rays.chief_height_mm
    short, long = WAVELENGTH_UM["F"], WAVELENGTH_UM["C"]
    jump = ((lens.index(short) - lens.index(long)) / index).diff()
    layer = -2 * _column(lens.path_mm(short) - lens.path_mm(long), 0)
    return y * (A * jump + y * layer), y * (A_bar * jump + y_bar * layer)
