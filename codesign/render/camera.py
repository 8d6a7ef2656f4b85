"""A camera: a lens before a pixel grid. Makes camera-space rays and projects points."""

import copy
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import chain
from typing import Any, Protocol

import torch
from torch import Tensor

from codesign.backend import differentiable_once
from codesign.checks import check_finite, check_kind, check_seed, check_whole
from codesign.errors import DomainError, ShapeError, searching
from codesign.render.film import Film, check_memory, coarse_pixels, film_pupil_pattern
from codesign.types import Rays

_NEWTON_STEPS = 12
_STEP_MM = 1e-4
CHECKED_ACROSS = 32
CHECKED_RAYS = 16


class Lens(Protocol):
    """camera_rays(film_mm [N, 2], pupil [N, 2], aim=...) -> Rays [N], as GeoLens has it; ``dtype``
    where it is not float64, ``entrance_pupil_diameter_mm`` where there is an aperture."""

    @property
    def camera_rays(self) -> Callable[..., Rays]: ...


class Camera:
    """A lens (GeoLens, ThinLens or Pinhole: anything with ``camera_rays``) before a film.

    >>> from codesign import lens, render
    >>> camera = render.Camera(lens.load("cooke-triplet").scaled(0.2), 8, 8, 0.5, samples_per_pixel=4)
    >>> camera.check().rays().weight.shape  # 8 x 8 pixels x 4 samples
    torch.Size([256])

    The same seed gives the same film and pupil samples in every frame and for every lens state
    (common random numbers).
    spectrum: anything with wavelengths_um and weights (sum 1), such as lens.Spectrum: each takes an
      equal share of the samples, and chief rays (true flow, ``project``) are those of the mean
      wavelength; None is the d line.
    falloff: whether the natural illumination falloff (cos^4 and pupil growth) darkens the image;
      without it the image is as after flat-field correction.
    aim: whether pupil samples lie on the real stop instead of the paraxial exit pupil; several
      traces more per frame.
    """

    def __init__(
        self,
        lens: Lens,
        width_px: int,
        height_px: int,
        pixel_pitch_mm: float,
        samples_per_pixel: int = 16,
        seed: int = 0,
        film: Film | None = None,
        *,
        spectrum: Any = None,
        falloff: bool = False,
        aim: bool = False,
    ):
        samples_per_pixel = check_whole(samples_per_pixel, "camera: samples_per_pixel")
        if spectrum is not None and not (
            hasattr(spectrum, "wavelengths_um") and hasattr(spectrum, "weights")
        ):
            raise DomainError(
                f"camera: a {type(spectrum).__name__} is no spectrum; give a lens.Spectrum, or None for the "
                "d line."
            )
        if spectrum is not None and samples_per_pixel % len(spectrum.wavelengths_um):
            raise DomainError(
                f"camera: {samples_per_pixel} samples per pixel cannot be shared equally by "
                f"{len(spectrum.wavelengths_um)} wavelengths; make the one a multiple of the other."
            )
        if not hasattr(lens, "camera_rays") or isinstance(lens, type):
            raise DomainError(
                f"camera: a {type(lens).__name__} has no camera_rays, so it is no lens; give a GeoLens, "
                "ThinLens, Pinhole, or an object of your own with camera_rays as GeoLens has it."
            )
        self.lens: Any = lens
        if film is not None:
            check_kind(film, Film, "camera: the film")
            sizes = (film.width_px, film.height_px), tuple(film.sensor_px.int().tolist())
            same = math.isclose(pixel_pitch_mm, film.pixel_pitch_mm, rel_tol=1e-9)
            if (width_px, height_px) not in sizes or not same:
                raise DomainError(
                    f"camera: {width_px} x {height_px} px of {pixel_pitch_mm:g} mm are given beside a film of "
                    f"{film.width_px} x {film.height_px} px of {film.pixel_pitch_mm:g} mm; give the film's own."
                )
        self.samples_per_pixel = samples_per_pixel
        self.seed = check_seed(seed, "camera: seed")
        self._film = (
            film or Film(width_px, height_px, width_px, height_px, pixel_pitch_mm)
        ).check()
        check_memory(self.film, self.samples_per_pixel)
        self.spectrum = spectrum
        self._line = _mean_line(spectrum)
        self.falloff = falloff
        self.aim = aim

    def _with(self, **changes):
        twin = copy.copy(self)
        vars(twin).update(changes)
        return twin

    @property
    def film(self) -> Film:
        """Its pixels, with coordinates on the device of the lens."""
        return replace(self._film, device=device_of(self.lens))

    def with_lens(self, lens: Lens) -> "Camera":
        """The same film and samples behind another lens."""
        return self._with(lens=lens)

    def with_film(self, film: Film) -> "Camera":
        """The same lens and samples before other pixels."""
        return self._with(_film=film.check())

    def with_seed(self, seed: int) -> "Camera":
        """The same lens and film with other samples."""
        return self._with(seed=check_seed(seed, "camera: seed"))

    def with_samples(self, samples_per_pixel: int) -> "Camera":
        """The same lens and film with other numbers of rays per pixel; each colour needs its equal
        share."""
        film, colours = self.film, {"spectrum": self.spectrum, "falloff": self.falloff}
        size = film.width_px, film.height_px, film.pixel_pitch_mm
        made = Camera(self.lens, *size, samples_per_pixel, self.seed, film, aim=self.aim, **colours)
        return made._with(_line=self._line)

    def in_one_colour(self) -> "Camera":
        """The same camera for light of the colour of its chief rays alone, without falloff."""
        return self._with(spectrum=None, falloff=False)

    @property
    def colours(self) -> list[tuple[dict[str, float], float]]:
        """Of each colour what ``camera_rays`` has to be told, and how its light counts beside an
        equal share."""
        if self.spectrum is None:
            return [(self._line, 1.0)]
        lines = self.spectrum.wavelengths_um
        return [
            ({"wavelength_um": line}, weight * len(lines))
            for line, weight in zip(lines, self.spectrum.weights, strict=True)
        ]

    @property
    def aperture_m(self) -> float:
        """Radius of the entrance pupil, metres; 0 without an aperture."""
        return getattr(self.lens, "entrance_pupil_diameter_mm", 0.0) * 1e-3 / 2

    def light(self, rays: Rays, colour: Tensor) -> Tensor:
        """Light [N] that rays in the colours of their numbers ([N], or one of all) bring, less what
        falls off towards the corners.
        Raises: DomainError for a lens that does not say how it does."""
        light = rays.weight
        if self.spectrum is not None:
            light = light * light.new_tensor([share for _, share in self.colours])[colour]
        if not self.falloff:
            return light
        if rays.irradiance is None:
            raise DomainError(
                "camera: this lens does not say how illumination falls off; leave falloff=False."
            )
        return light * rays.irradiance

    def check(self) -> "Camera":
        """Raise DomainError when some pixels of the film get no light at all through the lens;
        returns the camera.

        Pixels on a grid of about CHECKED_ACROSS across the film are looked at, by CHECKED_RAYS rays
        each; no gradient. To be asked once per lens, before the first step of a design.
        """
        every_px = max(1, math.ceil(max(self.film.width_px, self.film.height_px) / CHECKED_ACROSS))
        pixels = coarse_pixels(self.film, every_px)
        _, pupil = film_pupil_pattern(CHECKED_RAYS, self.seed, pixels.device)
        with torch.no_grad():
            rays = self.rays_through(
                pixels.repeat_interleave(CHECKED_RAYS, 0), pupil.repeat(len(pixels), 1)
            )
        dark = (rays.weight.reshape(-1, CHECKED_RAYS) > 0).logical_not().all(1).cpu()
        if bool(dark.any()):
            radius_mm = self.film_mm(pixels).norm(dim=1)
            lit_mm = float(radius_mm[~dark].max()) if not bool(dark.all()) else 0.0
            raise DomainError(
                f"camera: about {float(dark.double().mean()):.0%} of the film's pixels get no light: it "
                f"comes as far as {lit_mm:.3g} mm from the axis, the film reaches "
                f"{float(radius_mm.max()):.3g} mm; make the film or its pixels smaller, or give a lens "
                "with a larger image circle."
            )
        return self

    def film_mm(self, pixels: Tensor) -> Tensor:
        """Upright image position in millimetres of pixel coordinates [N, 2], float64."""
        film = self.film
        return (pixels.to(film.middle_px) - film.middle_px) * film.pixel_pitch_mm

    def __repr__(self):
        pixels = " x ".join(str(size) for size in self.film.shape)
        return (
            f"Camera({self.lens!r}, {pixels} pixels of {self.film.pixel_pitch_mm:g} mm, "
            f"{self.samples_per_pixel} rays each)"
        )

    def given(self, rays: Rays | None) -> Rays:
        """The same rays, or newly traced ones for None. Raises: ShapeError unless they are as many
        as this camera has."""
        if rays is None:
            return self.rays()
        count = math.prod(self.film.shape) * self.samples_per_pixel
        check_kind(rays, Rays, "the rays", "give those of this camera, camera.rays()")
        if rays.weight.numel() != count:
            raise ShapeError(
                f"{rays.weight.numel()} rays for a camera of {math.prod(self.film.shape)} pixels with "
                f"{self.samples_per_pixel} samples each; give the rays of this camera, camera.rays()."
            )
        return rays

    def rays(self) -> Rays:
        """All rays of one frame, pixel after pixel, samples_per_pixel each: Rays with N = pixels x
        samples, in the lens's dtype. Gradient: to the lens."""
        pixels = self.film.pixels()
        offset, pupil = film_pupil_pattern(self.samples_per_pixel, self.seed, pixels.device)
        points = pixels[:, None] + offset
        colours = len(self.colours)
        # samples of one colour stand side by side in every pixel, so no ray is looked up
        shares = zip(points.chunk(colours, 1), pupil.chunk(colours), strict=True)
        parts = [self._rays(number, *share) for number, share in enumerate(shares)]
        if colours == 1:
            return parts[0]

        def joined(*column):
            return torch.cat([part.unflatten(0, (len(pixels), -1)) for part in column], 1).flatten(
                0, 1
            )

        return _columns(joined, *parts)

    def _rays(self, number, points, pupil):
        """Rays of one colour from points [P, n, 2] of the film, through the same points [n, 2] of
        the pupil."""
        dtype = getattr(self.lens, "dtype", torch.float64)
        film_mm = self.film_mm(points).reshape(-1, 2).to(dtype)
        line, _ = self.colours[number]
        rays = self.lens.camera_rays(
            film_mm, pupil.repeat(len(points), 1).to(dtype), aim=self.aim, **line
        )
        return replace(rays, weight=self.light(rays, torch.tensor(number)))

    def coloured_rays(self, pixels: Tensor, pupil: Tensor, colour: Tensor) -> Rays:
        """As ``rays_through``, each in the colour of its number [N]."""
        if self.spectrum is None:
            return self.rays_through(pixels, pupil)
        rows = [torch.nonzero(colour == number)[:, 0] for number in range(len(self.colours))]
        parts = [
            self.rays_through(pixels[row], pupil[row], **line)
            for row, (line, _) in zip(rows, self.colours, strict=True)
        ]
        back = torch.cat(rows).argsort()
        return _columns(lambda *column: torch.cat(column)[back], *parts)

    def chief_rays(self, pixels: Tensor) -> Rays:
        """Rays through the pupil's centre for pixel coordinates [N, 2], of the spectrum's mean
        wavelength (the d line without one): Rays, float64."""
        at_mm = self.film_mm(pixels)
        return self.lens.camera_rays(at_mm, torch.zeros_like(at_mm), aim=self.aim, **self._line)

    def slope_per_px(self) -> float:
        """Slope of a chief ray per pixel, near the axis; no gradient."""
        with torch.no_grad():
            middle = self.film.middle_px
            _, slope = lines(self.chief_rays(middle + middle.new_tensor([[0.0, 0.0], [1.0, 0.0]])))
        return float(slope[1, 0] - slope[0, 0])

    def rays_through(
        self,
        pixels: Tensor,
        pupil: Tensor,
        wavelength_um: float | None = None,
    ) -> Rays:
        """Rays of pixel coordinates [N, 2] through points [N, 2] of the pupil, of one colour (that of
        the chief rays when none is given): Rays, float64. The axial ray goes along: only a lens that
        passes nothing at all is an error."""
        line = self._line if wavelength_um is None else {"wavelength_um": wavelength_um}
        at_mm = self.film_mm(pixels)
        pupil = pupil.to(at_mm)
        axis = at_mm.new_zeros(1, 2)
        film_mm, through = torch.cat([axis, at_mm]), torch.cat([axis, pupil])
        rays = self.lens.camera_rays(film_mm, through, aim=self.aim, **line)
        return _columns(lambda column: column[1:], rays)


