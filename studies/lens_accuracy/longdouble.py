"""An independent lens in long double: real rays from object points, y-u rays, and the figures made of them.

It shares nothing with codesign.lens: surfaces are met by Newton steps on z - sag, pupils come from two forward y-u
rays, wavefronts from whole path lengths (where ours subtracts first), image-space transforms from plain sums. With 64
bits of mantissa its rounding is some two thousand times finer than float64's.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

L = np.longdouble
PI = np.arctan2(L(0), L(-1))
NEWTON_STEPS = 20
CONVERGED = (
    1e-18  # of a step, relative to the lengths there are; quadratic convergence leaves less than rounding
)


@dataclass(frozen=True)
class System:
    """Numbers of a lens, as they are given in float64. curvature, thickness, conic [S]; asphere [S, A] of r^2, r^4,
    ...; index: line -> [S + 1]; stop: surface; diameter of the entrance pupil at the d line. Lengths in mm."""

    curvature: np.ndarray
    thickness: np.ndarray
    conic: np.ndarray
    asphere: np.ndarray
    index: dict[str, np.ndarray]
    stop: int
    diameter: float

    def __post_init__(self):
        for name in ("curvature", "thickness", "conic", "asphere"):
            object.__setattr__(self, name, np.asarray(getattr(self, name), dtype=L))
        object.__setattr__(self, "index", {k: np.asarray(v, dtype=L) for k, v in self.index.items()})
        object.__setattr__(self, "diameter", L(self.diameter))


@dataclass(frozen=True)
class Rays:
    """On the film: position [N, 2], direction [N, 3], path [N] from the object point, heights [S, N] on the surfaces,
    worst [N] the least cosine of incidence or refraction (NaN where a ray fails)."""

    position: np.ndarray
    direction: np.ndarray
    path: np.ndarray
    heights: np.ndarray
    worst: np.ndarray


def trace(system, line, origin, direction):
    """Rays from ``origin`` to the film."""
    o = origin.astype(L)
    d = direction.astype(L)
    n = system.index[line]
    path = np.zeros(len(o), dtype=L)
    worst = np.ones(len(o), dtype=L)
    heights = []
    for i in range(len(system.curvature)):
        shape = system.curvature[i], system.conic[i], system.asphere[i]
        t = -o[:, 2] / d[:, 2]
        for _ in range(NEWTON_STEPS):
            p = o + d * t[:, None]
            sag, slope = _sag(p[:, 0] ** 2 + p[:, 1] ** 2, *shape)
            step = (p[:, 2] - sag) / (d[:, 2] - slope * (p[:, 0] * d[:, 0] + p[:, 1] * d[:, 1]))
            t = t - step
            if np.abs(step).max() <= CONVERGED * np.abs(t).max():
                break
        p = o + d * t[:, None]
        path = path + n[i] * t
        heights.append(np.hypot(p[:, 0], p[:, 1]))
        slope = _sag(p[:, 0] ** 2 + p[:, 1] ** 2, *shape)[1]
        normal = np.stack([-slope * p[:, 0], -slope * p[:, 1], np.ones_like(t)], 1)
        normal = normal / np.sqrt((normal**2).sum(1))[:, None]
        cosine = (d * normal).sum(1)
        ratio = n[i] / n[i + 1]
        inside = 1 - ratio**2 * (1 - cosine**2)
        d = ratio * d + (np.sqrt(inside) - ratio * cosine)[:, None] * normal
        worst = np.minimum(worst, np.minimum(cosine, np.sqrt(inside)))
        o = p - np.array([0, 0, 1], dtype=L) * system.thickness[i]
    t = -o[:, 2] / d[:, 2]
    worst = np.minimum(worst, d[:, 2])
    return Rays((o + d * t[:, None])[:, :2], d, path + n[-1] * t, np.stack(heights), worst)


def _sag(r2, c, k, asphere):
    """Sag, and its derivative over the height divided by the height."""
    root = np.sqrt(1 - (1 + k) * c * c * r2)
    sag = c * r2 / (1 + root)
    slope = c / root
    for i, a in enumerate(asphere):
        sag = sag + a * r2 ** (i + 1)
        slope = slope + 2 * (i + 1) * a * r2**i
    return sag, slope


def yu(system, line, y, nu):
    """Heights and reduced angles just behind each surface, [S] each, of a paraxial ray at the first vertex."""
    n = system.index[line]
    y = L(y)
    nu = L(nu)
    found = []
    for i, c in enumerate(system.curvature + 2 * system.asphere[:, 0]):
        nu = nu - y * c * (n[i + 1] - n[i])
        found.append((y, nu))
        y = y + system.thickness[i] * nu / n[i + 1]
    return np.array([f[0] for f in found]), np.array([f[1] for f in found])


def entrance_pupil(system, line="d"):
    """Place of the entrance pupil behind the first vertex: rays through the stop's centre aim at it."""
    a = yu(system, line, 1, 0)[0][system.stop]
    b = yu(system, line, 0, 1)[0][system.stop]
    return b / a


def exit_pupil(system, line="d"):
    """Place of the exit pupil behind the last vertex."""
    z = entrance_pupil(system, line)
    y, nu = yu(system, line, -z, 1)
    return -y[-1] * system.index[line][-1] / nu[-1]


def image_place(system, at, line="d"):
    """Paraxial image of the axial point ``at`` mm before the entrance pupil of d, behind the last vertex."""
    y, nu = yu(system, line, at - entrance_pupil(system), 1)
    return -y[-1] * system.index[line][-1] / nu[-1]


