"""How much light transport a scene gets: emissive lookup, light baked once into textures, or
Mitsuba's path integrator on the same camera rays.

The cheap level is ``MitsubaScene``: every surface shows its own radiance. ``bake``
(codesign.render.bake) computes the light of a Lambertian scene once and returns such a
``MitsubaScene``. ``PathScene`` traces paths for every camera ray: the reference. All three have
``radiance``, ``hit`` and ``dtype``.
"""

import copy
import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from codesign.checks import check_positive, check_seed, check_whole
from codesign.errors import DomainError, GradientError
from codesign.exclusive import exclusive
from codesign.render.bake import bake
from codesign.render.camera import Camera
from codesign.render.moving import MovingScene, Scene
from codesign.render.sequence import frames
from codesign.render.world import MitsubaScene

__all__ = ["Choice", "LevelError", "PathScene", "bake", "choose", "level_error"]

# share of a frame's mean radiance below which errors are relative to this share instead of to the
# pixel
FLOOR = 0.05


class PathScene(MitsubaScene):
    """A Mitsuba scene of any surfaces and lights, seen by path tracing along the camera's own rays.

    Args:
      description: a Mitsuba scene dictionary, or an mi.Scene. samples: paths per camera ray, on top
        of the camera's samples per pixel.
      max_depth: longest path; 1 sees emitters only, 2 one reflection, -1 any length. seed: of the
        random numbers; equal calls give equal frames. Noise is independent from ray to ray, so a
        camera at rest sees frames that differ by it: raise samples until events of noise are rare.
        integrator: a Mitsuba SamplingIntegrator instead of path tracing to max_depth.
    Gradient: none. A path's light behind a moved ray jumps wherever the path changes, and
      differentiating the numbers one by one is not the gradient of their mean; asking for it raises
      GradientError.
    """

    @exclusive
    def __init__(
        self,
        description: Mapping[str, Any] | Any,
        device: str = "cpu",
        *,
        samples: int = 16,
        max_depth: int = 8,
        seed: int = 0,
        integrator: Any = None,
    ):
        samples = check_whole(samples, "path light: samples per ray")
        if max_depth != -1:
            check_whole(max_depth, "path light: max_depth", remedy="or give -1 for any length")
        super().__init__(description, device, emissive=False)
        self.samples = samples
        self.seed = _path_seed(seed)
        self.integrator = integrator or self.mi.load_dict(
            {"type": "path", "max_depth": int(max_depth), "rr_depth": 64}
        )

    def with_seed(self, seed: int) -> "PathScene":
        """The same scene with other random numbers."""
        twin = copy.copy(self)
        twin.seed = _path_seed(seed)
        return twin

    def radiance(self, arr: Any, origin: Any, direction: Any) -> Any:
        """Mean radiance of ``samples`` paths along each world ray. Raises: GradientError when a
        gradient is asked for."""
        import drjit as dr

        if dr.grad_enabled(origin, direction):
            raise GradientError(
                "PathScene has no gradient; differentiate a scene of baked light (light.bake), or use "
                "differences with common random numbers."
            )
        mi = self.mi
        count = dr.width(origin, direction)
        if count * self.samples >= 2**32:
            raise DomainError(
                f"path light: {count} rays of {self.samples} paths are more than fit into one launch; "
                "render fewer frames at a time."
            )
        dr.eval(origin, direction)
        ray = dr.arange(mi.UInt32, count * self.samples) // self.samples
        o, d = (dr.gather(mi.Point3f, mi.Point3f(part), ray) for part in (origin, direction))
        sampler = mi.load_dict({"type": "independent"})
        # opaque: another seed needs no new kernel
        sampler.seed(dr.opaque(mi.UInt32, self.seed), count * self.samples)
        light, _, _ = self.integrator.sample(
            self.scene, sampler, mi.RayDifferential3f(o, mi.Vector3f(d))
        )
        return dr.block_sum(light[0], self.samples) / self.samples

    def radiance_and_distance(self, arr: Any, origin: Any, direction: Any) -> Any:
        """Radiance as above, and the distance to the first surface (infinite where there is
        none)."""
        mi = self.mi
        light = self.radiance(arr, origin, direction)
        ray = mi.Ray3f(mi.Point3f(origin), mi.Vector3f(direction))
        return light, self.scene.ray_intersect_preliminary(ray, coherent=True).t


def _path_seed(seed):
    return check_seed(seed, "path light: seed", bits=31) % 2**32


@dataclass(frozen=True)
class LevelError:
    """Error of one light level against another, per frame: [T] tensors, shares of the reference's
    radiance.

    mean, percentile_95, maximum: of |cheap - reference| over the pixels, the reference's noise
      included.
    rms: root mean square with the noise taken out (products of errors against two independent
      references), 0 where noise hides it.
    rms_after_gain: the same after the best single factor for the frame: what is left for a sensor
      of log intensity.
    noise: standard deviation of a pixel of the reference, root mean square.
    """

    mean: Tensor
    percentile_95: Tensor
    maximum: Tensor
    rms: Tensor
    rms_after_gain: Tensor
    noise: Tensor


