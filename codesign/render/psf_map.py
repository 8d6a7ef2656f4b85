"""Point spread functions of a camera over field and depth, as tensors with gradients.

The rays of a pixel through the pupil do not depend on what they meet. So one trace, of pupil points
for the nodes of a grid over the film, says for every distance which places of the sharp picture
(that of the chief rays) the pixel gathers light from: where the ray meets the plane at that
distance, in pixels of the chief rays around it. That is the point spread function mirrored, exact
for a plane across the axis, whatever the lens (vignetting, decentred elements, colour).
"""

import math
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import interpolate

from codesign.checks import check_number, check_positive
from codesign.errors import DomainError, ShapeError
from codesign.render.camera import Camera, lines
from codesign.render.film import coarse_pixels, concentric_disc, some_pixels
from codesign.types import Rays

ROUNDING = 1e-6  # of distances given in float32
LARGEST_PX = 32  # radius of a blur up to which pictures are convolved
LAYER_PX = 1.0  # of blur's radius, from one layer of depth to the next
PUPIL_PX = 1.0  # spacing of the pupil's points in the widest blur, about
ACROSS = 32  # film points across the sensor whose light is traced
APART_PX = 0.5  # of the chief rays that give the scale of the picture, on either side
SIDE = 2  # values of the sharp picture per side of a pixel
# a pixel's weights reach beyond the blur by the quartic splines and, until it has fallen below 0.5
# %, the ringing of the interpolation, in spacings of the sharp picture
TAIL_PX = math.ceil((2.5 + (SIDE - 1) / 2 + 4) / SIDE)


