"""Published lenses by name."""

from codesign.errors import DomainError
from codesign.lens.glass import Glass
from codesign.lens.surface import Surface

_INF = float("inf")

# Schott catalogue values (2017) at F, d, C, rounded to 1e-9 as the published reference traces of
# these lenses used them
GLASSES = {
    "N-BK7": (1.52237629, 1.516800035, 1.514322347),
    "N-SK16": (1.627556349, 1.620409965, 1.61727166),
    "N-SK2": (1.614857066, 1.60738097, 1.604135445),
    "N-SSK2": (1.630451679, 1.622293796, 1.618770607),
    "F2": (1.632081457, 1.620040137, 1.615031692),
    "F5": (1.614612261, 1.603420257, 1.598745273),
}

# name -> (entrance pupil diameter mm, half field degrees, stop index, rows of radius, thickness,
# glass, semi-aperture)
LENSES = {
    # Cooke triplet, 50 mm f/5, 40 degrees (Zemax sample lens)
    "cooke-triplet": (
        10.0,
        20.0,
        3,
        [
            (22.01359, 3.25896, "N-SK16", 9.5),
            (-435.76044, 6.00755, None, 9.5),
            (-22.21328, 0.99997, "F2", 5.0),
            (20.29192, 4.75041, None, 5.0),
            (79.6836, 2.95208, "N-SK16", 7.5),
            (-18.39533, 42.20778, None, 7.5),
        ],
    ),
    # Double Gauss, 100 mm f/3, 28 degrees (Zemax sample lens)
    "double-gauss": (
        33.33,
        14.0,
        5,
        [
            (56.20238, 8.75, "N-SSK2", 29.0),
            (152.2858, 0.5, None, 29.0),
            (37.68262, 12.5, "N-SK2", 24.0),
            (_INF, 3.8, "F5", 24.0),
            (24.2313, 16.369445, None, 15.0),
            (_INF, 13.747957, None, 11.0),
            (-28.37731, 3.8, "F5", 14.0),
            (_INF, 11.0, "N-SK16", 18.0),
            (-37.92546, 0.5, None, 19.0),
            (177.41176, 7.0, "N-SK16", 22.0),
            (-79.41143, 61.487536, None, 22.0),
        ],
    ),
    # Thorlabs LA1509 plano-convex singlet, 100 mm (catalogue values)
    "la1509": (20.0, 2.0, 0, [(51.5, 3.6, "N-BK7", 12.7), (_INF, 97.278278, None, 12.7)]),
}


def named_surfaces(name: str) -> tuple[list[Surface], float]:
    """Surfaces and entrance pupil diameter (mm) of a published lens."""
    diameter, _, stop, rows = LENSES[name]
    surfaces = [
        Surface(r, t, Glass.from_indices(*GLASSES[g], g) if g else None, a, is_stop=i == stop)
        for i, (r, t, g, a) in enumerate(rows)
    ]
    return surfaces, diameter


def half_field_deg(name: str) -> float:
    """Published half field of view, degrees. Raises: DomainError for a lens that is not in the
    catalogue."""
    if name not in LENSES:
        raise DomainError(
            f"no published lens is called {name!r}; choose one of {', '.join(LENSES)}."
        )
    return LENSES[name][1]
