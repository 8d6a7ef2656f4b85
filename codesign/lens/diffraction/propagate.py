"""Free-space propagation of sampled fields: by their angular spectrum, and by a Fresnel transform with a
grid of its own for beams that converge.

Both are differentiable, to the field and to the distance. What a grid cannot hold is refused, never folded
back into the picture.
"""

import math
from dataclasses import replace

import torch
from torch import Tensor

from codesign.errors import DomainError
from codesign.lens.diffraction.field import Field, check_grid
from codesign.lens.distance import real_number, real_numbers

LOST = 1e-2  # share of the light that may leave the grid unless more is allowed
# a field is taken as undersampled when more than the second share of its light lies beyond the first of the
# highest frequency that its pitch holds
NEAR_LIMIT = 0.9
UNRESOLVED = 1e-2
HELD = 0.999  # share of the light that a window named in an error is to hold


def angular_spectrum(
    field: Field, distance_mm: float | Tensor, padding: int = 3, may_leave: float = LOST
) -> Field:
    """The field ``distance_mm`` further along +z on the same grid, without a paraxial approximation.

    The grid is zero-padded, its plane waves get exp(i z sqrt(k^2 - kx^2 - ky^2)), and those so steep that
    they leave the padded grid are faded out, as they would come in again from the other side (a sharp limit,
    as Matsushima and Shimobaba have it, rings by 1e-3 behind hard edges).

    Args: padding: >= 2 times the grid; 1 takes the field as periodic, so nothing leaves. distance_mm: number
      or scalar tensor, negative for backwards. may_leave: share of the light, in [0, 1], that may leave the
      grid.
    Returns: Field of the same pitch and count. Evanescent waves decay either way.
    Gradient: to the field and the distance.
    Raises: DomainError when the pitch is too coarse for the field, or more light than allowed leaves the
      grid; it names the size that is needed.
    Source: Matsushima and Shimobaba, Band-limited angular spectrum method, Optics Express 17 (2009).
    """
    if not isinstance(padding, int) or padding < 1:
        raise DomainError(f"padding {padding} must be a whole number of at least 1 (1: periodic).")
    count = field.count
    wide = count * int(padding)
    spectrum = torch.fft.fft2(field.amplitude, s=(wide, wide))
    real = field.amplitude.real
    # direction cosines
    step = torch.fft.fftfreq(wide, dtype=torch.float64, device=real.device) * (
        field.wavelength_mm / field.pitch_mm
    )
    power = spectrum.detach().abs().square()
    check_resolved(power, field)
    cosine2 = 1 - step.square() - step[:, None].square()
    axial = cosine2.abs().clamp_min(1e-12).sqrt()
    length = real_number(distance_mm, "distance in mm").to(real.device)
    k = 2 * math.pi / field.wavelength_mm
    travels = cosine2 > 0
    transfer = torch.polar(
        torch.where(travels, 1.0, torch.exp(-k * axial * length.abs())),
        torch.where(travels, k * axial * length, 0.0),
    )
    if padding > 1:
        transfer = transfer * _stays(
            step, axial, length.detach(), count * field.pitch_mm, wide * field.pitch_mm
        )
    out = torch.fft.ifft2(spectrum * transfer.to(spectrum.dtype))[..., :count, :count]
    found = replace(field, amplitude=out)
    if padding > 1:
        _check_kept(field, found, power, step, float(length.detach()), may_leave)
    return found


