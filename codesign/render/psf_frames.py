"""Frames by their point spread functions: one sharp picture with depth, convolved layer by layer.

The fidelity level between the thin and the traced lens. A picture of the chief rays (distortion in
it, no blur) is split into layers of depth, by hats over 1 / distance that sum to 1; each is
convolved with the point spread functions of its depth, interpolated over the film; layers are put
on each other front to back. What a nearer layer hides of a farther one is filled in from around it.
"""

import itertools
import math
from collections.abc import Sequence

import scipy
import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, pad

from codesign.errors import DomainError, ShapeError
from codesign.pose import Poses
from codesign.render.camera import Camera
from codesign.render.moving import MovingScene, Scene, scenes_and_poses, views_of
from codesign.render.psf_map import SIDE, PsfMap, probed, psf_map
from codesign.render.wavefront import light_and_nearness

ALIKE = ("spectrum", "falloff", "aim")  # of the cameras of a map and of its frames
LEAST = 1e-3  # coverage below this counts as this
FEW = 4  # layers that are made finer where what is seen needs no more
FINEST = 4  # times that their step is halved at most


def psf_frames(
    camera: Camera,
    scene: Scene | MovingScene | Sequence[Scene | MovingScene],
    T_world_cam: Poses,
    psf: PsfMap | None = None,
) -> Tensor:
    """Frames as ``render.frames`` has them, by convolution: four rays per pixel whatever the blur.

    >>> from codesign import lens, pose, render
    >>> camera = render.Camera(lens.ThinLens(8.0, 1.0).focus_at(1.0), 16, 16, pixel_pitch_mm=0.05)
    >>> plane = render.TexturedPlane([[2.0, 1.0]], [0.5], [0.0])
    >>> poses = pose.look_at((0, -0.1, 2), (0, 0, 0)).repeat(3, 1, 1)
    >>> near = render.psf_frames(camera, plane, poses)
    >>> traced = render.frames(render.Camera(camera.lens, 16, 16, 0.05, samples_per_pixel=256), plane, poses)
    >>> near.shape, bool((near - traced).abs().max() < 1e-3 * traced.std())
    (torch.Size([3, 16, 16]), True)

    Args:
      camera, scene, T_world_cam: as for ``render.frames``; the camera's samples and seed do not
        count.
      psf: ``psf_map(camera)``, made once for many calls while the lens stays as it is; None makes
        one.
    Returns: [..., T, *film.shape].
    Gradient: to lens, poses and poses of objects, through the sharp picture, its depth and the
      point spread functions; "interior" as in ``render.frames``: the motion of silhouettes is left
      out.
    Raises: DomainError for surfaces nearer than the map is made for, scenes without distances, and
      a map of another lens (also of this one before it was changed), spectrum, falloff or aim;
      ShapeError for one of another film.
    True where blur changes slowly; not within a blur's radius of depth edges, where light that a
    chief ray does not see is guessed (docs/worlds.md has figures).
    """
    if psf is None:
        psf = psf_map(camera)
    else:
        _check_map(psf, camera)
    if pairs := scenes_and_poses(scene, T_world_cam):
        return torch.stack([psf_frames(camera, one, poses, psf) for one, poses in pairs])
    views = views_of(scene, T_world_cam, psf.sharp)
    light, per_m = light_and_nearness(psf.sharp, views)
    lit = (psf.sharp.weight.detach() > 0).to(light)
    found = [_frame(psf, *frame, lit) for frame in zip(light, per_m, strict=True)]
    return torch.stack(found).reshape(*views.batch, *camera.film.shape)


def _check_map(psf, camera):
    """Raise for a map that is of another camera, or of this one before its lens changed."""
    if psf.camera.film != camera.film:
        raise ShapeError(
            f"psf frames: the map is of the film {psf.camera.film}, the camera has {camera.film}; make the "
            "map of this camera, psf_map(camera)."
        )
    same = {name: getattr(camera, name) == getattr(psf.camera, name) for name in ALIKE}
    rays = probed(camera)
    same["lens"] = all(
        torch.equal(getattr(rays, name).double(), getattr(psf.probe, name).double())
        for name in ("origin_m", "direction", "weight")
    )
    if not all(same.values()):
        raise DomainError(
            f"psf frames: {' and '.join(name for name in same if not same[name])} of the camera are not "
            "those of the map; make the map of this camera, psf_map(camera)."
        )


def _layers(psf, per_m, lit):
    """Layers of depth for what one frame shows, as numbers (near to far) of a step in 1 / distance:
    the map's, halved while there are few. Raises: DomainError for surfaces nearer than the map's, or a
    film without chief rays."""
    if not bool(lit.any()):
        raise DomainError(
            "psf frames: no chief ray passes the lens; open its apertures or make the film smaller."
        )
    nearest = float((per_m * lit).max())
    farthest = float(torch.where(lit > 0, per_m, torch.inf).min())
    if nearest > (1 + 1e-5) / psf.nearest_m:
        raise DomainError(
            f"psf frames: a surface is {1 / nearest:.4g} m away, nearer than the {psf.nearest_m:g} m of the "
            f"map; make it with psf_map(camera, nearest_m={0.9 / nearest:.2g})."
        )
    for halvings in range(FINEST, -1, -1):
        step = psf.step_per_m / 2**halvings
        numbers = range(math.ceil(nearest / step), math.floor(farthest / step) - 1, -1)
        if len(numbers) <= FEW:
            break
    return numbers, step