@dataclass(frozen=True)
class PsfMap:
    """Rays of a camera from which its point spread functions follow, made by ``psf_map``.

    camera: Camera. nearest_m: least distance it is made for. nodes_px: [N, 2] film points, pixel
      coordinates; ``grid`` = (windows, rows, columns) of them, N in all, cells of ``cell_px``
      (rows, columns) pixels between.
    transmission: [windows, H, W] share of the light that passes, as in the traced frames.
      radius_px: how far the light of a pixel comes from. step_per_m: of 1 / distance, over which
      blur grows by LAYER_PX at most.
      sharp: chief rays of the film's pixels and a margin of radius_px around them, window after
      window, SIDE x SIDE values a pixel of ``fine`` x ``fine`` rays each.
      probe: a few rays of the lens as it was (``probed``). transfers: what ``psf_frames`` keeps
      for its next call.
    base_m, slope: [N, M, 2] where rays through pupil points meet the entrance pupil's plane, and
      their slopes, both relative to the chief ray; share: [N, M] of the light, sum 1.
      base_m_per_px, slope_per_px: [N, 2, 2] the same of neighbouring chief rays, per pixel.
    """

    camera: Camera
    nearest_m: float
    nodes_px: Tensor
    grid: tuple[int, int, int]
    cell_px: tuple[int, int]
    transmission: Tensor
    base_m: Tensor
    slope: Tensor
    share: Tensor
    base_m_per_px: Tensor
    slope_per_px: Tensor
    radius_px: int
    step_per_m: float
    sharp: Rays
    fine: int
    probe: Rays
    transfers: dict[tuple[Any, ...], Tensor] = field(
        default_factory=dict, repr=False, compare=False
    )

    def offsets_px(self, per_m: Tensor) -> Tensor:
        """Where the light of a point ends up, relative to its chief ray: [D, N, M, 2] px, for 1 /
        distance [D].

        Gradient: to the lens and to per_m. Raises: DomainError for distances nearer than
          ``nearest_m``.
        """
        per_m = torch.as_tensor(per_m, dtype=torch.float64)
        if per_m.ndim != 1:
            raise ShapeError(
                f"psf map: distances must be a list [D], got shape {tuple(per_m.shape)}."
            )
        known = (per_m.detach() >= 0) & (per_m.detach() <= (1 + ROUNDING) / self.nearest_m)
        if not bool(known.all()):
            raise DomainError(
                f"psf map: 1 / distance {per_m.tolist()} must lie between 0 and {1 / self.nearest_m:g} per "
                f"metre, as the map is made for {self.nearest_m:g} m and beyond; give psf_map a smaller "
                "nearest_m."
            )
        return self._offsets_px(per_m)

    def _offsets_px(self, per_m):
        v = per_m.to(self.base_m)[:, None, None, None]
        return -_solved(self.slope_per_px + v * self.base_m_per_px, self.slope + v * self.base_m)

    def energy(self, distance_m: Tensor, size_px: int | None = None) -> Tensor:
        """The point spread functions, [D, N, K, K]: share of a point's light per pixel, rows along
        +y (down), columns along +x, the chief ray on the middle pixel; the sum is 1.

        >>> from codesign import lens, render
        >>> camera = render.Camera(lens.ThinLens(10.0, 4.0).focus_at(1.0), 96, 64, pixel_pitch_mm=0.005)
        >>> psf = render.psf_map(camera, nearest_m=0.5)
        >>> blur = psf.energy(torch.tensor([0.5, 1.0, float("inf")]))
        >>> blur.shape  # three distances, nodes, rows and columns
        torch.Size([3, 6, 11, 11])
        >>> [round(float(part.max()), 2) for part in blur[:, 0]]  # sharp at 1 m
        [0.02, 1.0, 0.02]

        Args:
          distance_m: [D] along the camera's axis from the entrance pupil, inf allowed.
          size_px: rows and columns, odd; None is as many as the widest blur needs. A ray is shared
            bilinearly among four pixels.
        Gradient: to every tensor of the lens and to the distances, piecewise linear in the rays'
          positions.
        Raises: DomainError for distances nearer than ``nearest_m``, or a size that does not hold
          the blur.
        """
        distance_m = torch.as_tensor(distance_m, dtype=torch.float64, device=self.base_m.device)
        offsets_px = self.offsets_px(1 / distance_m)
        needed = 2 * (self.radius_px - TAIL_PX) + 3
        size = needed if size_px is None else size_px
        if not size >= needed or size % 2 != 1:
            raise DomainError(
                f"psf map: {size} x {size} pixels do not hold the blur about a middle pixel; give an odd "
                f"number of at least {needed}."
            )
        at = offsets_px[..., None] - (torch.arange(size).to(self.base_m) - size // 2)
        return _shared((1 - at.abs()).clamp_min(0), self.share)

    def weights(self, per_m: Tensor) -> Tensor:
        """What pixels gather from the sharp picture at 1 / distance [J]: [J, N, S, S, K, K], by
        which the picture of each of a pixel's S x S values is convolved; K = 2 radius_px + 1, all
        of a node sum to 1.

        The sharp picture is taken as the cubic spline through its values. Values of one ray each
        are integrated over the pixel in closed form (quartic splines); those of several are means
        over their part of it already.
        Source: Unser, IEEE Signal Processing Magazine 16, 1999.
        """
        dtype = per_m.dtype
        share = self.share.to(dtype)
        reach = SIDE * self.radius_px
        spacings = torch.arange(-reach, reach + SIDE, dtype=dtype, device=share.device)
        gathered = -SIDE * self._offsets_px(per_m).to(dtype)
        far = gathered[..., None] - (spacings - (SIDE - 1) / 2)
        spline = _quartic if self.fine == 1 else _cubic
        splines = sum(spline(far + shift - (SIDE - 1) / 2) for shift in range(SIDE)) / SIDE
        inverse = torch.linalg.inv(_cubic(spacings[:, None] - spacings))
        found = inverse @ _shared(splines, share) @ inverse
        found = (
            (found / found.sum((-2, -1), keepdim=True))
            .unflatten(-1, (-1, SIDE))
            .unflatten(-3, (-1, SIDE))
        )
        return found.permute(0, 1, 3, 5, 2, 4).flip((-2, -1))


def psf_map(
    camera: Camera,
    nearest_m: float = 0.3,
    cell_px: int = 64,
    rays_per_px: int = 4,
) -> PsfMap:
    """Trace what the point spread functions of a camera at all distances from ``nearest_m`` on
    follow from.

    Args:
      camera: before any lens with ``camera_rays``; its spectrum, falloff and aim count, its samples
        do not.
      nearest_m: metres from the entrance pupil.
      cell_px: largest spacing of the film points between which point spread functions are
        interpolated.
      rays_per_px: 4, or for scenes full of hard edges 16, 36, 64, ...
    Gradient: to the lens. To be made anew for every state of the lens.
    Raises: DomainError when the blur is wider than LARGEST_PX, or no light reaches the film.
    """
    check_positive(nearest_m, "psf map: nearest_m")
    check_number(cell_px, "psf map: cell_px", 2.0)
    fine = math.isqrt(max(0, rays_per_px)) // SIDE if isinstance(rays_per_px, int) else 0
    if fine < 1 or (SIDE * fine) ** 2 != rays_per_px:
        raise DomainError(
            f"psf map: rays_per_px = {rays_per_px} must be 4, 16, 36 or another square of an even number."
        )
    nodes, grid, cell = _nodes(camera, cell_px)
    chief = lines(camera.chief_rays(_around(nodes)))
    base, slope = (part.reshape(-1, 5, 2) for part in chief)
    scale = [
        torch.stack([part[:, 1] - part[:, 2], part[:, 3] - part[:, 4]], -1) / (2 * APART_PX)
        for part in (base, slope)
    ]
    found = _gathered(camera, nodes, 16, base, slope, scale)
    reach = _reach(*found[:2], scale, 1 / nearest_m)
    if reach > LARGEST_PX:
        raise DomainError(
            f"psf map: between {nearest_m:g} m and infinity the blur reaches {reach:.0f} pixels from its "
            f"chief ray, more than {LARGEST_PX}; focus the lens, give a larger nearest_m, or render traced "
            "frames."
        )
    across = 2 ** math.ceil(math.log2(max(16.0, 2 * reach / PUPIL_PX)))
    if across > 16:
        found = _gathered(camera, nodes, across, base, slope, scale)
    offset, lean, share = found
    with torch.no_grad():
        change = _solved(scale[1], offset).norm(dim=-1)[share > 0].max()
    step = 2.0 ** math.floor(math.log2(LAYER_PX / max(float(change), LAYER_PX * nearest_m)))
    return PsfMap(
        camera,
        float(nearest_m),
        nodes,
        grid,
        cell,
        _transmission(camera),
        offset,
        lean,
        share,
        *scale,
        math.ceil(reach) + TAIL_PX,
        step,
        camera.chief_rays(_places(camera.film, math.ceil(reach) + TAIL_PX, fine)),
        fine,
        probed(camera),
    )


@torch.no_grad()
def probed(camera: Camera) -> Rays:
    """Rays at some pixels and points of the pupil, by which lenses are told apart."""
    pixels = camera.film.pixels()[some_pixels(camera.film, 64)]
    turn = torch.arange(len(pixels)).to(pixels)
    return camera.rays_through(pixels, 0.7 * torch.stack([turn.cos(), turn.sin()], 1))


def _nodes(camera, cell_px):
    """Film points at the corners of equal cells over every window: [N, 2] px, how many, and pixels
    of a cell."""
    film = camera.film
    nodes = []
    cell = []
    for length in (film.height_px, film.width_px):
        count = math.ceil(length / cell_px)
        cell.append(math.ceil(length / count))
        nodes.append(
            (torch.arange(count + 1.0, dtype=torch.float64) * cell[-1]).clamp_max(length - 1)
        )
    return (
        film.in_windows(*nodes),
        (len(film.corners_px), len(nodes[0]), len(nodes[1])),
        tuple(cell),
    )


def _around(nodes):
    """Every node and its neighbours in +x, -x, +y, -y: [5 N, 2] px."""
    steps = nodes.new_tensor([[0.0, 0.0], [1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
    return (nodes[:, None] + APART_PX * steps).reshape(-1, 2)


def _through_pupil(camera, places, across):
    """Rays of film points [P, 2] px through ``across`` x ``across`` equal parts of the pupil,
    colour after
    colour: at the entrance pupil's plane and slopes [P, M, 2], and their light [P, M], 1 in all
      where nothing stops it."""
    line = (torch.arange(across, dtype=torch.float64, device=places.device) + 0.5) / across
    pupil = concentric_disc(torch.cartesian_prod(line, line)).repeat(len(camera.colours), 1)
    colour = torch.arange(len(camera.colours), device=places.device)
    colour = colour.repeat_interleave(across**2).repeat(len(places))
    rays = camera.coloured_rays(
        places.repeat_interleave(len(pupil), 0), pupil.repeat(len(places), 1), colour
    )
    light = camera.light(rays, colour) / len(pupil)
    return [v.unflatten(0, (len(places), -1)) for v in (*lines(rays), light)]


def _gathered(camera, nodes, across, base, slope, scale):
    """Rays through the pupil relative to the chief rays: base and slope [N, M, 2], and shares of
    the light [N, M]."""
    meets, leans, light = _through_pupil(camera, nodes, across)
    total = light.sum(1, keepdim=True)
    if not bool((total.detach() > 0).any()):
        raise DomainError(
            "psf map: no light reaches the film; open the apertures or make the film smaller."
        )
    usable = (light.detach() > 0)[..., None] & (torch.linalg.det(scale[1].detach()) != 0)[
        :, None, None
    ]
    share = torch.where(total > 0, light / torch.where(total > 0, total, 1), 1 / light.shape[1])
    return (
        torch.where(usable, meets - base[:, :1], 0),
        torch.where(usable, leans - slope[:, :1], 0),
        share,
    )


def _transmission(camera):
    """Share of the light that passes, [windows, H, W], linear between film points on a grid."""
    film = camera.film
    every_px = math.ceil(max(film.sensor_width_px, film.sensor_height_px) / ACROSS)
    light = _through_pupil(camera, coarse_pixels(film, every_px), 16)[2].sum(1)
    size = [math.ceil((n - 1) / every_px) + 1 for n in (film.height_px, film.width_px)]
    grid = light.reshape(-1, 1, *size)
    return interpolate(grid, size=film.shape[-2:], mode="bilinear", align_corners=True)[:, 0]


def _reach(base, slope, scale, nearest_per_m):
    """Radius of the widest blur at infinity and at the nearest distance, px; between them it is
    smaller."""
    with torch.no_grad():
        ends = [_solved(scale[1] + v * scale[0], slope + v * base) for v in (0.0, nearest_per_m)]
        return float(torch.stack(ends).abs().max())


def _solved(matrix, vectors):
    """matrix^-1 [..., N, 2, 2] times vectors [..., N, M, 2], written out; nodes without chief rays
    give 0."""
    (a, b), (c, d) = (row.unbind(-1) for row in matrix.unbind(-2))
    determinant = a * d - b * c
    regular = determinant != 0
    inverse = torch.where(regular, 1 / torch.where(regular, determinant, 1), 0)[..., None]
    x, y = vectors.unbind(-1)
    a, b, c, d = (v[..., None] for v in (a, b, c, d))
    return torch.stack([(d * x - b * y) * inverse, (a * y - c * x) * inverse], -1)


def _places(film, margin, fine):
    """Pixel coordinates of ``fine`` x ``fine`` points in each of SIDE x SIDE equal parts of every
    pixel of the windows and a margin around them."""
    around = [
        torch.arange(-margin, n + margin, dtype=torch.float64)
        for n in (film.height_px, film.width_px)
    ]
    count = SIDE * fine
    inside = ((torch.arange(count, dtype=torch.float64) + 0.5) / count - 0.5).reshape(SIDE, fine)
    y, x = torch.broadcast_tensors(inside[:, None, :, None], inside[None, :, None, :])
    at = film.in_windows(*around)
    part = torch.stack([x.reshape(-1), y.reshape(-1)], 1).to(at)
    return (at[:, None] + part).reshape(-1, 2)


def _shared(at, share):
    """[..., K, K] of weights [..., M, 2, K] along x and y of points with shares [..., M]."""
    return (at[..., 1, :] * share[..., None]).mT @ at[..., 0, :]


def _cubic(at):
    """Cubic B-spline of unit spacing."""
    far = at.abs()
    return ((2 - far).clamp_min(0) ** 3 - 4 * (1 - far).clamp_min(0) ** 3) / 6


def _quartic(at):
    """Quartic B-spline, the cubic one averaged over a unit."""
    far = at.abs()
    parts = [(reach - far).clamp_min(0).square().square() for reach in (2.5, 1.5, 0.5)]
    return (parts[0] - 5 * parts[1] + 10 * parts[2]) / 24
