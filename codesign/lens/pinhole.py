"""The cheap fidelity levels of a lens: a pinhole, and a thin lens with defocus. Same interface as the traced
lens."""

import copy

import torch

from codesign.errors import DomainError
from codesign.types import Rays


class ThinLens:
    """Ideal lens of focal length efl_mm and pupil diameter, with the film image_distance_mm behind it.

    Both lengths may be tensors; gradients flow to them.
    """

    def __init__(self, efl_mm, entrance_pupil_diameter_mm, image_distance_mm=None):
        self.efl_mm = torch.as_tensor(efl_mm, dtype=None if torch.is_tensor(efl_mm) else torch.float64)
        self.entrance_pupil_diameter_mm = float(entrance_pupil_diameter_mm)
        self.image_distance_mm = (
            self.efl_mm
            if image_distance_mm is None
            else torch.as_tensor(image_distance_mm, dtype=self.efl_mm.dtype)
        )
        if not (float(self.efl_mm.detach()) > 0 and float(self.image_distance_mm.detach()) > 0):
            raise DomainError(
                f"thin lens: focal length {float(self.efl_mm.detach())} mm and image distance "
                f"{float(self.image_distance_mm.detach())} mm must be positive."
            )
        if not 0 <= self.entrance_pupil_diameter_mm < float("inf"):
            raise DomainError(
                f"thin lens: entrance pupil diameter {self.entrance_pupil_diameter_mm} mm must be finite "
                "and at least 0 (0 is a pinhole)."
            )

    @property
    def dtype(self):
        return self.efl_mm.dtype

    def replace(self, **lengths):
        """The same lens with another efl_mm or image_distance_mm."""
        twin = copy.copy(self)
        for name, value in lengths.items():
            if name not in ("efl_mm", "image_distance_mm"):
                raise DomainError(f"a thin lens has no tensor '{name}'; it has efl_mm and image_distance_mm.")
            setattr(twin, name, torch.as_tensor(value, dtype=self.efl_mm.dtype))
        return twin

    def camera_rays(self, film_mm, pupil, wavelength_um=None, aim=False):
        """Rays towards the scene; see GeoLens.camera_rays (the pupil is ideal, so aiming changes nothing).
        Paraxial refraction: slope out = slope in - q / f."""
        q = pupil * (self.entrance_pupil_diameter_mm / 2)
        inside = (q + film_mm) / self.image_distance_mm
        slope = inside - q / self.efl_mm
        direction = torch.nn.functional.normalize(torch.cat([slope, torch.ones_like(slope[:, :1])], 1), dim=1)
        origin = torch.cat([q, torch.zeros_like(q[:, :1])], 1) * 1e-3
        return Rays(
            origin + 0 * direction,
            direction,
            torch.ones_like(direction[:, 0]),
            (1 + inside.square().sum(1)) ** -2,
        )

    def film_points(self, points_mm, pupil, wavelength_um=None):
        """Where light from points of space meets the film; see GeoLens.film_points (here the pupil points
        stay as they are)."""
        q = pupil * (self.entrance_pupil_diameter_mm / 2)
        inside = (points_mm[:, :2] - q) / points_mm[:, 2:] + q / self.efl_mm
        return inside * self.image_distance_mm - q, pupil, points_mm.detach()[:, 2] > 0


class Pinhole(ThinLens):
    """All rays through one point: no blur, no distortion."""

    def __init__(self, efl_mm):
        super().__init__(efl_mm, 0.0)
