"""What the kernels of the closed form share: the samples of an image, numbers for lanes of them,
recordings, how a kernel enters a graph of torch, and the switch to plain operations of torch."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from functools import lru_cache, wraps
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd import Function

from codesign import backend

_FIRST_ONLY = (
    "the kernels of the closed form give first derivatives only; a second derivative through event flow was asked "
    "for. Use differences of gradients instead."
)
# of a kernel: one for each size and setting in use
RECORDINGS = 64
_PLAIN = ContextVar("plain operations", default=False)


@contextmanager
def plain_operations() -> Iterator[None]:
    """Within it, operations of torch take the kernels' place: slower, for programs that run without
    this package (export), and to compare with."""
    token = _PLAIN.set(True)
    try:
        yield
    finally:
        _PLAIN.reset(token)


def plain_wanted() -> bool:
    """Whether a ``plain_operations`` is open."""
    return _PLAIN.get()


@dataclass(frozen=True)
class Grid:
    """Samples of an image of height x width pixels: the centres of its squares of stride x stride
    pixels."""

    height: int
    width: int
    stride: int = 1

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns; a square that sticks out at the lower or right border has no sample."""
        return self.height // self.stride, self.width // self.stride


class Form(NamedTuple):
    """What a kernel must know of its arrays: device, precision, and sizes of a batch of images."""

    device: str
    dtype: torch.dtype
    images: int
    height: int
    width: int
    stride: int

    @classmethod
    def of(cls, tensor: Tensor, grid: Grid) -> "Form":
        """Of a tensor [B, ...] on the samples of ``grid``."""
        return cls(
            tensor.device.type, tensor.dtype, len(tensor), grid.height, grid.width, grid.stride
        )

    def load(self, *tensors: Tensor) -> list[Any]:
        """As flat drjit arrays, without a copy where they are dense."""
        flat = backend.arrays(self.device, self.dtype).Float
        return [backend.load(flat, tensor) for tensor in tensors]

    def scalars(self, numbers: list[float]) -> list[Any]:
        """Opaque: other numbers need no new kernel."""
        import drjit as dr

        flat = backend.arrays(self.device, self.dtype).Float
        return [dr.opaque(flat, number) for number in numbers]


def recorded(kernel: Callable[..., Any]) -> Callable[..., Any]:
    """A function of hashable settings and then drjit arrays or lists of them, which is traced once
    for each of the settings and replayed after that: small images cost mostly tracing. Widths of
    arrays must follow from the settings.

    While drjit looks at what a recording is given, or at what its closure holds, it holds its own
    lock. Where that runs anything in Python, as for a dataclass, another thread may get Python's
    lock and wait for drjit's for ever (one that gives tensors back to torch does). So settings,
    which have methods in Python, are not given but bound as defaults.
    """

    @lru_cache(RECORDINGS)
    def frozen(settings):
        import drjit as dr

        def of_arrays(*arrays, settings=settings, kernel=kernel):
            return kernel(*settings, *arrays)

        return dr.freeze(of_arrays, warn_after=1 << 30)

    @wraps(kernel)
    def run(*args):
        import drjit as dr

        given = tuple(each for each in args if isinstance(each, list) or dr.is_array_v(each))
        with dr.suspend_grad():
            return frozen(args[: len(args) - len(given)])(*given)

    return run


def tensors(shape: tuple[int, ...], *values: Any) -> list[Tensor]:
    """Evaluated drjit arrays as tensors of one shape that own their memory."""
    import drjit as dr

    dr.sync_thread()
    return [value.torch().reshape(shape) for value in values]


def in_graph(
    forward: Callable[..., Any],
    adjoint: Callable[..., Any],
    settings: tuple[Any, ...],
    *given: Tensor,
) -> tuple[Tensor, ...]:
    """What a kernel gives, in a graph of torch.

    Args:
      forward: forward(*settings, *given) gives the outputs and what else the adjoint needs.
      adjoint: adjoint(*settings, *given, *that, grads, wanted) gives a gradient, or None, of each
        of the given; ``grads`` are None where an output has no gradient, ``wanted`` says which of
        the given want one.
    """
    return _Kernel.apply(forward, adjoint, settings, *given)


class _Kernel(Function):
    @staticmethod
    def forward(ctx, forward, adjoint, settings, *given):
        ctx.set_materialize_grads(False)
        found, kept = forward(*settings, *given)
        ctx.save_for_backward(*given, *kept)
        ctx.rest = adjoint, settings, len(given)
        return tuple(found)

    @staticmethod
    def backward(ctx, *grads):  # pyright: ignore[reportIncompatibleMethodOverride]
        adjoint, settings, count = ctx.rest
        live = [grad for grad in grads if grad is not None]
        if not live:
            return (None,) * (3 + count)
        saved = ctx.saved_tensors
        found = adjoint(*settings, *saved, grads, ctx.needs_input_grad[3:])
        sources = (*saved[:count], *live)
        return None, None, None, *backend.first_only(found, sources, _FIRST_ONLY)


class Lanes:
    """Lanes of drjit for the samples of images, and numbers that need no new kernel when they
    change."""

    def __init__(self, form: Form) -> None:
        import drjit as dr

        self.dr: Any = dr
        self.arr = backend.arrays(form.device, form.dtype)
        self.double = backend.arrays(form.device, torch.float64).Float
        self.form = form
        self.images = form.images
        self.rows, self.columns = Grid(*form[3:]).shape
        self.samples = self.rows * self.columns
        self.width = self.images * self.samples
        self.area = self.count(self.samples)
        self.across = self.count(self.columns)

    def count(self, value: int) -> Any:
        return self.dr.opaque(self.arr.UInt32, value)

    def number(self, value: float) -> Any:
        return self.dr.opaque(self.arr.Float, value)

    def lanes(self, count: int) -> Any:
        return self.dr.arange(self.arr.UInt32, count)

    def take(self, flat: Any, index: Any) -> Any:
        return self.dr.gather(self.arr.Float, flat, index)

    def split(self, index: Any, size: int) -> tuple[Any, Any]:
        """Quotient and remainder by a size. Processors divide no vectors of whole numbers; the half
        keeps the rounded quotient off the next whole number."""
        inverse = self.dr.opaque(self.double, 1 / size)
        quotient = self.arr.UInt32((self.double(index) + 0.5) * inverse)
        return quotient, index - quotient * self.count(size)

    def empty(self, count: int) -> Any:
        """Memory to be filled by ``put``; drjit hands the same pages out again and again."""
        target = self.dr.empty(self.arr.Float, count)
        self.dr.eval(target)
        return target

    def put(self, target: Any, value: Any, index: Any) -> None:
        self.dr.scatter(target, value, index, mode=self.dr.ReduceMode.NoConflicts)

    def loop(self, first: Any, end: Any, body: Any, *carried: Any) -> list[Any]:
        """carried = body(k, *carried) for k from ``first`` to ``end``, per lane."""
        _, *carried = self.dr.while_loop(
            (first, *carried),
            lambda k, *_: k < end,
            lambda k, *carried: (k + 1, *body(k, *carried)),
            mode="symbolic",
        )
        return carried
