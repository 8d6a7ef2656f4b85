"""The rays every analysis of a lens is made of: one field of an object at infinity, traced to the image
plane."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor

from codesign.errors import DomainError, ShapeError
from codesign.lens.glass import WAVELENGTH_UM
from codesign.lens.traced import TracedLens


class SpectralLines(Protocol):
    """Wavelengths (um) and their weights; Spectrum is one."""

    @property
    def wavelengths_um(self) -> Sequence[float]: ...

    @property
    def weights(self) -> Sequence[float]: ...


Values = Sequence[float] | Tensor | np.ndarray
Light = float | Values | SpectralLines  # wavelengths in um, of equal weight where they come alone


def pupil_grid(count: int, dtype: torch.dtype = torch.float64, device: torch.device | str = "cpu") -> Tensor:
    """Cell centres of a count x count grid over [-1, 1]^2 that lie in the unit disc, [M, 2]."""
    line = (torch.arange(count, dtype=dtype, device=device) + 0.5) / count * 2 - 1
    y, x = torch.meshgrid(line, line, indexing="ij")
    points = torch.stack([x.reshape(-1), y.reshape(-1)], 1)
    return points[points.square().sum(1) <= 1]


def field_rays(
    lens: TracedLens,
    field_rad: float,
    pupil: Tensor,
    wavelength_um: float = WAVELENGTH_UM["d"],
    start_z_mm: float = -5.0,
) -> tuple[Tensor, Tensor]:
    """Parallel rays of one field angle (in +y) through points of the paraxial entrance pupil.

    Args: field_rad scalar; pupil [M, 2] on the unit disc (placed at the pupil of the d line). Returns:
      origins and directions [M, 3].
    Gradient: origins to the lens, since the pupil moves with it.
    """
    f = lens.first_order()
    at = torch.cat(
        [pupil * (f.entrance_pupil_diameter_mm / 2), f.entrance_pupil_z_mm.expand(pupil.shape[0], 1)], 1
    )
    direction = torch.tensor(
        [0.0, math.sin(field_rad), math.cos(field_rad)], dtype=pupil.dtype, device=pupil.device
    ).expand(pupil.shape[0], 3)
    return at + direction * ((start_z_mm - at[:, 2:]) / direction[:, 2:]), direction.contiguous()


def source_rays(
    lens: TracedLens, field_rad: float, pupil: Tensor, wavelength_um: float
) -> tuple[Tensor, Tensor]:
    """The rays all analyses start with; the one place that decides where pupil points lie (now: on the
    paraxial entrance pupil)."""
    return field_rays(lens, field_rad, pupil, wavelength_um)


@dataclass(frozen=True)
class ImageRays:
    """Rays of one field and wavelength on a plane across the axis near the image.

    position_mm: [M, 2] (x, y). direction: [M, 3] unit. path_mm: [M] optical path from a plane wavefront of
      the field (one for all rays) to the plane. weight: [M] >= 0, 0 for rays that do not arrive. index:
      refractive index in image space.
    """

    position_mm: Tensor
    direction: Tensor
    path_mm: Tensor
    weight: Tensor
    index: Tensor

    def shifted(self, defocus_mm: float | Tensor) -> "ImageRays":
        """The same rays on a plane ``defocus_mm`` further along +z (scalar, may carry a gradient); rays of
        weight 0 stay where they failed."""
        arrived = self.weight > 0
        length = torch.where(arrived, defocus_mm / torch.where(arrived, self.direction[:, 2], 1), 0)
        return replace(
            self,
            position_mm=self.position_mm + self.direction[:, :2] * length[:, None],
            path_mm=self.path_mm + self.index * length,
        )


def trace_field(
    lens: TracedLens,
    field_rad: float,
    pupil: Tensor,
    wavelength_um: float = WAVELENGTH_UM["d"],
    vignetting: bool = False,
    defocus_mm: float | Tensor = 0.0,
) -> ImageRays:
    """Trace one field (object at infinity, in +y) through pupil points to the image plane.

    Args:
      field_rad: scalar angle. pupil: [M, 2] on the unit disc. vignetting: weigh rays by the apertures' soft
        edges; otherwise every ray that arrives weighs 1. defocus_mm: distance of the plane behind the lens's
        own image plane.
    Returns: ImageRays.
    Gradient: positions, directions and paths to every lens tensor; with vignetting the weights too.
    Raises: DomainError when no ray arrives.
    """
    if pupil.ndim != 2 or pupil.shape[1] != 2 or pupil.shape[0] == 0:
        raise ShapeError(f"pupil points must be [M >= 1, 2], got {tuple(pupil.shape)}.")
    origin, direction = source_rays(lens, field_rad, pupil, wavelength_um)
    out = lens.trace(origin, direction, wavelength_um)
    arrived = (out.status == 0).to(out.weight.dtype)
    weight = out.weight * arrived if vignetting else arrived
    if not bool((weight.detach() > 0).any()):
        raise DomainError(
            f"{lens.name}: no ray arrives at field {math.degrees(field_rad):.4g} degrees; use a smaller "
            "field, weaker curvatures or larger apertures."
        )
    index = lens.index(wavelength_um)
    path = out.optical_path_mm + index[0] * (origin * direction).sum(
        1
    )  # from the plane wavefront through the first vertex
    return ImageRays(out.position_mm[:, :2], out.direction, path, weight, index[-1]).shifted(defocus_mm)


def chief_ray(
    lens: TracedLens,
    field_rad: float,
    wavelength_um: float = WAVELENGTH_UM["d"],
    defocus_mm: float | Tensor = 0.0,
) -> ImageRays:
    """The ray through the centre of the pupil, as ImageRays with M = 1. Raises: DomainError when it does not
    arrive."""
    return trace_field(
        lens,
        field_rad,
        torch.zeros(1, 2, dtype=lens.dtype, device=lens.curvature_per_mm.device),
        wavelength_um,
        defocus_mm=defocus_mm,
    )


def spectral_lines(light: Light) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Wavelengths (um) and weights that sum to 1, from a wavelength, a list of them (equal weights), or
    anything with wavelengths_um and weights.

    Raises: DomainError for no wavelength, one that is not positive, or weights that are negative or sum to 0.
    """
    given: Any = light
    if hasattr(given, "wavelengths_um"):
        wavelengths = [float(w) for w in given.wavelengths_um]
        weights = [float(w) for w in given.weights]
    else:
        wavelengths = [float(given)] if isinstance(given, (int, float)) else [float(w) for w in given]
        weights = [1.0] * len(wavelengths)
    if not wavelengths or len(wavelengths) != len(weights) or not all(0 < w < math.inf for w in wavelengths):
        raise DomainError(
            f"light of wavelengths {wavelengths} um with weights {weights}: give at least one positive "
            "wavelength, and one weight for each."
        )
    total = sum(weights)
    if not (all(w >= 0 for w in weights) and 0 < total < math.inf):
        raise DomainError(f"weights {weights} must be at least 0, with a positive sum.")
    return tuple(wavelengths), tuple(w / total for w in weights)
