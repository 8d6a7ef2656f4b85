"""Numbers of a lens as dimensionless variables whose unit is a natural step: one that moves the
rays on the film by a set distance."""

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from codesign.checks import check_positive
from codesign.errors import DomainError, ShapeError
from codesign.lens.surface import passed_twice
from codesign.lens.traced import TracedLens

# a bound on one side bends the map within about this part of the room that the start leaves
BOUND_BEND = 5.0
TRIAL = 1e-4  # of a reach: the step of the differences that measure how rays move
DEAD = 1e-6  # of the natural step: a number whose whole reach moves the rays by less is no variable

LABELS = ("low", "high", "width", "places", "start", "unit")  # buffers of each kind of variables

Bound = float | Sequence[float] | Tensor | None


@dataclass(frozen=True)
class Kind:
    """Numbers of a lens that go by one name.

    tensor: name of the tensor they are in. places: [K] their places in it, flattened. reach: [K]
    the largest change that a unit of a variable may make, for numbers that hardly move a ray. low:
    least value where no other bound is given. tied: those of the places whose numbers another row
    repeats.
    """

    tensor: str
    places: Tensor
    reach: Tensor
    low: float = -math.inf
    tied: Collection[int] = ()


@dataclass(frozen=True)
class Chosen:
    """Numbers of a tensor that become variables: [K] places, units, and lower and upper bounds."""

    tensor: str
    places: Tensor
    unit: Tensor
    low: Tensor
    high: Tensor


class Variables(nn.Module):
    """Tensors of a lens as functions of variables: value = bound(start + unit u).

    For every kind a Parameter [K] of its name, zero at the values that ``tensors`` hold. Where
    bounds are given on both sides the value is middle + half tanh(.), where on one side it is bound
    ± width log(1 + exp(.)); their slope at the start is in the unit, so that a step means the same
    with bounds and without.
    Raises: DomainError for a start that does not lie strictly inside its bounds.
    """

    def __init__(
        self,
        tensors: Mapping[str, Tensor],
        chosen: Mapping[str, Chosen],
        held: Mapping[str, Tensor],
    ) -> None:
        super().__init__()
        self.tensor_of = {name: kind.tensor for name, kind in chosen.items()}
        for prefix, entries in (("start", tensors), ("held", held)):
            for name, value in entries.items():
                self.register_buffer(f"{prefix}_{name}", value.detach().clone())
        for name, kind in chosen.items():
            value = tensors[kind.tensor].detach().reshape(-1)[kind.places]
            width = _width(value, kind.low, kind.high)
            start = _unbounded(value, kind.low, kind.high, width)
            unit = kind.unit / _slope(start, kind.low, kind.high, width)
            entries = kind.low, kind.high, width, kind.places, start, unit
            for label, entry in zip(LABELS, entries, strict=True):
                self.register_buffer(f"{name}_{label}", entry.detach().clone())
            self.register_parameter(name, nn.Parameter(torch.zeros_like(value)))

    def makes(self, tensor: str) -> bool:
        """Whether a tensor of this name comes from here."""
        return f"start_{tensor}" in self._buffers

    @property
    def held(self) -> dict[str, Tensor]:
        """What solves hold, by name."""
        return self._labelled("held_")

    def forward(self) -> dict[str, Tensor]:
        """The tensors at the variables as they are, by name. Gradient: exact, to the variables."""
        made = self._labelled("start_")
        for name, tensor in self.tensor_of.items():
            low, high, width, places, start, unit = (
                getattr(self, f"{name}_{label}") for label in LABELS
            )
            values = _bounded(start + unit * getattr(self, name), low, high, width)
            flat = made[tensor].reshape(-1).index_put((places,), values)
            made[tensor] = flat.reshape(made[tensor].shape)
        return made

    def _labelled(self, prefix):
        return {
            name.removeprefix(prefix): value
            for name, value in self._buffers.items()
            if value is not None and name.startswith(prefix)
        }


def ray_motion(
    ahead: tuple[Tensor, Tensor],
    behind: tuple[Tensor, Tensor],
) -> tuple[Tensor, Tensor]:
    """How rays move on the film between two states of a lens: [fields, M, 2] mm, and [fields, M] 1
    for rays that arrive in both, else 0.

    Args:
      ahead, behind: positions [fields, M, 2] and weights [fields, M], as from ``spots``.
    """
    weight = ahead[1] * behind[1]
    return (ahead[0] - behind[0]) * weight[..., None], weight