def _mean_line(spectrum):
    """What ``camera_rays`` has to be told for light of the mean wavelength of a spectrum."""
    if spectrum is None:
        return {}
    shares = zip(spectrum.wavelengths_um, spectrum.weights, strict=True)
    mean_um = sum(line * share for line, share in shares) / sum(spectrum.weights)
    return {"wavelength_um": mean_um}


def device_of(lens: Any) -> torch.device:
    """Where the tensors of a lens are; the processor for one of the user's own without any."""
    tensors = chain(lens.parameters(), lens.buffers()) if isinstance(lens, torch.nn.Module) else ()
    return next((tensor.device for tensor in tensors), torch.device("cpu"))


def _columns(of, *rays):
    """Rays of which every column is ``of`` those of the given ones; None where one of them does not
    say."""
    columns = zip(*((r.origin_m, r.direction, r.weight, r.irradiance) for r in rays), strict=True)
    found: list[Any] = [
        None if any(v is None for v in column) else of(*column) for column in columns
    ]
    return Rays(*found)


def lines(rays: Rays) -> tuple[Tensor, Tensor]:
    """Rays as places on the entrance pupil's plane [N, 2] metres and slopes [N, 2]; those that run
    aside have slopes of the length of their directions."""
    ahead = rays.direction[:, 2:]
    slope = rays.direction[:, :2] / torch.where(ahead.detach() > 1e-6, ahead, 1)
    return rays.origin_m[:, :2] - rays.origin_m[:, 2:] * slope, slope


