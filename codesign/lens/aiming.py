"""Ray aiming: rays that meet the real stop at given points, and the image irradiance that follows
from them.

Paraxial pupils are where thin pencils near the axis see the stop; off the axis the real pupil
moves, tilts and shrinks. Aiming solves, ray by ray, for the point of the paraxial pupil plane
through which the ray must
start: Newton steps with the exact derivative of each ray, halved until the miss falls; rays that do
not get there are led to their field from the axis in small steps.
"""

import warnings
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from codesign.errors import is_searched
from codesign.lens.glass import D_UM
from codesign.lens.paraxial import field_angles
from codesign.lens.trace import Prescription, Status, across, trace
from codesign.lens.traced import TracedLens, in_float64

NEWTON_STEPS = 12
HALVINGS = 6
FIELD_STEPS = 16
# miss at the stop, relative to the stop's radius: where rounding of a float64 trace begins
REACHED = 1e-11
SINGULAR = 1e-12  # determinant at the stop of rays that stay where they are
# step of the derivative that goes into the irradiance, relative to the pupil's size; its error is
# the square
DIFFERENCE = 1e-3
START_Z_MM = -5.0  # where aimed rays start, from the first vertex


@dataclass(frozen=True)
class Aim:
    """Where rays cross the paraxial pupil's plane to meet the stop.

    point_mm: [N, 2]. found: [N] bool; where False, no ray meets the stop there and the point is the
      paraxial one.
    """

    point_mm: Tensor
    found: Tensor


def aim_at_stop(
    rays: Callable[[Tensor, Tensor], tuple[Tensor, Tensor]],
    until_stop: Prescription,
    pupil: Tensor,
    stop_radius_mm: Tensor,
    pupil_radius_mm: Tensor,
) -> Aim:
    """Solve for the points of the pupil plane whose rays meet the stop, in its own axes where it is
    decentred or tilted, at the targets.

    Args:
      rays: function (points [K N, 2], share [K N, 1]) -> origin, direction [K N, 3], for the N rays
        K times over; share scales the field from the axis (0) to where it is wanted (1).
      until_stop: Prescription that ends on the stop. pupil: [N, 2] points of the unit disc; the
        radii give it its size on the stop and on the pupil plane.
    Returns: Aim. Gradient: point_mm to every tensor behind ``rays``, ``until_stop`` and the radii,
      by the implicit function theorem.
    Warns: when some rays cannot be aimed, and nobody searches; they keep their guess.
    """
    target_mm = pupil * stop_radius_mm
    with torch.no_grad():
        fixed = until_stop.detached()
        guess_mm = pupil * pupil_radius_mm
        scale = stop_radius_mm.detach()
        full = torch.ones_like(guess_mm[:, :1])
        at, found = _newton(rays, fixed, target_mm, guess_mm.clone(), full, scale)
        lost = torch.nonzero(~found)[:, 0]
        if lost.numel():
            at[lost], found[lost] = _from_the_axis(rays, fixed, target_mm, guess_mm, lost, scale)
            if not bool(found.all()):
                at[~found] = guess_mm[~found]
                _tell_lost(found)
    met, _ = _meet(rays, until_stop, at, full)
    jacobian = _jacobian(rays, fixed, at, full, slice(None))
    still = ~found | (torch.linalg.det(jacobian).abs() <= SINGULAR)
    jacobian = _or_identity(jacobian, still)
    change = torch.linalg.solve(jacobian, torch.where(still[:, None], 0, met - target_mm))
    return Aim(at - change, found)


def _tell_lost(found):
    if not is_searched():
        warnings.warn(
            f"{int((~found).sum())} of {found.numel()} rays cannot be aimed at the stop (no light takes "
            "that way); they keep their paraxial aim.",
            stacklevel=4,
        )


def area_at_stop(
    rays: Callable[[Tensor, Tensor], tuple[Tensor, Tensor]],
    until_stop: Prescription,
    aim: Aim,
    pupil_radius_mm: Tensor,
) -> Tensor:
    """Area that aimed rays cover at the stop per area of the pupil's plane, [N], with its sign; 1
    where no ray was found.

    Args: as for ``aim_at_stop``, which returns ``aim``.
    Gradient: to every tensor behind ``rays`` and ``until_stop``, and through the aimed points.
    """
    size = pupil_radius_mm.detach()
    line = torch.tensor([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]]).to(aim.point_mm)
    points = aim.point_mm[None] + DIFFERENCE * size * line[:, None]
    full = torch.ones_like(points[..., :1])
    met, _ = _meet(rays, until_stop, points.reshape(-1, 2), full.reshape(-1, 1))
    stop = met.reshape(4, -1, 2)
    jacobian = torch.stack([stop[0] - stop[1], stop[2] - stop[3]], -1) / (2 * DIFFERENCE * size)
    still = torch.linalg.det(jacobian.detach()).abs() <= SINGULAR
    return torch.linalg.det(_or_identity(jacobian, still | ~aim.found))