def natural_units(
    land: Callable[[Tensor], tuple[Tensor, Tensor]], values: Tensor, reach: Tensor, step_mm: float
) -> tuple[Tensor, Tensor]:
    """Change of each number [K] that moves the rays by ``step_mm`` RMS over the bundle, at most its
    ``reach``; and whether it moves them at all, [K] bool.

    Args:
      land: numbers [K] -> (positions [fields, M, 2] mm, weights [fields, M]).
    """
    moves = torch.zeros_like(values)
    for i in range(values.numel()):
        trial = torch.zeros_like(values)
        trial[i] = TRIAL * reach[i]
        with torch.no_grad():
            moved, weight = ray_motion(land(values + trial), land(values - trial))
        rms = torch.linalg.vector_norm(moved) / weight.sum().clamp_min(1).sqrt()
        moves[i] = rms / (2 * TRIAL)  # over the whole reach
    return reach / (moves / step_mm).clamp_min(1), moves > DEAD * step_mm


def checked_step(step_mm: float) -> float:
    """The natural step as a number. Raises: DomainError unless it is positive and finite."""
    check_positive(step_mm, "natural step, mm,", remedy="the pixel pitch is a good one")
    return float(step_mm)


def checked_bounds(
    name: str, kind: Kind, value: Tensor, given: tuple[Bound, Bound] | None, rows: Tensor
) -> tuple[Tensor, Tensor]:
    """Lower and upper bounds [R] of the numbers at ``rows`` of one kind; infinite where there is
    none.

    Raises: ShapeError; DomainError for a number that does not lie strictly inside.
    """
    given = (kind.low, math.inf) if given is None else given
    if len(given) != 2:
        raise ShapeError(
            f"bounds of {name} are (low, high), got {len(given)} entries; None leaves one side free."
        )
    sides = []
    for side, free in zip(given, (-math.inf, math.inf), strict=True):
        side = torch.as_tensor(
            free if side is None else side, dtype=value.dtype, device=value.device
        )
        if side.numel() not in (1, value.numel()):
            raise ShapeError(
                f"a bound of {name} is a number or {value.numel()} of them, got {side.numel()}."
            )
        sides.append(side.reshape(-1).expand_as(value)[rows])
    low, high = sides
    wrong = torch.nonzero(~((low < value[rows]) & (value[rows] < high)))[:, 0].tolist()
    if wrong:
        at = wrong[0]
        raise DomainError(
            f"{name} {int(rows[at]) + 1} is {float(value[rows][at]):.6g}, not strictly inside its bounds "
            f"{float(low[at]):.6g} to {float(high[at]):.6g}; widen them, start elsewhere, or mask it."
        )
    return low, high


def _width(value, low, high):
    room = torch.where(low.isfinite(), value - low, high - value) / BOUND_BEND
    width = torch.where(low.isfinite() & high.isfinite(), (high - low) / 2, room)
    return torch.where(low.isfinite() | high.isfinite(), width, 1.0)


def _sides(low, high):
    """Masks of bounds on both sides, below only, above only; and the bounds, 0 where there is
    none."""
    below = low.isfinite()
    above = high.isfinite()
    return (
        (below & above, below & ~above, above & ~below),
        torch.where(below, low, 0),
        torch.where(above, high, 0),
    )


def _bounded(x, low, high, width):
    (both, below, above), low, high = _sides(low, high)
    x = x / width
    zero = torch.zeros_like(x)
    value = torch.where(both, (low + high) / 2 + width * torch.tanh(x), width * x)
    value = torch.where(below, low + width * torch.logaddexp(x, zero), value)
    return torch.where(above, high - width * torch.logaddexp(-x, zero), value)


def _unbounded(value, low, high, width):
    (both, below, above), low, high = _sides(low, high)
    offset = torch.where(both, (value - (low + high) / 2) / width, 0.0)
    room = torch.where(below, value - low, torch.where(above, high - value, width)) / width
    one_side = room + torch.log(-torch.expm1(-room))  # log(exp(room) - 1)
    x = torch.where(both, torch.atanh(offset), value / width)
    x = torch.where(below, one_side, x)
    return torch.where(above, -one_side, x) * width


def _slope(x, low, high, width):
    """Derivative of ``_bounded``."""
    with torch.enable_grad():
        x = x.detach().requires_grad_()
        return torch.autograd.grad(_bounded(x, low, high, width).sum(), x)[0]


