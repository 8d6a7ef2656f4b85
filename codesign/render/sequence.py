"""Frames of a scene along trajectories, and the ways to their gradient.

interior: what moves inside surfaces (plain automatic differentiation).
boundary: with the motion of silhouettes and edges.
difference: central differences with common random numbers, twelve renders for the poses and two per
  lens number.
auto: the cheapest of the three that is right for the frames at hand.
"""

from collections.abc import Sequence
from dataclasses import replace
from itertools import chain
from typing import Any, Literal

import torch
from torch import Tensor

from codesign.backend import differentiable_once
from codesign.checks import check_choice, check_kind, check_positive
from codesign.errors import DomainError
from codesign.pose import Poses, inverse, se3_exp
from codesign.render.aperture_edges import aperture_edge_term
from codesign.render.camera import Camera, device_of, lines
from codesign.render.film import border_px
from codesign.render.moving import MovingScene, Scene, Views, scenes_and_poses, views_of
from codesign.render.silhouettes.boundary import boundary_term, radiance_jumps
from codesign.render.silhouettes.occlusion_check import reach_m
from codesign.render.wavefront import shaded
from codesign.types import Rays

Way = Literal["interior", "boundary", "difference", "auto"]
WAYS: tuple[Way, ...] = ("interior", "boundary", "difference", "auto")
PROVEN: tuple[Way, ...] = ("interior", "boundary")  # those that differences judge
POSE_STEP = 2e-3  # metres and radians, but never more than STEP_PX on the film
STEP_PX = 0.3
# of the numbers of a lens before they are sized to STEP_PX, by LONGEST at most; None where
# differences know none
LENS_STEP = {
    "curvature_per_mm": 2e-5,
    "thickness_mm": 5e-3,
    "conic": 1e-2,
    "asphere": None,
    "index_offset": 1e-4,
    "phase": None,
    "decentre_mm": None,
    "tilt_rad": None,
    "semi_aperture_mm": 2e-3,
    "efl_mm": 1e-2,
    "image_distance_mm": 2e-3,
}
LONGEST = 100.0
APERTURE_SAMPLES = 4  # points per pixel on the edges of apertures, for "boundary"


