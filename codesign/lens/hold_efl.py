"""The focal length held by a curvature: a solve in closed form, differentiable."""

from typing import TypeVar

import torch
from torch import Tensor

from codesign.errors import DomainError
from codesign.lens.paraxial import bending, yu_trace
from codesign.lens.traced import TracedLens

L = TypeVar("L", bound=TracedLens)

FLAT = 1e-12  # per mm; a curvature below this is a plane
NO_POWER = 1e-9  # index step, or ray height in mm, below which a curvature cannot bend the ray


def holding_surface(lens: TracedLens) -> int:
    """Index of the surface whose curvature holds the focal length: the last that bends light and is not the
    face of a plane-parallel plate.

    A stop in air and a cover glass behind the lens are passed over; the plane side of a plano-convex lens is
    not. When all are plane (a design from scratch) it is the last that bends light. It goes by today's
    curvatures: where those of a cover glass vary, name the surface instead. Raises: DomainError when none
    does.
    """
    step = bending(lens.index(), lens.mirrors).detach().abs().tolist()
    curved = [abs(c) > FLAT for c in lens.curvature_per_mm.tolist()]
    refracts = [s > NO_POWER for s in step]
    index = lens.index().tolist()
    bends = [i for i, yes in enumerate(refracts) if yes]
    if not bends:
        raise DomainError(
            f"{lens.name}: no surface changes the index (all index steps are 0), so none can hold the focal "
            "length; give a surface a glass."
        )

    def has_shape(i):
        neighbours = [
            j for j, n in ((i - 1, index[i]), (i + 1, index[i + 1])) if 0 <= j < len(curved) and n > 1 + 1e-3
        ]
        return curved[i] or any(curved[j] for j in neighbours)

    return next((i for i in reversed(bends) if has_shape(i)), bends[-1])


def hold_efl(lens: L, efl_mm: float | Tensor, surface: int | None = None) -> L:
    """The lens with one curvature solved so that the focal length is ``efl_mm`` exactly.

    Args: efl_mm: not 0, at the d line. surface: index of the curvature to solve; ``holding_surface(lens)``
      when left out.
    Gradient: the solved curvature carries that of all others, of thicknesses and of indices; efl_mm too when
      it is a tensor.
    Raises: DomainError when that curvature cannot do it.
    Source: the y-u trace solved for one refraction, n'u' = n u - y phi, with the surfaces behind it as a
      linear map of (y, n'u') (Smith, Modern Optical Engineering, ch. 2).
    """
    c = lens.curvature_per_mm
    t = lens.thickness_mm
    n = lens.index()
    power = lens.surface_power()
    at = holding_surface(lens) if surface is None else range(c.numel())[surface]
    count = c.numel()
    one = torch.ones_like(c[0])
    zero = torch.zeros_like(c[0])
    heights, angles = yu_trace(power, t, n, one, zero, last=at)
    y, nu = (heights[-1] + t[at - 1] * angles[-1] / n[at], angles[-1]) if heights else (one, zero)
    # the last angle = by_height * y + by_angle * nu'
    by_height = zero
    by_angle = one
    if at < count - 1:
        by_height = yu_trace(power, t, n, one, zero, first=at + 1)[1][-1]
        by_angle = yu_trace(power, t, n, t[at] / n[at + 1], one, first=at + 1)[1][-1]
    step = bending(n, lens.mirrors)[at]
    weak = [float(v.detach()) for v in (step, y, by_angle)]
    if min(map(abs, weak)) < NO_POWER:
        raise DomainError(
            f"{lens.name}: surface {at + 1} cannot hold the focal length (index step {weak[0]:.3g}, ray "
            f"height {weak[1]:.3g}, lever {weak[2]:.3g}); name a refracting one away from an image."
        )
    wanted = (-n[-1] / efl_mm - by_height * y) / by_angle
    solved = c[at] + ((nu - wanted) / y - power[at]) / step
    return lens.replace(curvature_per_mm=torch.cat([c[:at], solved.reshape(1), c[at + 1 :]]))
