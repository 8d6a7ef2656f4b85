"""A lens design as free variables: curvatures but one, which holds the focal length, and all
thicknesses."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from codesign.errors import DomainError
from codesign.grad.jacobian import principal_modes
from codesign.lens.analysis import rms_spot_mm, spots
from codesign.lens.design.constraints import gap_mm
from codesign.lens.geolens import LEARNABLES, GeoLens
from codesign.lens.solves import hold_efl, holding_surface
from codesign.lens.variables import ray_motion


def edge_thickness_mm(lens: GeoLens) -> Tensor:
    """Gap between neighbouring surfaces at the larger of their semi-apertures, [S - 1] mm.
    Gradient:
    curvatures, thicknesses, conics."""
    return gap_mm(lens, torch.ones_like(lens.thickness_mm[:1]))[:, 0]


@dataclass(frozen=True)
class LensDesign:
    """Free variables of a lens around a reference; each unit variable moves the rays by the same
    distance, in its own way.

    reference: the lens at variables = 0. efl_mm: held, by the last curvature that can (see
      solves.holding_surface).
    basis: [V, V], columns are changes of curvatures (S - 1, per mm) and thicknesses (S, mm) per
      unit variable.
    floor_mm: [S] least centre thickness; edge_floor_mm: [S - 1] least edge thickness.
    """

    reference: GeoLens
    efl_mm: float
    basis: Tensor
    floor_mm: Tensor
    edge_floor_mm: Tensor

    def lens(self, variables: Tensor) -> GeoLens:
        """The lens at dimensionless variables [V]; gradients flow back to them.

        Thicknesses stay above their floors by a smooth bend that is the identity a few hundredths
        of the floor above it.
        """
        return self.changed(self.basis @ variables.to(self.basis))

    def changed(self, change: Tensor) -> GeoLens:
        """The lens with curvatures and thicknesses changed by [V] (per mm, then mm) from the
        reference."""
        count = self.reference.curvature_per_mm.numel()
        at = holding_surface(self.reference)
        curvature = self.reference.curvature_per_mm.detach() + torch.cat(
            [change[:at], torch.zeros_like(change[:1]), change[at : count - 1]]
        )
        room = self.reference.thickness_mm.detach() + change[count - 1 :] - self.floor_mm
        width = 0.02 * self.floor_mm.clamp_min(1e-3)
        thickness = self.floor_mm + width * torch.nn.functional.softplus(room / width)
        return hold_efl(
            self.reference.replace(curvature_per_mm=curvature, thickness_mm=thickness),
            self.efl_mm,
            at,
        )

    def shortfall(self, lens: GeoLens) -> Tensor:
        """How far edge thicknesses lie below their floors, [S - 1], in units of 1 % of the focal
        length."""
        return (self.edge_floor_mm - edge_thickness_mm(lens)).clamp_min(0) / (0.01 * self.efl_mm)

    def penalty(self, lens: GeoLens) -> Tensor:
        """Smooth hinge, the sum of the squared shortfalls; 0 when all floors hold."""
        return self.shortfall(lens).square().sum()


def sizes_of(lens: GeoLens) -> Tensor:
    """Sizes of the free numbers of a design, [V]: the mean curvature per mm for S - 1, each
    thickness in mm."""
    curvature = lens.curvature_per_mm.detach().abs().mean()
    return torch.cat([curvature.expand(len(lens.surfaces) - 1), lens.thickness_mm.detach()])


def make_design(
    lens: GeoLens,
    fields_rad: Sequence[float],
    step_mm: float,
    floors: LensDesign | None = None,
    floor_share: float = 0.6,
) -> LensDesign:
    """LensDesign around ``lens`` whose variables are the principal modes of ray motion.

    With J the motion of the rays about each spot's mean per scaled curvature and thickness, the
    variables are the eigenvectors of J^T J, each scaled to move the rays by ``step_mm`` RMS, or to
    change no curvature or thickness by more than a tenth of its size. Defocus, coma, astigmatism
    and so on then have separate step sizes, which a step per curvature has not.

    Args:
      fields_rad: angles at which ray motion is measured.
      floors: another LensDesign whose thickness floors to keep; by default they are ``floor_share``
        of today's centre and edge thicknesses.
    """
    # the caller's lens keeps its gradients
    lens = lens.replace(**{name: getattr(lens, name).detach().clone() for name in LEARNABLES})
    size = sizes_of(lens)
    with torch.no_grad():
        edges = edge_thickness_mm(lens)
        least = (
            (floors.floor_mm, floors.edge_floor_mm)
            if floors
            else (
                lens.thickness_mm * floor_share,
                edges * torch.where(edges > 0, floor_share, 1 / floor_share),
            )
        )
        plain = LensDesign(lens, float(lens.first_order().efl_mm), torch.diag(size), *least)
        # [rays, V], steps per relative change
        motion = (
            torch.stack([_motion(plain, v, fields_rad) for v in range(size.numel())], 1) / step_mm
        )
        basis = principal_modes(motion, limit=0.1, size=size)
    return LensDesign(lens, plain.efl_mm, basis, *least)


def _motion(design, variable, fields_rad, step=1e-4):
    """Ray motion about the mean of each spot per unit of one variable, RMS-normalised: [rays * 2]
    mm."""
    shift = torch.zeros_like(design.basis[0])
    shift[variable] = step
    ahead, behind = (spots(design.lens(change), fields_rad) for change in (shift, -shift))
    moved, weight = ray_motion(ahead, behind)
    moved = moved / (2 * step)
    weight = weight[..., None]
    # a shift of the whole spot does not blur
    moved = moved - weight * moved.sum(1, keepdim=True) / weight.sum(1, keepdim=True).clamp_min(1)
    return moved.reshape(-1) / (moved.shape[0] * moved.shape[1]) ** 0.5


def detune(
    design: LensDesign,
    fields_rad: Sequence[float],
    target_mm: float,
    generator: torch.Generator,
    spot_mm: Callable[[GeoLens], Tensor] | None = None,
) -> GeoLens:
    """The reference lens with errors in curvatures and focus that bring its mean RMS spot to
    ``target_mm``, focal length held.

    Every curvature but the one that holds the focal length and the image distance get independent
    Gaussian errors of one common relative size, which is raised until the target is met. spot_mm:
    what is raised to the target, a scalar; None is the mean RMS spot in the d line. One that
    refocuses first asks for errors that no focusing takes away. Raises: DomainError when 50 % is
    not enough.
    """
    count = design.reference.curvature_per_mm.numel()
    at = holding_surface(design.reference)
    size = torch.cat(
        [
            design.reference.curvature_per_mm[:at],
            design.reference.curvature_per_mm[at + 1 :],
            torch.zeros_like(design.floor_mm[:-1]),
            design.reference.thickness_mm[-1:],
        ]
    )
    direction = torch.randn(2 * count - 1, generator=generator, dtype=size.dtype) * size
    with torch.no_grad():

        def spot(size):
            made = design.changed(direction * size)
            return float(rms_spot_mm(made, fields_rad).mean() if spot_mm is None else spot_mm(made))

        low = 0.0
        high = 0.0
        while spot(high) < target_mm:
            low = high
            high = high + 0.002
            if high > 0.5:
                raise DomainError(
                    f"detuning along this direction never reaches an RMS spot of {target_mm:.4g} mm; choose "
                    "another seed, or a smaller spot."
                )
        for _ in range(40):
            middle = (low + high) / 2
            low, high = (middle, high) if spot(middle) < target_mm else (low, middle)
        return design.changed(direction * high)
