"""Emissive textured geometry in Mitsuba: one ray cast and one texture lookup per ray."""

import copy
from collections.abc import Mapping
from dataclasses import replace
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from codesign import backend
from codesign.errors import DomainError
from codesign.exclusive import exclusive
from codesign.reading import reading
from codesign.render.mitsuba_shapes import (
    are_geometric,
    attribute_at,
    attribute_of,
    box_around,
    check_description,
    check_scene,
    eval_repeated,
    repeats,
    shape_numbers,
)
from codesign.render.pixel_means import with_slopes
from codesign.render.silhouettes import outlines
from codesign.render.silhouettes.curves import Segments
from codesign.render.silhouettes.shapes import Bodies, read


class MitsubaScene:
    """A Mitsuba scene whose radiance is read directly from its emitters.

    Args:
      description: a Mitsuba scene dictionary; every shape carries an area emitter (of radiance 0
        where it is black). Also an mi.Scene that is loaded already. Shapes, their places and their
        pictures' uv are remembered: after an update of these make a new MitsubaScene.
      device: "cpu" or "cuda".
      merge: whether Mitsuba may join meshes that look alike into one.
      emissive: whether every shape must have an emitter; False for a scene whose geometry alone is
        asked for.
    Computes in float32. Raises: DomainError when Mitsuba refuses the description, a shape has no
      emitter, a mesh has no faces, vertices that are not finite or faces of vertices that are not
      there, a radiance is negative or not finite.
    """

    dtype = torch.float32
    both_sides = False  # whether surfaces glow on both sides; see ``two_sided``

    @property
    def mi(self) -> Any:
        """Mitsuba, its variant that of the scene's device: another world may have set another."""
        return backend.mitsuba(self._device)

    def __deepcopy__(self, memo):
        return self  # a scene is never changed, so copies of what holds it share it

    @exclusive
    def __init__(
        self,
        description: Mapping[str, Any] | Any,
        device: str = "cpu",
        *,
        merge: bool = True,
        emissive: bool = True,
    ):
        self._device = device
        self._outline = self._bodies = None
        if isinstance(description, self.mi.Scene):
            self.scene: Any = description
        else:
            check_description(self.mi, description)
            self.scene = self._built(description, merge)
            if emissive and merge and not all(shape.is_emitter() for shape in self.scene.shapes()):
                self.scene = self._built(description, False)  # joined meshes have lost their names
        check_scene(self.mi, self.scene, emissive)
        self._numbers = shape_numbers(self.mi, self.scene)
        self._repeats = repeats(self.mi, self.scene)
        self._box = box_around(self.mi, self.scene)

    def _built(self, description, merge):
        with reading(
            "the scene's description", "Mitsuba cannot build the scene from it", DomainError
        ):
            return self.mi.load_dict({"type": "scene", **description}, optimize=merge)

    def two_sided(self) -> "MitsubaScene":
        """The same scene with surfaces that show from behind what they show from in front, as
        sheets and meshes of unknown winding need; otherwise they are black there."""
        twin = copy.copy(self)
        twin.both_sides = True
        twin._outline = None
        return twin

    def radiance(self, arr: Any, origin: Any, direction: Any) -> Any:
        """Radiance along world rays (drjit arrays), 0 where nothing is hit. Gradient: to the rays,
        inside surfaces."""
        return self.radiance_and_distance(arr, origin, direction)[0]

    def radiance_and_distance(self, arr: Any, origin: Any, direction: Any) -> Any:
        """Radiance as above, and the distance to what is hit (infinite where nothing is). Gradient:
        to the rays, the surface taken as its tangent plane."""
        import drjit as dr

        mi = self.mi
        ray = mi.Ray3f(mi.Point3f(origin), mi.Vector3f(direction))
        still = dr.detach(ray)
        found = self.scene.ray_intersect_preliminary(
            still, coherent=True, active=self._ahead(still)
        )
        met = found.is_valid()
        number = self._number(found)
        shown = [*map(self._shown, self.scene.shapes(), self._geometric), self._beyond]
        if not dr.grad_enabled(ray.o, ray.d):
            return dr.switch(number, shown, still.o, still.d, found)[0], found.t
        sloped = [with_slopes(each) for each in shown]
        light, normal, to_origin, to_direction = dr.switch(number, sloped, still.o, still.d, found)
        falling = dr.dot(ray.d, normal)
        along = dr.dot(still(found.t) - ray.o, normal) / dr.select(met & (falling != 0), falling, 1)
        return (
            dr.replace_grad(light, dr.dot(to_origin, ray.o) + dr.dot(to_direction, ray.d)),
            dr.replace_grad(found.t, dr.select(met, along, 0)),
        )

    def _number(self, found):
        """Number of the shape that is met, as many as there are where none is."""
        import drjit as dr

        held = dr.reinterpret_array(self.mi.UInt32, found.shape)
        number = dr.gather(self.mi.UInt32, self._numbers, held, found.is_valid())
        return dr.select(found.is_valid(), number, len(self.scene.shapes()))

    def _ahead(self, ray):
        """Whether rays may meet anything: those that pass by a small object need no cast."""
        if self._box is None:
            return True
        crossed, _, leaves = self._box.ray_intersect(ray)
        return crossed & (leaves > 0)

    @cached_property
    def _geometric(self):
        return [are_geometric(self.mi, shape) for shape in self.scene.shapes()]

    def _shown(self, shape, geometric):
        """What a shape shows to rays that meet it, and its normal there; geometric: as
        ``are_geometric`` says."""
        mi = self.mi

        def shown(origin, direction, found):
            ray = mi.Ray3f(origin, direction)
            si = self._met(shape, geometric, ray, found, mi.RayFlags.UV)
            return self.leaving(shape, si, ray), si.n

        return shown

    def _met(self, shape, geometric, ray, found, asked):
        """Where a ray meets a shape, its normal on the side that the shape's own normals say:
        mirrored rectangles and cubes have theirs on the other one."""
        import drjit as dr

        flags = self.mi.RayFlags
        asked |= flags.Minimal if geometric else flags.ShadingFrame
        si = shape.compute_surface_interaction(ray, found, asked)
        if not geometric:
            si.n = dr.mulsign(si.n, dr.dot(si.n, si.sh_frame.n))
        return si

    def _beyond(self, origin, direction, found):
        """What is seen where nothing is met."""
        mi = self.mi
        return self.sky(direction), mi.Normal3f(0, 0, 0)

    def leaving(self, shape: Any, si: Any, ray: Any) -> Any:
        """Radiance of a shape where it is met (drjit arrays) towards the ray."""
        import drjit as dr

        emitter = shape.emitter()
        if emitter is None:
            return self.mi.Float(0)
        # emission is one-sided by the face: vertex normals are stored to 1 % only and would blacken
        # faces seen nearly edge-on
        facing = -dr.dot(si.n, ray.d)
        return self.emitted(shape, emitter, si, dr.abs(facing) if self.both_sides else facing)

    def emitted(self, shape: Any, emitter: Any, si: Any, facing: Any) -> Any:
        """Radiance that an emitter shows on a shape where it is met (drjit arrays); 0 where
        ``facing`` is negative."""
        import drjit as dr

        si.wi = self.mi.Vector3f(0, 0, facing)
        name = attribute_of(self.mi, shape, emitter)
        if name is None:
            return eval_repeated(self.mi, emitter, si, self._repeats.get(emitter))[0]
        scale = float(self.mi.traverse(emitter)["radiance.scale"])
        return dr.select(facing > 0, scale * attribute_at(self.mi, shape, name, si), 0)

    def sky(self, direction: Any) -> Any:
        """Radiance that comes against directions (drjit arrays) where nothing is met; 0 without a
        sky."""
        import drjit as dr

        mi = self.mi
        environment = self.scene.environment()
        if environment is None:
            return mi.Float(0)
        si = dr.zeros(mi.SurfaceInteraction3f)
        si.wi = -direction
        return environment.eval(si)[0]

    @exclusive
    def outline(self) -> Any:
        """Curves where radiance may jump, see codesign.render.silhouettes; worked out once."""
        if self._outline is None:
            curves = outlines(self._read())
            self._outline = [_never_black(curve) for curve in curves] if self.both_sides else curves
        return self._outline

    def nearest_m(self, eye_m: Tensor) -> float:
        """Distance from a point [3] in world axes below which there is no surface; infinite without
        shapes."""
        if self._bodies is None:
            self._bodies = Bodies.of(self._read())
        return self._bodies.nearest_m(eye_m.detach().cpu().numpy())

    @exclusive
    def _read(self):
        return [read(self.mi, shape) for shape in self.scene.shapes()]

    @exclusive
    def hit(self, origin_m: Tensor, direction: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """First surface met by world rays [N, 3]: point [N, 3], normal [N, 3], valid [N]; no
        gradient, float64 out of float32 geometry."""
        import drjit as dr

        mi = self.mi
        if origin_m.shape[0] == 0:  # a cast of no rays would end the process
            nothing = origin_m.detach()
            return nothing, nothing, torch.zeros_like(nothing[:, 0], dtype=torch.bool)
        o, d = (part.detach().float().unbind(1) for part in (origin_m, direction))
        ray = mi.Ray3f(
            mi.Point3f(*[backend.load(mi.Float, v) for v in o]),
            mi.Vector3f(*[backend.load(mi.Float, v) for v in d]),
        )
        found = self.scene.ray_intersect_preliminary(ray, coherent=True, active=self._ahead(ray))
        n = self._normal(ray, found)
        dr.eval(found.t, n)
        valid, t, normal = (
            torch.as_tensor(v.numpy()).to(origin_m.device) for v in (found.is_valid(), found.t, n)
        )
        valid, t, normal = valid.reshape(-1), t.double(), normal.double()
        t = torch.where(valid, t, torch.ones_like(t))
        return origin_m.detach() + direction.detach() * t[:, None], normal.T, valid

    def _normal(self, ray, found):
        """Normals (drjit arrays) of the surfaces that are met."""
        import drjit as dr

        mi = self.mi
        shapes = self.scene.shapes()
        # met are shapes of its group, not in the list
        if any(shape.class_name() == "Instance" for shape in shapes):
            return found.compute_surface_interaction(ray, mi.RayFlags.Minimal).n

        def of(shape, geometric):
            return lambda ray, found: self._met(shape, geometric, ray, found, mi.RayFlags.Minimal).n

        across = [*map(of, shapes, self._geometric), lambda ray, found: mi.Normal3f(0, 0, 0)]
        return dr.switch(self._number(found), across, ray, found)


def _never_black(curve):
    """Curves of surfaces that show on both sides: an edge that counts from every side counts also
    from that which its faces turn away from."""
    if not isinstance(curve, Segments):
        return curve
    return replace(curve, normals=torch.where(curve.always[:, None, None], 0.0, curve.normals))
