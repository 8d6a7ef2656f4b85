"""The ray-trace kernel: one fused drjit program for a whole lens.

Intersection with a conic in the form t = F / (G + sqrt(G^2 - A F)), regular at zero curvature
(Welford, Aberrations of Optical Systems, ch. 4); even aspheres by Newton steps from the conic, the
last one differentiable, so that the gradient is that of the implicit function; vector forms of
Snell's law, reflection and the local grating equation. A ray that fails is frozen where it failed:
its square roots keep safe inputs, so gradients stay finite, and it carries weight 0, a status and a
deficit (how far its radicand fell below zero; 1 where Newton steps found no point of an asphere).
"""

from dataclasses import dataclass
from enum import IntEnum
from typing import Any

from codesign.backend import widen

NEWTON_STEPS = 8
FLAT = 1e-12  # per mm; a surface flatter than this has no far side
FORWARD = 1e-6  # smallest z component of a direction that counts as forward
# smallest radicand taken as a hit; below it the derivative of the square root exceeds 5e3
GRAZING = 1e-8


class Status(IntEnum):
    """What became of a ray."""

    OK = 0
    MISS = 1
    TOTAL_REFLECTION = 2


@dataclass(frozen=True)
class Works:
    """What one surface needs of the kernel; what it does not need is not compiled.

    conic, refracts, mirror, moved (decentred or tilted), obstructed: whether; asphere, path: how
    many terms.
    """

    conic: bool
    asphere: int
    refracts: bool
    mirror: bool
    path: int
    moved: bool
    obstructed: bool


@dataclass(frozen=True)
class Kernel:
    """The program for one sequence of surfaces. Called with flat drjit arrays: see ``trace.trace``
    for what they hold."""

    works: tuple[Works, ...]
    asphere_width: int
    path_width: int
    to_plane: bool

    @property
    def special(self) -> bool:
        """Whether any surface diffracts, is moved, or carries an obstruction."""
        return any(w.path or w.moved or w.obstructed for w in self.works)

    def __call__(
        self,
        arr: Any,
        origin: Any,
        direction: Any,
        *prescription: Any,
    ) -> tuple[Any, ...]:
        import drjit as dr

        count = dr.width(origin) // 3
        c, t, k, n, ratio, per_mm2, reach, terms, *special = (
            widen(arr, values, dr.width(values), count) for values in prescription
        )
        path_terms, decentre, cosines, sines, inner_per_mm2, inner_reach = special or [[]] * 6
        alive = dr.full(arr.Bool, True, count)
        path = arr.Float(0)
        weight = arr.Float(1)
        deficit = arr.Float(0)
        o = dr.unravel(arr.Array3, origin)
        d = dr.unravel(arr.Array3, direction)
        # 8 x surface + status of the failure
        packed_status = arr.Int32(-8)
        inside = dr.full(arr.Bool, True, count)
        travels_forward = d.z > FORWARD
        # to the first vertex plane: far objects would drown the quadratic in rounding
        start = dr.select(travels_forward, -o.z / dr.select(travels_forward, d.z, 1), 0)
        o = arr.Array3(o.x + d.x * start, o.y + d.y * start, dr.select(travels_forward, 0, o.z))
        path = path + n[0] * start
        for i, work in enumerate(self.works):
            pair = slice(2 * i, 2 * i + 2)
            frame = _Frame(*decentre[pair], *cosines[pair], *sines[pair]) if work.moved else None
            if frame:
                o, d = frame.enter(o, d)
            conic = k[i] if work.conic else None
            asphere = terms[i * self.asphere_width :][: work.asphere]
            step, now, shortfall = _intersect(arr, o, d, c[i], conic, asphere, alive)
            o = o + d * step
            path = path + n[i] * step
            r2 = dr.square(o.x) + dr.square(o.y)
            edges = [reach[i] - per_mm2[i] * r2]
            if work.obstructed:
                edges.append(inner_reach[i] + inner_per_mm2[i] * r2)
            for edge in edges:  # 1/2 at the edge itself
                weight *= _soft_edge(edge)
                inside &= (edge >= 0.5) | ~now
            here = arr.Int32(8 * i + Status.MISS)
            if work.refracts or work.mirror or work.path:
                plain = conic is None and not asphere
                normal = _normal(o if plain else dr.select(now, o, 0), c[i], conic, asphere)
                if work.mirror:
                    d = dr.select(now, d - 2 * dr.dot(d, normal) * normal, d)
                else:
                    if work.path:
                        phase = path_terms[i * self.path_width :][: work.path]
                        added, gradient = _diffraction(arr, o, r2, phase)
                        path = path + dr.select(now, added, 0)
                        d, kept, lost = _diffract(d, normal, gradient, n[i], n[i + 1], now)
                    else:
                        d, kept, lost = _refract(d, normal, ratio[i], now)
                    here = dr.select(now, arr.Int32(8 * i + Status.TOTAL_REFLECTION), here)
                    shortfall = dr.select(now, lost, shortfall)
                    now = kept
            fails = alive & ~now
            packed_status = dr.select(fails, here, packed_status)
            deficit = dr.select(fails, shortfall, deficit)
            alive = now
            if frame:
                o, d = frame.leave(o, d)
            if work.mirror:
                o = arr.Array3(o.x, o.y, -o.z)
                d = arr.Array3(d.x, d.y, -d.z)
            if self.to_plane or i + 1 < len(self.works):
                o = arr.Array3(o.x, o.y, o.z - t[i])
        S = len(self.works)
        forward = alive & (d.z > FORWARD)
        fails = alive & ~forward
        packed_status = dr.select(fails, arr.Int32(8 * S + Status.MISS), packed_status)
        deficit = dr.select(fails, FORWARD - d.z, deficit)
        position = o
        if self.to_plane:
            step = dr.select(forward, -o.z / dr.select(forward, d.z, 1), 0)
            position = arr.Array3(o.x + d.x * step, o.y + d.y * step, 0)
            path = path + n[S] * step
        return (
            dr.ravel(position),
            dr.ravel(d),
            path,
            dr.select(forward, weight, 0),
            dr.select(inside, packed_status + 4, packed_status),
            deficit,
        )


