"""What the parts that GeoLens is built on ask of a traced lens; GeoLens is one."""

from typing import Protocol, Self, TypeVar

import torch
from torch import Tensor

from codesign.lens.glass import D_UM
from codesign.lens.paraxial import ParaxialLens
from codesign.lens.surface import Surface
from codesign.lens.trace import Prescription, TraceResult


class TracedLens(ParaxialLens, Protocol):
    """A lens whose rays can be traced and whose tensors can be replaced; see GeoLens for what each
    name holds."""

    tensor_names: tuple[str, ...]
    surfaces: tuple[Surface, ...]
    mirrors: tuple[bool, ...]
    stop_index: int
    curvature_per_mm: Tensor
    asphere: Tensor
    phase: Tensor
    glass: Tensor
    semi_aperture_mm: Tensor

    @property
    def dtype(self) -> torch.dtype: ...

    def prescription(self, wavelength_um: float = D_UM) -> Prescription: ...

    def trace(
        self,
        origin_mm: Tensor,
        direction: Tensor,
        wavelength_um: float = D_UM,
    ) -> TraceResult: ...

    def replace(self, **tensors: Tensor) -> Self: ...


L = TypeVar("L", bound=TracedLens)


def in_float64(lens: L) -> L:
    """The lens with its numbers in float64, for figures that float32 would drown in rounding; the
    lens itself where they are that already. Gradient: to every tensor of the lens."""
    if lens.dtype == torch.float64:
        return lens
    lens = lens.replace()
    return lens.replace(**{name: getattr(lens, name).double() for name in lens.tensor_names})
