"""Hard cases of lenses full of coincidences (equal neighbours, flats, concentric surfaces, zeros): a
kernel that leaves out what has no effect today must not leave out its derivative.

The trace here leaves out nothing and shares nothing with the kernel: every surface is a conic with a
polynomial, decentred and tilted by matrices, diffracts, and is found by Newton's steps on its sag.
"""

import math
from functools import cache, partial

import torch
from torch import Tensor

from codesign.lens import GeoLens, Glass, Phase, Surface
from studies.stability.case import Case, Span

# how far a unit of each number goes: rays move by 1e-2 to 1 mm
UNITS = {
    "curvature_per_mm": 1e-2,
    "thickness_mm": 1.0,
    "conic": 1.0,
    "asphere": torch.tensor([1e-3, 1e-5]),
    "index_offset": 0.1,
    "phase": torch.tensor([1.0, 0.1]),
    "decentre_mm": 1.0,
    "tilt_rad": 0.1,
}
PAIRS = ("asphere", "phase", "decentre_mm", "tilt_rad")  # two numbers a surface
WAVELENGTH_UM = 0.5875618
RAYS = 6
NEWTON_STEPS = 12
# g: glass, e: the same glass as before, o: other glass of the same index, a: air, s: flat stop in
# air, m: mirror
FORMS = {
    "stop behind glass": "gasge",
    "equal neighbours": "geaso",
    "stop first": "sgega",
    "equal indices": "goagae",
    "mirror": "gamsga",
}


@cache
def drawn(form: str, seed: int) -> tuple[list[Surface], Tensor, Tensor]:
    """Surfaces of a form, and rays through them that all arrive: origins and directions
    [RAYS, 3]."""
    generator = torch.Generator().manual_seed(seed)
    while True:
        surfaces = _surfaces(generator, form)
        origin = 1.2 * (2 * torch.rand(RAYS, 3, generator=generator, dtype=torch.float64) - 1)
        origin[:, 2] = -3.0
        slope = 0.08 * torch.randn(RAYS, 3, generator=generator, dtype=torch.float64)
        slope[:, 2] = 1.0
        rays = origin, torch.nn.functional.normalize(slope, dim=1)
        if _through(surfaces, *rays, _numbers(_lens(surfaces), {})).isfinite().all():
            return surfaces, *rays


def _surfaces(generator, form):
    def uniform(low, high):
        return low + (high - low) * float(torch.rand((), generator=generator, dtype=torch.float64))

    def chance(share):
        return uniform(0, 1) < share

    found = []
    glass = None
    # a phase anywhere makes the kernel bend rays by their grating equation everywhere
    diffracts = chance(0.3)
    for i, letter in enumerate(form):
        if letter == "g":
            n = uniform(1.45, 1.85)
            glass = Glass.from_indices(n + 0.008, n, n - 0.004, f"g{i}")
        elif letter == "o":  # equal at the d line, not elsewhere
            glass = Glass.from_indices(n + 0.02, n, n - 0.01, f"o{i}")
        thickness = 0.0 if chance(0.1) else uniform(0.5, 4.0)
        radius = uniform(12, 60) * (1 if chance(0.5) else -1)
        if chance(0.3) and found and math.isfinite(found[-1].radius_mm):
            radius = found[-1].radius_mm - found[-1].thickness_mm  # concentric with the one before
        if letter == "s" or chance(0.25) or abs(radius) < 8:
            radius = math.inf
        conic = 0.0 if chance(0.5) else uniform(-1.5, 1.0)
        asphere = [0.0 if chance(0.5) else size * uniform(-1, 1) for size in (1e-3, 1e-5)]
        phase = [0.0 if chance(0.6) else size * uniform(-1, 1) for size in (3.0, 0.05)]
        moved = not chance(0.5)
        plain = letter == "m"
        found.append(
            Surface(
                radius,
                thickness,
                None if letter in "asm" else glass,
                5.0,
                conic,
                () if plain else tuple(asphere),
                is_stop=letter == "s",
                mirror=plain,
                phase=Phase(tuple(phase), order=1 + i % 2) if diffracts and not plain else None,
                decentre_mm=(uniform(-0.1, 0.1), uniform(-0.1, 0.1)) if moved else (0.0, 0.0),
                tilt_deg=(uniform(-1, 1), uniform(-1, 1)) if moved else (0.0, 0.0),
            )
        )
    return found


def _lens(surfaces, dtype=torch.float64):
    return GeoLens(surfaces, 3.0, dtype, soft_edge_mm=0.01).freeze()


def _numbers(geo, moves, alone=None):
    """The lens's tensors, moved by so many units each. alone: a seed by which one kind of number
    asks for its gradient alone, so that the others may be left out."""
    if alone is not None:
        there = [name for name in moves if getattr(geo, name).numel()]
        kept = there[alone % len(there)]
        moves = {name: each if name == kept else each.detach() for name, each in moves.items()}
    found = {}
    for name, unit in UNITS.items():
        base = getattr(geo, name)
        found[name] = base + unit * moves[name].to(base) if name in moves and base.numel() else base
    return found