def frames(
    camera: Camera,
    scene: Scene | MovingScene | Sequence[Scene | MovingScene],
    T_world_cam: Poses,
    gradient: Way = "interior",
    per_px: float = 2.5,
    *,
    rays: Rays | None = None,
) -> Tensor:
    """Frames of a scene along a trajectory, or along several.

    >>> from codesign import lens, pose, render
    >>> camera = render.Camera(lens.Pinhole(8.0), 8, 8, pixel_pitch_mm=0.5, samples_per_pixel=4)
    >>> poses = pose.look_at((0, -2, 1), (0, 0, 0)).repeat(3, 5, 1, 1)  # three trajectories of five poses
    >>> plane = render.TexturedPlane([[2.0, 1.0]], [0.5], [0.0])  # one wave of two by one periods per metre
    >>> render.frames(camera, plane, poses).shape
    torch.Size([3, 5, 8, 8])

    Args:
      camera: Camera, before any lens with ``camera_rays``.
      scene: anything with ``radiance`` and ``dtype`` (MitsubaScene, TexturedPlane, MovingScene), or
        a list of scenes, one for each entry of the first axis of T_world_cam.
      T_world_cam: [..., T, 4, 4], several trajectories in one batch as if each were rendered by
        itself.
      gradient: "interior", "boundary", "difference" or "auto", see the top of this file; the frames
        are the same.
      per_px: samples per pixel length of silhouettes and edges for "boundary".
      rays: ``camera.rays()`` where they are traced already (one trace for many calls) or recorded,
        for "interior" and "boundary"; the boundary term traces its own points through the camera's
        lens.
    Returns: [..., T, H, W] (or [..., T, windows, H, W] behind a Film with windows) linear
      irradiance in the scene's units, box-filtered over each pixel.
    Gradient: lens and poses; "interior" leaves out the motion of silhouettes.
    Raises: DomainError for an unknown way, rays that it cannot use, or a scene whose silhouettes
      are not known; ShapeError for rays of another camera, or numbers of scenes and poses that
      differ.
    """
    check_choice(gradient, "gradient", WAYS)
    if rays is not None and gradient not in PROVEN:
        raise DomainError(
            f"gradient {gradient!r} traces the lens at other values than the given rays have; leave rays "
            "out, or choose 'interior' or 'boundary'."
        )
    check_positive(per_px, "per_px", remedy="samples per pixel length of silhouettes, such as 2.5")
    check_kind(camera, Camera, "the camera", "a render.Camera has a lens and a film")
    if pairs := scenes_and_poses(scene, T_world_cam):
        rays = camera.given(rays) if gradient in PROVEN else None
        return torch.stack(
            [frames(camera, s, poses, gradient, per_px, rays=rays) for s, poses in pairs]
        )
    rays = camera.given(rays)
    views = views_of(scene, T_world_cam, rays)
    if gradient in ("boundary", "auto") and device_of(camera.lens).type != "cpu":
        raise DomainError(
            f"gradient {gradient!r}: silhouettes are found on the processor only; move lens, poses and scene "
            "there, or choose 'interior' or 'difference'."
        )
    if gradient == "auto":
        gradient = cheapest(camera, views)
    if gradient == "difference":
        return by_differences(rays, camera, views)
    if gradient == "interior":
        return image(rays, camera, views)
    taken = None
    if rays.weight.requires_grad:
        taken = aperture_edge_term(
            camera, views, max(APERTURE_SAMPLES, camera.samples_per_pixel // 8)
        )
    if taken is not None:
        rays = _with_still_apertures(camera, rays)
    found = image(rays, camera, views) + boundary_term(camera, views, per_px)
    return found if taken is None else found + taken


def _with_still_apertures(camera, rays):
    """The same rays; no gradient goes to the light that apertures take away."""
    weight = rays.weight.detach()
    if camera.falloff:
        weight = weight * (rays.irradiance / rays.irradiance.detach())
    return replace(rays, weight=weight)


def image(rays: Rays, camera: Camera, views: Views) -> Tensor:
    """Frames [..., T, *film.shape] with their interior gradient."""
    return shaded(rays, views, camera.samples_per_pixel).reshape(*views.batch, *camera.film.shape)


def by_differences(rays: Rays, camera: Camera, views: Views) -> Tensor:
    """Frames whose gradient to poses and lens tensors is that of central differences with common
    random numbers."""
    if _objects_ask(views.scene):
        raise DomainError(
            "gradient 'difference' goes to camera and lens only, but the pose of an object asks for one; "
            "use 'boundary'."
        )
    with torch.no_grad():
        found = image(rays, camera, views)
    for at, size, number in (*_pose_numbers(rays, camera, views), *_lens_numbers(camera, views)):
        with torch.no_grad():
            ahead, behind = (at(sign * size).reshape(found.shape) for sign in (1, -1))
            slope = (ahead - behind) / (2 * size)
        found = found + slope * number.to(found)
    return differentiable_once(
        found, "frames: gradient 'difference' has none of its own; use differences of gradients."
    )


def _objects_ask(scene):
    """Whether the pose of an object asks for a gradient."""
    return any(pose.requires_grad for pose in getattr(scene, "T_world_object", ()))


def _twist(T_world_cam):
    """Zero-valued twists [T, 6] (translation first) whose gradient is that of small motions of the
    poses in their own axes."""
    small = inverse(T_world_cam.detach().double()) @ T_world_cam.double()
    turn = (small[:, :3, :3] - small[:, :3, :3].mT) / 2
    return torch.stack([*small[:, :3, 3].unbind(1), turn[:, 2, 1], turn[:, 0, 2], turn[:, 1, 0]], 1)


def pose_steps(camera: Camera, views: Views) -> list[float]:
    """Steps of differences to the six components of a twist, metres and radians: at most STEP_PX of
    motion on the film, for translations at the median distance of what the first frame shows."""
    with torch.no_grad():
        turn = STEP_PX * abs(camera.slope_per_px())
        move = turn * reach_m(camera, views.scene, views.cameras[:, :1])
    return 3 * [min(POSE_STEP, move)] + 3 * [min(POSE_STEP, turn)]


def _pose_numbers(rays, camera, views):
    """For every component of the twist of all poses: frames as a function of its change, the step,
    and the zero-valued component of each frame."""
    if not views.cameras.requires_grad:
        return
    twist = _twist(views.T_world_cam).reshape(*views.batch, *[1] * len(camera.film.shape), 6)
    for k, size in enumerate(pose_steps(camera, views)):
        way = torch.eye(6, dtype=torch.float64, device=twist.device)[k : k + 1]

        def at(change, way=way):
            return image(
                rays, camera, views_of(views.scene, views.T_world_cam @ se3_exp(change * way))
            )

        yield at, size, twist[..., k]


def lens_tensors(lens: Any) -> dict[str, Tensor]:
    """Tensors of a lens that ask for gradients, by name; one that another follows only once."""
    made = _made(lens)
    found = {}
    for name in LENS_STEP:
        value = getattr(made, name, None)
        asks = torch.is_tensor(value) and value.requires_grad and value.numel()
        if asks and not any(value is other for other in found.values()):
            found[name] = value
    return found


def _made(lens):
    """A lens with tensors in place of the variables that make them."""
    return lens.replace() if hasattr(lens, "replace") else lens


def _check_known(lens):
    """Raise DomainError when a lens asks for gradients to tensors that differences do not know: of a
    phase plate, of the pupil, of a lens of the user's own."""
    if not isinstance(lens, torch.nn.Module):
        return
    made = _made(lens)
    for name, tensor in chain(made.named_parameters(), made.named_buffers()):
        if tensor.requires_grad and tensor.numel() and name not in LENS_STEP:
            raise DomainError(
                f"differences know no step for the lens's parameter '{name}'; freeze it, or choose gradient "
                "'interior' or 'boundary'."
            )


def _lens_numbers(camera, views):
    """As above, for every number of the lens that asks for a gradient."""
    _check_known(camera.lens)
    for name, tensor in lens_tensors(camera.lens).items():
        if (size := LENS_STEP[name]) is None:
            raise DomainError(
                f"differences to the lens's {name} have no step; freeze it, or use gradient 'boundary'."
            )
        held = tensor.detach()
        for i, number in enumerate(tensor.reshape(-1)):
            way = (
                torch.zeros_like(held)
                .reshape(-1)
                .index_fill(0, torch.tensor(i), 1.0)
                .reshape(held.shape)
            )

            def changed(change, name=name, held=held, way=way):
                return camera.with_lens(camera.lens.replace(**{name: held + change * way}))

            def at(change, changed=changed):
                return image(changed(change).rays(), camera, views)

            yield at, _lens_step(camera, changed, size), number - number.detach()


@torch.no_grad()
def _lens_step(camera, changed, trial):
    """Step of a number that moves the rays of the film's border by STEP_PX, from what a trial step
    does; ``trial`` itself where they stay."""
    border = border_px(torch.zeros_like(camera.film.sensor_px), camera.film.sensor_px, 3)
    pupil = torch.tensor([[0.0, 0.0], [0.7, 0.0], [0.0, 0.7]]).to(border)
    at = border.repeat_interleave(len(pupil), 0), pupil.repeat(len(border), 1)
    rays = [c.rays_through(*at) for c in (camera, changed(trial))]
    passes = (rays[0].weight > 0) & (rays[1].weight > 0)
    before, after = (lines(r)[1][passes] for r in rays)
    if not bool((before != after).any()):
        return trial
    moved_px = float((after - before).norm(dim=1).max()) / abs(camera.slope_per_px())
    return trial * min(STEP_PX / moved_px, LONGEST)


def cheapest(camera: Camera, views: Views) -> Way:
    """The cheapest way that is right for these very frames: "interior" where no edge or outline in
    them parts two radiances, "boundary" where one does, "difference" where the scene does not list
    them."""
    middle = camera.film.middle_px[None]
    ray = camera.rays_through(middle, torch.zeros_like(middle))
    asked = [
        views.cameras,
        ray.origin_m,
        ray.direction,
        ray.weight,
        *lens_tensors(camera.lens).values(),
    ]
    objects = _objects_ask(views.scene)
    if not (objects or any(tensor.requires_grad for tensor in asked)):
        return "interior"
    try:
        return "boundary" if radiance_jumps(camera, views) else "interior"
    except DomainError:
        # differences do not reach objects
        if objects:
            raise
        return "difference"
