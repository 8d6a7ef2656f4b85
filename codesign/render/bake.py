"""Light of a Lambertian scene, computed once by path tracing and kept as emissive textures.

Outgoing radiance of a Lambertian surface is emission + albedo x irradiance / pi, the same from every side.
Irradiance is smooth, so it is estimated on a coarse light map; albedo and emission are read at their own
resolution; the product is the texture of a ``MitsubaScene``.
"""

import itertools
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.ndimage import distance_transform_edt, zoom

from codesign.errors import DomainError
from codesign.render.charts import Faces, charts_of, placed
from codesign.render.world import MitsubaScene

# of (1 m + distance from the origin): height over the surface from which a texel is looked at; about half of
# Mitsuba's own ray offset
LIFT = 5e-5
SIZES = (
    1 << 14,
    1 << 17,
    1 << 20,
)  # of launches: a new size is a new kernel, so points are padded to one of these
FACE = 8  # times the samples of a texel for a face, since faces are larger than texels
DARK = 1e-4  # an albedo below this shows no light worth measuring
INVISIBLE = ("point", "directional", "spot")  # lamps that no camera ray meets


def bake(
    description: Mapping[str, Any],
    device: str = "cpu",
    *,
    texel_m: float = 0.05,
    samples: int = 64,
    seed: int = 0,
    max_depth: int = 8,
    max_texels: int = 512,
    fine: int = 10,
) -> MitsubaScene:
    """A MitsubaScene whose emissive textures are the outgoing radiance of a Lambertian scene.

    Args:
      description: Mitsuba scene dictionary of rectangles, disks, spheres, cylinders, cubes and meshes
        (dictionaries, or mi.Mesh objects) with 'diffuse' BSDFs, area emitters where they glow, and lamps of
        any kind. Environment maps stay in the scene, seen and lighting.
      texel_m: size of light-map texels, from 4 to max_texels along each side of a shape. samples: paths per
        texel; seed: of all of them.
      max_depth: longest path. fine: texels of a finished texture per light-map texel along each side, unless
        its picture is coarser than that.
    Returns: MitsubaScene. Meshes without texture coordinates get one radiance per face, cubes a texture of
      six parts.
    Error: noise of about 1 / sqrt(samples) of what arrives indirectly, light smeared over a texel at contact
      shadows; see light.level_error.
    Raises: DomainError for surfaces that are not diffuse (their radiance depends on the side one looks from),
      two-sided ones (one texture per surface), shapes without known charts, texture coordinates that overlap
      or leave the unit square.
    """
    if not (texel_m > 0 and samples >= 1 and max_texels >= 4 and fine >= 1):
        raise DomainError(
            f"bake: texel_m = {texel_m}, samples = {samples}, max_texels = {max_texels}, fine = {fine}: "
            "sizes must be positive, samples and fine at least 1, max_texels at least 4."
        )
    lit = MitsubaScene(description, device, merge=False, emissive=False)  # every shape keeps its name
    mi = lit.mi
    _check_surfaces(mi, lit.scene, description)
    work = _Bake(
        mi,
        lit.scene,
        mi.load_dict({"type": "path", "max_depth": int(max_depth), "rr_depth": 64}),
        np.random.default_rng(seed),
        int(samples),
        float(texel_m),
        int(max_texels),
        int(fine),
    )
    shapes = {shape.id(): shape for shape in lit.scene.shapes()}
    kept = {}
    found = {}
    for name, entry in description.items():
        kind = entry.get("type") if isinstance(entry, dict) else None
        if kind in ("envmap", "constant", "sunsky"):
            kept[name] = entry
        elif isinstance(entry, mi.Shape) or name in shapes:
            shape = entry if kind is None else shapes[name]
            found[name] = (entry, shape, charts_of(mi, name, entry, shape))
        elif kind not in INVISIBLE and isinstance(entry, dict):
            raise DomainError(
                f"bake: '{name}' of type '{kind}' is neither a shape nor a light that is known here; leave "
                "it out."
            )
    textures = work.textures(
        [
            (name, entry, chart)
            for name, (entry, _, charts) in found.items()
            if not isinstance(charts, Faces)
            for chart in charts
        ]
    )
    radiance = {
        name: work.faces(charts) if isinstance(charts, Faces) else [next(textures) for _ in charts]
        for name, (_, _, charts) in found.items()
    }
    return MitsubaScene(
        {
            **{
                name: placed(mi, entry, shape, charts, radiance[name])
                for name, (entry, shape, charts) in found.items()
            },
            **kept,
        },
        device,
    )  # made last: each new object would mean new kernels