def _frame(psf, light, per_m, lit):
    """One frame [*film.shape] of light and 1 / depth along the sharp picture's rays."""
    film = psf.camera.film
    numbers, step = _layers(psf, per_m.detach(), lit)
    place = torch.tensor(list(numbers))[:, None].to(per_m)
    share = (1 - (per_m / step - place).abs()).clamp_min(0) * lit
    size = (film.height_px + 2 * psf.radius_px, film.width_px + 2 * psf.radius_px)
    layers = torch.stack([share * light, share], 1).reshape(
        len(numbers), 2, -1, *size, SIDE * SIDE, psf.fine**2
    )
    layers = layers.mean(-1).movedim(-1, 2)
    if (len(numbers) - 1) * step > psf.step_per_m:  # otherwise blur changes by less than a pixel
        layers = _filled(layers, 2 * psf.radius_px + 1)
    blurred = _convolved(psf, layers, [number * step for number in numbers])
    left = torch.ones_like(blurred[0, 0])
    image = torch.zeros_like(left)
    for colour, cover in blurred:
        kept = (left / cover.clamp_min(LEAST)).clamp(0, 1)
        image = image + kept * colour
        left = left - kept * cover
    return (image / (1 - left).clamp_min(LEAST) * psf.transmission.to(image)).reshape(film.shape)


def _filled(layers, width):
    """Layers of light and coverage [J, 2, S, W, H, W], near to far, with what nearer ones hide
    taken from
    around: the mean of the layer's light within ``width`` pixels, where there is any."""
    around = layers.mean(2).flatten(0, 1)
    for size in ((width, 1), (1, width)):
        around = avg_pool2d(around, size, 1, (size[0] // 2, size[1] // 2), count_include_pad=False)
    light, cover = around.unflatten(0, layers.shape[:2]).unsqueeze(2).unbind(1)
    there = cover > LEAST
    mean = torch.where(there, light / torch.where(there, cover, 1), 0)
    own, share = layers.unbind(1)
    hidden = (share.cumsum(0) - share) * there
    colour = (own + LEAST * mean) / (share + LEAST)  # its own light, where a hat leaves it any
    return layers + torch.stack([hidden * colour, hidden], 1)


def _convolved(psf, layers, depths_per_m):
    """Layers [J, 2, S, W, H + 2 R, W + 2 R] at these 1 / distance convolved: [J, 2, W, H, W].

    Cell after cell, by Fourier transforms: with the weights of its four corners, which are then
    interpolated (so a constant stays constant).
    """
    film = psf.camera.film
    rows, columns = (n - 1 for n in psf.grid[1:])
    high, wide = psf.cell_px
    margin = 2 * psf.radius_px
    size = tuple(scipy.fft.next_fast_len(n + margin, real=True) for n in psf.cell_px)
    transfer = torch.stack([_transfer(psf, v, layers, size) for v in depths_per_m])[:, None]
    padded = pad(layers, (0, columns * wide - film.width_px, 0, rows * high - film.height_px))
    cells = padded.unfold(-2, high + margin, high).unfold(-2, wide + margin, wide)
    down = _between(film.height_px, high, rows).to(layers)
    right = _between(film.width_px, wide, columns).to(layers)
    strips = []
    for row in range(rows):
        # [J, 2, S, windows, columns, ...]
        spectrum = torch.fft.rfft2(cells[:, :, :, :, row], s=size)
        strip = 0
        for i, j in itertools.product((0, 1), (0, 1)):
            corner = transfer[..., row + i, j : j + columns, :, :]
            found = spectrum[:, :, 0] * corner[:, :, 0]
            for part in range(1, SIDE * SIDE):
                found = torch.addcmul(found, spectrum[:, :, part], corner[:, :, part])
            found = torch.fft.irfft2(found, s=size)[
                ..., margin : margin + high, margin : margin + wide
            ]
            strip = strip + found * (down[i, row][:, None] * right[j][:, None, :])
        strips.append(strip.transpose(-3, -2).flatten(-2))  # cells of a row, side by side
    return torch.cat(strips, -2)[..., : film.height_px, : film.width_px]


def _transfer(psf, per_m, like, size):
    """Fourier transform of the weights of a layer, [S, windows, rows, columns, ...]; kept by the
    map."""
    key = (per_m, like.dtype, torch.is_grad_enabled())
    if key not in psf.transfers:
        weights = psf.weights(like.new_tensor([per_m]))[0].flatten(1, 2)
        psf.transfers[key] = torch.fft.rfft2(weights.unflatten(0, psf.grid).movedim(3, 0), s=size)
    return psf.transfers[key]


def _between(length, cell, count):
    """Weights [2, count, cell] of the node before and the node behind each pixel of a row of
    cells."""
    node = (torch.arange(count + 1.0) * cell).clamp_max(length - 1)
    at = (torch.arange(count * cell, dtype=node.dtype)).reshape(count, cell)
    share = ((at - node[:-1, None]) / (node[1:] - node[:-1]).clamp_min(1)[:, None]).clamp(0, 1)
    return torch.stack([1 - share, share])
