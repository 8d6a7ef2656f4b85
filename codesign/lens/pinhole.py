"""The cheap fidelity levels of a lens: a pinhole, and a thin lens with defocus. Same interface as
the traced lens."""

import math
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from codesign.checks import check_number, check_positive
from codesign.errors import DomainError
from codesign.lens.analysis.rays import pupil_grid
from codesign.lens.replaceable import Replaceable, settled
from codesign.lens.variables import Bound, Kind, checked_step
from codesign.types import Rays


class ThinLens(Replaceable):
    """Ideal lens of focal length efl_mm and pupil diameter, with the film image_distance_mm behind
    it.

    >>> from codesign import lens
    >>> thin = lens.ThinLens(50.0, 10.0)
    >>> float(thin.focus_at(1.0).image_distance_mm)  # 1 / (1 / 50 - 1 / 1000)
    52.631578947368425
    >>> optimiser = torch.optim.Adam(thin.variables("efl", "focus"), lr=0.1)

    Args:
      efl_mm, image_distance_mm: numbers, or tensors that gradients flow to. A number becomes a
        Parameter that asks for no gradient until ``requires_grad_()`` or ``variables``; a tensor
        with a gradient is kept as given. image_distance_mm follows efl_mm when it is None, also in
        what ``replace`` returns.
    Raises: DomainError for lengths that are not positive, or a diameter below 0.
    """

    tensor_names: tuple[str, ...] = ("efl_mm", "image_distance_mm")
    parameter_names = tensor_names
    solved_tensors: ClassVar = {}
    efl_mm: Tensor
    image_distance_mm: Tensor

    def __init__(
        self,
        efl_mm: float | Tensor,
        entrance_pupil_diameter_mm: float,
        image_distance_mm: float | Tensor | None = None,
    ) -> None:
        super().__init__()
        real = torch.is_tensor(efl_mm) and efl_mm.is_floating_point()
        efl = torch.as_tensor(efl_mm, dtype=None if real else torch.float64)
        self._hold("efl_mm", efl)
        image = (
            None
            if image_distance_mm is None
            else torch.as_tensor(image_distance_mm, dtype=efl.dtype)
        )
        self._hold("image_distance_mm", image)
        self.entrance_pupil_diameter_mm = float(entrance_pupil_diameter_mm)
        focal_mm, image_mm = float(self.efl_mm.detach()), float(self.image_distance_mm.detach())
        check_positive(focal_mm, "thin lens: focal length, mm,")
        check_positive(image_mm, "thin lens: image distance, mm,")
        check_number(
            self.entrance_pupil_diameter_mm,
            "thin lens: entrance_pupil_diameter_mm",
            0.0,
            remedy="0 is a pinhole",
        )

    def extra_repr(self) -> str:
        return f"{float(self.efl_mm.detach()):.4g} mm, entrance pupil {self.entrance_pupil_diameter_mm:g} mm"

    def _hold(self, name, value):
        if value is None or isinstance(value, nn.Parameter):
            self.register_parameter(name, value)
        elif value.requires_grad:
            self.register_buffer(name, value)
        else:
            self.register_parameter(name, nn.Parameter(value, requires_grad=False))

    def __getattr__(self, name: str) -> Any:
        found = super().__getattr__(name)
        return self.efl_mm if found is None and name == "image_distance_mm" else found

    def _now(self):
        own = self._parameters, self._buffers, self._made(self._driver)
        held = any(found.get("image_distance_mm") is not None for found in own)
        return super()._now() | ({} if held else {"image_distance_mm": None})

    @property
    def dtype(self) -> torch.dtype:
        return self.efl_mm.dtype

    def variables(
        self,
        *names: str,
        step_mm: float | None = None,
        bounds: Mapping[str, tuple[Bound, Bound]] | None = None,
        fields_rad: Sequence[float] = (0.0, 0.25, 0.35),
    ) -> list[nn.Parameter]:
        """Make "efl", "focus" (the image distance) or both variables for torch.optim; see
        ``GeoLens.variables``.

        The lengths stay positive. Where the image distance follows the focal length, "efl" alone
        moves both.

        >>> from codesign import lens
        >>> pinhole = lens.Pinhole(5.0)
        >>> (efl,) = pinhole.variables("efl", step_mm=0.01)
        >>> efl.shape
        torch.Size([1])
        """
        return self._make_variables(
            names,
            step_mm=checked_step(
                1e-3 * float(self.efl_mm.detach()) if step_mm is None else step_mm
            ),
            bounds=bounds or {},
            mask={},
            fields_rad=fields_rad,
            wavelength_um=None,
            held={},
        )

    def focus_at(self, distance_m: float | Tensor) -> "ThinLens":
        """The lens with its film where a point at ``distance_m`` is imaged, 1 / s' = 1 / f - 1 / s;
        inf is allowed. Gradient: to the focal length and the distance.

        Raises: DomainError for a point that is not beyond the focal length.
        """
        efl = self.efl_mm
        distance_mm = 1e3 * torch.as_tensor(distance_m, dtype=efl.dtype, device=efl.device)
        if not float(distance_mm.detach()) > float(efl.detach()):
            raise DomainError(
                f"thin lens: a point {float(distance_mm.detach()) * 1e-3:.6g} m away lies inside the focal "
                f"length ({float(efl.detach()):.6g} mm), so its light leaves the lens without meeting; "
                "give a larger distance, or a shorter focal length."
            )
        return self.replace(efl_mm=efl, image_distance_mm=1 / (1 / efl - 1 / distance_mm))

    def _identity(self):
        return {"entrance pupil diameter in mm": self.entrance_pupil_diameter_mm}

    def _kinds(self):
        at = torch.zeros(1, dtype=torch.int64, device=self.efl_mm.device)
        reach = 0.1 * self.efl_mm.detach().reshape(1)
        return {
            "efl": Kind("efl_mm", at, reach, 0.0),
            "focus": Kind("image_distance_mm", at, reach, 0.0),
        }

    def _landing(self, fields_rad, wavelength_um):
        q = pupil_grid(8).to(self.efl_mm.detach()) * (self.entrance_pupil_diameter_mm / 2)
        slope = torch.tensor([[0.0, math.tan(f)] for f in fields_rad]).to(q)[:, None]
        landing = (slope + q / self.efl_mm) * self.image_distance_mm - q
        return landing, torch.ones_like(landing[..., 0])

    @settled
    def camera_rays(
        self, film_mm: Tensor, pupil: Tensor, wavelength_um: float | None = None, aim: bool = False
    ) -> Rays:
        """Rays towards the scene; see GeoLens.camera_rays (the pupil is ideal, so aiming changes
        nothing). Paraxial refraction: slope out = slope in - q / f."""
        q = pupil * (self.entrance_pupil_diameter_mm / 2)
        inside = (q + film_mm) / self.image_distance_mm
        slope = inside - q / self.efl_mm
        direction = torch.nn.functional.normalize(
            torch.cat([slope, torch.ones_like(slope[:, :1])], 1), dim=1
        )
        origin = torch.cat([q, torch.zeros_like(q[:, :1])], 1) * 1e-3
        return Rays(
            origin + 0 * direction,
            direction,
            torch.ones_like(direction[:, 0]),
            (1 + inside.square().sum(1)) ** -2,
        )

    @settled
    def film_points(
        self, points_mm: Tensor, pupil: Tensor, wavelength_um: float | None = None
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Where light from points of space meets the film; see GeoLens.film_points (here the pupil
        points stay as they are)."""
        q = pupil * (self.entrance_pupil_diameter_mm / 2)
        inside = (points_mm[:, :2] - q) / points_mm[:, 2:] + q / self.efl_mm
        return inside * self.image_distance_mm - q, pupil, points_mm.detach()[:, 2] > 0


class Pinhole(ThinLens):
    """All rays through one point: no blur, no distortion.

    >>> from codesign import lens
    >>> rays = lens.Pinhole(5.0).camera_rays(torch.tensor([[3.0, 4.0]]).double(), torch.zeros(1, 2).double())
    >>> rays.direction[0, :2] / rays.direction[0, 2]
    tensor([0.6000, 0.8000], dtype=torch.float64)
    """

    def __init__(self, efl_mm: float | Tensor) -> None:
        super().__init__(efl_mm, 0.0)