def make_variables(
    lens: Any,
    names: Sequence[str],
    step_mm: float,
    bounds: Mapping[str, tuple[Bound, Bound]],
    mask: Mapping[str, Sequence[bool]],
    fields_rad: Sequence[float],
    wavelength_um: float | None,
    held: Mapping[str, Tensor],
) -> Variables:
    """Variables of the named kinds around a lens as it is now; see ``GeoLens.variables``.

    The lens says what it has: ``_kinds()`` -> {name: Kind}, ``_solved(tensors, held)`` -> tensors,
    ``_landing(fields_rad, wavelength_um)`` -> positions and weights of a bundle of rays on the
    film, ``solved_tensors``: which tensor a solve makes.
    """
    exact = lens._fixed().double()
    kinds = exact._kinds()
    for label, found, known in (
        ("variables", names, kinds),
        ("bounds of", bounds, names),
        ("mask of", mask, names),
    ):
        unknown = [name for name in found if name not in known]
        if unknown or len(set(found)) < len(found):
            raise DomainError(
                f"{lens}: {label} {', '.join(map(repr, unknown or found))}: name each once, of "
                f"{', '.join(known)}."
            )
    if not names:
        raise DomainError(f"{lens}: name the numbers that become variables, of {', '.join(kinds)}.")
    tensors = {t: getattr(exact, t).detach() for t in exact.tensor_names}
    solved = [exact.solved_tensors[name] for name in held]
    chosen = {}
    for name in names:
        kind = kinds[name]
        value = tensors[kind.tensor].reshape(-1)[kind.places]
        rows = torch.nonzero(_kept(name, kind, value, bounds, mask))[:, 0]

        def land(numbers, tensor=kind.tensor, at=kind.places[rows]):
            moved = (
                tensors[tensor].reshape(-1).index_put((at,), numbers).reshape(tensors[tensor].shape)
            )
            given = {name: tensors[name] for name in solved} | {tensor: moved}
            return exact._with(exact._solved(given, held))._landing(fields_rad, wavelength_um)

        unit, alive = natural_units(land, value[rows], kind.reach[rows], step_mm)
        if not bool(alive.any()):
            raise DomainError(
                f"{lens}: no {name} moves a ray (none is there, or all are masked), so it cannot be a "
                "variable; leave it out."
            )
        rows = rows[alive]
        if not set(kind.places[rows].tolist()).isdisjoint(kind.tied):
            raise DomainError(
                f"{lens}: the light passes a piece of glass twice, as a mirror sends it back, and {name} would "
                "vary in one pass without the other; leave that piece out by mask, or make both from one "
                "number and replace."
            )
        limits = checked_bounds(name, kind, value, bounds.get(name), rows)
        chosen[name] = Chosen(kind.tensor, kind.places[rows], unit[alive], *limits)
    made = {kind.tensor for kind in chosen.values()} | set(solved)
    return Variables({name: tensors[name] for name in sorted(made)}, chosen, held).to(lens.dtype)


def _kept(name, kind, value, bounds, mask):
    """Which numbers of a kind may be variables, [K] bool."""
    keep = torch.ones_like(value, dtype=torch.bool) if name in bounds else value > kind.low
    if name in mask:
        asked = torch.as_tensor(mask[name], dtype=torch.bool, device=value.device)
        if asked.shape != value.shape:
            raise ShapeError(
                f"the mask of {name} needs {value.numel()} entries, got {tuple(asked.shape)}."
            )
        keep = keep & asked
    return keep


# largest natural steps, for numbers that hardly move a ray
GAP = 0.1  # thickness, in focal lengths
BEND = 0.1  # slope that a change of shape adds at the rim
INDEX = 0.05
PHASE = 300.0  # radians at the rim, over its radius


def kinds(lens: TracedLens) -> dict[str, Kind]:
    """{name: Kind} of a GeoLens."""
    rows = torch.arange(len(lens.surfaces), device=lens.semi_aperture_mm.device)
    efl = lens.first_order().efl_mm.detach().abs()
    rim = lens.semi_aperture_mm.minimum(efl)
    gap = (GAP * efl).expand(rows.shape)
    turn = (lens.curvature_per_mm.detach() * rim).square().clamp_min(1e-12)
    index = torch.full_like(rim, INDEX)[lens.glass]
    faces, gaps, media = passed_twice(lens.surfaces)
    return {
        "curvature": Kind("curvature_per_mm", rows, BEND / rim, tied=faces),
        "thickness": Kind("thickness_mm", rows[:-1], gap[:-1], 0.0, gaps),
        "focus": Kind("thickness_mm", rows[-1:], gap[-1:], 0.0),
        "conic": Kind("conic", rows, BEND / turn, tied=faces),
        "asphere": _polynomial("asphere", lens.asphere, BEND, rim, faces),
        "index": Kind("index_offset", rows[lens.glass], index, tied=media),
        "phase": _polynomial("phase", lens.phase, PHASE, rim, faces),
    }


def _polynomial(name, table, slope, rim, faces):
    """Coefficients [S, A] of r^2, r^4, ...: each may add that much per millimetre at the rim."""
    power = 2 * torch.arange(1, table.shape[1] + 1, dtype=rim.dtype, device=rim.device)
    return Kind(
        name,
        torch.arange(table.numel(), device=rim.device),
        (slope * rim[:, None] ** (1 - power)).reshape(-1),
        tied=[at for at in range(table.numel()) if at // table.shape[1] in faces],
    )
