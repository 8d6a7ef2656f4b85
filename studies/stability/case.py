"""What a hard case is, and the one runner that judges it.

A case gives the numbers it is tried at, what the library makes of them, and what theory says:

    Case("half turn", "pose", {"twist": Span(3.1, 3.2, (6,))}, pose.se3_exp, rodrigues)

From the two functions come three cells: value, gradient (of the closed form, by automatic
differentiation) and single precision. Words in place of the second say that the library refuses.
"""

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from torch import Tensor

from codesign.errors import CodesignError

KINDS = ("value", "gradient", "float32")
# errors are absolute where neither an outcome nor its unit is larger
LEAST = 1e-30
Numbers = dict[str, Tensor]
Row = dict[str, Any]


@dataclass(frozen=True)
class Span:
    """Numbers from ``low`` to ``high``, of one shape; ``log``: evenly by their logarithm."""

    low: float
    high: float
    shape: tuple[int, ...] = ()
    log: bool = False

    @property
    def size(self) -> int:
        return math.prod(self.shape)

    def at(self, shares: Tensor) -> Tensor:
        """Numbers [*shape] float64 at shares [size] in 0..1 of the way from low to high."""
        low, high = (math.log(end) if self.log else end for end in (self.low, self.high))
        found = (low + (high - low) * shares).reshape(self.shape)
        return found.exp() if self.log else found


@dataclass(frozen=True)
class Case:
    """One hard case of one stage.

    spans: numbers that ``seen``, ``expected`` and ``slopes`` are called with, by name.
    seen: what the library makes of them, in their precision.
    expected: the same in closed form, broadcasting to it; or words of the sentence that refuses.
    slopes: a number whose derivatives are those expected, where they are not those of ``expected``
      (straight-through gradients).
    learn: whose gradients are compared; all by default, none where ``()``.
    unit: natural size of values and slopes; where less is expected, errors are relative to it.
    allowed: errors of value, gradient and single precision, relative to the largest expected.
    slow: whether it takes seconds, so that fewer numbers are tried.
    known: what is known of a miss that stands; a case that passes has none.
    """

    name: str
    stage: str
    spans: Mapping[str, Span]
    seen: Callable[..., Tensor]
    expected: Callable[..., Tensor | float] | str
    allowed: tuple[float, float, float] = (1e-12, 1e-9, 1e-5)
    learn: tuple[str, ...] | None = None
    slopes: Callable[..., Tensor] | None = None
    unit: float = 1.0
    slow: bool = False
    known: str = ""

    @property
    def label(self) -> str:
        return f"{self.name}, {self.stage}"

    @property
    def theory(self) -> str:
        """Why the outcome is expected: what ``expected``, or else ``seen``, says of itself."""
        functions = [getattr(f, "func", f) for f in (self.expected, self.seen) if callable(f)]
        said = next((f.__doc__ for f in functions if f.__doc__), "")
        return " ".join(said.split("\n\n")[0].split()).rstrip(".")

    @property
    def learnt(self) -> tuple[str, ...]:
        """Names of the numbers whose gradients are compared."""
        if isinstance(self.expected, str):
            return ()
        return tuple(self.spans) if self.learn is None else self.learn

    @property
    def kinds(self) -> tuple[str, ...]:
        """Of the cells that apply."""
        return KINDS if self.learnt else (KINDS[0], KINDS[2])

    def numbers(self, share: Callable[[tuple[int]], Tensor]) -> Numbers:
        """Numbers of the spans; ``share`` gives so many shares in 0..1."""
        return {name: span.at(share((span.size,))) for name, span in self.spans.items()}