def fresnel(
    field: Field,
    distance_mm: float | Tensor,
    pitch_mm: float,
    count: int,
    focus_mm: float | Tensor = math.inf,
) -> Field:
    """The field ``distance_mm`` further along +z on a grid of one's own, in the Fresnel approximation.

    ``focus_mm`` takes out what a grid cannot sample: the amplitude given is that on a sphere about the point
    of the axis ``focus_mm`` behind the field's plane, so that the true field is amplitude x exp(-i k r^2 / 2
    focus). With ``focus_mm = distance_mm`` what is left is a Fourier transform: the focal plane of a lens.
    The sums are two matrix products with kernels that separate in x and y.

    The paths are parabolas instead of roots: rays from r to x err by (r - x)^4 / 8 z^3, except in what a
    sphere takes out.

    Args: distance_mm, focus_mm: numbers or scalar tensors, not 0. pitch_mm, count: the grid of the
      result.
    Returns: Field. Gradient: to the field and both lengths.
    Raises: DomainError when the pitch is too coarse for the phase of field and paths, or the result is wider
      than the wavelength x distance / pitch after which it repeats; it names the pitch that is needed.
    Source: Goodman, Introduction to Fourier Optics, ch. 4.
    """
    real = field.amplitude.real
    check_grid(count, pitch_mm)
    length = real_number(distance_mm, "distance in mm").to(real.device)
    focus = real_numbers(focus_mm, "focus in mm").to(length)
    if focus.ndim or float(length.detach()) == 0 or float(focus.detach()) == 0 or bool(focus.isnan()):
        raise DomainError(
            f"distance {distance_mm} mm and focus {focus_mm} mm must be single numbers, neither of them 0; "
            "use "
            "angular_spectrum for short distances."
        )
    at = field.places_mm().double()
    to = (torch.arange(count, dtype=torch.float64, device=real.device) - count // 2) * pitch_mm
    period = field.wavelength_mm * abs(float(length.detach())) / field.pitch_mm
    if count * pitch_mm > period:
        raise DomainError(
            f"a result of {count * pitch_mm:.3g} mm is wider than the {period:.3g} mm after which it "
            "repeats at a "
            f"pitch of {field.pitch_mm:.3g} mm; a pitch of "
            f"{field.pitch_mm * period / (count * pitch_mm):.3g} mm is "
            "needed, or a smaller result."
        )
    bend = 1 / length - 1 / focus
    chirp = torch.polar(torch.ones_like(at), math.pi / field.wavelength_mm * bend.detach() * at.square())
    left = field.amplitude.detach() * (chirp * chirp[:, None]).to(field.amplitude.dtype)  # what is summed
    check_resolved(torch.fft.fft2(left).abs().square(), field)
    phase = (math.pi / field.wavelength_mm) * (
        (to[:, None].square() - 2 * to[:, None] * at) / length + bend * at.square()
    )
    kernel = torch.polar(torch.ones_like(phase), phase).to(field.amplitude.dtype)
    k = 2 * math.pi / field.wavelength_mm
    scale = field.pitch_mm**2 / (field.wavelength_mm * length)
    carrier = torch.polar(torch.ones_like(scale), k * length - math.pi / 2) * scale
    amplitude = (kernel @ field.amplitude @ kernel.T) * carrier.to(field.amplitude.dtype)
    return Field(amplitude, pitch_mm, field.wavelength_um)


def check_resolved(power: Tensor, field: Field) -> None:
    """Raise DomainError when much of a spectrum's energy (power [..., M, M], in the order of ``fft2``) lies
    near the highest frequency of its grid, so that phases turn by about half a wave from sample to sample."""
    outer = torch.fft.fftfreq(power.shape[-1], device=power.device).abs() > 0.5 * NEAR_LIMIT
    beyond = (power * (outer | outer[:, None])).sum((-2, -1)) / power.sum((-2, -1)).clamp_min(1e-300)
    if float(beyond.max()) > UNRESOLVED:
        raise DomainError(
            "the phase of the field turns by about half a wave from sample to sample "
            f"({float(beyond.max()):.0%} of "
            f"its light lies at the limit of a pitch of {field.pitch_mm:.3g} mm); give a pitch of "
            f"{field.pitch_mm / 2:.3g} mm or less, or take a sphere out and use fresnel with its focus."
        )


def _stays(step, axial, length, size_mm, padded_mm):
    """Weight of each plane wave, [M, M]: 1 while it moves light by at most the grid's size, 0 where that
    light comes in again from the other side."""
    rows = []
    for cosine in (step[None], step[:, None]):
        shift = (length * cosine / axial).abs()
        room = padded_mm - 2 * size_mm
        if room > 0:
            u = ((shift - size_mm) / room).clamp(0, 1)
            rows.append(1 - u * u * (3 - 2 * u))
        else:
            rows.append((shift <= size_mm).to(step.dtype))
    return rows[0] * rows[1]


def _check_kept(field, found, power, step, length, may_leave):
    """Raise DomainError when more light than allowed is not on the grid any more."""
    before = field.energy.detach()
    # a dark one loses none
    left = float(torch.where(before > 0, 1 - found.energy.detach() / before, 0).max())
    if left <= may_leave:
        return
    along = power.sum(-1) + power.sum(-2)
    while along.ndim > 1:
        along = along.sum(0)
    order = step.abs().argsort()
    share = along[order].cumsum(0) / along.sum()
    steepest = float(step.abs()[order][int((share < HELD).sum().clamp_max(len(step) - 1))])
    size = field.count * field.pitch_mm
    spread = 2 * abs(length) * steepest / math.sqrt(max(1 - steepest**2, 1e-6))
    raise DomainError(
        f"{left:.2%} of the light leaves the grid of {size:.3g} mm within {abs(length):.4g} mm, and "
        f"{may_leave:.2%} may; "
        f"a grid of {size + spread:.3g} mm ({math.ceil((size + spread) / field.pitch_mm)} samples) holds "
        "nearly all of "
        "it: make it larger, or allow more with may_leave."
    )
