"""Where searches begin: mounts spread evenly over what is allowed; and what makes a search hopeless, said
before it."""

import math
from collections.abc import Sequence

import torch
from torch import Tensor
from torch.quasirandom import SobolEngine

from codesign.errors import DomainError, as_number, check_seed, check_whole
from codesign.mount.pose import Mount
from codesign.mount.requirements import Clearance, Requirement, judge
from codesign.mount.triangles import closest_points
from codesign.pose import se3_exp
from codesign.types import ChiefRayCamera

INNER = 0.9  # of the box, in which searches begin: at its walls the map of the mount is flat
DRAWS = 64  # looked at together
MOST_DRAWS = 64  # times DRAWS
PLACES = 256  # of a box, in which room is looked for
NEAREST = 8  # places of the box from which the way to the body is followed
WAYS = 50  # steps of it, to and fro between box and body


def starts(
    mount: Mount,
    count: int,
    requirements: Sequence[Requirement] = (),
    camera: ChiefRayCamera | None = None,
    *,
    reach_rad: float = math.pi / 4,
    roll_rad: float = 0.0,
    seed: int = 0,
) -> Tensor:
    """Numbers of mounts from which to search: quasi-random in the box and in the directions around the
    mount's start attitude, as far as they keep the requirements.

    Args:
      count: how many.
      camera: for requirements that look through it.
      reach_rad: largest angle of the view from that of the start attitude, up to pi (all directions).
      roll_rad: largest turn about the view either way.
      seed: of the scrambling.
    Returns: [count, 6] for ``Mount.forward`` or ``mount.numbers.copy_``; the same for the same seed.
      Gradient: none.
    Raises: DomainError when hardly any draw keeps the requirements, naming the one at which most fail; they
      are asked in their order, so the cheap ones stand first.
    Source: Sobol, USSR Comput. Math. 7, 1967, scrambled (torch.quasirandom).

    >>> mount = Mount((0.2, 0.0, 0.4), (0.1, 0.0, 0.2), pitch_rad=1.0)
    >>> found = starts(mount, 5, reach_rad=0.5)
    >>> mount(found)[:, 1, 3].tolist()  # this axis is held
    [0.0, 0.0, 0.0, 0.0, 0.0]
    """
    count = check_whole(count, "starts: count")
    for name, value in (("reach_rad", reach_rad), ("roll_rad", roll_rad)):
        if not 0 <= as_number(value, name) <= math.pi:
            raise DomainError(f"starts: {name} is {value}; an angle from 0 to pi is needed.")
    engine = SobolEngine(6, scramble=True, seed=check_seed(seed, "starts: seed"))
    found: list[Tensor] = []
    failed = torch.zeros(len(requirements))
    for _ in range(MOST_DRAWS):
        poses = _drawn(mount, engine.draw(DRAWS, dtype=torch.float64), reach_rad, roll_rad)
        for k, each in enumerate(requirements):
            kept = (_exact(each, poses, camera) >= 0).all(-1)
            failed[k] += int((~kept).sum())
            poses = poses[kept]
            if not len(poses):
                break
        else:
            found.append(mount.numbers_at(poses))
        if sum(map(len, found)) >= count:
            return torch.cat(found)[:count]
    worst = int(failed.argmax())
    raise DomainError(
        f"starts: of {DRAWS * MOST_DRAWS} mounts {sum(map(len, found))} keep the requirements, {count} are asked for; "
        f"most, {float(failed[worst]) / (DRAWS * MOST_DRAWS):.0%}, fail first at '{requirements[worst].name}': move or widen "
        "the box, turn the start attitude, or ask for less."
    )


@torch.no_grad()
def _exact(requirement, poses, camera):
    return requirement.exact(poses, camera)


def _drawn(mount, draw, reach_rad, roll_rad):
    """Poses [N, 4, 4] of numbers [N, 6] in 0..1, spread evenly over the cap of directions."""
    tilt = torch.acos(1 - draw[:, 3] * (1 - math.cos(reach_rad)))
    around = 2 * math.pi * draw[:, 4]
    zero = torch.zeros_like(tilt)
    towards = torch.stack([zero, zero, zero, -tilt * around.sin(), tilt * around.cos(), zero], 1)
    roll = torch.stack([zero, zero, zero, zero, zero, roll_rad * (2 * draw[:, 5] - 1)], 1)
    poses = se3_exp(towards) @ se3_exp(roll)
    poses[:, :3, :3] = mount.start_attitude @ poses[:, :3, :3]
    poses[:, :3, 3] = mount.nominal_m + INNER * mount.half_range_m * (2 * draw[:, :3] - 1)
    return poses


@torch.no_grad()
def check_mount(
    mount: Mount, requirements: Sequence[Requirement], camera: ChiefRayCamera, *, reach_m: float = 0.3
) -> None:
    """Look at box, requirements and camera before anything is rendered.

    Args: reach_m: how far from the body a bracket may hold a camera.
    Raises: DomainError, in a sentence that says what to change, for a box that is farther from the robot than
      ``reach_m`` or has no room beside it, a start that does not keep a requirement, or a camera whose lens
      has a smaller image circle than its film (where the camera has ``check``).
    """
    for each in requirements:
        if isinstance(each, Clearance):
            _check_box(mount, each, reach_m)
    if hasattr(camera, "check"):
        camera.check()  # pyright: ignore[reportAttributeAccessIssue] - render.Camera knows its image circle
    missed = [verdict for verdict in judge(requirements, mount(), camera) if not verdict.kept]
    if missed:
        raise DomainError(
            f"mount: its start does not keep what is required ({'; '.join(map(str, missed))}); move the start, for "
            "example to one of mount.starts, or ask for less."
        )


def _check_box(mount, clearance, reach_m):
    """Raise for a box beside which there is no robot, or in which there is no room."""
    low = mount.nominal_m - mount.half_range_m
    high = mount.nominal_m + mount.half_range_m
    corners = torch.cartesian_prod(*torch.tensor([[0.0, 1.0]] * 3, dtype=torch.float64))
    draw = torch.cat([corners, SobolEngine(3).draw(PLACES, dtype=torch.float64)])
    for count in (len(corners), len(draw)):  # meshes of many faces take their time: mostly the corners say it
        places = low + (high - low) * draw[:count]
        distance = clearance.body.distance_m(places)
        room = float(distance.max()) - clearance.housing.radius_m - clearance.margin_m
        if room >= 0 and float(distance.min()) <= reach_m:
            return
    said = f"the box of allowed positions from {_list(low)} to {_list(high)} m"
    if room < 0:
        raise DomainError(
            f"mount: {said} has no room for the camera: everywhere in it the housing is inside the robot or too near, at "
            f"best by {-room:.3g} m; move the box out, or leave out the link that carries the camera (Body.of)."
        )
    nearest = places[distance.argsort()[:NEAREST]]
    for _ in range(WAYS):
        at = closest_points(nearest, clearance.body.triangles)[0]
        nearest = torch.minimum(torch.maximum(at, low), high)
    gap = float((nearest - at).norm(dim=-1).min())
    if gap > reach_m:
        raise DomainError(
            f"mount: {said} is {gap:.3g} m away from the robot, farther than reach_m = {reach_m:g}; move it to the robot, "
            "and see that both are in the same axes and in metres."
        )


def _list(values):
    return [round(value, 6) for value in values.tolist()]