def _or_identity(jacobian, rows):
    """The Jacobians [N, 2, 2] (at the stop, on the pupil's plane), the identity in some rows."""
    return torch.where(rows[:, None, None], torch.eye(2).to(jacobian), jacobian)


def aimed_rays(
    lens: TracedLens,
    field_rad: float | Tensor,
    pupil: Tensor,
    wavelength_um: float = D_UM,
) -> tuple[Tensor, Tensor]:
    """Parallel rays of one field angle (in +y) that meet the real stop at points of its disc.

    Args: field_rad scalar; pupil [M, 2] on the unit disc, in units of the stop's paraxial radius,
      which is that of the d line in every colour.
    Returns: origins and directions [M, 3], lens axes, in the lens's precision; solved in float64.
    Gradient: origins to the lens. Warns: when some rays cannot be aimed. Raises: DomainError for a
      field of 90 degrees and more.
    """
    dtype = lens.dtype
    lens = in_float64(lens)
    f = lens.first_order(wavelength_um)
    pupil = pupil.to(f.entrance_pupil_z_mm)
    tangent = field_angles(lens, field_rad).tan().to(pupil)

    def rays(points, share):
        slope = torch.cat([0 * share, tangent * share, torch.ones_like(share)], 1)
        direction = torch.nn.functional.normalize(slope, dim=1)
        at = torch.cat([points, f.entrance_pupil_z_mm.expand(points.shape[0], 1)], 1)
        return at + slope * (START_Z_MM - at[:, 2:]), direction

    aim = aim_at_stop(
        rays,
        lens.prescription(wavelength_um).until(lens.stop_index),
        pupil,
        lens.first_order().stop_semi_aperture_mm,
        f.entrance_pupil_diameter_mm / 2,
    )
    origin, direction = rays(aim.point_mm, torch.ones_like(pupil[:, :1]))
    return origin.to(dtype), direction.to(dtype)


def _meet(rays, until_stop, points, share):
    """Places [N, 2] on the stop, and whether the rays get there."""
    out = trace(until_stop, *rays(points, share))
    return across(until_stop, -1, out.position_mm), out.status == Status.OK


def _newton(rays, until_stop, target, at, share, scale):
    """Newton steps from ``at`` [N, 2]; returns points and whether each ray reached its target. Rays
    that have no derivative stay."""
    miss, passes = _miss(rays, until_stop, target, at, share)
    for _ in range(NEWTON_STEPS):
        active = torch.nonzero(passes & (miss.norm(dim=1) > REACHED * scale))[:, 0]
        if not active.numel():
            break
        jacobian = _jacobian(rays, until_stop, at, share, active)
        step = torch.zeros_like(at)
        solvable = torch.linalg.det(jacobian).abs() > SINGULAR
        step[active[solvable]] = torch.linalg.solve(jacobian[solvable], miss[active[solvable]])
        before = at.clone()
        for halving in range(HALVINGS):
            trial = before - step * 0.5**halving
            there, reaches = _miss(rays, until_stop, target, trial, share)
            better = reaches & (there.norm(dim=1) < miss.norm(dim=1))
            at = torch.where(better[:, None], trial, at)
            miss = torch.where(better[:, None], there, miss)
            step = torch.where(better[:, None], 0, step)
            if not bool(step.any()):
                break
        if torch.equal(at, before):
            break
    return at, passes & (miss.norm(dim=1) <= 1e3 * REACHED * scale)


def _from_the_axis(rays, until_stop, target, guess, rows, scale):
    """Follow rays from the axis, where the paraxial guess holds, to their field in small steps;
    returns points and whether they arrived."""
    full = torch.zeros_like(target[:, :1])
    at = guess.clone()
    before = guess.clone()
    for k in range(FIELD_STEPS + 1):
        share = full + k / FIELD_STEPS
        start = at + (at - before) if k > 1 else at  # go on as before
        before = at
        at, found = _newton(rays, until_stop, target, start, share, scale)
        at = torch.where(found[:, None], at, start)
    return at[rows], found[rows]


def _miss(rays, until_stop, target, at, share):
    met, passes = _meet(rays, until_stop, at, share)
    return met - target, passes


def _jacobian(rays, until_stop, at, share, rows):
    """Motion at the stop per motion on the pupil plane, [rows, 2, 2]; exact, since each ray depends
    on its own point only."""
    with torch.enable_grad():
        points = at.clone().requires_grad_(True)
        stop, _ = _meet(rays, until_stop, points, share)
        found = [
            torch.autograd.grad(stop[:, i].sum(), points, retain_graph=i == 0)[0] for i in (0, 1)
        ]
    return torch.stack(found, 1)[rows]