def _check_surfaces(mi, scene, description):
    for shape in scene.shapes():
        bsdf = shape.bsdf()
        if bsdf is None:
            continue
        flags = bsdf.flags()
        name = shape.id()
        lambertian = (
            int(mi.BSDFFlags.DiffuseReflection)
            | int(mi.BSDFFlags.FrontSide)
            | int(mi.BSDFFlags.SpatiallyVarying)
        )
        if int(flags) & int(mi.BSDFFlags.BackSide):
            raise DomainError(
                f"bake: shape '{name}' reflects on both sides, and one texture holds one; use a plain "
                "'diffuse' surface on a closed shape."
            )
        if int(flags) & ~lambertian:
            raise DomainError(
                f"bake: shape '{name}' is not Lambertian, so its radiance depends on where it is seen from; "
                "use 'diffuse', or PathScene."
            )


@dataclass(frozen=True)
class _Bake:
    mi: Any
    scene: Any
    integrator: Any
    random: np.random.Generator
    samples: int
    texel_m: float
    max_texels: int
    fine: int

    def textures(self, jobs):
        """Outgoing radiance [H, W] of each (name, entry, chart), in order."""
        coarse = [self._coarse(chart) for _, _, chart in jobs]
        fine = [self._fine(entry, chart) for _, entry, chart in jobs]
        total, count = ([np.zeros(rows * columns) for rows, columns in coarse] for _ in range(2))
        there = [False] * len(jobs)
        for (k, texel, inside), light, albedo, _, seen in self._stream(
            self._coarse_points(jobs, coarse), True
        ):
            seen &= inside
            there[k] |= bool(seen.any())
            seen &= albedo > DARK
            total[k] += np.bincount(texel, np.where(seen, light, 0), len(total[k]))
            count[k] += np.bincount(texel, seen, len(total[k]))
        for k, (name, _, _) in enumerate(jobs):
            if not there[k]:
                raise DomainError(
                    f"bake: nothing of shape '{name}' can be seen from its front; another shape covers it, "
                    "or its normals point inwards."
                )
        for (k, inside), _, albedo, emission, seen in self._stream(self._fine_points(jobs, fine), False):
            light = _filled(
                (total[k] / np.maximum(count[k], 1)).reshape(coarse[k]), (count[k] > 0).reshape(coarse[k])
            )
            seen = (seen & inside).reshape(fine[k])
            albedo, emission = (_filled(part.reshape(fine[k]), seen) for part in (albedo, emission))
            yield (emission + albedo * _resized(light, fine[k])).astype(np.float32)

    def _coarse_points(self, jobs, sizes):
        """Random points within light-map texels: points, normals, (job, texel, on the surface), in blocks."""
        block = max(1, SIZES[-1] // self.samples)
        for k, ((_, _, chart), (rows, columns)) in enumerate(zip(jobs, sizes, strict=True)):
            for start in range(0, rows * columns, block):
                texel = np.repeat(np.arange(start, min(start + block, rows * columns)), self.samples)
                shift = self.random.random((2, texel.size))
                points, normals, inside = chart.at(
                    (texel % columns + shift[0]) / columns, (texel // columns + shift[1]) / rows
                )
                yield points, normals, (k, texel, inside)

    def _fine_points(self, jobs, sizes):
        """Centres of the texels of finished textures: points, normals, (job, on the surface)."""
        for k, ((_, _, chart), (rows, columns)) in enumerate(zip(jobs, sizes, strict=True)):
            v, u = np.divmod(np.arange(rows * columns), columns)
            points, normals, inside = chart.at((u + 0.5) / columns, (v + 0.5) / rows)
            yield points, normals, (k, inside)

    def _stream(self, requests, paths):
        """Answers of ``_look`` to (points, normals, tag), as (tag, *answers) in order; small requests share a
        launch, since setting one up costs a tenth of a second."""
        waiting = []
        lanes = 0
        for request in itertools.chain(requests, [None]):
            if waiting and (request is None or lanes + len(request[0]) > SIZES[-1]):
                points, normals = (np.concatenate([np.float32(row[k]) for row in waiting]) for k in (0, 1))
                ends = np.cumsum([len(row[0]) for row in waiting])[:-1]
                for (_, _, tag), *answers in zip(
                    waiting,
                    *(np.split(part, ends) for part in self._look(points, normals, paths)),
                    strict=True,
                ):
                    yield tag, *answers
                waiting = []
                lanes = 0
            if request is not None:
                waiting.append(request)
                lanes += len(request[0])

    def _fine(self, entry, chart):
        """Texels (rows, columns) of the finished texture: those of the pictures on the shape, but no more
        than ``fine`` per light-map texel."""
        coarse = np.array(self._coarse(chart))
        wanted = [2 * coarse]
        for surface, slot in (("bsdf", "reflectance"), ("emitter", "radiance")):
            picture = (
                entry.get(surface, {}).get(slot)
                if isinstance(entry, dict) and isinstance(entry.get(surface), dict)
                else None
            )
            if isinstance(picture, dict) and picture.get("type") == "bitmap" and "bitmap" in picture:
                columns, rows = picture["bitmap"].size()
                scale = np.array(picture["to_uv"].matrix, dtype=float) if "to_uv" in picture else np.eye(3)
                wanted.append(np.ceil([rows * abs(scale[1, 1]), columns * abs(scale[0, 0])]))
        return tuple(int(n) for n in np.minimum(np.max(wanted, 0), np.maximum(self.fine, 2) * coarse))

    def _coarse(self, chart):
        return tuple(
            int(n) for n in np.clip(np.ceil(np.array(chart.size_m)[::-1] / self.texel_m), 4, self.max_texels)
        )

    def faces(self, charts):
        """Outgoing radiance [F] of faces."""
        points, normals = charts.points(self.random, FACE * self.samples)
        light, albedo, emission, seen = (
            part.reshape(points.shape[:2])
            for part in self._look(points.reshape(-1, 3), np.repeat(normals, FACE * self.samples, 0), True)
        )
        return (np.where(seen, emission + albedo * light, 0).sum(1) / np.maximum(seen.sum(1), 1)).astype(
            np.float32
        )

    def _look(self, points, normals, paths):
        """Light (irradiance / pi), albedo, emission and whether the surface is there, for points just before
        a surface; numpy [N]."""
        import drjit as dr

        mi = self.mi
        parts = []
        for start in range(0, len(points), SIZES[-1]):
            p = points[start : start + SIZES[-1]]
            n = normals[start : start + SIZES[-1]]
            count = len(p)
            width = next(size for size in SIZES if size >= len(p))
            p, n = (np.concatenate([part, np.broadcast_to(part[-1], (width - count, 3))]) for part in (p, n))
            lift = LIFT * (1 + np.abs(p).max(1))
            ray = mi.RayDifferential3f(
                mi.Point3f(*_columns(mi, p + lift[:, None] * n)), mi.Vector3f(*_columns(mi, -n))
            )
            si = self.scene.ray_intersect(mi.Ray3f(ray.o, ray.d))
            bsdf = si.bsdf()
            albedo = bsdf.eval_diffuse_reflectance(si)[0]
            emission = si.emitter(self.scene).eval(si)[0]
            height = mi.Float(lift.astype(np.float32))
            seen = si.is_valid() & (si.t > 0.5 * height) & (si.t < 2 * height)
            light = mi.Float(0)
            if paths:
                sampler = mi.load_dict({"type": "independent"})
                sampler.seed(
                    dr.opaque(mi.UInt32, int(self.random.integers(2**31))), width
                )  # opaque: one kernel for all calls
                radiance = self.integrator.sample(self.scene, sampler, ray)[0][0]
                light = dr.maximum(radiance - emission, 0) / dr.maximum(albedo, DARK)
            dr.eval(light, albedo, emission, seen)
            parts.append(
                [
                    np.broadcast_to(np.array(part), (width,))[:count].astype(kind)
                    for part, kind in ((light, float), (albedo, float), (emission, float), (seen, bool))
                ]
            )
        return [np.concatenate(column) for column in zip(*parts, strict=True)]


def _columns(mi, rows):
    return [mi.Float(np.ascontiguousarray(rows[:, k], dtype=np.float32)) for k in range(3)]


def _filled(values, known):
    """Unknown texels take the value of the nearest known one."""
    if known.all() or not known.any():
        return values
    nearest: Any = distance_transform_edt(~known, return_distances=False, return_indices=True)
    return values[nearest[0], nearest[1]]


def _resized(light, shape):
    """Bilinear, texel centres at half-integers as a texture lookup has them."""
    return zoom(light, np.array(shape) / light.shape, order=1, mode="nearest", grid_mode=True)