def image_scale(system, at, line="d"):
    """Height of the paraxial image per tangent of the field: minus the magnification times the distance."""
    nu = yu(system, line, at - entrance_pupil(system), 1)[1]
    return -L(at) / nu[-1]


def object_rays(system, field, pupil, at):
    """Origins (the object point) and directions [N, 3] to points [N, 2] of the unit disc of the entrance pupil."""
    z = entrance_pupil(system)
    point = np.array([0, -L(at) * np.tan(L(field)), z - L(at)], dtype=L)
    aim = np.concatenate([pupil.astype(L) * system.diameter / 2, np.full((len(pupil), 1), z, dtype=L)], 1)
    away = aim - point
    return np.broadcast_to(point, away.shape), away / np.sqrt((away**2).sum(1))[:, None]


def field_rays(system, line, field, pupil, at):
    """Rays of an object point through pupil points [N, 2]."""
    return trace(system, line, *object_rays(system, field, pupil, at))


def rms(points):
    """RMS distance from the mean point."""
    return np.sqrt(((points - points.mean(0)) ** 2).sum(1).mean())


def path_differences(system, line, rays, chief):
    """Path of the chief ray minus that of each ray [N], from the object point to the sphere about the chief ray's
    point on the film through the centre of the exit pupil; and slopes [N, 2], n times the direction cosines from
    the sphere to that point, minus the chief ray's."""
    centre = np.array([*chief.position[0], 0], dtype=L)
    before = system.thickness[-1] - exit_pupil(system, line)
    radius = np.sqrt(before**2 + (centre**2).sum())
    n = system.index[line][-1]

    def to_sphere(bundle):
        from_centre = np.concatenate([bundle.position, np.zeros((len(bundle.path), 1), dtype=L)], 1) - centre
        b = (from_centre * bundle.direction).sum(1)
        root = np.sqrt(b * b - (from_centre**2).sum(1) + radius**2)
        length = -b - np.sign(before) * root  # along the ray, to the side of the pupil
        return bundle.path + n * length, -n * (from_centre + bundle.direction * length[:, None])[:, :2] / (
            radius * np.sign(before)
        )

    mine, slope = to_sphere(rays)
    whole, straight = to_sphere(chief)
    return whole[0] - mine, slope - straight[0]


def seidel(system, field, at):
    """S_I to S_V, C_I, C_II of each surface, [7, S] mm: Welford's sums, with S_V = (A_bar / A) (S_III + S_IV)."""
    z = entrance_pupil(system)
    u = system.diameter / 2 / L(at)
    u_bar = np.tan(L(field))
    n = system.index["d"]
    y, nu = yu(system, "d", u * (L(at) - z), u)
    y_bar, nu_bar = yu(system, "d", -u_bar * z, u_bar)
    nu = np.concatenate([[u], nu])
    nu_bar = np.concatenate([[u_bar], nu_bar])
    c = system.curvature + 2 * system.asphere[:, 0]
    A = nu[:-1] + n[:-1] * c * y
    A_bar = nu_bar[:-1] + n[:-1] * c * y_bar
    jump = nu[1:] / n[1:] ** 2 - nu[:-1] / n[:-1] ** 2
    H = nu_bar[0] * y[0] - nu[0] * y_bar[0]
    quartic = system.asphere[:, 1] if system.asphere.shape[1] > 1 else 0
    figure = (1 + system.conic) * system.curvature**3 / 8 + quartic - c**3 / 8
    plate = 8 * figure * (n[1:] - n[:-1])
    third = -(A_bar**2) * y * jump
    fourth = -(H**2) * c * (1 / n[1:] - 1 / n[:-1])
    spread = (system.index["F"] - system.index["C"]) / n
    colour = spread[1:] - spread[:-1]
    return np.stack(
        [
            -(A**2) * y * jump + plate * y**4,
            -A * A_bar * y * jump + plate * y**3 * y_bar,
            third + plate * (y * y_bar) ** 2,
            fourth,
            A_bar / A * (third + fourth) + plate * y * y_bar**3,
            A * y * colour,
            A_bar * y * colour,
        ]
    )


def focus_shifts(system, line, field, at, reach=1e-3):
    """Tangential and sagittal focus behind the film, [2]: limits of close rays by extrapolation."""
    found = []
    for axis in (1, 0):
        estimates = []
        for share in (1, 0.5, 0.25):
            pupil = np.zeros((2, 2), dtype=L)
            pupil[:, axis] = np.array([1, -1]) * L(reach) * share
            rays = field_rays(system, line, field, pupil, at)
            slope = rays.direction[:, axis] / rays.direction[:, 2]
            position = rays.position[:, axis]
            estimates.append(-(position[0] - position[1]) / (slope[0] - slope[1]))
        # errors go as the square and the fourth power of the reach
        first = [(4 * b - a) / 3 for a, b in pairwise(estimates)]
        found.append((16 * first[1] - first[0]) / 15)
    return np.array(found)


def least_spot(bundles):
    """Shift of the film to the least mean square spot of several bundles (position, slope)."""
    product = L(0)
    square = L(0)
    for position, slope in bundles:
        p = position - position.mean(0)
        s = slope - slope.mean(0)
        product = product + (p * s).sum() / len(p)
        square = square + (s * s).sum() / len(p)
    return -product / square
