"""Light of a scene, computed once by path tracing and kept as emissive textures.

Outgoing radiance of a Lambertian surface is emission + albedo x irradiance / pi, the same from
every side. Irradiance is smooth, so it is estimated on a coarse light map; albedo and emission are
read at their own resolution; the product is the texture of a ``MitsubaScene``. Of surfaces that
shine, whose radiance depends on where they are seen from, it is the mean over directions (weighted
by their cosine, so that the energy is right), or the radiance towards one point. Surfaces that
reflect on both sides have a texture for each.
"""

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy
import torch

from codesign.checks import check_positive, check_whole
from codesign.errors import DomainError
from codesign.exclusive import exclusive
from codesign.render.atlas import Nodes
from codesign.render.charts import FINE, Chart, Surface, placed, surfaces_of
from codesign.render.placed import Placement, SidedScene
from codesign.render.world import MitsubaScene

# of (1 m + distance from the origin): height over the surface from which a texel is looked at;
# about half of Mitsuba's own ray offset
LIFT = 5e-5
# of launches: a new size is a new kernel, so points are padded to one of these
SIZES = (
    1 << 14,
    1 << 17,
    1 << 20,
)
DARK = 1e-4  # an albedo below this shows no light worth measuring
SHINE = 0.2  # least albedo that light is divided by where part of it is not coloured by the albedo
GRAZING = 0.05  # cosine of the flattest direction that shiny surfaces are looked at from
LEAST_SIDE, MOST_SIDE = 4, 512  # texels of a light map along each side of a shape
MAX_FINE = 1 << 24  # texels of a finished texture


@exclusive
def bake(
    description: Mapping[str, Any] | Any,
    device: str = "cpu",
    *,
    texel_m: float = 0.05,
    samples: int = 64,
    seed: int = 0,
    max_depth: int = 8,
    towards_m: Sequence[float] | None = None,
    matte: bool = False,
    integrator: Any = None,
    lit: bool = True,
    placement: Placement | None = None,
) -> MitsubaScene:
    """A MitsubaScene whose emissive textures are the outgoing radiance of a scene.

    Args:
      description: Mitsuba scene dictionary, or an mi.Scene, of rectangles, disks, spheres,
        cylinders and meshes, area emitters where they glow, and lamps of any kind. Environment maps
        stay in the scene, seen and lighting.
      texel_m: size of light-map texels, from LEAST_SIDE to MOST_SIDE along each side of a shape;
        larger on a mesh that would need more than two million. samples: paths per texel; seed: of
        all of them.
      max_depth: longest path. integrator: a Mitsuba SamplingIntegrator instead.
      towards_m: place from which shiny surfaces look as they are; None shows the mean over
        directions.
      matte: whether mirrors, glass and masks are shown as if they were matte, in their mean
        radiance.
      lit: whether there is light at all; without it what glows shows its emission, anything else
        its albedo.
      placement: of the scene in the world; texel_m and towards_m are the world's.
    Returns: MitsubaScene. Meshes have textures of their own, whatever texture coordinates they come
      with; those finer than their texels have radiance at vertices.
    Error: noise of about 1 / sqrt(samples) of what arrives indirectly, light smeared over a texel
      at contact shadows, pictures read bilinearly, gloss from one direction; see light.level_error.
    Raises: DomainError for mirrors, glass and masks unless ``matte``; media; shapes without known
      charts; of a dictionary, shapes of which nothing can be seen from their front.
    """
    check_positive(texel_m, "bake: texel_m")
    check_whole(samples, "bake: samples")
    # every shape keeps its name
    world = MitsubaScene(description, device, merge=False, emissive=False)
    mi = world.mi
    if lit and integrator is None:
        integrator = mi.load_dict({"type": "path", "max_depth": int(max_depth), "rr_depth": 64})
    place = placement or Placement(torch.eye(3))
    work = Bake(
        mi,
        world.scene,
        integrator if lit else None,
        np.random.default_rng(seed),
        int(samples),
        texel_m / place.unit_m,
        None
        if towards_m is None
        else (np.array(towards_m) @ place.R_world_scene.numpy()) / place.unit_m,
    )
    surfaces = surfaces_of(mi, world.scene, work.texel, matte)
    light = work.radiance(surfaces, strict=isinstance(description, Mapping))
    return shown(world, surfaces, light, place, device)