def trials(case: Case, tries: int, seed: int) -> list[Numbers]:
    """Numbers at both ends of the spans and at so many random places between; slow cases at their
    middle, and at a fifth as many."""
    generator = torch.Generator().manual_seed(seed)

    def random(size):
        return torch.rand(size, generator=generator, dtype=torch.float64)

    ends = [0.5] if case.slow else [0.0, 1.0]
    fixed = [case.numbers(partial(torch.full, fill_value=end, dtype=torch.float64)) for end in ends]
    return fixed + [case.numbers(random) for _ in range(tries // 5 if case.slow else tries)]


def judge(case: Case, numbers: Numbers) -> list[Row]:
    """Rows of the case's cells at some numbers: what was expected and seen, by how much they differ
    and may. One that stops with another error than is expected has failed, with what it said."""
    single = {name: value.float() for name, value in numbers.items()}
    if isinstance(case.expected, str):
        return [_refused(case, *of) for of in zip(case.kinds, (numbers, single), strict=True)]
    rows = _compared(case, case.kinds[:-1], _beside_theory, numbers)
    return [*rows, *_compared(case, KINDS[2:], _beside_double, single)]


def worst(rows: Iterable[Row]) -> Row:
    """Of the rows of one cell, the one furthest off; what has no number is furthest."""
    return max(rows, key=lambda row: math.inf if row["off"] is None else row["off"])


def nothing(**_: Tensor) -> float:
    return 0.0


SPOILT = {"place": Span(0, 1), "kind": Span(0, 1)}


def spoilt(values: Tensor, place: Tensor, kind: float = 0.0) -> Tensor:
    """Values of which the one at a place, 0 to 1 of the way through them, is NaN, or infinite from
    a ``kind`` of 1/2 on."""
    at = (place * (values.numel() - 0.1)).long()
    flat = values.flatten().index_fill(0, at, math.nan if kind < 0.5 else math.inf)
    return flat.reshape(values.shape)


def off(expected: Tensor, seen: Tensor, unit: float = 1.0) -> float:
    """Largest difference over the largest expected, or over the unit where that is larger."""
    size = max(float(expected.abs().max()), unit)
    return float((seen - expected).abs().max()) / (size if size > LEAST else 1.0)


def _refused(case, kind, numbers):
    try:
        seen, passed = f"no refusal: {_ends(case.seen(**numbers))}", False
    except CodesignError as error:
        seen = _sentence(error)
        passed = case.expected in seen
    error = 0.0 if passed else None
    return {"kind": kind, **_figures(f"“{case.expected}”", seen, error, 0.0)}


def _compared(case, kinds, pairs_of, numbers):
    """Rows of ``kinds``; pairs_of: numbers -> pairs by kind."""
    allowed = dict(zip(KINDS, case.allowed, strict=True))
    try:
        found = pairs_of(case, numbers)
    except (CodesignError, RuntimeError, ArithmeticError, ValueError, TypeError) as error:
        said = f"stopped: {_sentence(error)}"
        return [{"kind": k, **_figures("an outcome", said, None, allowed[k])} for k in kinds]
    return [{"kind": k, **_furthest(found[k], case.unit, allowed[k])} for k in kinds]


def _beside_theory(case, numbers):
    seen, slopes = _outcome(case.seen, case, numbers)
    if case.learnt and slopes is None:
        raise RuntimeError("the outcome carries no gradient")
    expected, theory = _outcome(case.expected, case, numbers, seen.shape)
    if case.slopes:
        _, theory = _outcome(case.slopes, case, numbers, seen.shape)
    none = [torch.zeros_like(numbers[name]) for name in case.learnt]
    return {
        "value": [(expected, seen)],
        "gradient": list(zip(theory or none, slopes or none, strict=True)),
    }


def _beside_double(case, single):
    """Values and gradients in single precision beside those of the same numbers in double."""
    double = {name: value.double() for name, value in single.items()}
    (expected, theory), (seen, slopes) = (_outcome(case.seen, case, x) for x in (double, single))
    return {"float32": [(expected, seen), *zip(theory or [], slopes or [], strict=True)]}


def _outcome(function, case, numbers, shape=None) -> tuple[Tensor, list[Tensor] | None]:
    """A function's value, and the gradients of a sum of it with fixed weights, in which nothing
    cancels, to what is learnt; None where it carries none."""
    leaves = {k: v.clone().requires_grad_(k in case.learnt) for k, v in numbers.items()}
    found = torch.as_tensor(function(**leaves)).double()
    found = found if shape is None else found.expand(shape)
    if not found.requires_grad:
        return found, None
    weight = torch.cos(torch.arange(found.numel(), dtype=torch.float64)).reshape(found.shape)
    asked = [leaves[name] for name in case.learnt]
    total = (found * weight).sum()
    slopes = torch.autograd.grad(total, asked, allow_unused=True, materialize_grads=True)
    return found.detach(), [slope.double() for slope in slopes]


def _furthest(pairs, unit, allowed):
    errors = [off(*pair, unit) for pair in pairs]
    k = max(range(len(errors)), key=lambda k: (not math.isfinite(errors[k]), errors[k]))
    return _figures(*map(_ends, pairs[k]), errors[k] if math.isfinite(errors[k]) else None, allowed)


def _figures(expected, seen, error, allowed):
    passed = error is not None and error <= allowed
    return {"expected": expected, "seen": seen, "off": error, "allowed": allowed, "passed": passed}


def _ends(value):
    """A number, or the ends of several."""
    value = torch.as_tensor(value).detach().double()
    ends = dict.fromkeys((float(value.min()), float(value.max())))
    return " to ".join(f"{end + 0.0:.6g}" for end in ends)


def _sentence(error):
    return " ".join(str(error).split())[:160]
