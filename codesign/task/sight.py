"""What cameras are blind to: a table over attitudes, and a map over all directions a camera may look in."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from codesign import place
from codesign.errors import DomainError, ShapeError, check_whole
from codesign.flow.checks import check_number
from codesign.place.criterion import LINEAR, NAMES
from codesign.place.mount import attitude
from codesign.task.depth import ground_depth
from codesign.types import ChiefRayCamera

ATTITUDES = {  # yaw and pitch, degrees
    "forward": (0.0, 0.0),
    "oblique": (0.0, 45.0),
    "downward": (0.0, 90.0),
    "sideways": (90.0, 0.0),
    "sideways oblique": (90.0, 45.0),
}
UNIT = (0.1, 0.1, 0.1, 0.1, 0.1, 0.1)  # m/s and rad/s that count 1
PRIOR = (1.0, 1.0, 1.0, 1.0, 1.0, 1.0)
VELOCITIES = tuple(f"{name}_{'m_s' if axis < LINEAR else 'rad_s'}" for axis, name in enumerate(NAMES))
MOST_PIXELS = 1024  # of a film, spread over it, that are looked at
Depth = Callable[[ChiefRayCamera, Tensor, Tensor, Any], Tensor]


@dataclass(frozen=True)
class Surroundings:
    """Where and by what flow a body's velocity is read.

    position_m: of the camera on the body. T_world_body: [4, 4], None: at the world's origin. depth: as of EgoVelocity,
    ``task.ground_depth`` or ``task.scene_depth``; scene: handed to it. axes: the velocities that the body has.
    deviation_px_s: of the flow of one point; points: independent ones in the picture (a window read by an affine flow
    counts as three). farthest_m: what lies farther counts as unseen: a pixel covers whole patterns there.
    """

    position_m: tuple[float, float, float]
    T_world_body: Tensor | None = None
    depth: Depth = ground_depth
    scene: Any = None
    axes: Sequence[int] = place.FREE
    deviation_px_s: float = 5.0
    points: float = 27.0
    farthest_m: float = 30.0

    def __post_init__(self):
        for name in ("deviation_px_s", "points", "farthest_m"):
            check_number(getattr(self, name), name, above=0.0)

    def information(self, camera: ChiefRayCamera, T_body_cam: Tensor) -> tuple[Tensor, Tensor]:
        """Information [..., K, K] without prior of mounts [..., 4, 4], and the share [...] of the picture that sees
        something. Gradient: mount and lens."""
        pixels = camera.film.pixels()
        count = min(MOST_PIXELS, len(pixels))
        pixels = pixels[torch.linspace(0, len(pixels) - 1, count).round().long()]
        pose = T_body_cam.double().reshape(-1, 4, 4)
        world = pose if self.T_world_body is None else self.T_world_body.to(pose) @ pose
        each = pixels.expand(len(pose), *pixels.shape)
        depth = self.depth(camera, each, world, self.scene)
        depth = torch.where(depth.detach() <= self.farthest_m, depth, torch.inf)
        rows, seen = place.body_flow(camera, depth, pose, each)
        rows = rows[..., list(self.axes)]
        weight = self.points / count / self.deviation_px_s**2
        found = weight * torch.einsum("npck,npcl->nkl", rows, rows)
        batch = T_body_cam.shape[:-2]
        return found.reshape(*batch, *found.shape[1:]), seen.double().mean(-1).reshape(batch)

    def mount(self, yaw_rad: float, pitch_rad: float) -> Tensor:
        """T_body_cam [4, 4] of a camera without roll in that direction."""
        pose = torch.eye(4, dtype=torch.float64)
        pose[:3, :3] = attitude(yaw_rad, pitch_rad, 0.0)
        pose[:3, 3] = torch.tensor(self.position_m, dtype=torch.float64)
        return pose


def sight_units(around: Surroundings) -> list[float]:
    """[K] errors that count 1 by default: 0.1 m/s and 0.1 rad/s."""
    return [UNIT[axis] for axis in around.axes]


@torch.no_grad()
def sight_table(
    camera: ChiefRayCamera,
    around: Surroundings,
    attitudes: Mapping[str, tuple[float, float]] = ATTITUDES,
    unit: Sequence[float] | None = None,
) -> dict[str, dict[str, Any]]:
    """What forward, downward, sideways and oblique cameras see of the body's motion, and what they are blind to.

    Args: attitudes: name -> yaw and pitch in degrees. unit: [K] errors that count 1; 0.1 m/s and 0.1 rad/s when None.
    Returns: name -> "seen" (share of the picture), "sight" (place.Sight), a column for each velocity (standard deviation
      in m/s or rad/s, all unknown), "blind" (names of velocities worse than one unit), "weakest" (the motion that
      shows least, in words) and "weakest_units" (its deviation). No gradient.

    >>> from codesign import lens, render, task
    >>> camera = render.Camera(lens.Pinhole(3.4), 32, 24, 0.148)
    >>> table = sight_table(camera, task.Surroundings((0.2, 0.0, 0.4), axes=(0, 1, 5)))
    >>> table["downward"]["blind"], table["forward"]["blind"]
    ([], ['forward', 'left'])
    """
    unit = sight_units(around) if unit is None else unit
    table = {}
    for name, (yaw_deg, pitch_deg) in attitudes.items():
        pose = around.mount(math.radians(yaw_deg), math.radians(pitch_deg))
        information, seen = around.information(camera, pose)
        found = place.sight(information, unit, around.axes)
        table[name] = {"seen": float(seen), "sight": found}
        for axis, deviation in zip(around.axes, found.deviation.tolist(), strict=True):
            table[name][VELOCITIES[axis]] = deviation
        table[name] |= {
            "blind": found.blind(),
            "weakest": found.weakest_named(),
            "weakest_units": found.weakest_deviation,
        }
    return table


@torch.no_grad()
def sight_map(
    camera: ChiefRayCamera,
    around: Surroundings,
    rows: int = 19,
    columns: int = 36,
    unit: Sequence[float] | None = None,
    prior: Sequence[float] | None = None,
) -> tuple[Tensor, Tensor, Tensor]:
    """Expected error over all directions that a camera at one place may look in.

    Args: rows: from straight up to straight down; columns: all around, both at least 2. unit, prior: [K] as of
      ``place.expected_error``; 0.1 and 1 when None.
    Returns: yaw [columns], pitch [rows] rad at the middle of the cells, and the error [rows, columns] in units. For
      ``report.mount_sphere``. No gradient.
    """
    if check_whole(rows, "rows") < 2 or check_whole(columns, "columns") < 2:
        raise DomainError(f"sight_map: {rows} rows and {columns} columns; at least 2 of each are needed.")
    unit = sight_units(around) if unit is None else unit
    prior = [PRIOR[axis] for axis in around.axes] if prior is None else prior
    if not len(unit) == len(prior) == len(around.axes):
        raise ShapeError(f"sight_map: unit and prior need {len(around.axes)} numbers each, one per velocity.")
    yaw = (torch.arange(columns, dtype=torch.float64) + 0.5) / columns * 2 * math.pi - math.pi
    pitch = (torch.arange(rows, dtype=torch.float64) + 0.5) / rows * math.pi - math.pi / 2
    found = []
    for tilt in pitch.tolist():
        poses = torch.stack([around.mount(turn, tilt) for turn in yaw.tolist()])
        found.append(place.expected_error(around.information(camera, poses)[0], unit, prior))
    return yaw, pitch, torch.stack(found)
