"""Random lenses of spheres, conics, aspheres and glasses with the stop anywhere, that image a near object."""

import numpy as np

from studies.lens_accuracy import longdouble as ld
from studies.lens_accuracy.longdouble import System

# media behind the surfaces (g glass, a air) and their kinds: s sphere, c conic, a asphere, p plane in air
STRUCTURES = (
    ("ga", "as"),
    ("gga", "ssc"),
    ("gaga", "ssss"),
    ("agga", "psas"),
    ("gagaga", "scssas"),
    ("ggagaga", "ssasscs"),
)
FIELDS = (0.0, 0.1, 0.2)
NEAREST_M = 0.2
FARTHEST_M = 5.0


def draw(seed):
    """A System and the distance of its object in metres; the same for the same seed."""
    rng = np.random.default_rng(seed)
    media, kinds = STRUCTURES[seed % len(STRUCTURES)]
    while True:
        found = _attempt(rng, media, kinds)
        if found is not None:
            return found


def _attempt(rng, media, kinds):
    """One draw, None where it is no lens, or where its rays fail or graze."""
    count = len(media)
    efl = rng.uniform(12.0, 50.0)
    at_m = float(np.exp(rng.uniform(np.log(NEAREST_M), np.log(FARTHEST_M))))
    curvature = rng.normal(0, 0.6, count) / efl
    curvature[[k == "p" for k in kinds]] = 0.0
    thickness = (
        np.where([m == "g" for m in media], rng.uniform(0.05, 0.2, count), rng.uniform(0.01, 0.15, count))
        * efl
    )
    conic = np.where([k in "ca" for k in kinds], rng.uniform(-1.5, 1.0, count), 0.0)
    terms = rng.normal(0, 1, (count, 4)) * [2e-2 / efl, 2e-2 / efl**3, 2e-2 / efl**5, 2e-2 / efl**7]
    asphere = np.where(np.array([k == "a" for k in kinds])[:, None], terms, 0.0)
    index = _indices(rng, media)
    system = System(
        curvature, thickness, conic, asphere, index, int(rng.integers(count)), efl / rng.uniform(4, 10)
    )
    # the last surface holds the focal length: power is linear in its curvature
    powers = []
    for trial in (0.0, 1.0):
        curvature[-1] = trial / efl
        powers.append(-float(ld.yu(_with(system, curvature=curvature), "d", 1, 0)[1][-1]))
    curvature[-1] = (1 / efl - powers[0]) / (powers[1] - powers[0]) / efl
    if np.abs(curvature).max() > 2.5 / efl:
        return None
    system = _with(system, curvature=curvature)
    pupil = float(ld.entrance_pupil(system))
    place = float(ld.image_place(system, 1e3 * at_m))
    if (
        not (0.1 * efl < place < 3 * efl and -2 * efl < pupil < 2 * efl)
        or abs(ld.exit_pupil(system)) > 20 * efl
    ):
        return None
    thickness[-1] = place * (1 + 0.003 * rng.normal())
    system = _with(system, thickness=thickness)
    turn = np.linspace(0, 2 * np.pi, 13)[:-1]
    rim = np.stack([np.cos(turn), np.sin(turn)], 1)
    with np.errstate(all="ignore"):
        for field in (*FIELDS, -FIELDS[-1]):
            rays = ld.field_rays(system, "d", field, rim, 1e3 * at_m)
            reach = np.abs(system.curvature)[:, None] * rays.heights
            if not (rays.worst > 0.6).all() or not (reach < 0.5).all():
                return None
    return system, at_m


def _indices(rng, media):
    """Line -> [S + 1] indices with the dispersion of some glass."""
    found = {line: np.ones(len(media) + 1) for line in "dFC"}
    for i, medium in enumerate(media):
        if medium == "g":
            nd = rng.uniform(1.45, 1.85)
            mean = (nd - 1) / rng.uniform(25, 70)
            for line, value in zip("dFC", (nd, nd + 0.7 * mean, nd - 0.3 * mean), strict=True):
                found[line][i + 1] = value
    return found


def _with(system, **changes):
    return System(**{**vars(system), **changes})
