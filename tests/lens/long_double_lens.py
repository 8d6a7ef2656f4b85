"""An independent lens in long double, for tests: real rays from object points, paraxial rays,
random systems.

It shares nothing with codesign.lens: surfaces are met by Newton steps on z - sag, pupils come from
two forward paraxial rays, wavefronts from whole path lengths (where ours subtracts first). With 64
bits of mantissa its rounding is some two thousand times finer than float64's. Beside it a tracer of
spheres from one local frame to the next, for what is tilted and shifted.
"""

from dataclasses import dataclass

import numpy as np

L = np.longdouble
NEWTON_STEPS = 12
FIELDS = (0.0, 0.1, 0.2)
# media behind the surfaces (g glass, a air) and their kinds: s sphere, c conic, a asphere, p plane
# in air
STRUCTURES = (
    ("ga", "as"),
    ("gga", "ssc"),
    ("gaga", "ssss"),
    ("agga", "psas"),
    ("gagaga", "scssas"),
    ("ggagaga", "ssasscs"),
)


@dataclass(frozen=True)
class System:
    """A lens in mm: curvature, thickness, conic [S]; asphere [S, A] of r^2, r^4, ...; index: line
    -> [S + 1];
    stop: surface; diameter of the entrance pupil at the d line."""

    curvature: np.ndarray
    thickness: np.ndarray
    conic: np.ndarray
    asphere: np.ndarray
    index: dict[str, np.ndarray]
    stop: int
    diameter: float


@dataclass(frozen=True)
class Rays:
    """On the film: position [N, 2], direction [N, 3], path [N] from the object point; heights
    [S, N] on the surfaces, cosines [S, N] of incidence; worst [N], the least cosine of incidence or
    refraction (NaN where a ray fails)."""

    position: np.ndarray
    direction: np.ndarray
    path: np.ndarray
    heights: np.ndarray
    cosines: np.ndarray
    worst: np.ndarray

    @property
    def slopes(self):
        return self.direction[:, :2] / self.direction[:, 2:]


def field_rays(system, line, field, pupil, at):
    """Rays of the object point at an angle, ``at`` mm before the entrance pupil, through points
    [N, 2] of the unit disc of the pupil."""
    z = entrance_pupil(system)
    point = np.array([0, -L(at) * np.tan(L(field)), z - L(at)], dtype=L)
    aim = np.concatenate([L(pupil) * system.diameter / 2, np.full((len(pupil), 1), z, dtype=L)], 1)
    d = (aim - point) / np.sqrt(((aim - point) ** 2).sum(1))[:, None]
    o = np.broadcast_to(point, d.shape)
    n = system.index[line]
    path = np.zeros(len(o), dtype=L)
    worst = np.ones(len(o), dtype=L)
    heights, cosines = [], []
    for i, thickness in enumerate(system.thickness):
        shape = system.curvature[i], system.conic[i], system.asphere[i]
        t = -o[:, 2] / d[:, 2]
        for _ in range(NEWTON_STEPS):
            p = o + d * t[:, None]
            sag, slope = _sag(p, *shape)
            t = t - (p[:, 2] - sag) / (d[:, 2] - (slope * p[:, :2] * d[:, :2]).sum(1))
        p = o + d * t[:, None]
        path = path + n[i] * t
        heights.append(np.hypot(p[:, 0], p[:, 1]))
        normal = np.concatenate([-_sag(p, *shape)[1] * p[:, :2], np.ones((len(p), 1))], 1)
        normal = normal / np.sqrt((normal**2).sum(1))[:, None]
        cosine = (d * normal).sum(1)
        cosines.append(cosine)
        ratio = n[i] / n[i + 1]
        refracted = np.sqrt(1 - ratio**2 * (1 - cosine**2))
        d = ratio * d + (refracted - ratio * cosine)[:, None] * normal
        worst = np.minimum(worst, np.minimum(cosine, refracted))
        o = p - np.array([0, 0, 1], dtype=L) * thickness
    t = -o[:, 2] / d[:, 2]
    film = (o + d * t[:, None])[:, :2]
    worst = np.minimum(worst, d[:, 2])
    return Rays(film, d, path + n[-1] * t, np.stack(heights), np.stack(cosines), worst)


def _sag(p, c, k, asphere):
    """Sag [N] at points [N, 3], and its derivative over the height divided by the height [N, 1]."""
    r2 = p[:, 0] ** 2 + p[:, 1] ** 2
    root = np.sqrt(1 - (1 + k) * c * c * r2)
    sag = c * r2 / (1 + root)
    slope = c / root
    for i, a in enumerate(asphere):
        sag = sag + a * r2 ** (i + 1)
        slope = slope + 2 * (i + 1) * a * r2**i
    return sag, slope[:, None]


