"""A camera: a lens before a pixel grid. Makes camera-space rays and projects points."""

import copy
import math
from collections.abc import Callable
from dataclasses import fields, replace
from typing import Any, Protocol

import torch
from torch import Tensor

from codesign.errors import DomainError, ShapeError, check_finite, check_seed, check_whole
from codesign.render.film import Film, check_memory, coarse_pixels, film_pupil_pattern
from codesign.types import Rays

_NEWTON_STEPS = 8
_STEP_MM = 1e-4
# a first guess beyond the lens's field is drawn towards the axis this often, by this factor
_SHRINK_STEPS = 3
_SHRINK = 0.85
CHECKED_ACROSS = 32
CHECKED_RAYS = 16


class Lens(Protocol):
    """camera_rays(film_mm [N, 2], pupil [N, 2], aim=...) -> Rays [N], as GeoLens has it; ``dtype`` where it is
    not float64, ``film_points`` for a first guess where gradients of silhouettes are asked for,
    ``entrance_pupil_diameter_mm`` where there is an aperture."""

    @property
    def camera_rays(self) -> Callable[..., Rays]: ...


class Camera:
    """A lens (GeoLens, ThinLens or Pinhole: anything with ``camera_rays``) before a film.

    >>> from codesign import lens, render
    >>> camera = render.Camera(lens.load("cooke-triplet").scaled(0.2), 8, 8, pixel_pitch_mm=0.5, samples_per_pixel=4)
    >>> camera.check().rays().weight.shape  # 8 x 8 pixels x 4 samples
    torch.Size([256])

    The same seed gives the same film and pupil samples in every frame and for every lens state (common random
    numbers).
    spectrum: anything with wavelengths_um and weights (sum 1), such as lens.Spectrum: each takes an equal
      share of the samples; None is the d line.
    falloff: whether the natural illumination falloff (cos^4 and pupil growth) darkens the image; without it
      the image is as after flat-field correction.
    aim: whether pupil samples lie on the real stop instead of the paraxial exit pupil; several traces more
      per frame.
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
                f"camera: a {type(spectrum).__name__} is no spectrum; give a lens.Spectrum, or None for the d line."
            )
        if spectrum is not None and samples_per_pixel % len(spectrum.wavelengths_um):
            raise DomainError(
                f"camera: {samples_per_pixel} samples per pixel cannot be shared equally by "
                f"{len(spectrum.wavelengths_um)} wavelengths; make the one a multiple of the other."
            )
        if not hasattr(lens, "camera_rays") or isinstance(lens, type):
            raise DomainError(
                f"camera: a {type(lens).__name__} has no camera_rays, so it is no lens; give a GeoLens, ThinLens, "
                "Pinhole, or an object of your own with camera_rays as GeoLens has it."
            )
        self.lens: Any = lens
        if film is not None and not isinstance(film, Film):
            raise DomainError(f"camera: a {type(film).__name__} is no film; give a render.Film, or None.")
        self.samples_per_pixel = samples_per_pixel
        self.seed = check_seed(seed, "camera: seed")
        self.film = (film or Film(width_px, height_px, width_px, height_px, pixel_pitch_mm)).check()
        check_memory(self.film, self.samples_per_pixel)
        self.spectrum = spectrum
        self.falloff = falloff
        self.aim = aim

    def with_lens(self, lens: Lens) -> "Camera":
        """The same film and samples behind another lens."""
        twin = copy.copy(self)
        twin.lens = lens
        return twin

    def with_film(self, film: Film) -> "Camera":
        """The same lens and samples before other pixels."""
        twin = copy.copy(self)
        twin.film = film.check()
        return twin

    def with_seed(self, seed: int) -> "Camera":
        """The same lens and film with other samples."""
        twin = copy.copy(self)
        twin.seed = check_seed(seed, "camera: seed")
        return twin

    def check(self) -> "Camera":
        """Raise DomainError when some pixels of the film get no light at all through the lens; returns the
        camera.

        Pixels on a grid of about CHECKED_ACROSS across the film are looked at, by CHECKED_RAYS rays each; no
        gradient. To be asked once per lens, before the first step of a design.
        """
        every_px = max(1, math.ceil(max(self.film.width_px, self.film.height_px) / CHECKED_ACROSS))
        pixels = coarse_pixels(self.film, every_px)
        _, pupil = film_pupil_pattern(CHECKED_RAYS, self.seed)
        with torch.no_grad():
            rays = self.rays_through(pixels.repeat_interleave(CHECKED_RAYS, 0), pupil.repeat(len(pixels), 1))
        dark = (rays.weight.reshape(-1, CHECKED_RAYS) > 0).logical_not().all(1).cpu()
        if bool(dark.any()):
            radius_mm = self.film_mm(pixels).norm(dim=1)
            lit_mm = float(radius_mm[~dark].max()) if not bool(dark.all()) else 0.0
            raise DomainError(
                f"camera: about {float(dark.double().mean()):.0%} of the film's pixels get no light: it comes as "
                f"far as {lit_mm:.3g} mm from the axis, the film reaches {float(radius_mm.max()):.3g} mm; make "
                "the film or its pixels smaller, or give a lens with a larger image circle."
            )
        return self

    def film_mm(self, pixels: Tensor) -> Tensor:
        """Upright image position in millimetres of pixel coordinates [N, 2]."""
        return (pixels - self.film.middle_px.to(pixels)) * self.film.pixel_pitch_mm

    def given(self, rays: Rays | None) -> Rays:
        """The same rays, or newly traced ones for None. Raises: ShapeError unless they are as many as this
        camera has."""
        if rays is None:
            return self.rays()
        count = math.prod(self.film.shape) * self.samples_per_pixel
        if not isinstance(rays, Rays):
            raise DomainError(
                f"a {type(rays).__name__} was given as rays; give those of this camera, camera.rays()."
            )
        if rays.weight.numel() != count:
            raise ShapeError(
                f"{rays.weight.numel()} rays for a camera of {math.prod(self.film.shape)} pixels with "
                f"{self.samples_per_pixel} samples each; give the rays of this camera, camera.rays()."
            )
        return rays

    def rays(self) -> Rays:
        """All rays of one frame, pixel after pixel, samples_per_pixel each: Rays with N = pixels x samples,
        in the lens's dtype. Gradient: to the lens."""
        offset, pupil = film_pupil_pattern(self.samples_per_pixel, self.seed)
        if self.spectrum is None:
            rays = self._rays(offset, pupil)
            light = None
        else:
            colours = len(self.spectrum.wavelengths_um)
            parts = [
                self._rays(o, p, wavelength_um=w)
                for w, o, p in zip(
                    self.spectrum.wavelengths_um, offset.chunk(colours), pupil.chunk(colours), strict=True
                )
            ]
            rays = Rays(*(self._joined([getattr(part, f.name) for part in parts]) for f in fields(Rays)))
            light = (
                torch.tensor(self.spectrum.weights)
                .repeat_interleave(self.samples_per_pixel // colours)
                .to(rays.weight)
                .repeat(self.film.pixels().shape[0])
                * colours
            )
        weight = rays.weight if light is None else rays.weight * light
        if self.falloff:
            if rays.irradiance is None:
                raise DomainError(
                    "camera: this lens does not say how illumination falls off; leave falloff=False."
                )
            weight = weight * rays.irradiance
        return replace(rays, weight=weight)

    def _rays(self, offset, pupil, **wavelength):
        pixels = self.film.pixels()
        dtype = getattr(self.lens, "dtype", torch.float64)
        points = (pixels[:, None] + offset).reshape(-1, 2)
        return self.lens.camera_rays(
            self.film_mm(points).to(dtype),
            pupil.repeat(pixels.shape[0], 1).to(dtype),
            aim=self.aim,
            **wavelength,
        )

    def _joined(self, parts):
        """What rays of several colours have, pixel after pixel; None where they do not say."""
        if any(part is None for part in parts):
            return None
        pixels = self.film.pixels().shape[0]
        return torch.cat([part.reshape(pixels, -1, *part.shape[1:]) for part in parts], 1).flatten(0, 1)

    def chief_rays(self, pixels: Tensor) -> Rays:
        """Rays through the pupil's centre for pixel coordinates [N, 2]: Rays, float64."""
        return self.lens.camera_rays(self.film_mm(pixels), torch.zeros_like(pixels))

    def slope_per_px(self) -> float:
        """Slope of a chief ray per pixel, near the axis; no gradient."""
        with torch.no_grad():
            rays = self.chief_rays(
                self.film.middle_px + torch.tensor([[0.0, 0.0], [1.0, 0.0]], dtype=torch.float64)
            )
        return float(
            rays.direction[1, 0] / rays.direction[1, 2] - rays.direction[0, 0] / rays.direction[0, 2]
        )

    def rays_through(self, pixels: Tensor, pupil: Tensor, wavelength_um: float | None = None) -> Rays:
        """Rays of pixel coordinates [N, 2] through points [N, 2] of the pupil, of one colour (the d line when none is
        given): Rays, float64. The axial ray goes along: only a lens that passes nothing at all is an error."""
        colour = {} if wavelength_um is None else {"wavelength_um": wavelength_um}
        at = torch.cat([self.film.middle_px[None].to(pixels), pixels])
        through = torch.cat([pupil.new_zeros(1, 2), pupil])
        rays = self.lens.camera_rays(self.film_mm(at), through, aim=self.aim, **colour)
        irradiance = None if rays.irradiance is None else rays.irradiance[1:]
        return Rays(rays.origin_m[1:], rays.direction[1:], rays.weight[1:], irradiance)


def project(camera: Camera, points_cam_m: Tensor, pupil: Tensor | None = None) -> Tensor:
    """Pixel coordinates whose ray through a point of the pupil (the centre when none is given) passes through
    points of space.

    Args: points_cam_m [..., N, 3], camera axes, metres, in front of the camera. pupil: [..., N, 2] on the unit
      disc, or None for chief rays.
    Returns: [..., N, 2] px (the centre of the first pixel is 0, 0), float64; NaN for points that no such ray
      reaches (outside the lens's field).

    >>> from codesign import lens, render
    >>> camera = render.Camera(lens.Pinhole(8.0), 8, 8, pixel_pitch_mm=0.5)
    >>> points = torch.tensor([[0.0, 0.0, 2.0], [0.125, 0.0, 2.0]])  # metres; 8 / 2000 / 0.5 px per millimetre
    >>> render.project(camera, points).tolist()
    [[3.5, 3.5], [4.5, 3.5]]

    Gradient: to the points and to the lens, by the implicit function theorem (one Newton step with gradients
      at the solution); 0 to NaN points.
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
        at = camera.film.middle_px + points_cam_m[:, :2] / points_cam_m[:, 2:] / camera.slope_per_px()
        step = _STEP_MM / camera.film.pixel_pitch_mm
        shifts = torch.tensor([[0.0, 0.0], [step, 0.0], [0.0, step]], dtype=at.dtype)
        for turn in range(_NEWTON_STEPS):
            miss, passes = _miss(
                camera,
                (at[None] + shifts[:, None]).reshape(-1, 2),
                points_cam_m.repeat(3, 1),
                pupil.repeat(3, 1),
            )
            miss, ahead_x, ahead_y = miss.reshape(3, -1, 2)
            jacobian = torch.stack([ahead_x - miss, ahead_y - miss], -1) / step
            found = passes.reshape(3, -1).all(0) & (
                torch.linalg.det(jacobian).abs() > 1e-12 * jacobian.square().sum((1, 2))
            )
            jacobian = torch.where(found[:, None, None], jacobian, torch.eye(2, dtype=at.dtype))
            change = torch.linalg.solve(jacobian, miss)
            at = torch.where(
                found[:, None], at - change, camera.film.middle_px + _SHRINK * (at - camera.film.middle_px)
            )
            if bool(
                (change[found].abs() < 1e-6).all() & (found.all() | (turn >= _SHRINK_STEPS))
            ):  # the next step would be its square
                break
    miss, passes = _miss(camera, at, points_cam_m, pupil)
    change = torch.linalg.solve(jacobian, torch.where(found[:, None], miss, 0))
    found = found & passes & (change.detach().abs() < 1e-3).all(1)
    return torch.where(found[:, None], at - change, torch.nan).reshape(shape)


def _miss(camera, pixels, points_cam_m, pupil):
    """Where rays pass the depth of the points, minus the points: [N, 2] metres; and whether light takes them:
    [N]."""
    rays = camera.rays_through(pixels, pupil)
    origin = rays.origin_m
    direction = rays.direction
    passes = (rays.weight.detach() > 0) & (direction.detach()[:, 2] > 1e-6)
    ahead = (points_cam_m[:, 2:] - origin[:, 2:]) / torch.where(passes[:, None], direction[:, 2:], 1)
    return origin[:, :2] + direction[:, :2] * ahead - points_cam_m[:, :2], passes


def angular_miss_rad(camera: Camera, pixels: Tensor, points_cam_m: Tensor) -> Tensor:
    """Angle by which the chief rays of pixel coordinates [N, 2] miss points [N, 3] given in camera axes: [N]
    rad.

    A flow error in task units: zero when the pixel images the point, whatever the focal length and
    distortion.
    Gradient: to the pixels, the points and the lens; smooth at zero, where the value is 1e-6 rad instead of
      0.
    """
    rays = camera.chief_rays(pixels)
    towards = torch.nn.functional.normalize(points_cam_m - rays.origin_m, dim=1)
    return ((towards - rays.direction).square().sum(1) + 1e-12).sqrt()


__all__ = ["Camera", "Film", "Rays", "angular_miss_rad", "project"]


def coloured_rays(
    camera: Camera, film_px: Tensor, pupil: Tensor, colour: Tensor, whole: bool = True
) -> tuple[Tensor, Tensor, Tensor]:
    """Origins and directions [n, 3] in camera axes of rays through film positions and pupil points, and the share of
    a sample's light [n] that they carry, each in its own colour; without ``whole`` the share that passes the apertures."""
    if camera.spectrum is None:
        return _of_rays(camera, camera.rays_through(film_px, pupil), 1.0, whole)
    count = len(camera.spectrum.wavelengths_um)
    found = []
    order = []
    for number, (wavelength, weight) in enumerate(
        zip(camera.spectrum.wavelengths_um, camera.spectrum.weights, strict=True)
    ):
        rows = torch.nonzero(colour == number)[:, 0]
        order.append(rows)
        rays = camera.rays_through(film_px[rows], pupil[rows], wavelength)
        found.append(_of_rays(camera, rays, weight * count, whole))
    back = torch.cat(order).argsort()
    origin, direction, light = (torch.cat(column)[back] for column in zip(*found, strict=True))
    return origin, direction, light


def _of_rays(camera, rays, share, whole):
    light = rays.weight * share if whole else rays.weight
    if whole and camera.falloff:
        light = light * rays.irradiance.detach()
    return rays.origin_m.double(), rays.direction.double(), light.double()
