"""An ideal lens with faults of stated size: what a lens designer is asked to keep small, one number each."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from codesign.errors import DomainError
from codesign.lens.spectrum import LINE_UM
from codesign.types import Rays

CUT = 1 - math.exp(-4.5)  # light of a Gaussian within three standard deviations; none lies beyond
CORE = 0.8  # share of the light in the core of a point image with flare
CORE_RMS = 0.25  # RMS radius of that core over that of the whole


def _disc(inside: Tensor) -> Tensor:
    return (2 * inside).sqrt()


def _gaussian(inside: Tensor) -> Tensor:
    mean_square = 1 + (1 - CUT) * math.log(1 - CUT) / CUT
    return (-torch.log1p(-CUT * inside) / mean_square).sqrt()


def _flare(inside: Tensor) -> Tensor:
    halo_rms = math.sqrt((1 - CORE * CORE_RMS**2) / (1 - CORE))
    core = CORE_RMS * (2 * inside / CORE).sqrt()
    halo = halo_rms * (2 * (inside - CORE).clamp_min(0) / (1 - CORE)).sqrt()
    return torch.where(inside < CORE, core, halo)


@dataclass(frozen=True)
class FaultyLens:
    """A pinhole's image with faults added, for objects at any distance.

    efl_mm: focal length. edge_mm: image height that the faults of the field are stated for.
    blur_mm: RMS radius of the point image, the same over the field; blur: its shape, one of SHAPES: "disc" (even),
      "gaussian" (within three standard deviations) or "flare" (80 % of the light in a core of a quarter of the
      radius, the rest in an even halo).
    distortion_percent: how far an image point at edge_mm lies outside its ideal place, over the ideal height;
      barrel is below 0. It grows as the square of the image height.
    edge_illumination: illumination at edge_mm over that of the axis; the loss grows as the square of the height.
    lateral_colour_mm: height at edge_mm in C light minus that in F light; linear in the wavelength and the height.
    Raises: DomainError for what no lens has.

    >>> lens = FaultyLens(11.0, edge_mm=4.0, distortion_percent=-2.0)
    >>> rays = lens.camera_rays(torch.tensor([[0.0, 4.0]]).double(), torch.zeros(1, 2).double())
    >>> round(float(4.0 / (11.0 * rays.direction[0, 1] / rays.direction[0, 2])), 6)  # place over the ideal one
    0.98
    """

    SHAPES: ClassVar[dict[str, Callable[[Tensor], Tensor]]] = {
        "disc": _disc,
        "gaussian": _gaussian,
        "flare": _flare,
    }
    efl_mm: float
    edge_mm: float
    blur_mm: float = 0.0
    blur: str = "disc"
    distortion_percent: float = 0.0
    edge_illumination: float = 1.0
    lateral_colour_mm: float = 0.0

    def __post_init__(self) -> None:
        if self.blur not in self.SHAPES:
            raise DomainError(f"blur is {self.blur!r}; give one of {', '.join(self.SHAPES)}.")
        allowed = {  # least (itself allowed) and most (not allowed)
            "efl_mm": (1e-6, math.inf),
            "edge_mm": (1e-6, math.inf),
            "blur_mm": (0.0, math.inf),
            "distortion_percent": (-90.0, 50.0),  # from 50 on, two object points share an image point
            "edge_illumination": (1e-6, 1.0 + 1e-12),
            "lateral_colour_mm": (-0.5 * self.edge_mm, 0.5 * self.edge_mm),
        }
        for name, (least, most) in allowed.items():
            value = getattr(self, name)
            if not least <= value < most:
                raise DomainError(
                    f"a faulty lens with {name} = {value}; give a number from {least:g} to below {most:g}."
                )

    @property
    def dtype(self) -> torch.dtype:
        return torch.float64

    def camera_rays(
        self, film_mm: Tensor, pupil: Tensor, wavelength_um: float | None = None, aim: bool = False
    ) -> Rays:
        """Rays towards the scene, all from one point; see GeoLens.camera_rays. The pupil point says which part of
        the point image the ray belongs to. No gradient is made use of.

        Args: film_mm, pupil: [N, 2]. wavelength_um: None is the d line.
        """
        height = film_mm.square().sum(1, keepdim=True) / self.edge_mm**2  # squared, relative to the edge
        share = self.distortion_percent / 100
        ideal = film_mm * (1 - share / (1 + share) * height)
        ideal = (ideal + self._spread(pupil)) / (self.efl_mm * self._magnification(wavelength_um))
        direction = torch.nn.functional.normalize(torch.cat([ideal, torch.ones_like(ideal[:, :1])], 1), dim=1)
        weight = 1 - (1 - self.edge_illumination) * height[:, 0]
        if bool((weight <= 0).any()):
            raise DomainError(
                f"the film reaches {float(height.max().sqrt()) * self.edge_mm:.3g} mm from the axis, where a lens "
                f"with edge_illumination = {self.edge_illumination} at {self.edge_mm:.3g} mm has no light; make "
                "the film smaller or edge_mm larger."
            )
        return Rays(torch.zeros_like(direction), direction, weight)

    def _spread(self, pupil):
        inside = pupil.square().sum(1, keepdim=True).clamp_max(1.0)  # share of the light nearer to the middle
        radius = inside.sqrt()
        outwards = pupil / torch.where(radius > 0, radius, 1)
        return self.blur_mm * self.SHAPES[self.blur](inside) * outwards

    def _magnification(self, wavelength_um):
        if wavelength_um is None:
            return 1.0
        along = (wavelength_um - LINE_UM["d"]) / (LINE_UM["C"] - LINE_UM["F"])
        return 1 + self.lateral_colour_mm / self.edge_mm * along
