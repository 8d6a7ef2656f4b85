"""Random lenses full of coincidences (equal neighbours, flats, concentric surfaces, zeros), and
their gradients against differences of a trace in extended precision that shares nothing with the
kernel.

A kernel that leaves out what has no effect today must not leave out its derivative. The trace here
leaves out
nothing: every surface is a conic with a polynomial, decentred and tilted by matrices, diffracts,
and is found by Newton's steps on its sag. Differences are central and extrapolated (Richardson), so
they err by the fourth power of a step of 1e-4 and by rounding of 1e-19 over it.
"""

import math
from dataclasses import dataclass

import numpy as np
import torch

from codesign.checks import check_finite
from codesign.lens import GeoLens, Glass, Phase, Surface

KINDS = (
    "curvature_per_mm",
    "thickness_mm",
    "conic",
    "asphere",
    "index_offset",
    "phase",
    "decentre_mm",
    "tilt_rad",
)
STEPS = {  # per column, so that each moves rays by 1e-4 to 1e-3 mm
    "curvature_per_mm": (2e-5,),
    "thickness_mm": (1e-3,),
    "conic": (0.1,),
    "asphere": (2e-5, 2e-6),
    "index_offset": (1e-4,),
    "phase": (0.1, 0.01),
    "decentre_mm": (1e-3, 1e-3),
    "tilt_rad": (1e-4, 1e-4),
}
WAVELENGTH_UM = 0.5875618
RAYS = 6
NEWTON_STEPS = 12
# g: glass, e: the same glass as before, o: other glass of the same index, a: air, s: flat stop in
# air, m: mirror
FORMS = ("gasge", "geaso", "sgega", "goagae", "gamsga")
real = np.longdouble


@dataclass(frozen=True)
class System:
    """A lens, rays through it, and the weights [RAYS, 7] of what comes out in the scalar that is
    differentiated."""

    lens: GeoLens
    origin_mm: torch.Tensor
    direction: torch.Tensor
    weight: torch.Tensor


def draw_system(generator: torch.Generator, form: str) -> System:
    """A random lens of one of FORMS whose rays all arrive. Drawn again until they do."""
    while True:
        surfaces = _surfaces(generator, form)
        geo = GeoLens(surfaces, 3.0, soft_edge_mm=0.01)
        origin = 1.2 * (2 * torch.rand(RAYS, 3, generator=generator, dtype=torch.float64) - 1)
        origin[:, 2] = -3.0
        slope = 0.08 * torch.randn(RAYS, 3, generator=generator, dtype=torch.float64)
        slope[:, 2] = 1.0
        direction = torch.nn.functional.normalize(slope, dim=1)
        weight = torch.randn(RAYS, 7, generator=generator, dtype=torch.float64)
        system = System(geo, origin, direction, weight)
        if np.isfinite(_scalar(system, _numbers(geo))).all():
            return system


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
        found.append(
            Surface(
                radius,
                thickness,
                None if letter in "asm" else glass,
                5.0,
                conic,
                () if letter == "m" else tuple(asphere),
                is_stop=letter == "s",
                mirror=letter == "m",
                phase=None
                if letter == "m" or not diffracts
                else Phase(tuple(phase), order=1 + (i % 2)),
                decentre_mm=(uniform(-0.1, 0.1), uniform(-0.1, 0.1)) if moved else (0.0, 0.0),
                tilt_deg=(uniform(-1, 1), uniform(-1, 1)) if moved else (0.0, 0.0),
            )
        )
    return found


def gradients(system: System, kinds: tuple[str, ...]) -> dict[str, np.ndarray]:
    """Gradient of the system's scalar to each of ``kinds`` by the toolkit; the other tensors ask
    for none."""
    geo = system.lens.freeze()
    leaves = {name: getattr(geo, name).detach().clone().requires_grad_() for name in kinds}
    if not any(leaf.numel() for leaf in leaves.values()):
        return {}
    out = geo.replace(**leaves).trace(system.origin_mm, system.direction, WAVELENGTH_UM)
    seen = torch.cat([out.position_mm, out.direction, out.optical_path_mm[:, None]], 1)
    (seen * system.weight).sum().backward()
    return {name: check_finite(leaf.grad, name).numpy() for name, leaf in leaves.items()}


