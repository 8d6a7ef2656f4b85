"""Sequential ray trace through rotationally symmetric surfaces, as one fused drjit kernel.

Intersection with a conic in the form t = F / (G + sqrt(G^2 - A F)), regular at zero curvature (Welford, Aberrations of
Optical Systems, ch. 4); even aspheres by Newton steps from the conic, the last one differentiable, so that the gradient is
that of the implicit function; vector form of Snell's law. A ray that fails is frozen where it failed: its square roots keep
safe inputs, so gradients stay finite, and it carries weight 0, a status and a deficit (how far its radicand fell below zero; 1 where Newton steps found no point of an asphere).
"""

from dataclasses import dataclass, fields, replace
from enum import IntEnum

import torch
from torch import Tensor

from codesign.backend import run_kernel, widen

NEWTON_STEPS = 8
FLAT = 1e-12  # per mm; a surface flatter than this has no far side
FORWARD = 1e-6  # smallest z component of a direction that counts as forward
GRAZING = 1e-8  # smallest radicand taken as a hit; below it the derivative of the square root exceeds 5e3


class Status(IntEnum):
    """What became of a ray."""

    OK = 0
    MISS = 1
    TOTAL_REFLECTION = 2


@dataclass(frozen=True)
class Prescription:
    """Numbers the kernel needs, for one wavelength. Tensors of one dtype and device; gradients flow to all of them.

    curvature_per_mm, thickness_mm, conic, semi_aperture_mm: [S]. asphere: [S, A], coefficients of r^2, r^4, ...
    index: [S + 1], the first before the first surface. soft_edge_mm: full width of the smooth edge of the apertures.
    """

    curvature_per_mm: Tensor
    thickness_mm: Tensor
    conic: Tensor
    asphere: Tensor
    index: Tensor
    semi_aperture_mm: Tensor
    soft_edge_mm: float

    def reversed(self, last_gap_mm):
        """The same lens seen from the image side; ``last_gap_mm`` is the distance of the plane where the rays end."""
        gaps = torch.cat([self.thickness_mm[:-1].flip(0), last_gap_mm.reshape(1)])
        return Prescription(-self.curvature_per_mm.flip(0), gaps, self.conic.flip(0), -self.asphere.flip(0), self.index.flip(0), self.semi_aperture_mm.flip(0), self.soft_edge_mm)

    def to(self, dtype):
        """The same numbers in another precision; gradients flow through."""
        return replace(self, **{f.name: getattr(self, f.name).to(dtype) for f in fields(self)[:-1]})


@dataclass(frozen=True)
class TraceResult:
    """Rays on the plane behind the last thickness.

    position_mm: [N, 3] relative to the plane's centre (z = 0). direction: [N, 3] unit. optical_path_mm: [N].
    weight: [N] product of the soft aperture edges; 0 for failed rays. status: [N] int, see Status.
    failed_surface: [N] int, first surface where the ray failed, -1 if none. deficit: [N] >= 0, dimensionless.
    """

    position_mm: Tensor
    direction: Tensor
    optical_path_mm: Tensor
    weight: Tensor
    status: Tensor
    failed_surface: Tensor
    deficit: Tensor


def trace(prescription, origin_mm, direction):
    """Trace rays from points relative to the first vertex to the plane behind the last thickness.

    Args: origin_mm [N, 3], direction [N, 3] unit, both of the prescription's dtype.
    Returns: TraceResult.
    Gradient: position, direction, optical path, weight and deficit, to rays and to every tensor of the prescription.
    """
    p, count = prescription, origin_mm.shape[0]
    surfaces = p.curvature_per_mm.numel()
    conics = [p.conic.requires_grad or k != 0 for k in p.conic.tolist()]  # its value matters, or its derivative is wanted
    terms = [_last_active(row) for row in p.asphere.unbind(0)] if p.asphere.shape[1] else [0] * surfaces
    refracts = [a != b for a, b in zip(p.index[:-1].tolist(), p.index[1:].tolist(), strict=True)]
    kernel = _Kernel(surfaces, p.asphere.shape[1], tuple(conics), tuple(terms), tuple(refracts))
    ratio = p.index[:-1] / p.index[1:]
    per_mm2 = 0.5 / (max(p.soft_edge_mm, 1e-6) * p.semi_aperture_mm)  # slope of the apertures' edges in r^2
    columns = [origin_mm, direction, p.curvature_per_mm, p.thickness_mm, p.conic, p.index, ratio, per_mm2, p.semi_aperture_mm.square() * per_mm2 + 0.5, p.asphere]
    return TraceResult(*run_kernel(kernel, columns, [(count, 3), (count, 3), *[(count,)] * 5]))


