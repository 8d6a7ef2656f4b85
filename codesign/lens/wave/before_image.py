"""The field a lens makes on its way to the film, out of its pupil function."""

import math

import torch
from torch import Tensor

from codesign.errors import DomainError
from codesign.lens.analysis.pupil import LARGEST_STEP_WAVES, pupil_function
from codesign.lens.distance import PARALLEL, real_number
from codesign.lens.geolens import GeoLens
from codesign.lens.glass import WAVELENGTH_UM
from codesign.lens.wave.field import Field, check_grid


def before_image(
    lens: GeoLens,
    distance_mm: float | Tensor,
    pitch_mm: float,
    count: int,
    wavelength_um: float = WAVELENGTH_UM["d"],
    grid: int | None = None,
    at_m: float | Tensor = PARALLEL,
) -> Field:
    """Field of an axial object point on a plane ``distance_mm`` before the film, about the axis.

    The pupil function holds the plane waves that the lens sends to the film; each is taken back by its own path.
    A thin element there, of any phase (wrapped, stepped) or amplitude, is ``.times(transmission)``, and
    ``angular_spectrum`` over the same distance goes on to the film.

    >>> from codesign import lens
    >>> from codesign.lens import wave
    >>> geo = lens.load("la1509").replace()  # f/5
    >>> field = wave.before_image(geo, 1.0, pitch_mm=0.0016, count=192, grid=512)
    >>> film = wave.angular_spectrum(field, 1.0)
    >>> [round(float(f.energy.detach()), 2) for f in (field, film)]  # of 1
    [1.0, 0.99]

    Args: grid, at_m: see ``pupil_function``. pitch_mm, count: of the result.
    Returns: Field whose energy is the share of the light on the grid.
    Gradient: to every lens tensor, its plate, distance_mm and at_m.
    Raises: DomainError when the pupil's cells are too coarse for the distance or the size of the result, the pitch
      for the lens's f-number, or as ``pupil_function``; it names what is needed.
    """
    check_grid(count, pitch_mm)
    distance = real_number(distance_mm, "distance in mm")
    pupil = pupil_function(lens, 0.0, wavelength_um, grid, at_m=at_m)
    cells = pupil.field.shape[0]
    like = pupil.cosine_radius
    distance = distance.to(like.device)
    radius = float(like.detach().max())
    coarsest = pupil.wavelength_mm / (2 * radius)
    steepest = abs(float(distance.detach())) * radius / math.sqrt(1 - radius**2)
    needed = math.ceil(
        max(2 * radius * steepest / LARGEST_STEP_WAVES, 2 * radius * count * pitch_mm) / pupil.wavelength_mm
    )
    if pitch_mm > coarsest or cells < needed:
        raise DomainError(
            f"{lens.name}: a field of {count} samples of {pitch_mm:.3g} mm, {float(distance.detach()):.4g} mm before the "
            f"film, asks for a pitch of at most {coarsest:.3g} mm and a pupil grid of at least {needed}, not {cells}."
        )
    line = (torch.arange(cells, dtype=torch.float64, device=like.device) + 0.5) / cells * 2 - 1
    x, y = (line * r for r in like)
    axial = (1 - x.square() - y[:, None].square()).clamp_min(0).sqrt()
    k = 2 * math.pi / pupil.wavelength_mm
    waves = pupil.field * torch.polar(torch.ones_like(axial), -k * distance * axial)
    at = (torch.arange(count, dtype=torch.float64, device=like.device) - count // 2) * pitch_mm
    to_x, to_y = (torch.polar(torch.ones_like(a), a) for a in (k * at[:, None] * c for c in (x, y)))
    cell = (2 / cells) ** 2 * like.prod()  # solid angle of a cell in direction cosines
    power = (pupil.field.real.square() + pupil.field.imag.square()).sum()
    amplitude = (to_y @ waves @ to_x.T) * (cell / power).sqrt() / pupil.wavelength_mm
    return Field(amplitude, pitch_mm, wavelength_um)
