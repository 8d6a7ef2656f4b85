"""Writer of OpticStudio .zmx files."""

from codesign.errors import CodesignError, FileFormatError
from codesign.lens.geolens import GeoLens
from codesign.lens.glass import AIR, WAVELENGTH_UM, Glass, names

MOST_TERMS = 8  # of an even asphere
# of a model glass
LEAST_ABBE = 10
MOST_ABBE = 150
# a glass goes by its catalogue name when its indices at F, d and C are the catalogue's to this;
# published tables round to 1e-9
SAME_INDEX = 1e-8
# how a glass's source begins -> the catalogue that every program has. Names of plastics and
# crystals stand for other media elsewhere (COC of one program is 3 % of a focal length from that of
# another), so they are not written
CATALOGUES = {
    "Schott, optical glass": "SCHOTT",
    "Schott, earlier glasses": "SCHOTT",
    "Ohara, optical glass": "OHARA",
    "Hoya, optical glass": "HOYA",
    "Hikari (Nikon), optical glass": "HIKARI",
    "Sumita, optical glass": "SUMITA",
    "CDGM, optical glass": "CDGM",
}


def to_zmx(lens: GeoLens) -> str:
    """The text of a .zmx file of the lens's current values; numbers keep all their digits.

    Kept: curvatures, thicknesses and aspheres with their signs along a fixed axis, conics, stop,
      apertures and central obstructions, mirrors, entrance pupil diameter, half field, name. A
      glass of the catalogue keeps its name, with its true nd and Vd beside it and its maker among
      the catalogues, so that a program that has another glass of that name can tell; any other,
      plastics among them, becomes a model glass of nd and Vd. Not kept: the width of the soft
      edges.
    Raises: DomainError for values that cannot be; FileFormatError for what a centred .zmx surface
      cannot hold.
    """
    field = lens.half_field_deg or 0.0
    surfaces = lens.to_surfaces()
    head = [
        "VERS 140124 0 0",
        "MODE SEQ",
        f"NAME {_plain(lens.name)}",
        "UNIT MM X W X CM MR CPMM",
        f"ENPD {lens.entrance_pupil_diameter_mm!r}",
        "ENVD 20 1 0",
        *_catalogues(surfaces),
        "FTYP 0 0 2 3 0 0 0",
        "XFLN 0 0",
        f"YFLN 0 {field!r}",
        *(f"WAVM {i} {w!r} 1" for i, w in enumerate(WAVELENGTH_UM.values(), 1)),
        "PWAV 2",
        *_block(0, ["TYPE STANDARD", "CURV 0", "DISZ INFINITY"]),
    ]
    sign = 1.0
    lines = []
    for i, surface in enumerate(surfaces, 1):
        surface.check(f"{lens.name}, surface {i}")
        lines += _block(
            i, _surface(surface, sign, f"{lens.name}, surface {i}", i == lens.stop_index + 1)
        )
        sign = -sign if surface.mirror else sign
    tail = _block(len(surfaces) + 1, ["TYPE STANDARD", "CURV 0", "DISZ 0"])
    return "\n".join([*head, *lines, *tail]) + "\n"


def _block(number, lines):
    return [f"SURF {number}", *(f"  {line}" for line in lines)]


def _surface(surface, sign, label, is_stop):
    if any(surface.decentre_mm) or any(surface.tilt_deg):
        raise FileFormatError(
            f"{label}: it is decentred or tilted, which is not written to .zmx; save the lens as .json."
        )
    if surface.phase is not None:
        raise FileFormatError(
            f"{label}: programs that read .zmx refuse its diffractive phase or leave it out without a "
            "word; save the lens as .json."
        )
    terms = [sign * a + 0.0 for a in surface.asphere]
    if any(terms[MOST_TERMS:]):
        raise FileFormatError(
            f"{label}: it has {len(terms)} asphere terms, a .zmx file holds {MOST_TERMS}; save the lens as "
            ".json."
        )
    kind = "EVENASPH" if any(terms) else "STANDARD"
    behind = -sign if surface.mirror else sign
    lines = ["STOP"] if is_stop else []
    lines += [f"TYPE {kind}", f"CURV {sign * surface.curvature_per_mm + 0.0!r}"]
    if kind != "STANDARD":
        lines += [f"PARM {i} {a!r}" for i, a in enumerate(terms[:MOST_TERMS], 1)]
    lines += [f"DISZ {behind * surface.thickness_mm + 0.0!r}", *_glass(surface, label)]
    lines += [f"CONI {surface.conic!r}"] if surface.conic else []
    aperture = (
        f"CLAP {surface.inner_semi_aperture_mm!r} {surface.semi_aperture_mm!r} 0"
        if surface.inner_semi_aperture_mm
        else f"FLAP 0 {surface.semi_aperture_mm!r} 0"
    )
    return [*lines, f'DIAM {surface.semi_aperture_mm!r} 1 0 0 1 ""', aperture]


def _glass(surface, label):
    if surface.mirror:
        return ["GLAS MIRROR 0 0 1.5 40 0 0 0 0 0 0"]
    glass = surface.medium
    if glass is None or glass == AIR:
        return []
    if _is_named(glass):
        return [f"GLAS {glass.name} 0 0 {glass.index_d!r} {glass.abbe_number!r} 0 0 0 0 0 0"]
    if not LEAST_ABBE <= glass.abbe_number <= MOST_ABBE:
        raise FileFormatError(
            f"{label}: its medium {glass.name} has the Abbe number {glass.abbe_number:.4g}, model glasses "
            f"{LEAST_ABBE} to {MOST_ABBE}; save the lens as .json."
        )
    return [f"GLAS ___BLANK 1 0 {glass.index_d!r} {glass.abbe_number!r} 0 0 0 0 0 0"]


def _catalogues(surfaces):
    """The line of the catalogues that hold the named glasses, in the order of their use; none
    without such."""
    used = [s.medium for s in surfaces if s.medium not in (None, AIR) and _is_named(s.medium)]
    makers = dict.fromkeys(_catalogue(Glass.named(glass.name)) for glass in used)
    return [f"GCAT {' '.join(makers)}"] if makers else []


def _catalogue(known):
    return next(
        (name for begins, name in CATALOGUES.items() if known.source.startswith(begins)), ""
    )


def _is_named(glass):
    try:
        known = Glass.named(glass.name)
        same = all(
            abs(known.index(w) - glass.index(w)) < SAME_INDEX for w in WAVELENGTH_UM.values()
        )
    except CodesignError:
        return False
    # 1.6123/44.1 is a name too, but only here
    return (
        same
        and known.name in names()
        and _catalogue(known) not in ("", glass.name.rpartition("_")[2])
        and not any(c.isspace() for c in glass.name)
    )


def _plain(name):
    """A name on one line of printable ASCII."""
    return "".join(c if c.isascii() and c.isprintable() else "?" for c in name)