def traced(form, seed, alone=False, **moves):
    """What the library makes of it: positions, directions and optical paths [RAYS, 7]."""
    surfaces, origin, direction = drawn(form, int(seed))
    geo = _lens(surfaces, seed.dtype)
    moved = geo.replace(**_numbers(geo, moves, int(seed) if alone else None))
    out = moved.trace(origin.to(seed), direction.to(seed), WAVELENGTH_UM)
    return torch.cat([out.position_mm, out.direction, out.optical_path_mm[:, None]], 1)


def expected(form, seed, alone=False, **moves):
    """Nothing is left out: sag by Newton's steps, Snell's law with the grating term."""
    surfaces, *rays = drawn(form, int(seed))
    numbers = _numbers(_lens(surfaces), moves, int(seed) if alone else None)
    return _through(surfaces, *rays, numbers)


def _through(surfaces, o, d, numbers):
    """Positions, directions and optical paths [RAYS, 7] behind the last thickness."""
    length = 0.0
    before = torch.ones((), dtype=torch.float64)
    for i, surface in enumerate(surfaces):
        n = {name: value[i] for name, value in numbers.items()}
        turn, shift = _turn(n["tilt_rad"]), torch.cat([n["decentre_mm"], torch.zeros(1)])
        o, d = (o - shift) @ turn, d @ turn
        shape = n["curvature_per_mm"], n["conic"], n["asphere"]
        step = -o[:, 2] / d[:, 2]
        for _ in range(NEWTON_STEPS):
            p = o + step[:, None] * d
            sag, slope = _sag(p, *shape)
            step = step - (p[:, 2] - sag) / (d[:, 2] - slope * (p[:, :2] * d[:, :2]).sum(1))
        o = o + step[:, None] * d
        length = length + before * step
        normal = _above(-_sag(o, *shape)[1], o, 1.0)
        normal = normal / normal.norm(dim=1, keepdim=True)
        along = (d * normal).sum(1, keepdim=True)
        if surface.mirror:
            d = d - 2 * along * normal
        else:
            behind = torch.ones((), dtype=torch.float64)
            if surface.medium:
                behind = surface.medium.index(WAVELENGTH_UM) + n["index_offset"]
            waves = (surface.phase.order if surface.phase else 0) * WAVELENGTH_UM / (2e3 * math.pi)
            added, slope = _polynomial(o, n["phase"])
            length = length + waves * added
            grating = _above(waves * slope, o, 0.0)
            grating = grating - (grating * normal).sum(1, keepdim=True) * normal
            across = (before * (d - along * normal) + grating) / behind
            d = across + (1 - across.square().sum(1, keepdim=True)).sqrt() * normal
            before = behind
        o, d = o @ turn.mT + shift, d @ turn.mT
        if surface.mirror:
            unfolded = torch.tensor([1.0, 1.0, -1.0])
            o, d = o * unfolded, d * unfolded
        o = o - torch.cat([torch.zeros(2), n["thickness_mm"][None]])
    step = -o[:, 2] / d[:, 2]
    return torch.cat([o + step[:, None] * d, d, (length + before * step)[:, None]], 1)


def _above(slope, at, height):
    """Vectors [RAYS, 3]: a radial slope over r, and a height."""
    return torch.cat([slope[:, None] * at[:, :2], torch.full_like(at[:, 2:], height)], 1)


def _turn(tilt):
    """Rx Ry [3, 3], by which rows of vectors are multiplied to get components along the turned
    axes."""
    (a, b), zero, one = tilt, torch.zeros_like(tilt[0]), torch.ones_like(tilt[0])
    about_x = torch.stack([one, zero, zero, zero, a.cos(), -a.sin(), zero, a.sin(), a.cos()])
    about_y = torch.stack([b.cos(), zero, b.sin(), zero, one, zero, -b.sin(), zero, b.cos()])
    return about_x.reshape(3, 3) @ about_y.reshape(3, 3)


def _sag(p, c, k, asphere):
    """Sag [RAYS] and its slope over r at points."""
    r2 = p[:, :2].square().sum(1)
    root = (1 - (1 + k) * c * c * r2).sqrt()
    added, slope = _polynomial(p, asphere)
    return c * r2 / (1 + root) + added, c / root + slope


def _polynomial(p, terms):
    """sum of terms[i] r^(2 i + 2) and its slope over r."""
    r2 = p[:, :2].square().sum(1)
    value = slope = torch.zeros_like(r2)
    for i, term in enumerate(terms):
        value = value + term * r2 ** (i + 1)
        slope = slope + 2 * (i + 1) * term * r2**i
    return value, slope


def case(name, form, alone=False):
    shapes = {kind: (len(form), 2) if kind in PAIRS else (len(form),) for kind in UNITS}
    moves = {kind: Span(0, 0, shape) for kind, shape in shapes.items()}
    functions = (partial(each, form, alone=alone) for each in (traced, expected))
    return Case(name, "lens", {"seed": Span(0, 1e6), **moves}, *functions, learn=tuple(UNITS))


CASES = [
    *(case(name, form) for name, form in FORMS.items()),
    case("one kind alone", FORMS["equal neighbours"], alone=True),
]