def differences(system: System) -> dict[str, np.ndarray]:
    """The same by differences of the trace in extended precision."""
    now = _numbers(system.lens)
    variants = {name: [] for name in now}
    for name in KINDS:
        for place in range(now[name].size):
            for factor in (1, -1, 2, -2):
                for other in now:
                    value = now[other].copy()
                    if other == name:
                        value.reshape(-1)[place] += factor * _step(name, place)
                    variants[other].append(value)
    values = _scalar(system, {name: np.stack(rows) for name, rows in variants.items()}).reshape(
        -1, 4
    )
    near = (values[:, 0] - values[:, 1]) / 2
    far = (values[:, 2] - values[:, 3]) / 4
    slopes = (4 * near - far) / 3
    found = {}
    first = 0
    for name in KINDS:
        size = now[name].size
        steps = np.array([_step(name, place) for place in range(size)], real)
        found[name] = (slopes[first : first + size] / steps).reshape(now[name].shape)
        first += size
    return found


def _step(name, place):
    steps = STEPS[name]
    return real(steps[place % len(steps)])


def worst_error(found: dict[str, np.ndarray], truth: dict[str, np.ndarray]) -> dict[str, float]:
    """Largest relative error of each kind's gradients. Entries below 1/1000 of a kind's largest
    count relative to that, and those that change the scalar by less than 1e-9 over a step of the
    differences relative to 1e-9: the conic between equal glasses has none, and the differences only
    their rounding."""
    errors = {}
    for name, value in found.items():
        wanted = truth[name]
        if name == "index_offset":  # rows of air and of mirrors, which the trace here lets vary
            wanted = np.where(truth["glass"], wanted, 0)
        least = max(1e-3 * np.abs(wanted).max(initial=0.0), 1e-9 / max(STEPS[name]))
        errors[name] = float(
            np.max(np.abs(value - wanted) / np.maximum(np.abs(wanted), least), initial=0.0)
        )
    return errors


def errors_of_systems(
    count: int, generator: torch.Generator, alone_every: int = 5, advance=lambda: None
) -> dict[str, float]:
    """Worst error per kind over ``count`` systems. All kinds ask for a gradient together; in every
    ``alone_every``-th system each asks alone, so that the others may be left out of the kernel."""
    worst = dict.fromkeys(KINDS, 0.0)
    for i in range(count):
        system = draw_system(generator, FORMS[i % len(FORMS)])
        truth = differences(system) | {"glass": system.lens.glass.numpy()}
        for asked in [(name,) for name in KINDS] if i % alone_every == alone_every - 1 else [KINDS]:
            for name, error in worst_error(gradients(system, asked), truth).items():
                worst[name] = max(worst[name], error)
        advance()
    return worst


def _numbers(geo):
    """The numbers of a lens as extended floats, and the indices at offset 0."""
    found = {name: getattr(geo, name).detach().numpy().astype(real)[None][0] for name in KINDS}
    medium = [1.0]
    for surface in geo.surfaces:
        at = (
            medium[-1]
            if surface.mirror
            else surface.medium.index(WAVELENGTH_UM)
            if surface.medium
            else 1.0
        )
        medium.append(at)
    return found | {"index": np.array(medium, real)}


