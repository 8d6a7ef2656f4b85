"""Reader of DiffOptics text tables: type, distance, radius, diameter, material, then conic and asphere."""

from codesign.errors import FileFormatError
from codesign.lens.files.deeplens import smallest
from codesign.lens.files.system import FileLens, FileSurface
from codesign.lens.files.text import MOST_SURFACES, at, lines, number, shown, title
from codesign.lens.glass import Glass

AIR = ("AIR", "VACUUM", "OCCLUDER")


def read_diffoptics(text: str, name: str) -> FileLens:
    """FileLens of the text of a table.

    The distance of a row leads to it from the row before; radius 0 is a plane; the numbers behind the
    material are the conic constant and the coefficients of r^4, r^6, ... The row A is the stop, else the
    surface with the smallest diameter. Raises: FileFormatError naming the row.
    """
    table = [(i, line.split()) for i, line in lines(text) if line.strip()]
    if len(table) < 4 or [w.lower() for w in table[1][1][:3]] != ["type", "distance", "roc"]:
        raise FileFormatError(
            "it is not a table of surfaces; its second line must be: type distance roc diameter material."
        )
    if len(table) > MOST_SURFACES + 4:
        raise FileFormatError(
            f"it has {len(table)} lines, at most {MOST_SURFACES} surfaces are read; is it a lens?"
        )
    surfaces: list[FileSurface] = []
    stops = []
    image = None
    for line, words in table[2:]:
        with at(f"line {line}"):
            if image is not None:
                raise FileFormatError(
                    f"'{shown(' '.join(words))}' stands behind the image (I), which must be the last row."
                )
            if len(words) < 5:
                raise FileFormatError(
                    f"'{shown(' '.join(words))}' has fewer than the five columns type, distance, roc, "
                    "diameter, material."
                )
            kind = words[0].upper()
            distance = number(words[1], "the distance")
            if surfaces:
                surfaces[-1].thickness = distance
            if kind == "I":
                image = _check_image(words)
            elif kind != "O":
                stops += [len(surfaces)] if kind == "A" else []
                surfaces.append(_surface(kind, words, len(surfaces) + 1))
    if image is None or not surfaces or len(stops) > 1:
        raise FileFormatError(
            f"it has {len(surfaces)} surfaces, {len(stops)} stops (A) and {'an' if image else 'no'} image "
            "(I); it needs surfaces, at most one stop, and an image."
        )
    surfaces[stops[0] if stops else smallest(surfaces)].is_stop = True
    return FileLens(title(" ".join(table[0][1]), name), surfaces, pupil=("stop", 0.0))


def _check_image(words):
    if number(words[2], "the radius"):
        raise FileFormatError("the image surface is curved; only a flat image plane is read.")
    return True


def _surface(kind, words, label):
    if kind not in ("S", "A", "X"):
        raise FileFormatError(f"type {shown(kind)} is not read; O, S, A, I are, and X without coefficients.")
    radius = number(words[2], "the radius")
    diameter = number(words[3], "the diameter")
    rest = [number(w, "a coefficient") for w in words[5:]]
    if kind == "X" and any(rest):
        raise FileFormatError(
            "its shape is a polynomial in x and y, and only surfaces of revolution are read."
        )
    if len(rest) > 16:
        raise FileFormatError(f"it has {len(rest)} coefficients, at most 16 are read.")
    asphere = (0.0, *rest[1:]) if kind == "S" and any(rest[1:]) else ()
    conic = rest[0] if kind == "S" and rest else 0.0
    return FileSurface(
        label, 1 / radius if radius else 0.0, 0.0, _medium(words[4]), diameter / 2, True, conic, asphere
    )


def _medium(word):
    if word.upper() in AIR:
        return None
    pair = word.split("/")
    if len(pair) == 2:
        return Glass.from_abbe(number(pair[0], "the index nd"), number(pair[1], "the Abbe number"), word)
    return Glass.named(word)
