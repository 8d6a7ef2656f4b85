"""What cameras are blind to: a table over attitudes, and a map over all directions a camera may
look in."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from codesign.checks import check_positive, check_whole
from codesign.errors import DomainError, ShapeError
from codesign.mount.depth import ground_depth
from codesign.mount.observability import FREE, body_flow
from codesign.mount.pose import attitude
from codesign.render.film import some_pixels
from codesign.types import ChiefRayCamera

NAMES = ("forward", "left", "up", "roll", "pitch", "yaw")
LINEAR = 3  # of the six, m/s; the others rad/s
# share of the largest eigenvalue below which a motion leaves all flow as it is, in float64
NOTHING = 1e-12


def expected_error(
    information: Tensor, unit: Sequence[float] | Tensor, prior: Sequence[float] | Tensor
) -> Tensor:
    """Root mean square error of K velocities, in units of ``unit``, that the best unbiased use of
    the flow leaves.

    Args:
      information: [..., K, K] as of ``Surroundings.information``, or of an estimator: the inverse
        of ``mount.Motion.covariance`` less the prior's.
      unit: [K] errors that count 1.
      prior: [K] standard deviations of the velocities around zero, by which what no flow shows
        counts.
    Returns: [...]. Gradient: information.
    Raises: ShapeError; DomainError for units or priors that are not positive.
    Source: Cramer-Rao bound with a prior (Van Trees, 1968).

    >>> round(float(expected_error(torch.diag(torch.tensor([3.0, 0.0])), (1.0, 1.0), (1.0, 2.0))), 3)  # 1/4 and 4
    1.458
    """
    unit = _scales(unit, information, "unit")
    deviation = _scales(prior, information, "prior")
    covariance = torch.linalg.inv(information.double() + torch.diag(deviation**-2))
    return (covariance.diagonal(dim1=-2, dim2=-1) / unit**2).mean(-1).sqrt()


@dataclass(frozen=True)
class Sight:
    """What flow tells of K velocities.

    axes: which of the six. deviation: [K] standard deviation of each where none is known, m/s and
    rad/s, infinite for what leaves no trace in the flow; alone: [K] where all others are known.
    weakest: [K] motion that shows least, of length 1 in units of ``unit``; weakest_deviation: its
    standard deviation in these units. unit: [K].
    """

    axes: tuple[int, ...]
    deviation: Tensor
    alone: Tensor
    weakest: Tensor
    weakest_deviation: float
    unit: Tensor

    def blind(self, limit: float = 1.0) -> list[str]:
        """Names of the velocities whose deviation is above ``limit`` units."""
        return [
            NAMES[axis]
            for axis, over in zip(self.axes, self.deviation / self.unit > limit, strict=True)
            if over
        ]

    def weakest_named(self, least: float = 0.2) -> str:
        """The weakest motion in words and shares of its units, such as "+0.71 left -0.70 roll";
        parts below ``least`` are left out."""
        parts = [
            f"{share:+.2f} {NAMES[axis]}"
            for axis, share in zip(self.axes, self.weakest.tolist(), strict=True)
            if abs(share) >= least
        ]
        return " ".join(parts)


@torch.no_grad()
def sight(information: Tensor, unit: Sequence[float] | Tensor, axes: Sequence[int] = FREE) -> Sight:
    """What a mount sees and what it is blind to.

    Args:
      information: [K, K] without prior.
      unit: [K] by which metres and radians per second are compared.
      axes: which of the six velocities the K are.
    Returns: Sight; no gradient.
    Raises: ShapeError; DomainError.

    >>> sight(torch.diag(torch.tensor([100.0, 4.0, 0.0])), (0.1, 0.1, 0.1), (0, 1, 5)).blind()
    ['left', 'yaw']
    """
    scale = _scales(unit, information, "unit")
    if information.shape != (len(scale), len(scale)) or len(axes) != len(scale):
        raise ShapeError(
            f"sight: one information [K, K] and K axes are needed, got {tuple(information.shape)}."
        )
    scaled = scale[:, None] * information.double() * scale
    values, vectors = torch.linalg.eigh(scaled)
    dark = values <= NOTHING * values[-1].clamp_min(0)
    shares = vectors.square()
    spread = torch.where(dark, 0.0, 1 / torch.where(dark, 1.0, values))
    lost = (shares * dark).sum(1) > 1e-9
    deviation = torch.where(lost, torch.inf, (shares * spread).sum(1).sqrt())
    weakest = vectors[:, 0] * torch.sign(vectors[vectors[:, 0].abs().argmax(), 0])
    return Sight(
        tuple(axes),
        deviation * scale,
        scaled.diagonal().clamp_min(0).rsqrt() * scale,
        weakest,
        torch.inf if bool(dark[0]) else float(values[0].rsqrt()),
        scale,
    )


def _scales(values, information, name):
    given = torch.as_tensor(values, dtype=torch.float64, device=information.device)
    if information.shape[-2:] != (len(given), len(given)):
        raise ShapeError(
            f"{name} has {len(given)} numbers for an information {tuple(information.shape)}; give one per velocity."
        )
    if not bool(((given > 0) & given.isfinite()).all()):
        raise DomainError(
            f"{name} is {given.tolist()}; finite numbers > 0 are needed (m/s, rad/s)."
        )
    return given


# yaw and pitch, degrees
ATTITUDES = {
    "forward": (0.0, 0.0),
    "oblique": (0.0, 45.0),
    "downward": (0.0, 90.0),
    "sideways": (90.0, 0.0),
    "sideways oblique": (90.0, 45.0),
}
UNIT = 0.1  # m/s and rad/s that count 1
PRIOR = 1.0
VELOCITIES = tuple(
    f"{name}_{'m_s' if axis < LINEAR else 'rad_s'}" for axis, name in enumerate(NAMES)
)
MOST_PIXELS = 1024  # of a film, spread over it, that are looked at
Depth = Callable[[ChiefRayCamera, Tensor, Tensor, Any], Tensor]


@dataclass(frozen=True)
class Surroundings:
    """Where and by what flow a body's velocity is read.

    position_m: of the camera on the body. T_world_body: [4, 4], None: at the world's origin. depth:
    as of EgoVelocity, ``mount.ground_depth`` or ``mount.scene_depth``; scene: handed to it. axes:
    the velocities that the body has.
    deviation_px_s: of the flow of one point; points: independent ones in the picture (a window read
    by an affine flow counts as three). farthest_m: what lies farther counts as unseen: a pixel
    covers whole patterns there.
    """

    position_m: tuple[float, float, float]
    T_world_body: Tensor | None = None
    depth: Depth = ground_depth
    scene: Any = None
    axes: Sequence[int] = FREE
    deviation_px_s: float = 5.0
    points: float = 27.0
    farthest_m: float = 30.0

    def __post_init__(self):
        for name in ("deviation_px_s", "points", "farthest_m"):
            check_positive(getattr(self, name), name)

    def information(self, camera: ChiefRayCamera, T_body_cam: Tensor) -> tuple[Tensor, Tensor]:
        """Information [..., K, K] without prior of mounts [..., 4, 4], and the share [...] of the
        picture that sees something. Gradient: mount and lens."""
        pixels = camera.film.pixels()[some_pixels(camera.film, MOST_PIXELS)]
        count = len(pixels)
        pose = T_body_cam.double().reshape(-1, 4, 4)
        world = pose if self.T_world_body is None else self.T_world_body.to(pose) @ pose
        each = pixels.expand(len(pose), *pixels.shape)
        depth = self.depth(camera, each, world, self.scene)
        lit = camera.chief_rays(pixels).weight > 0
        depth = torch.where(lit & (depth.detach() <= self.farthest_m), depth, torch.inf)
        rows, seen = body_flow(camera, depth, pose, each)
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
    """[K] errors that count 1: 0.1 m/s and 0.1 rad/s."""
    return [UNIT] * len(around.axes)


@torch.no_grad()
def sight_table(
    camera: ChiefRayCamera,
    around: Surroundings,
    attitudes: Mapping[str, tuple[float, float]] = ATTITUDES,
) -> dict[str, dict[str, Any]]:
    """What forward, downward, sideways and oblique cameras see of the body's motion, and what they
    are blind to.

    Args:
      attitudes: name -> yaw and pitch in degrees.
    Returns: name -> "seen" (share of the picture), "sight" (mount.Sight), a column for each
      velocity (standard deviation in m/s or rad/s, all unknown), "blind" (names of velocities worse
      than one unit), "weakest" (the motion that shows least, in words) and "weakest_units"
      (its deviation). No gradient.

    >>> from codesign import lens, render
    >>> from codesign.mount import Surroundings
    >>> camera = render.Camera(lens.Pinhole(3.4), 32, 24, 0.148)
    >>> table = sight_table(camera, Surroundings((0.2, 0.0, 0.4), axes=(0, 1, 5)))
    >>> table["downward"]["blind"], table["forward"]["blind"]
    ([], ['forward', 'left'])
    """
    table = {}
    for name, (yaw_deg, pitch_deg) in attitudes.items():
        pose = around.mount(math.radians(yaw_deg), math.radians(pitch_deg))
        information, seen = around.information(camera, pose)
        found = sight(information, sight_units(around), around.axes)
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
) -> tuple[Tensor, Tensor, Tensor]:
    """Expected error over all directions that a camera at one place may look in.

    Args:
      rows: from straight up to straight down;
      columns: all around, both at least 2.
    Returns: yaw [columns], pitch [rows] rad at the middle of the cells, and the error
      [rows, columns] in units. For ``report.mount_sphere``. No gradient.
    """
    check_whole(rows, "rows", 2)
    check_whole(columns, "columns", 2)
    yaw = (torch.arange(columns, dtype=torch.float64) + 0.5) / columns * 2 * math.pi - math.pi
    pitch = (torch.arange(rows, dtype=torch.float64) + 0.5) / rows * math.pi - math.pi / 2
    found = []
    for tilt in pitch.tolist():
        poses = torch.stack([around.mount(turn, tilt) for turn in yaw.tolist()])
        information, _ = around.information(camera, poses)
        found.append(expected_error(information, sight_units(around), [PRIOR] * len(around.axes)))
    return yaw, pitch, torch.stack(found)
