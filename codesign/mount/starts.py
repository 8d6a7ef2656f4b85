"""Where searches begin: mounts spread at random over what is allowed; and what makes a search
hopeless, said before it."""

from collections import Counter
from collections.abc import Sequence

import torch
from torch import Tensor
from torch.quasirandom import SobolEngine

from codesign.checks import check_seed, check_whole
from codesign.errors import DomainError
from codesign.mount.pose import Mount, MountRanges
from codesign.mount.requirements import Clearance, Requirement, judge
from codesign.mount.triangles import closest_points
from codesign.types import ChiefRayCamera

EDGE = 0.05  # of the bounds at either end, in which no search begins
TRIES = 2048
DRAWS = 16  # looked at together
PLACES = 256  # of a box, in which room is looked for
NEAREST = 8  # places of the box from which the way to the body is followed
WAYS = 50  # steps of it, to and fro between box and body


@torch.no_grad()
def starts(
    ranges: MountRanges,
    count: int,
    requirements: Sequence[Requirement] = (),
    camera: ChiefRayCamera | None = None,
    *,
    seed: int = 0,
) -> Tensor:
    """Mounts from which to search: at random within the bounds, as far as they keep the
    requirements.

    Args:
      ranges: their bounds; mounts begin in the inner nine tenths of each.
      count: how many.
      requirements: looked at through ``camera``, in their order, so the cheap ones stand first.
    Returns: shares [count, 6] float64 of the bounds; no gradient. The same seed gives the same.
    Raises: DomainError where too few of TRIES mounts keep the requirements; it names the one at
      which most fail.

    >>> ranges = MountRanges((0.1, 0.0, 0.2, 0.0, 0.5, 0.0), (0.3, 0.0, 0.6, 0.0, 1.5, 0.0))
    >>> ranges.pose(starts(ranges, 5))[:, 1, 3].tolist()  # this axis is held
    [0.0, 0.0, 0.0, 0.0, 0.0]
    """
    count = check_whole(count, "starts: count")
    random = torch.Generator().manual_seed(check_seed(seed, "starts: seed"))
    found: list[Tensor] = []
    failed: Counter[str] = Counter()
    for _ in range(TRIES // DRAWS):
        draw = torch.rand(DRAWS, 6, generator=random, dtype=torch.float64)
        share = EDGE + (1 - 2 * EDGE) * draw
        for each in requirements:
            kept = (each.exact(ranges.pose(share), camera) >= 0).all(-1)
            failed[each.name] += int((~kept).sum())
            share = share[kept]
            if not len(share):
                break
        found.append(share)
        if sum(map(len, found)) >= count:
            return torch.cat(found)[:count]
    [(worst, often)] = failed.most_common(1) or [("none", 0)]
    raise DomainError(
        f"starts: of {TRIES} mounts within the bounds {sum(map(len, found))} keep what is required, {count} are needed; most, "
        f"{often / TRIES:.0%}, fail first at '{worst}': widen the bounds, or ask for less."
    )


@torch.no_grad()
def check_mount(
    mount: Mount,
    requirements: Sequence[Requirement],
    camera: ChiefRayCamera,
    *,
    reach_m: float = 0.3,
) -> None:
    """Look at box, requirements and camera before anything is rendered.

    Args:
      reach_m: how far from the body a bracket may hold a camera.
    Raises: DomainError, in a sentence that says what to change, for a box that is farther from the
      robot than ``reach_m`` or has no room beside it, a start that does not keep a requirement, or
      a camera whose lens has a smaller image circle than its film (where the camera has ``check``).
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
    # meshes of many faces take their time: mostly the corners say it
    for count in (len(corners), len(draw)):
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