def project(camera: Camera, points_cam_m: Tensor, pupil: Tensor | None = None) -> Tensor:
    """Pixel coordinates whose ray through a point of the pupil (the centre when none is given)
    passes through points of space.

    Args: points_cam_m [..., N, 3], camera axes, metres, in front of the camera. pupil: [..., N, 2]
      on the unit disc, or None for chief rays.
    Returns: [..., N, 2] px (the centre of the first pixel is 0, 0), float64; NaN for points that no
      such ray reaches (outside the lens's field).

    >>> from codesign import lens, render
    >>> camera = render.Camera(lens.Pinhole(8.0), 8, 8, pixel_pitch_mm=0.5)
    >>> points = torch.tensor([[0.0, 0.0, 2.0], [0.125, 0.0, 2.0]])  # metres; 8 / 2000 / 0.5 px per mm
    >>> render.project(camera, points).tolist()
    [[3.5, 3.5], [4.5, 3.5]]

    Gradient: to the points and to the lens, by the implicit function theorem (one Newton step with
      gradients at the solution); 0 to NaN points.
    Raises: DomainError when a point is not finite or not in front of the camera; ShapeError.
    """
    points_cam_m = torch.as_tensor(points_cam_m)
    if points_cam_m.ndim < 2 or points_cam_m.shape[-1] != 3:
        raise ShapeError(f"points to project are [..., N, 3], got {tuple(points_cam_m.shape)}.")
    check_finite(points_cam_m, "points to project", "drop them first")
    shape = (*points_cam_m.shape[:-1], 2)
    points_cam_m = points_cam_m.reshape(-1, 3).double()
    if bool((points_cam_m.detach()[:, 2] <= 0).any()):
        raise DomainError("project: some points lie behind the camera (z <= 0); drop them first.")
    pupil = (
        torch.zeros_like(points_cam_m[:, :2]).detach()
        if pupil is None
        else pupil.reshape(-1, 2).to(points_cam_m)
    )
    with torch.no_grad():
        straight = points_cam_m[:, :2] / points_cam_m[:, 2:] / camera.slope_per_px()
        colour = torch.zeros_like(pupil[:, 0], dtype=torch.long)
        guess = camera.film.middle_px + straight
        apart_px = _STEP_MM / camera.film.pixel_pitch_mm
        one = camera.in_one_colour()
        rough = images(one, points_cam_m, pupil, colour, guess, apart_px, 1e-6)
    found = rough.step_px < 1.0  # Newton has come near
    near_px = torch.where(found[:, None], rough.at_px, camera.film.middle_px.to(rough.at_px))
    rays = camera.rays_through(near_px, pupil)
    base, slope = lines(rays)
    miss = base + slope * points_cam_m[:, 2:] - points_cam_m[:, :2]
    change = torch.linalg.solve(rough.m_per_px, torch.where(found[:, None], miss, 0))
    found = (
        found
        & (rays.weight.detach() > 0)
        & (rays.direction.detach()[:, 2] > 1e-6)
        & (change.detach().abs() < 1e-3).all(1)
    )
    at_px = torch.where(found[:, None], near_px - change, torch.nan).reshape(shape)
    return differentiable_once(
        at_px, "project: its gradient has none of its own; use differences of gradients."
    )