def shown(
    world: MitsubaScene, surfaces: Sequence[Surface], light: Any, place: Placement, device: str
) -> MitsubaScene:
    """The scene of these surfaces with their light, a list per surface of one array per side, as
    emission, and the sky of the scene they come from."""
    mi = world.mi
    to_world = np.eye(4)
    to_world[:3, :3] = place.unit_m * place.R_world_scene.numpy()
    sky = world.scene.environment()
    description: dict[str, Any] = {} if sky is None else {"sky": sky}
    backs = {}
    # made last: each new object would mean new kernels
    for surface, sides in zip(surfaces, light, strict=True):
        shape, back = placed(mi, surface.chart, to_world, sides)
        shape.set_id(surface.name)
        description[surface.name] = shape
        if back is not None:
            backs[surface.name] = back
    upright = sky is None or bool((place.R_world_scene == torch.eye(3)).all())
    plain = not backs and place.gain == 1 and upright
    return (
        MitsubaScene(description, device)
        if plain
        else SidedScene(description, backs, place, device)
    )


@dataclass(frozen=True)
class Bake:
    """The estimates. texel, towards: in the scene's unit and axes; integrator None takes light to
    be 1 everywhere, which leaves albedo and emission."""

    mi: Any
    scene: Any
    integrator: Any
    random: np.random.Generator
    samples: int
    texel: float
    towards: np.ndarray | None = None

    def radiance(self, surfaces: Sequence[Surface], strict: bool) -> list[list[np.ndarray]]:
        """Outgoing radiance of every side of every surface: textures [H, W], or values [N] of
        nodes. strict:
        whether a surface that nothing can be seen of from its front is an error."""
        jobs = [(surface, side) for surface in surfaces for side in (1, -1)[: surface.sides]]
        found = {}
        for kind, estimate in ((Chart, self._textures(jobs, strict)), (Nodes, self._values(jobs))):
            for (surface, _), value in zip(
                (job for job in jobs if isinstance(job[0].chart, kind)), estimate, strict=True
            ):
                found.setdefault(surface.name, []).append(value)
        return [found[surface.name] for surface in surfaces]

    def _textures(self, jobs, strict):
        """Outgoing radiance [H, W] of each (surface, side) with a chart, in order."""
        jobs = [job for job in jobs if isinstance(job[0].chart, Chart)]
        coarse = [self._coarse(surface.chart) for surface, _ in jobs]
        fine = [self._fine(surface) for surface, _ in jobs]
        total, count = ([np.zeros(rows * columns) for rows, columns in coarse] for _ in range(2))
        if self.integrator is None:
            total = [
                np.full(rows * columns, _unlit(job))
                for job, (rows, columns) in zip(jobs, coarse, strict=True)
            ]
            count = [np.ones_like(part) for part in total]
        there = [False] * len(jobs)
        arriving = self._texels(jobs, coarse, self.samples) if self.integrator else ()
        for (k, texel, _), light, albedo, _, seen in self._stream(arriving, True):
            there[k] |= bool(seen.any())
            seen &= albedo > DARK
            total[k] += np.bincount(texel, np.where(seen, light, 0), len(total[k]))
            count[k] += np.bincount(texel, seen, len(total[k]))
        for k, (surface, side) in enumerate(jobs):
            if strict and self.integrator and side > 0 and not there[k]:
                raise DomainError(
                    f"bake: nothing of shape '{surface.name}' can be seen from its front; another shape "
                    "covers it, or its normals point inwards."
                )
        values = None
        finished = self._texels(jobs, fine, 0)
        for (k, texel, last), _, albedo, emission, seen in self._stream(finished, False):
            size = fine[k][0] * fine[k][1]
            values = np.zeros((3, size)) if values is None else values
            values[:, texel[seen]] = np.stack([albedo, emission, seen])[:, seen]
            if last:
                light = _filled(
                    (total[k] / np.maximum(count[k], 1)).reshape(coarse[k]),
                    (count[k] > 0).reshape(coarse[k]),
                )
                albedo, emission, known = values.reshape(3, *fine[k])
                albedo, emission = (_filled(part, known > 0) for part in (albedo, emission))
                yield (emission + albedo * _resized(light, fine[k])).astype(np.float32)
                values = None

    def _texels(self, jobs, sizes, samples):
        """Random points within texels, ``samples`` each, or their centres for 0: points, normals,
        shiny, (job, texel, whether the last), in blocks."""
        block = max(1, SIZES[-1] // max(samples, 1))
        for k, ((surface, side), (rows, columns)) in enumerate(zip(jobs, sizes, strict=True)):
            for start in range(0, rows * columns, block):
                end = min(start + block, rows * columns)
                texel = np.arange(start, end).repeat(max(samples, 1))
                x, y = self.random.random((2, texel.size)) if samples else (0.5, 0.5)
                at = (texel % columns + x) / columns, (texel // columns + y) / rows
                points, normals, inside = surface.chart.at(*at)
                last = end == rows * columns
                yield (
                    points[inside],
                    side * normals[inside],
                    surface.shiny,
                    (k, texel[inside], last),
                )

    def _stream(self, requests, paths):
        """Answers of ``_look`` to (points, normals, shiny, tag), as (tag, *answers) in order; small
        requests share a launch, since setting one up costs a tenth of a second."""
        waiting = []
        lanes = 0
        for request in itertools.chain(requests, [None]):
            if waiting and (request is None or lanes + len(request[0]) > SIZES[-1]):
                points, normals = (
                    np.concatenate([np.float32(row[k]) for row in waiting]) for k in (0, 1)
                )
                shiny = np.repeat([row[2] for row in waiting], [len(row[0]) for row in waiting])
                ends = np.cumsum([len(row[0]) for row in waiting])[:-1]
                answers = self._look(points, normals, shiny, paths)
                for row, *parts in zip(
                    waiting, *(np.split(part, ends) for part in answers), strict=True
                ):
                    yield row[3], *parts
                waiting = []
                lanes = 0
            if request is not None:
                waiting.append(request)
                lanes += len(request[0])

    def _values(self, jobs):
        """Outgoing radiance [N] of each (surface, side) with nodes: the mean near each; where
        nothing is seen that of the others."""
        jobs = [job for job in jobs if isinstance(job[0].chart, Nodes)]
        total, count = (
            [np.zeros(len(surface.chart.vertices)) for surface, _ in jobs] for _ in range(2)
        )
        lit = self.integrator is not None
        for (k, node), light, albedo, emission, seen in self._stream(self._node_points(jobs), lit):
            out = emission + albedo * (
                np.where(albedo > DARK, light, 0) if lit else _unlit(jobs[k])
            )
            total[k] += np.bincount(node, np.where(seen, out, 0), len(total[k]))
            count[k] += np.bincount(node, seen, len(total[k]))
        for sums, times in zip(total, count, strict=True):
            mean = sums / np.maximum(times, 1)
            yield np.where(times > 0, mean, mean[times > 0].mean() if times.any() else 0.0)

    def _node_points(self, jobs):
        """Random points near nodes: points, normals, shiny, (job, node), in blocks."""
        block = max(1, SIZES[1] // self.samples)
        for k, (surface, side) in enumerate(jobs):
            for start in range(0, len(surface.chart.vertices), block):
                node = np.arange(start, min(start + block, len(surface.chart.vertices))).repeat(
                    self.samples
                )
                points, normals = surface.chart.points(self.random, node)
                yield points, side * normals, surface.shiny, (k, node)

    def _coarse(self, chart):
        """Rows and columns of a light map."""
        if chart.atlas is not None:
            return chart.atlas.texels
        wanted = np.ceil(np.array(chart.size)[::-1] / self.texel)
        return tuple(int(n) for n in np.clip(wanted, LEAST_SIDE, MOST_SIDE))

    def _fine(self, surface):
        """Texels (rows, columns) of the finished texture: those of the pictures on the shape, but
        no more than FINE per light-map texel."""
        chart = surface.chart
        coarse = np.array(self._coarse(chart))
        pictures = np.array(surface.texels_per_uv)
        # the same factor both ways, since its cells lie in all directions
        if chart.atlas is not None:
            per_uv = float(np.sqrt(pictures.prod()))
            per_texel = (
                per_uv * chart.uv_per_unit * chart.size[0] / coarse[1]
                if np.isfinite(per_uv)
                else per_uv
            )
            wanted = max(1, np.ceil(min(per_texel, FINE))) * coarse
        else:
            wanted = np.minimum(np.maximum(2 * coarse, np.ceil(pictures)), FINE * coarse)
        most = np.sqrt(MAX_FINE / np.prod(wanted))
        return tuple(int(n) for n in np.maximum(coarse, wanted * min(1.0, most)))

    def _look(self, points, normals, shiny, paths):
        """Light (irradiance / pi), albedo, emission and whether the surface is there, for points on
        a surface; numpy [N]. Where it is ``shiny`` light comes towards one direction, and albedo is
        no less than SHINE."""
        import drjit as dr

        mi = self.mi
        parts = [[np.zeros(0)] * 3 + [np.zeros(0, dtype=bool)]]
        for start in range(0, len(points), SIZES[-1]):
            p, n, loose = (part[start : start + SIZES[-1]] for part in (points, normals, shiny))
            out = self._directions(p, n, loose)
            count = len(p)
            width = next(size for size in SIZES if size >= len(p))
            lift = LIFT * (1 + np.abs(p).max(1))
            reach = lift / np.maximum((out * n).sum(1), GRAZING)
            p, out, reach, loose = (
                np.concatenate([part, np.broadcast_to(part[-1], (width - count, *part.shape[1:]))])
                for part in (p, out, reach, loose)
            )
            ray = mi.RayDifferential3f(
                mi.Point3f(*_columns(mi, p + reach[:, None] * out)),
                mi.Vector3f(*_columns(mi, -out)),
            )
            si = self.scene.ray_intersect(mi.Ray3f(ray.o, ray.d))
            albedo = si.bsdf().eval_diffuse_reflectance(si)[0]
            albedo = dr.select(mi.Bool(loose), dr.clip(albedo, SHINE, 1), albedo)
            emission = si.emitter(self.scene).eval(si)[0]
            height = mi.Float(reach.astype(np.float32))
            seen = si.is_valid() & (si.t > 0.5 * height) & (si.t < 2 * height)
            light = mi.Float(0)
            if paths:
                sampler = mi.load_dict({"type": "independent"})
                # opaque: one kernel for all calls
                sampler.seed(dr.opaque(mi.UInt32, int(self.random.integers(2**31))), width)
                radiance = self.integrator.sample(self.scene, sampler, ray)[0][0]
                light = dr.maximum(radiance - emission, 0) / dr.maximum(albedo, DARK)
            dr.eval(light, albedo, emission, seen)
            parts.append(
                [
                    np.broadcast_to(np.array(part), (width,))[:count].astype(kind)
                    for part, kind in (
                        (light, float),
                        (albedo, float),
                        (emission, float),
                        (seen, bool),
                    )
                ]
            )
        return [np.concatenate(column) for column in zip(*parts, strict=True)]

    def _directions(self, points, normals, shiny):
        """Where each point is looked at from: along its normal, or where it shines from
        ``towards``, or from anywhere with the density of the cosine."""
        if not shiny.any():
            return normals
        cosine = np.sqrt(self.random.uniform(GRAZING**2, 1, len(points)))[:, None]
        turn = 2 * np.pi * self.random.random((len(points), 1))
        helper = np.where(np.abs(normals[:, :1]) < 0.7, [1.0, 0.0, 0.0], [0.0, 1.0, 0.0])
        u = np.cross(normals, helper)
        u /= np.linalg.norm(u, axis=1, keepdims=True)
        across = np.cos(turn) * u + np.sin(turn) * np.cross(normals, u)
        out = cosine * normals + np.sqrt(1 - cosine**2) * across
        if self.towards is not None:
            there = self.towards - points
            there /= np.maximum(np.linalg.norm(there, axis=1, keepdims=True), 1e-12)
            out = np.where(((there * normals).sum(1) > GRAZING)[:, None], there, out)
        return np.where(shiny[:, None], out, normals)


def _unlit(job):
    """What stands for light at the level without it: what glows shows its emission alone."""
    return 0.0 if job[0].shape.is_emitter() else 1.0


def _columns(mi, rows):
    return [mi.Float(np.ascontiguousarray(rows[:, k], dtype=np.float32)) for k in range(3)]


def _filled(values, known):
    """Unknown texels take the value of the nearest known one."""
    if known.all() or not known.any():
        return values
    how = {"return_distances": False, "return_indices": True}
    nearest: Any = scipy.ndimage.distance_transform_edt(~known, **how)
    return values[nearest[0], nearest[1]]


def _resized(light, shape):
    """Bilinear, texel centres at half-integers as a texture lookup has them."""
    share = np.array(shape) / light.shape
    return scipy.ndimage.zoom(light, share, order=1, mode="nearest", grid_mode=True)
