"""A lens design as free variables: curvatures but the last, which holds the focal length, and all thicknesses."""

from dataclasses import dataclass

import torch
from torch import Tensor

from codesign.errors import DomainError
from codesign.lens.analysis import rms_spot_mm, spots
from codesign.lens.geolens import GeoLens
from codesign.lens.paraxial import powers_curvature, yu_trace


def hold_efl(lens, efl_mm):
    """The lens with its last curvature solved so that the focal length is ``efl_mm`` exactly. Differentiable.

    Source: the y-u trace solved for the last refraction, nu' = -y_1 / f (Smith, Modern Optical Engineering, ch. 2).
    """
    c, t, n = lens.curvature_per_mm, lens.thickness_mm, lens.index()
    vertex = powers_curvature(c, lens.asphere)
    one = torch.ones_like(c[0])
    heights, angles = yu_trace(vertex, t, n, one, torch.zeros_like(one), last=c.numel() - 1)
    y = heights[-1] + t[-2] * angles[-1] / n[-2]
    step = n[-1] - n[-2]
    if abs(float(step.detach())) < 1e-9 or abs(float(y.detach())) < 1e-9:
        raise DomainError(f"{lens.name}: the last surface cannot hold the focal length (index step {float(step):.3g}, ray height {float(y):.3g}); end the lens with a refracting surface.")
    last = (angles[-1] + one / efl_mm) / (y * step) - (vertex[-1] - c[-1])
    return lens.replace(curvature_per_mm=torch.cat([c[:-1], last.reshape(1)]))


def edge_thickness_mm(lens):
    """Gap between neighbouring surfaces at the larger of their semi-apertures, [S - 1] mm. Gradient: curvatures, thicknesses, conics."""
    a = torch.maximum(lens.semi_aperture_mm[:-1], lens.semi_aperture_mm[1:])
    return lens.thickness_mm[:-1] + _sag(lens, slice(1, None), a) - _sag(lens, slice(None, -1), a)


def _sag(lens, rows, height):
    c, k = lens.curvature_per_mm[rows], lens.conic[rows]
    r2 = height.square()
    sag = c * r2 / (1 + (1 - (1 + k) * c.square() * r2).clamp_min(1e-6).sqrt())
    for i in range(lens.asphere.shape[1]):
        sag = sag + lens.asphere[rows, i] * r2 ** (i + 1)
    return sag


@dataclass(frozen=True)
class LensDesign:
    """Free variables of a lens around a reference, in steps that each move the rays by about the same distance.

    reference: the lens at variables = 0. efl_mm: held. scale: [V] step per variable, curvatures (S - 1, per mm) then thicknesses (S, mm).
    floor_mm: [S] least centre thickness; edge_floor_mm: [S - 1] least edge thickness.
    """

    reference: GeoLens
    efl_mm: float
    scale: Tensor
    floor_mm: Tensor
    edge_floor_mm: Tensor

    def lens(self, variables):
        """The lens at dimensionless variables [V]; gradients flow back to them.

        Thicknesses stay above their floors by a smooth bend that is the identity a few floor-widths above.
        """
        count = self.reference.curvature_per_mm.numel()
        change = variables.to(self.scale) * self.scale
        curvature = self.reference.curvature_per_mm.detach() + torch.cat([change[: count - 1], torch.zeros_like(change[:1])])
        room = self.reference.thickness_mm.detach() + change[count - 1 :] - self.floor_mm
        width = 0.02 * self.floor_mm.clamp_min(1e-3)
        thickness = self.floor_mm + width * torch.nn.functional.softplus(room / width)
        return hold_efl(self.reference.replace(curvature_per_mm=curvature, thickness_mm=thickness), self.efl_mm)

    def penalty(self, lens):
        """Smooth hinge on edge thicknesses below their floors, in units of 1 % of the focal length squared; 0 when all hold."""
        lack = (self.edge_floor_mm - edge_thickness_mm(lens)).clamp_min(0) / (0.01 * self.efl_mm)
        return lack.square().sum()


def make_design(lens, fields_rad, step_mm, floor_share=0.6):
    """LensDesign around ``lens``: every unit variable alone moves the rays of the fields by ``step_mm`` RMS about their mean.

    Args: fields_rad: angles at which ray motion is measured. floor_share: floors as a share of today's centre and edge thickness.
    """
    lens = lens.freeze()
    count = lens.curvature_per_mm.numel()
    efl = float(lens.first_order().efl_mm)
    edges = edge_thickness_mm(lens)
    plain = LensDesign(lens, efl, torch.ones(2 * count - 1, dtype=lens.thickness_mm.dtype), lens.thickness_mm * floor_share, edges * torch.where(edges > 0, floor_share, 1 / floor_share))
    scale = torch.empty_like(plain.scale)
    with torch.no_grad():
        for v in range(scale.numel()):
            h = 1e-4 * (float(lens.curvature_per_mm.abs().mean()) if v < count - 1 else float(lens.thickness_mm[v - count + 1]))
            up, down = torch.zeros_like(scale), torch.zeros_like(scale)
            up[v], down[v] = h, -h
            motion = (spots(plain.lens(up), fields_rad)[0] - spots(plain.lens(down), fields_rad)[0]) / (2 * h)
            motion = motion - motion.mean(1, keepdim=True)  # a shift of the whole spot does not blur
            scale[v] = step_mm / motion.square().sum(-1).mean().sqrt().clamp_min(1e-12)
    limit = torch.cat([0.2 * lens.curvature_per_mm.abs().mean().expand(count - 1), 0.2 * lens.thickness_mm])
    return LensDesign(lens, efl, torch.minimum(scale, limit), plain.floor_mm, plain.edge_floor_mm)


def detune(design, fields_rad, target_mm, generator):
    """Variables [V] along a random direction of curvatures and focus where the mean RMS spot first reaches ``target_mm``.

    The direction is Gaussian in the design's own steps; thicknesses other than the last keep their values. Raises DomainError when
    no step up to 30 units reaches the target.
    """
    count = design.reference.curvature_per_mm.numel()
    direction = torch.randn(design.scale.numel(), generator=generator, dtype=design.scale.dtype)
    direction[count - 1 : -1] = 0
    spot = lambda size: float(rms_spot_mm(design.lens(direction * size), fields_rad).mean())  # noqa: E731
    low, high = 0.0, 0.0
    with torch.no_grad():
        while spot(high) < target_mm:
            low, high = high, high + 0.05
            if high > 30:
                raise DomainError(f"detuning along this direction never reaches an RMS spot of {target_mm} mm; choose another seed.")
        for _ in range(30):
            middle = (low + high) / 2
            low, high = (middle, high) if spot(middle) < target_mm else (low, middle)
    return direction * high