def paraxial(system, line, y, nu):
    """Heights and reduced angles just behind each surface, [S] each, of a paraxial ray at the first
    vertex."""
    n = system.index[line]
    found = []
    for i, c in enumerate(system.curvature + 2 * system.asphere[:, 0]):
        nu = L(nu) - y * c * (n[i + 1] - n[i])
        found.append((y, nu))
        y = y + system.thickness[i] * nu / n[i + 1]
    return np.array(found, dtype=L).T


def entrance_pupil(system):
    """Place behind the first vertex, for d: rays through the stop's centre aim at it."""
    one, other = (paraxial(system, "d", *start)[0][system.stop] for start in ((1, 0), (0, 1)))
    return other / one


def crossing(system, line, at):
    """Where the paraxial light of the axial point ``at`` mm before the entrance pupil meets the
    axis behind the last vertex; at = 0 is the exit pupil."""
    y, nu = paraxial(system, line, at - entrance_pupil(system), 1)
    return -y[-1] * system.index[line][-1] / nu[-1]


def path_differences(system, line, rays, chief):
    """Path of the chief ray minus that of each ray [N], from the object point to the sphere about
    the chief ray's point on the film through the centre of the exit pupil; and slopes [N, 2], n
    times the direction cosines from the sphere to that point, minus the chief ray's."""
    centre = np.array([*chief.position[0], 0], dtype=L)
    before = system.thickness[-1] - crossing(system, "d", 0)
    radius = np.sqrt(before**2 + (centre**2).sum())
    n = system.index[line][-1]

    def to_sphere(bundle):
        away = (
            np.concatenate([bundle.position, np.zeros((len(bundle.path), 1), dtype=L)], 1) - centre
        )
        b = (away * bundle.direction).sum(1)
        # along the ray, to the side of the pupil
        length = -b - np.sign(before) * np.sqrt(b * b - (away**2).sum(1) + radius**2)
        place = away + bundle.direction * length[:, None]
        return bundle.path + n * length, -n * place[:, :2] / (radius * np.sign(before))

    mine, slope = to_sphere(rays)
    whole, straight = to_sphere(chief)
    return whole[0] - mine, slope - straight[0]


def seidel(system, field, at):
    """S_I to S_V of each surface, [5, S] mm: Welford's sums, with S_V = (A_bar / A)
    (S_III + S_IV)."""
    z = entrance_pupil(system)
    u = system.diameter / 2 / L(at)
    u_bar = np.tan(L(field))
    n = system.index["d"]
    y, nu = paraxial(system, "d", u * (L(at) - z), u)
    y_bar, nu_bar = paraxial(system, "d", -u_bar * z, u_bar)
    nu = np.concatenate([[u], nu])
    nu_bar = np.concatenate([[u_bar], nu_bar])
    c = system.curvature + 2 * system.asphere[:, 0]
    A = nu[:-1] + n[:-1] * c * y
    A_bar = nu_bar[:-1] + n[:-1] * c * y_bar
    jump = np.diff(nu / n**2)
    H = nu_bar[0] * y[0] - nu[0] * y_bar[0]
    figure = (1 + system.conic) * system.curvature**3 / 8 + system.asphere[:, 1] - c**3 / 8
    plate = 8 * figure * np.diff(n)
    third = -(A_bar**2) * y * jump
    fourth = -(H**2) * c * np.diff(1 / n)
    return np.stack(
        [
            -(A**2) * y * jump + plate * y**4,
            -A * A_bar * y * jump + plate * y**3 * y_bar,
            third + plate * (y * y_bar) ** 2,
            fourth,
            A_bar / A * (third + fourth) + plate * y * y_bar**3,
        ]
    )


def focus_shifts(system, field, at):
    """Tangential and sagittal focus of d behind the film, [2]: limits of close rays by
    extrapolation."""
    found = []
    for axis in ((0, 1), (1, 0)):
        estimates = []
        for reach in (1e-3, 5e-4, 2.5e-4):
            rays = field_rays(system, "d", field, reach * np.outer([1, -1], axis), at)
            position, slope = (
                np.diff(values, axis=0) @ axis for values in (rays.position, rays.slopes)
            )
            estimates.append(-(position / slope)[0])
        # errors go as the square and the fourth power of the reach
        a, b, c = estimates
        found.append((64 * c - 20 * b + a) / 45)
    return np.array(found)


def draw(seed):
    """A System that images a near object, and the distance of that in metres; the same for the same
    seed."""
    rng = np.random.default_rng(seed)
    while True:
        found = _attempt(rng, *STRUCTURES[seed % len(STRUCTURES)])
        if found is not None:
            return found


