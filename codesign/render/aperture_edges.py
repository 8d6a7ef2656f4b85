"""The gradient of the light that the rims of apertures take away, sampled where it is.

Within the pupil the share of light W that passes falls from one to nothing over the soft edge of an
aperture, and only there does it change with the lens. Samples spread over the whole pupil meet that
edge now and then, each with a large derivative: most of the noise of a gradient to the lens. Points
of the edge alone, weighted by its width, have the same mean: d/dp of the mean of W L over the disc
is the mean over angles of 2 (b - a) r dW/dp L with r uniform in [a, b], where b - a is the edge at
that angle and field point.
"""

import math
from dataclasses import replace

import torch
from torch import Tensor

from codesign.render.camera import Camera
from codesign.render.moving import Views
from codesign.render.wavefront import look

FIELDS = 6  # cells across the sensor, in each of which the edge is looked for
ANGLES = 16
RADII = 16
HALVINGS = 4
DARK = 1e-9
WHOLE = 1 - 1e-9  # share of light from which nothing is taken away


def aperture_edge_term(camera: Camera, views: Views, samples: int) -> Tensor | None:
    """Zero-valued image [..., T, *film.shape] whose gradient is that of the light which apertures
    take away; None where the edge cannot be found so (an obstruction in the pupil's middle).

    Args:
      camera: as for ``frames``.
      views: of a scene.
      samples: points of the edge per pixel, for those pixels whose pupil has one; more where the
        colours could not share them equally.
    Gradient: to what the camera's lens says of ``Rays.weight``.
    """
    shape = (*views.batch, *camera.film.shape)
    dtype = views.scene.dtype
    with torch.no_grad():
        found = _edge_points(camera, samples)
    if found is None:
        return None
    film_px, pupil, colour, pixel, share = found
    if not len(pixel):
        return torch.zeros(shape, dtype=dtype)
    rays = camera.coloured_rays(film_px, pupil, colour)
    with torch.no_grad():
        count = views.cameras.shape[1]
        frame = torch.arange(count).repeat_interleave(len(pixel))
        origin, direction = (v.detach().repeat(count, 1) for v in (rays.origin_m, rays.direction))
        light, _ = look(views.scene, views.cameras, frame, origin, direction)
        light = light.reshape(count, -1) * share
    taken = light * camera.light(replace(rays, weight=rays.weight - rays.weight.detach()), colour)
    image = torch.zeros(count, math.prod(camera.film.shape), dtype=taken.dtype).index_add(
        1, pixel, taken
    )
    return image.reshape(shape).to(dtype)


def _edge_points(camera, samples):
    """Film positions [n, 2] px, pupil points [n, 2], colours and pixels [n], and what share of its
    pixel's disc each point stands for [n]; None where the edge is no single one."""
    edge = _edge(camera)
    if edge is None:
        return None
    low, high, cell = edge
    count = len(camera.colours)
    samples = math.ceil(samples / count) * count
    pixels = camera.film.pixels()
    at = torch.quasirandom.SobolEngine(4, scramble=True, seed=camera.seed).draw(
        len(pixels) * samples, dtype=torch.float64
    )
    film_px = pixels.repeat_interleave(samples, 0) + at[:, :2] - 0.5
    column, row = ((film_px + 0.5) / cell).floor().long().clamp(0, FIELDS - 1).unbind(1)
    sector = (at[:, 2] * ANGLES).long().clamp_max(ANGLES - 1)
    first, last = low[row, column, sector], high[row, column, sector]
    rows = torch.nonzero(last > first)[:, 0]
    angle = 2 * torch.pi * at[rows, 2]
    spoke = torch.stack([angle.cos(), angle.sin()], 1)
    # every pixel has as many of each; another one first from pixel to pixel, so that none keeps to
    # one part of the pixels
    colour = (rows // (samples // count) + rows // samples) % count

    # the edge lies between the largest radius at which all light passes and the smallest at which
    # none does; both at once
    inner, outer = (v[rows].repeat(2, 1) for v in (first, last))
    least = torch.tensor([[WHOLE], [DARK]], dtype=torch.float64)
    for _ in range(HALVINGS):
        middle = (inner + outer) / 2
        q = (middle[..., None] * spoke).reshape(-1, 2)
        share = camera.coloured_rays(film_px[rows].repeat(2, 1), q, colour.repeat(2)).weight
        passes = share.reshape(2, -1) >= least
        inner, outer = torch.where(passes, middle, inner), torch.where(passes, outer, middle)
    begin, end = inner[0], outer[1]
    radius = begin + at[rows, 3] * (end - begin)
    return (
        film_px[rows],
        radius[:, None] * spoke,
        colour,
        rows // samples,
        2 * (end - begin) * radius / samples,
    )


def _edge(camera):
    """Least and largest radius [FIELDS, FIELDS, ANGLES] of the edge within each cell of the sensor
    and each sector of the pupil, and the size [2] px of a cell; None where light falls and rises
    again on the way out."""
    film = camera.film
    k = torch.arange(FIELDS + 1, dtype=torch.float64) / FIELDS
    fields = torch.cartesian_prod(k, k).flip(1) * film.sensor_px - 0.5
    turn = torch.arange(ANGLES, dtype=torch.float64) * (2 * math.pi / ANGLES)
    radius = torch.arange(RADII + 1, dtype=torch.float64) / RADII
    disc = (radius[:, None, None] * torch.stack([turn.cos(), turn.sin()], 1)).reshape(-1, 2)
    at = fields.repeat_interleave(len(disc), 0), disc.repeat(len(fields), 1)
    shares = [camera.rays_through(*at, **line).weight for line, _ in camera.colours]
    shares = torch.stack(shares).reshape(-1, FIELDS + 1, FIELDS + 1, RADII + 1, ANGLES).double()
    if bool((shares.diff(dim=3) > 1e-9).any()) or bool((shares[:, :, :, 0] < WHOLE).any()):
        return None
    least, most = shares.amin(0), shares.amax(0)
    # the last radius at which all passes, and one before
    whole = ((least >= WHOLE).sum(2) - 2).clamp(0, RADII)
    some = ((most > 0).sum(2) + 1).clamp(0, RADII)
    whole = torch.where((least >= WHOLE).all(2), RADII, whole)
    low, high = (
        _over_cells(v, f) / RADII for v, f in ((whole, torch.minimum), (some, torch.maximum))
    )
    return low, high, film.sensor_px / FIELDS


def _over_cells(values, of):
    """[F + 1, F + 1, A] at the corners and spokes to [F, F, A] of cells and sectors."""
    values = of(values[1:], values[:-1])
    values = of(values[:, 1:], values[:, :-1])
    return of(values, values.roll(-1, 2)).double()