@dataclass(frozen=True)
class _Frame:
    """Axes of a decentred and tilted surface: shifted by (x, y), turned about x (a), then about its
    own y (b)."""

    x: Any
    y: Any
    cos_a: Any
    cos_b: Any
    sin_a: Any
    sin_b: Any

    def enter(self, o, d):
        return self._turn_in(type(o)(o.x - self.x, o.y - self.y, o.z)), self._turn_in(d)

    def leave(self, o, d):
        o = self._turn_out(o)
        return type(o)(o.x + self.x, o.y + self.y, o.z), self._turn_out(d)

    def _turn_in(self, v):
        y = v.y * self.cos_a + v.z * self.sin_a
        z = v.z * self.cos_a - v.y * self.sin_a
        return type(v)(v.x * self.cos_b - z * self.sin_b, y, v.x * self.sin_b + z * self.cos_b)

    def _turn_out(self, v):
        x = v.x * self.cos_b + v.z * self.sin_b
        z = v.z * self.cos_b - v.x * self.sin_b
        return type(v)(x, v.y * self.cos_a - z * self.sin_a, v.y * self.sin_a + z * self.cos_a)


def _intersect(arr, o, d, c, conic, asphere, alive):
    """Distance along the ray to the surface, whether it is met, and the shortfall of the radicand
    where it is not (elsewhere it means nothing)."""
    import drjit as dr

    square = dr.squared_norm(o)
    d_dot_o = dr.dot(d, o)
    A = c
    if conic is not None:
        square = square + conic * dr.square(o.z)
        d_dot_o = d_dot_o + conic * d.z * o.z
        A = c * (1 + conic * dr.square(d.z))
    F = c * square - 2 * o.z
    G = d.z - c * d_dot_o
    radicand = G * G - A * F
    near = (
        G > 0
        # else the ray starts behind the centre, as in a ball lens: the other form of the same root,
        # without cancellation
    )
    hit = alive & (radicand > GRAZING) & (near | (dr.abs(A) > FLAT))
    root = dr.sqrt(dr.select(hit, radicand, 1))
    step = dr.select(near, F, G - root) / dr.select(hit, dr.select(near, G + root, A), 1)
    side = 1 - (c if conic is None else c * (1 + conic)) * (o.z + d.z * step)
    shortfall = dr.select(
        radicand > GRAZING, dr.select(hit, GRAZING - side, GRAZING - G), GRAZING - radicand
    )
    hit &= side > GRAZING  # the half (or sheet) that holds the vertex
    step = dr.select(hit, step, 0)
    if not asphere:
        return step, hit, shortfall
    start = dr.select(hit, dr.detach(step), dr.detach(-o.z / dr.select(dr.abs(d.z) > 1e-6, d.z, 1)))
    with dr.suspend_grad():
        t = start
        od = dr.detach(o)
        dd = dr.detach(d)
        for _ in range(NEWTON_STEPS):
            value, slope, _ = _implicit(od + dd * t, dd, c, conic, asphere)
            t -= value / dr.select(dr.abs(slope) > GRAZING, slope, 1)
        value, slope, inside = _implicit(od + dd * t, dd, c, conic, asphere)
        hit = (
            alive
            & inside
            & (slope > GRAZING)
            & (dr.abs(value) < (1e-10 if dr.type_v(arr.Float) == dr.VarType.Float64 else 1e-4))
        )
        t = dr.select(hit, t, 0)
        slope = dr.select(hit, slope, 1)
    # 1 where the conic is met but no point of the asphere was found
    shortfall = dr.select(shortfall > 0, shortfall, 1)
    value, _, _ = _implicit(dr.select(hit, o + d * t, 0), d, c, conic, asphere)
    return dr.select(hit, t - value / slope, 0), hit, shortfall