def _scalar(system, numbers):
    """The scalar of each variant [V] of the numbers (each [V, ...], or without V)."""
    geo = system.lens
    n = {
        name: value if value.ndim > geo_ndim(name) else value[None]
        for name, value in numbers.items()
    }
    V = n["index"].shape[0]
    o = np.broadcast_to(system.origin_mm.numpy().astype(real), (V, RAYS, 3)).copy()
    d = np.broadcast_to(system.direction.numpy().astype(real), (V, RAYS, 3)).copy()
    d /= np.sqrt((d * d).sum(-1, keepdims=True))
    length = np.zeros((V, RAYS), real)
    index = n["index"].copy()
    for i, mirror in enumerate(geo.mirrors):
        index[:, i + 1] = index[:, i] if mirror else index[:, i + 1] + n["index_offset"][:, i]
    for i, surface in enumerate(geo.surfaces):
        turn = _turn(n["tilt_rad"][:, i])
        shift = np.concatenate([n["decentre_mm"][:, i], np.zeros((V, 1), real)], 1)[:, None]
        o = (o - shift) @ turn
        d = d @ turn
        shape = n["curvature_per_mm"][:, i], n["conic"][:, i], n["asphere"][:, i]
        step = -o[..., 2] / d[..., 2]
        for _ in range(NEWTON_STEPS):
            p = o + step[..., None] * d
            sag, slope = _sag(p, *shape)
            step = step - (p[..., 2] - sag) / (
                d[..., 2] - slope * (p[..., 0] * d[..., 0] + p[..., 1] * d[..., 1])
            )
        o = o + step[..., None] * d
        length = length + index[:, i, None] * step
        _, slope = _sag(o, *shape)
        normal = np.stack([-slope * o[..., 0], -slope * o[..., 1], np.ones_like(slope)], -1)
        normal /= np.sqrt((normal * normal).sum(-1, keepdims=True))
        before, behind = index[:, i, None, None], index[:, i + 1, None, None]
        along = (d * normal).sum(-1, keepdims=True)
        if surface.mirror:
            d = d - 2 * along * normal
        else:
            waves = (
                (surface.phase.order if surface.phase else 0)
                * real(WAVELENGTH_UM)
                * real(1e-3)
                / (2 * real(np.pi))
            )
            added, slope = _polynomial(o, n["phase"][:, i])
            length = length + waves * added
            across = before * (d - along * normal)
            grating = waves * np.stack(
                [slope * o[..., 0], slope * o[..., 1], np.zeros_like(slope)], -1
            )
            across = (
                across + grating - (grating * normal).sum(-1, keepdims=True) * normal
            ) / behind
            d = across + np.sqrt(1 - (across * across).sum(-1, keepdims=True)) * normal
        back = turn.transpose(0, 2, 1)
        o = o @ back + shift
        d = d @ back
        if surface.mirror:
            o[..., 2] *= -1
            d[..., 2] *= -1
        o[..., 2] -= n["thickness_mm"][:, i, None]
    step = -o[..., 2] / d[..., 2]
    o = o + step[..., None] * d
    length = length + index[:, -1, None] * step
    seen = np.concatenate([o, d, length[..., None]], -1)
    return (seen * system.weight.numpy().astype(real)).sum((1, 2))


def geo_ndim(name):
    """Dimensions of one lens's numbers of a kind."""
    return 2 if name in ("asphere", "phase", "decentre_mm", "tilt_rad") else 1


def _turn(tilt):
    """[V, 3, 3] matrices Rx Ry, by which rows of vectors are multiplied to get components along the
    turned axes."""
    (a, b), zero, one = tilt.T, np.zeros_like(tilt[:, 0]), np.ones_like(tilt[:, 0])
    about_x = np.stack(
        [one, zero, zero, zero, np.cos(a), -np.sin(a), zero, np.sin(a), np.cos(a)], 1
    )
    about_y = np.stack(
        [np.cos(b), zero, np.sin(b), zero, one, zero, -np.sin(b), zero, np.cos(b)], 1
    )
    return about_x.reshape(-1, 3, 3) @ about_y.reshape(-1, 3, 3)


def _sag(p, curvature, conic, asphere):
    """Sag [V, R] and its slope over r at points."""
    c, k = curvature[:, None], conic[:, None]
    r2 = p[..., 0] ** 2 + p[..., 1] ** 2
    root = np.sqrt(1 - (1 + k) * c * c * r2)
    added, slope = _polynomial(p, asphere)
    return c * r2 / (1 + root) + added, c / root + slope


def _polynomial(p, terms):
    """sum of terms[i] r^(2 i + 2) and its slope over r."""
    r2 = p[..., 0] ** 2 + p[..., 1] ** 2
    powers = range(terms.shape[1])
    value = sum((terms[:, i, None] * r2 ** (i + 1) for i in powers), np.zeros_like(r2))
    slope = sum((2 * (i + 1) * terms[:, i, None] * r2**i for i in powers), np.zeros_like(r2))
    return value, slope