@dataclass(frozen=True)
class Images:
    """Where N points are seen: at_px [N, 2]; m_per_px [N, 2, 2], change of the place at that depth
    per pixel; slope [N, 2] of the ray there; step_px [N], the last step of Newton's method,
    infinite where no light passes."""

    at_px: Tensor
    m_per_px: Tensor
    slope: Tensor
    step_px: Tensor


def images(
    camera: Camera,
    points_cam_m: Tensor,
    pupil: Tensor,
    colour: Tensor,
    guess_px: Tensor,
    apart_px: float,
    within_px: float,
) -> Images:
    """Images of points [N, 3] in camera axes through points [N, 2] of the pupil, in the colours of
    their numbers [N].

    By Newton's method from a guess [N, 2] on the rays of the camera, their derivatives by
    differences over ``apart_px``, until a step is below ``within_px``. A step that misses by more,
    or gets no light, is halved; the first is that from the axis to the guess.
    """
    at = camera.film.middle_px.to(guess_px).repeat(len(guess_px), 1)  # the best so far
    step = at - guess_px
    missed_m = torch.full_like(at[:, 0], torch.inf)
    m_per_px = torch.eye(2, dtype=at.dtype, device=at.device).repeat(len(at), 1, 1)
    slope = torch.zeros_like(at)
    step_px = torch.full_like(at[:, 0], torch.inf)
    shifts = apart_px * at.new_tensor([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    rows = torch.arange(len(at), device=at.device)
    for _ in range(_NEWTON_STEPS):
        film_px = (at[rows] - step[rows] + shifts[:, None]).reshape(-1, 2)
        with searching():
            rays = camera.coloured_rays(film_px, pupil[rows].repeat(3, 1), colour[rows].repeat(3))
        origin, direction = (v.reshape(3, -1, 3) for v in (rays.origin_m, rays.direction))
        passes = ((rays.weight.reshape(3, -1) > 0) & (direction[..., 2] > 1e-6)).all(0)
        slopes = direction[..., :2] / torch.where(passes[:, None], direction[..., 2:], 1.0)
        meets = origin[..., :2] + slopes * (points_cam_m[rows, 2:] - origin[..., 2:])
        per_px = torch.stack([meets[1] - meets[0], meets[2] - meets[0]], -1) / apart_px
        miss = meets[0] - points_cam_m[rows, :2]
        miss_m = miss.norm(dim=1)
        better = passes & (miss_m < missed_m[rows])
        better &= torch.linalg.det(per_px).abs() > 1e-12 * per_px.square().sum((1, 2))
        worse, rows, per_px = rows[~better], rows[better], per_px[better]
        at[rows] -= step[rows]
        step[rows] = torch.linalg.solve(per_px, miss[better])
        missed_m[rows] = miss_m[better]
        m_per_px[rows] = per_px
        slope[rows] = slopes[0, better]
        step_px[rows] = step[rows].abs().amax(1)
        step[worse] /= 2
        rows = torch.cat([rows[step_px[rows] >= within_px], worse])
        if not rows.numel():
            break
    return Images(at - step, m_per_px, slope, step_px)


def angular_miss_rad(camera: Camera, pixels: Tensor, points_cam_m: Tensor) -> Tensor:
    """Angle by which the chief rays of pixel coordinates [N, 2] miss points [N, 3] given in camera
    axes: [N] rad.

    A flow error in task units: zero when the pixel images the point, whatever the focal length and
    distortion.
    Gradient: to the pixels, the points and the lens; smooth at zero, where the value is 1e-6 rad
      instead of 0.
    """
    rays = camera.chief_rays(pixels)
    towards = torch.nn.functional.normalize(points_cam_m - rays.origin_m, dim=1)
    return ((towards - rays.direction).square().sum(1) + 1e-12).sqrt()