def _last_active(row):
    """Number of asphere terms to compute: up to the last that is not zero, all when derivatives are wanted."""
    values = row.tolist()
    return len(values) if row.requires_grad else max((i + 1 for i, v in enumerate(values) if v != 0), default=0)


@dataclass(frozen=True)
class _Kernel:
    surfaces: int
    asphere_width: int
    conics: tuple[bool, ...]
    terms: tuple[int, ...]
    refracts: tuple[bool, ...]

    def __call__(self, arr, origin, direction, *prescription):
        import drjit as dr

        S = self.surfaces
        c, t, k, n, ratio, per_mm2, reach, terms = (widen(arr, values, dr.width(values), dr.width(origin) // 3) for values in prescription)
        asphere = [terms[i * self.asphere_width :][: self.terms[i]] for i in range(S)]
        alive, path, weight, deficit = dr.full(arr.Bool, True, dr.width(origin) // 3), arr.Float(0), arr.Float(1), arr.Float(0)
        o, d = dr.unravel(arr.Array3, origin), dr.unravel(arr.Array3, direction)
        fate = arr.Int32(-4)  # 4 x surface + status of the failure
        ahead = d.z > FORWARD
        start = dr.select(ahead, -o.z / dr.select(ahead, d.z, 1), 0)  # to the first vertex plane: far objects would drown the quadratic in rounding
        o, path = arr.Array3(o.x + d.x * start, o.y + d.y * start, dr.select(ahead, 0, o.z)), path + n[0] * start
        for i in range(S):
            conic = k[i] if self.conics[i] else None
            step, now, lack = _intersect(arr, o, d, c[i], conic, asphere[i], alive)
            o, path = o + d * step, path + n[i] * step
            weight *= _soft_edge(reach[i] - per_mm2[i] * (dr.square(o.x) + dr.square(o.y)))
            here = arr.Int32(4 * i + Status.MISS)
            if self.refracts[i]:
                plain = conic is None and not asphere[i]
                d, kept, lost = _refract(arr, d, _normal(o if plain else dr.select(now, o, 0), c[i], conic, asphere[i]), ratio[i], now)
                here, lack, now = dr.select(now, arr.Int32(4 * i + Status.TOTAL_REFLECTION), here), dr.select(now, lost, lack), kept
            fails = alive & ~now
            fate, deficit, alive = dr.select(fails, here, fate), dr.select(fails, lack, deficit), now
            o = arr.Array3(o.x, o.y, o.z - t[i])
        forward = alive & (d.z > FORWARD)
        fails = alive & ~forward
        fate, deficit = dr.select(fails, arr.Int32(4 * S + Status.MISS), fate), dr.select(fails, FORWARD - d.z, deficit)
        step = -o.z / dr.select(forward, d.z, 1)
        step = dr.select(forward, step, 0)
        position = arr.Array3(o.x + d.x * step, o.y + d.y * step, 0)
        return dr.ravel(position), dr.ravel(d), path + n[S] * step, dr.select(forward, weight, 0), fate & 3, fate >> 2, deficit


def _intersect(arr, o, d, c, conic, asphere, alive):
    """Distance along the ray to the surface, whether it is met, and the lack of the radicand where it is not (elsewhere it means nothing)."""
    import drjit as dr

    square, along = dr.squared_norm(o), dr.dot(d, o)
    A = c
    if conic is not None:
        square, along, A = square + conic * dr.square(o.z), along + conic * d.z * o.z, c * (1 + conic * dr.square(d.z))
    F, G = c * square - 2 * o.z, d.z - c * along
    radicand = G * G - A * F
    near = G > 0  # else the ray starts behind the centre, as in a ball lens: the other form of the same root, without cancellation
    hit = alive & (radicand > GRAZING) & (near | (dr.abs(A) > FLAT))
    root = dr.sqrt(dr.select(hit, radicand, 1))
    step = dr.select(near, F, G - root) / dr.select(hit, dr.select(near, G + root, A), 1)
    side = 1 - (c if conic is None else c * (1 + conic)) * (o.z + d.z * step)
    lack = dr.select(radicand > GRAZING, dr.select(hit, GRAZING - side, GRAZING - G), GRAZING - radicand)
    hit &= side > GRAZING  # the half (or sheet) that holds the vertex
    step = dr.select(hit, step, 0)
    if not asphere:
        return step, hit, lack
    start = dr.select(hit, dr.detach(step), dr.detach(-o.z / dr.select(dr.abs(d.z) > 1e-6, d.z, 1)))
    with dr.suspend_grad():
        t, od, dd = start, dr.detach(o), dr.detach(d)
        for _ in range(NEWTON_STEPS):
            value, slope, _ = _implicit(arr, od + dd * t, dd, c, conic, asphere)
            t -= value / dr.select(dr.abs(slope) > GRAZING, slope, 1)
        value, slope, inside = _implicit(arr, od + dd * t, dd, c, conic, asphere)
        hit = alive & inside & (slope > GRAZING) & (dr.abs(value) < (1e-10 if dr.type_v(arr.Float) == dr.VarType.Float64 else 1e-4))
        t, slope = dr.select(hit, t, 0), dr.select(hit, slope, 1)
    lack = dr.select(lack > 0, lack, 1)  # the conic is met but no point of the asphere was found
    value, _, _ = _implicit(arr, dr.select(hit, o + d * t, 0), d, c, conic, asphere)
    return dr.select(hit, t - value / slope, 0), hit, lack


def _implicit(arr, p, d, c, conic, asphere):
    """z - sag(r^2) at a point, its derivative along the ray, and whether the conic part exists there."""
    import drjit as dr

    r2 = dr.square(p.x) + dr.square(p.y)
    q = 1 - (c * c * r2 if conic is None else (1 + conic) * c * c * r2)
    inside = q > GRAZING
    root = dr.sqrt(dr.select(inside, q, 1))
    sag, slope = c * r2 / (1 + root), c / (2 * root)
    power, factor = r2, arr.Float(1)
    for i, a in enumerate(asphere):
        sag, slope = sag + a * power, slope + (i + 1) * a * factor
        power, factor = power * r2, factor * r2
    return p.z - sag, d.z - 2 * slope * (p.x * d.x + p.y * d.y), inside


def _normal(o, c, conic, asphere):
    """Unit normal at a point of the surface, towards +z."""
    import drjit as dr

    kind = type(o)
    if not asphere and conic is None:
        return kind(-c * o.x, -c * o.y, 1 - c * o.z)
    if not asphere:
        normal = kind(-c * o.x, -c * o.y, 1 - c * (1 + conic) * o.z)
    else:
        r2 = dr.square(o.x) + dr.square(o.y)
        q = 1 - (c * c * r2 if conic is None else (1 + conic) * c * c * r2)
        slope, factor = c / (2 * dr.sqrt(dr.select(q > GRAZING, q, 1))), type(r2)(1)
        for i, a in enumerate(asphere):
            slope, factor = slope + (i + 1) * a * factor, factor * r2
        normal = kind(-2 * slope * o.x, -2 * slope * o.y, 1)
    return normal / dr.sqrt(dr.maximum(dr.squared_norm(normal), 1e-12))


def _soft_edge(x):
    """Smooth step from 0 to 1 over x in [0, 1]; exactly 0 and 1 outside."""
    import drjit as dr

    u = dr.clip(x, 0, 1)
    return u * u * (3 - 2 * u)


def _refract(arr, d, normal, ratio, alive):
    """Direction after the surface, whether light passes, and the lack of the radicand where it is totally reflected."""
    import drjit as dr

    cosine = dr.dot(d, normal)
    radicand = 1 - ratio * ratio * (1 - cosine * cosine)
    passes = alive & (radicand > GRAZING)
    bent = ratio * d + (dr.sqrt(dr.select(passes, radicand, 1)) - ratio * cosine) * normal
    return dr.select(passes, bent, d), passes, dr.maximum(GRAZING - radicand, 0)