def level_error(
    scene_cheap: Scene | MovingScene,
    scene_reference: Any,
    camera: Camera,
    T_world_cam: Tensor,
) -> LevelError:
    """Relative radiance error of a cheap scene against a reference, seen by a camera along poses
    [T, 4, 4].

    The error of a pixel is relative to the reference there, or to FLOOR of the frame's mean where
    that is more. A reference with ``with_seed`` (PathScene) is rendered twice with independent
    numbers; any other counts as free of noise. No gradient. Returns: LevelError.
    Raises: DomainError when a frame of the reference is black.
    """
    with torch.no_grad():
        first = _flat(camera, scene_reference, T_world_cam)
        second = _again(camera, scene_reference, T_world_cam, first)
        return _compare(_flat(camera, scene_cheap, T_world_cam), first, second)


def _flat(camera, scene, T_world_cam):
    return frames(camera, scene, T_world_cam).double().flatten(1)


def _again(camera, scene, T_world_cam, first):
    """Frames with other random numbers, where a scene draws any."""
    if not hasattr(scene, "with_seed"):
        return first
    return _flat(camera, scene.with_seed(scene.seed + 1), T_world_cam)


def _compare(cheap, first, second):
    reference = (first + second) / 2
    if bool((reference.mean(1) <= 0).any()):
        raise DomainError(
            "level_error: a frame of the reference is black, so no error is relative to it; turn the camera "
            "towards some light."
        )
    size = reference.maximum(FLOOR * reference.mean(1, keepdim=True))
    share = (cheap - reference).abs() / size

    def product(image):
        return ((image - first) * (image - second) / size.square()).mean(1).clamp_min(0).sqrt()

    gain = (cheap * reference / size.square()).sum(1, keepdim=True) / (cheap / size).square().sum(
        1, keepdim=True
    ).clamp_min(1e-300)
    noise = ((first - second) / (2 * size)).square().mean(1).sqrt()
    return LevelError(
        share.mean(1),
        share.quantile(0.95, dim=1),
        share.amax(1),
        product(cheap),
        product(gain * cheap),
        noise,
    )


@dataclass(frozen=True)
class Choice:
    """The level chosen: its name and scene, the reason in one sentence, errors and CPU seconds of
    every level by name."""

    name: str
    scene: Any
    reason: str
    errors: dict[str, LevelError]
    cpu_s: dict[str, float]


def choose(
    levels: Mapping[str, Any],
    camera: Camera,
    T_world_cam: Tensor,
    tolerance: float,
    after_gain: bool = False,
) -> Choice:
    """The cheapest light level whose RMS radiance error against the last one stays within a
    tolerance in every frame.

    Args:
      levels: dictionary name -> scene, the last of them the reference.
      tolerance: share of the radiance.
      after_gain: whether one brightness factor per frame is forgiven, as by a sensor of log
        intensity.
    Returns: Choice. Costs are CPU seconds of rendering these frames once, kernels compiled before.
    Raises: DomainError without levels or for a tolerance that is not positive.
    """
    if not levels:
        raise DomainError("light.choose: there is no level to choose from; give at least one.")
    check_positive(tolerance, "light.choose: tolerance", remedy="such as 0.05 for 5 %")
    *_, last = levels
    cpu_s = {}
    with torch.no_grad():
        pictures = {}
        for name, scene in levels.items():
            _flat(camera, scene, T_world_cam[:1])  # the first call builds kernels
            start = time.process_time()
            pictures[name] = _flat(camera, scene, T_world_cam)
            cpu_s[name] = time.process_time() - start
        other = _again(camera, levels[last], T_world_cam, pictures[last])
    errors = {name: _compare(picture, pictures[last], other) for name, picture in pictures.items()}
    worst = {
        name: 0.0 if name == last else float((e.rms_after_gain if after_gain else e.rms).max())
        for name, e in errors.items()
    }
    name = min((n for n in levels if worst[n] <= tolerance), key=lambda n: cpu_s[n])
    noise = f"noise of the comparison {float(errors[last].noise.max()):.2g}"
    if name == last:
        others = ", ".join(f"{n} {worst[n]:.2g}" for n in levels if n != last)
        reason = f"{name}: no cheaper level stays within {tolerance:g} of it" + (
            f" (RMS errors: {others}; {noise})." if others else "."
        )
    else:
        reason = (
            f"{name}: the cheapest level within {tolerance:g} of {last}, with an RMS error of "
            f"{worst[name]:.2g} ({noise}) for {cpu_s[name]:.2g} CPU-s instead of {cpu_s[last]:.2g}."
        )
    return Choice(name, levels[name], reason, errors, cpu_s)
