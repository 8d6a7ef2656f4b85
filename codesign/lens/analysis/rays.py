"""The rays every analysis of a lens is made of: the light of object points, traced to the image
plane."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor

from codesign.checks import check_whole
from codesign.errors import DomainError, ShapeError
from codesign.lens.distance import PARALLEL, Distances, one_distance, vergence_per_mm
from codesign.lens.glass import D_UM
from codesign.lens.paraxial import field_angles
from codesign.lens.traced import TracedLens


class SpectralLines(Protocol):
    """Wavelengths (um) and their weights; Spectrum is one."""

    @property
    def wavelengths_um(self) -> Sequence[float]: ...

    @property
    def weights(self) -> Sequence[float]: ...


Values = Sequence[float] | Tensor | np.ndarray
Light = float | Values | SpectralLines  # wavelengths in um, of equal weight where they come alone


def pupil_grid(
    count: int,
    dtype: torch.dtype = torch.float64,
    device: torch.device | str = "cpu",
) -> Tensor:
    """Cell centres of a count x count grid over [-1, 1]^2 that lie in the unit disc, [M, 2]."""
    count = check_whole(count, "samples across a pupil grid")
    line = (torch.arange(count, dtype=dtype, device=device) + 0.5) / count * 2 - 1
    y, x = torch.meshgrid(line, line, indexing="ij")
    points = torch.stack([x.reshape(-1), y.reshape(-1)], 1)
    return points[points.square().sum(1) <= 1]


@dataclass(frozen=True)
class SourceRays:
    """Rays of object points before the lens, with leading axes [...] of distances and fields.

    origin_mm, direction: [..., M, 3]. path_mm: [..., M] distance from the wavefront of the object
      point that passes through the centre of the entrance pupil; a sphere, or the plane of parallel
      light.
    """

    origin_mm: Tensor
    direction: Tensor
    path_mm: Tensor


def source_rays(
    lens: TracedLens,
    fields_rad: float | Sequence[float] | Tensor,
    pupil: Tensor,
    at_m: Distances = PARALLEL,
    start_z_mm: float = -5.0,
) -> SourceRays:
    """The rays all analyses start with; the one place that decides where pupil points lie (on the
    paraxial entrance pupil of the d line) and where object points do.

    The object point of a field lies on the plane ``at_m`` before the entrance pupil and is seen
    under the field angle from the pupil's centre. Its light reaches the pupil point q along (q /
    distance + (0, tan field), 1), which holds for parallel light too.

    Args:
      fields_rad: an angle in +y, or F of them.
      pupil: [M, 2] on the unit disc.
      at_m: a distance, or D of them; see ``vergence_per_mm``.
      start_z_mm: plane on which the rays are given, from the first vertex.
    Returns: SourceRays with the axes [D, F], as far as several were given.
    Gradient: to the lens, whose pupil moves, and to at_m. Raises: DomainError for a distance inside
      the lens, or a field of 90 degrees and more.
    """
    if pupil.ndim != 2 or pupil.shape[1] != 2 or pupil.shape[0] == 0:
        raise ShapeError(f"pupil points must be [M >= 1, 2], got {tuple(pupil.shape)}.")
    f = lens.first_order()
    fields = field_angles(lens, fields_rad)
    sine, cosine = fields.sin().to(pupil), fields.cos().to(pupil)
    vergence = vergence_per_mm(lens, at_m, f.entrance_pupil_z_mm).reshape(-1, *[1] * fields.ndim)
    # 1 / distance of the object point from the pupil's centre
    near = (vergence * cosine)[..., None]
    x, y = (pupil * (f.entrance_pupil_diameter_mm / 2)).unbind(1)
    # towards q from the point at distance 1 / near along (0, sine, cosine), whose square is 1
    lean = 2 * sine[..., None] * y + near * (x * x + y * y)
    length = (1 + near * lean).sqrt()
    along = (near * x, sine[..., None] + near * y, cosine[..., None])
    direction = torch.stack([(part / length).expand(length.shape) for part in along], -1)
    back = (start_z_mm - f.entrance_pupil_z_mm) / direction[..., 2]
    start = (
        x + direction[..., 0] * back,
        y + direction[..., 1] * back,
        torch.full_like(back, start_z_mm),
    )
    # lean / (length + 1): distance of q from the object, less that of the pupil's centre, free of
    # cancellation
    path = lean / (length + 1) + back
    shape = (*torch.as_tensor(at_m).shape, *fields.shape, pupil.shape[0])
    return SourceRays(
        torch.stack(start, -1).reshape(*shape, 3), direction.reshape(*shape, 3), path.reshape(shape)
    )


def field_rays(
    lens: TracedLens,
    field_rad: float,
    pupil: Tensor,
    wavelength_um: float = D_UM,
    start_z_mm: float = -5.0,
    at_m: float | Tensor = PARALLEL,
) -> tuple[Tensor, Tensor]:
    """Rays of one object point, at one field angle (in +y), through points of the paraxial entrance
    pupil.

    Args: field_rad scalar; pupil [M, 2] on the unit disc (placed at the pupil of the d line for
      every wavelength); at_m: see ``source_rays``.
    Returns: origins and directions [M, 3].
    Gradient: to the lens, since the pupil moves with it, and to at_m.
    """
    rays = source_rays(lens, field_rad, pupil, at_m, start_z_mm)
    return rays.origin_mm, rays.direction


@dataclass(frozen=True)
class ImageRays:
    """Rays of one wavelength on the image plane, with leading axes [...] of distances and fields.

    position_mm: [..., M, 2] (x, y). direction: [..., M, 3] unit. path_mm: [..., M] optical path to
      the plane from the wavefront of the object point through the centre of the entrance pupil.
      weight: [..., M] >= 0, 0 for rays that do not arrive. index: refractive index in image space.
      transmission: [..., M] what the apertures' soft edges let pass.
    """

    position_mm: Tensor
    direction: Tensor
    path_mm: Tensor
    weight: Tensor
    index: Tensor
    transmission: Tensor

    def vignetted(self) -> "ImageRays":
        """The same rays weighed by the apertures too."""
        return replace(self, weight=self.weight * self.transmission)

    def part(self, rays: slice) -> "ImageRays":
        """Some of the rays."""
        return ImageRays(
            self.position_mm[..., rays, :],
            self.direction[..., rays, :],
            self.path_mm[..., rays],
            self.weight[..., rays],
            self.index,
            self.transmission[..., rays],
        )


def trace_field(
    lens: TracedLens,
    field_rad: float | Sequence[float] | Tensor,
    pupil: Tensor,
    wavelength_um: float = D_UM,
    vignetting: bool = False,
    at_m: Distances = PARALLEL,
) -> ImageRays:
    """Trace object points through pupil points to the image plane, in one trace.

    Args:
      field_rad: an angle in +y, or F of them. pupil: [M, 2] on the unit disc. vignetting: weigh
        rays by the apertures' soft edges; otherwise every ray that arrives weighs 1. at_m: metres
        from the entrance pupil to the object plane, or D of them; see ``source_rays``.
    Returns: ImageRays with the axes [D, F, M], D and F as far as several were given.
    Gradient: positions, directions and paths to every lens tensor and to at_m; with vignetting the
      weights too.
    Raises: DomainError when no ray of a field arrives, or for a distance inside the lens.
    """
    rays = trace_source(lens, source_rays(lens, field_rad, pupil, at_m), wavelength_um)
    return _lit(lens, rays.vignetted() if vignetting else rays, field_rad)


def _lit(lens, rays, field_rad):
    """The rays, of which some of every field must arrive."""
    dark = ~(rays.weight.detach() > 0).any(-1)
    if bool(dark.any()):
        fields = torch.as_tensor(field_rad, dtype=torch.float64).expand(dark.shape)
        names = ", ".join(sorted({f"{math.degrees(f):.4g}" for f in fields[dark.cpu()].tolist()}))
        raise DomainError(
            f"{lens.name}: no ray arrives at field {names} degrees; use a smaller "
            "field, weaker curvatures or larger apertures."
        )
    return rays


def trace_source(lens: TracedLens, source: SourceRays, wavelength_um: float) -> ImageRays:
    """ImageRays of source rays on the lens's own image plane, of weight 1 where they arrive; none
    need do so."""
    shape = source.path_mm.shape
    out = lens.trace(
        source.origin_mm.reshape(-1, 3), source.direction.reshape(-1, 3), wavelength_um
    )
    index = lens.index(wavelength_um)
    return ImageRays(
        out.position_mm[:, :2].reshape(*shape, 2),
        out.direction.reshape(*shape, 3),
        out.optical_path_mm.reshape(shape) + index[0] * source.path_mm,
        (out.status == 0).to(out.weight.dtype).reshape(shape),
        index[-1],
        out.weight.reshape(shape),
    )


def trace_with_chief(
    lens: TracedLens,
    field_rad: float,
    pupil: Tensor,
    wavelength_um: float,
    vignetting: bool,
    at_m: float | Tensor,
) -> tuple[ImageRays, ImageRays]:
    """The rays of one field as from ``trace_field``, and its ``chief_ray``, in one trace."""
    one_distance(at_m)
    points = torch.cat([pupil, torch.zeros_like(pupil[:1])])
    both = trace_source(lens, source_rays(lens, field_rad, points, at_m), wavelength_um)
    rays = both.part(slice(-1))
    chief = both.part(slice(-1, None))
    return _lit(lens, rays.vignetted() if vignetting else rays, field_rad), _lit(
        lens, chief, field_rad
    )


def chief_ray(
    lens: TracedLens,
    field_rad: float | Sequence[float] | Tensor,
    wavelength_um: float = D_UM,
    at_m: Distances = PARALLEL,
) -> ImageRays:
    """The ray through the centre of the pupil, as ImageRays with M = 1. Raises: DomainError when it
    does not arrive."""
    centre = torch.zeros(1, 2, dtype=lens.dtype, device=lens.curvature_per_mm.device)
    return trace_field(lens, field_rad, centre, wavelength_um, at_m=at_m)


def working_fno(
    lens: TracedLens, wavelength_um: float = D_UM, at_m: float | Tensor = PARALLEL
) -> Tensor:
    """f-number of the cone that makes the image of an axial point: 1 / (2 NA), NA the index there
    times the sine of half its angle, through all of the pupil that arrives. at_m: of one point, see
    ``trace_field``. Gradient: to every lens tensor. Raises: DomainError when no ray arrives."""
    line = torch.linspace(-1, 1, 33, dtype=lens.dtype, device=lens.curvature_per_mm.device)
    rays = trace_field(lens, 0.0, torch.stack([0 * line, line], 1), wavelength_um, at_m=at_m)
    sine = rays.direction[rays.weight > 0][:, 1]
    return 1 / (rays.index * (sine.max() - sine.min()))


def spectral_lines(light: Light) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Wavelengths (um) and weights that sum to 1, from a wavelength, a list of them
    (equal weights), or anything with wavelengths_um and weights.

    Raises: DomainError for no wavelength, one that is not positive, or weights that are negative or
      sum to 0.
    """
    given: Any = light
    if hasattr(given, "wavelengths_um"):
        wavelengths = [float(w) for w in given.wavelengths_um]
        weights = [float(w) for w in given.weights]
    else:
        wavelengths = (
            [float(given)] if isinstance(given, (int, float)) else [float(w) for w in given]
        )
        weights = [1.0] * len(wavelengths)
    if (
        not wavelengths
        or len(wavelengths) != len(weights)
        or not all(0 < w < math.inf for w in wavelengths)
    ):
        raise DomainError(
            f"light of wavelengths {wavelengths} um with weights {weights}: give at least one positive "
            "wavelength, and one weight for each."
        )
    total = sum(weights)
    if not (all(w >= 0 for w in weights) and 0 < total < math.inf):
        raise DomainError(f"weights {weights} must be at least 0, with a positive sum.")
    return tuple(wavelengths), tuple(w / total for w in weights)