def _attempt(rng, media, kinds):
    """One draw, None where it is no lens, or where its rays fail or graze."""
    count = len(media)
    efl = rng.uniform(12.0, 50.0)
    at_m = float(np.exp(rng.uniform(np.log(0.2), np.log(5.0))))
    curvature = rng.normal(0, 0.6, count) / efl * [k != "p" for k in kinds]
    share = np.where(
        [m == "g" for m in media], rng.uniform(0.05, 0.2, count), rng.uniform(0.01, 0.15, count)
    )
    conic = rng.uniform(-1.5, 1.0, count) * [k in "ca" for k in kinds]
    terms = rng.normal(0, 1, (count, 4)) * 2e-2 / efl ** np.array([1, 3, 5, 7])
    asphere = terms * np.array([[k == "a"] for k in kinds])
    stop = int(rng.integers(count))
    numbers = [a.astype(L) for a in (curvature, share * efl, conic, asphere)]
    system = System(*numbers, _indices(rng, media), stop, efl / rng.uniform(4, 10))
    # the last surface holds the focal length: power is linear in its curvature
    powers = []
    for trial in (0.0, 1.0):
        system.curvature[-1] = trial / efl
        powers.append(-float(paraxial(system, "d", 1, 0)[1][-1]))
    system.curvature[-1] = (1 / efl - powers[0]) / (powers[1] - powers[0]) / efl
    # rounded to float64, which ours is given
    film = float(crossing(system, "d", 1e3 * at_m))
    system.thickness[-1] = film * (1 + 0.003 * rng.normal())
    near = 0.1 * efl < film < 3 * efl and abs(entrance_pupil(system)) < 2 * efl
    if (
        not near
        or abs(crossing(system, "d", 0)) > 20 * efl
        or np.abs(system.curvature).max() > 2.5 / efl
    ):
        return None
    turn = np.linspace(0, 2 * np.pi, 13)[:-1]
    rim = np.stack([np.cos(turn), np.sin(turn)], 1)
    with np.errstate(all="ignore"):
        for field in (*FIELDS, -FIELDS[-1]):
            rays = field_rays(system, "d", field, rim, 1e3 * at_m)
            reach = np.abs(system.curvature)[:, None] * rays.heights
            if not (rays.worst > 0.6).all() or not (reach < 0.5).all():
                return None
    return system, at_m


def _indices(rng, media):
    """Line -> [S + 1] indices with the dispersion of some glass."""
    found = {line: np.ones(len(media) + 1, dtype=L) for line in "dFC"}
    for i, medium in enumerate(media):
        if medium == "g":
            nd = rng.uniform(1.45, 1.85)
            mean = (nd - 1) / rng.uniform(25, 70)
            for line, value in zip("dFC", (nd, nd + 0.7 * mean, nd - 0.3 * mean), strict=True):
                found[line][i + 1] = value
    return found


INDICES = {"glass": 1.6, "air": 1.0}


def by_frames(rows, p, d, bends=True):
    """A ray through rows of (medium or "mirror", thickness, curvature) and of coordinate breaks
    ("break", thickness, and PARM 1 to 6 of a .zmx file: shifts, angles in degrees, order), each in
    the frame of its own, to a plane; only led through the frames where it does not bend. Media are
    names or indices; point and direction [3] -> the same."""
    n = L(1)
    p, d = (np.array(v, dtype=L) for v in (p, d))
    for kind, thickness, *what in [*rows, ("air", 0.0, 0.0)]:
        what = np.array(what, dtype=L)
        if kind == "break":
            (sx, sy, sz), (cx, cy, cz) = (
                np.sin(np.radians(what[2:5])),
                np.cos(np.radians(what[2:5])),
            )
            # components along axes that were turned right-handed
            about_x = np.array([[1, 0, 0], [0, cx, sx], [0, -sx, cx]])
            about_y = np.array([[cy, 0, -sy], [0, 1, 0], [sy, 0, cy]])
            about_z = np.array([[cz, sz, 0], [-sz, cz, 0], [0, 0, 1]])
            turn = about_x @ about_y @ about_z if what[5] else about_z @ about_y @ about_x
            shift = np.array([*what[:2], 0])
            p, d = turn @ p - shift if what[5] else turn @ (p - shift), turn @ d
        elif bends:
            c = what[0]
            f, g = c * (p @ p) - 2 * p[2], d[2] - c * (p @ d)
            p = p + d * f / (g + np.copysign(np.sqrt(g * g - c * f), d[2]))
            normal = np.array([0, 0, 1]) - c * p
            cosine = d @ normal
            behind = n if kind == "mirror" else L(INDICES.get(kind, kind))
            root = np.copysign(np.sqrt(1 - (n / behind) ** 2 * (1 - cosine**2)), cosine)
            d = (
                n / behind * d
                + ((-root if kind == "mirror" else root) - n / behind * cosine) * normal
            )
            n = behind
        p = p - np.array([0, 0, thickness])
    return p, d