def _implicit(p, d, c, conic, asphere):
    """z - sag(r^2) at a point, its derivative along the ray, and whether the conic part exists
    there."""
    r2, slope, root, inside = _slope(p, c, conic, asphere)
    sag = c * r2 / (1 + root)
    power = r2
    for a in asphere:
        sag = sag + a * power
        power = power * r2
    return p.z - sag, d.z - 2 * slope * (p.x * d.x + p.y * d.y), inside


def _slope(p, c, conic, asphere):
    """r^2, the derivative of the sag to it, the root of the conic part, and whether that exists."""
    import drjit as dr

    r2 = dr.square(p.x) + dr.square(p.y)
    q = 1 - (c * c * r2 if conic is None else (1 + conic) * c * c * r2)
    inside = q > GRAZING
    root = dr.sqrt(dr.select(inside, q, 1))
    slope = c / (2 * root)
    factor = type(r2)(1)
    for i, a in enumerate(asphere):
        slope = slope + (i + 1) * a * factor
        factor = factor * r2
    return r2, slope, root, inside


def _normal(o, c, conic, asphere):
    """Unit normal at a point of the surface, towards +z."""
    import drjit as dr

    kind = type(o)
    if not asphere and conic is None:
        return kind(-c * o.x, -c * o.y, 1 - c * o.z)
    if not asphere:
        normal = kind(-c * o.x, -c * o.y, 1 - c * (1 + conic) * o.z)
    else:
        _, slope, _, _ = _slope(o, c, conic, asphere)
        normal = kind(-2 * slope * o.x, -2 * slope * o.y, 1)
    return normal / dr.sqrt(dr.maximum(dr.squared_norm(normal), 1e-12))


def _soft_edge(x):
    """Smooth step from 0 to 1 over x in [0, 1]; exactly 0 and 1 outside."""
    import drjit as dr

    u = dr.clip(x, 0, 1)
    return u * u * (3 - 2 * u)


def _refract(d, normal, ratio, alive):
    """Direction after the surface, whether light passes, and the shortfall of the radicand where it
    is totally reflected."""
    import drjit as dr

    cosine = dr.dot(d, normal)
    radicand = 1 - ratio * ratio * (1 - cosine * cosine)
    passes = alive & (radicand > GRAZING)
    bent = ratio * d + (dr.sqrt(dr.select(passes, radicand, 1)) - ratio * cosine) * normal
    return dr.select(passes, bent, d), passes, dr.maximum(GRAZING - radicand, 0)


def _diffraction(arr, o, r2, terms):
    """Optical path that a phase adds at a point, and its gradient across the axis."""
    path = arr.Float(0)
    slope = arr.Float(0)
    power = arr.Float(1)
    for i, a in enumerate(terms):
        slope = slope + 2 * (i + 1) * a * power
        power = power * r2
        path = path + a * power
    return path, arr.Array3(slope * o.x, slope * o.y, 0)


def _diffract(d, normal, gradient, before, after, alive):
    """Local grating equation: the tangential part of n d gains the tangential gradient of the added
    path. Returns as ``_refract``."""
    import drjit as dr

    across = before * d + gradient
    across = across - dr.dot(across, normal) * normal
    radicand = 1 - dr.squared_norm(across) / dr.square(after)
    passes = alive & (radicand > GRAZING)
    bent = across / after + dr.sqrt(dr.select(passes, radicand, 1)) * normal
    return dr.select(passes, bent, d), passes, dr.maximum(GRAZING - radicand, 0)
