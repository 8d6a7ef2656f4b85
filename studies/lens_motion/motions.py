"""Drives of a camera that looks along its motion, the flow directions they make in every window,
and cases drawn from them: a textured wall across the axis, a place before it, a motion.

A drive is a constant twist in camera axes over the interval (x right, y down, z forward). Speeds
are set so that the flow in a window at HEIGHT_PX is about SPEED_PX, whatever the focal length.
"""

import math
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import torch
from torch import Tensor

from codesign import pose, render
from codesign.errors import DomainError
from codesign.system import Batch
from scenes import trajectories
from scenes.tum import Recorded
from studies.lens_opt.task import (
    DISTANCE_M,
    DURATION_S,
    MOTION,
    PITCH_MM,
    SENSOR_PX,
    drawn_place,
)

SPEED_PX = 2.0  # over the interval
STILL_PX = 0.1  # median flow of a file of poses, below which there is nothing to see
SPREAD = 0.4  # standard deviation of the logarithm of the speed
STRAY = 0.1  # of the other components, relative to the speed
WIDE_PX, TALL_PX = 32, 64  # of a window: within it the focus of an uncorrected lens hardly changes
HEIGHT_PX = 157.0  # of the windows off axis
FRAMES = 13
NAMES = ("any", "forward", "turn", "hover")
# centres from the axis in pixels: both sides of the film, or the axis where no direction is
# preferred
SIDES = ((157, 0), (-157, 0))
WINDOWS = {"hover": ((0, 0),)}
# in a window, where a lens is looked at
OFFSETS_PX = tuple((x, y) for x in (-10, 0, 10) for y in (-20, 20))


@dataclass(frozen=True)
class Motion:
    """Statistics of drives: one of NAMES, or a file of camera poses in TUM format.

    efl_mm: focal length, by which turns are scaled. turned: the same with every flow vector turned
      by 90 degrees (forward becomes a roll about the axis, a turn sideways one up and down); of the
      directed motions only.
    """

    name: str
    efl_mm: float
    turned: bool = False

    def __post_init__(self) -> None:
        if self.name not in NAMES and not Path(self.name).is_file():
            raise DomainError(
                f"--motion {self.name} is neither a file of poses nor one of {', '.join(NAMES)}; give one of them."
            )
        if self.turned and not self.directed:
            raise DomainError(
                f"--motion {self.name} has no direction of its own that could be turned."
            )

    @property
    def directed(self) -> bool:
        return self.name in ("forward", "turn")

    @property
    def windows_px(self) -> tuple[tuple[int, int], ...]:
        """Centres of the windows, x right and y down from the axis."""
        return WINDOWS.get(self.name, SIDES)

    def points_px(self) -> Tensor:
        """Where a lens is looked at: OFFSETS_PX in every window, [P, 2] from the axis."""
        offsets = torch.tensor(OFFSETS_PX, dtype=torch.float64)
        return (torch.tensor(self.windows_px, dtype=torch.float64)[:, None] + offsets).reshape(
            -1, 2
        )

    def film(self) -> render.Film:
        corners = tuple(
            (round((SENSOR_PX[0] - WIDE_PX) / 2 + x), round((SENSOR_PX[1] - TALL_PX) / 2 + y))
            for x, y in self.windows_px
        )
        return render.Film(*SENSOR_PX, WIDE_PX, TALL_PX, PITCH_MM, corners)

    @cached_property
    def _recorded(self):
        return Recorded.read(self.name)

    def twist(self, generator: torch.Generator) -> Tensor:
        """One drive: m and rad over the interval in camera axes, [6] float64."""
        draw = torch.randn(8, generator=generator, dtype=torch.float64)
        if self.name == "any":
            return MOTION * draw[:6]
        speed_px = SPEED_PX * float((SPREAD * draw[6]).exp()) * math.copysign(1.0, float(draw[7]))
        turn_rad = speed_px * PITCH_MM / self.efl_mm
        slide_m = turn_rad * DISTANCE_M
        twist = torch.zeros(6, dtype=torch.float64)
        if self.name == "hover":
            twist[:2] = SPEED_PX / speed_px * slide_m * draw[:2] / math.sqrt(2)
        elif self.name == "forward":
            twist[:2] = STRAY * slide_m * draw[:2]
            twist[5 if self.turned else 2] = (
                (1.0 if self.turned else DISTANCE_M) * speed_px / HEIGHT_PX
            )
        elif self.name == "turn":
            along, across = (3, 4) if self.turned else (4, 3)
            twist[along], twist[across] = turn_rad, STRAY * turn_rad * float(draw[0])
        else:
            times = self._recorded.t_s
            at = times[0] + (times[-1] - times[0]) * torch.rand(
                1, generator=generator, dtype=torch.float64
            )
            twist = self._recorded.velocity(at)[0] * DURATION_S
        return twist

    def case(self, pool: list, seed: int) -> Batch:
        """A world out of ``pool``, a place before it and a drive, all from one seed."""
        generator = torch.Generator().manual_seed(seed)
        world = pool[drawn_world(len(pool), generator)]
        start = drawn_place(generator)
        t_s = torch.linspace(0, DURATION_S, FRAMES, dtype=torch.float64)
        drive = trajectories.body_twist(start, self.twist(generator) / DURATION_S, t_s)
        return Batch(drive, t_s, world, seed)

    def directions_rad(self, draws: int = 32, at_px: Tensor | None = None) -> Tensor:
        """Directions of flow of that many drives as angles from the radius, at ``points_px`` or
        other places [P, 2] from the axis: [P, draws]."""
        generator = torch.Generator().manual_seed(0)
        twists = torch.stack([self.twist(generator) for _ in range(draws)])
        at = self.points_px() if at_px is None else at_px
        moved = flow_px(at, twists, self.efl_mm)
        if moved.norm(dim=-1).median() < STILL_PX:
            raise DomainError(
                f"--motion {self.name} moves the picture by less than {STILL_PX} px over {DURATION_S:g} s; give poses "
                "in metres that move, with times in seconds."
            )
        radius = torch.atan2(at[:, 1], at[:, 0])
        return torch.atan2(moved[..., 1], moved[..., 0]) - radius[:, None]


def drawn_world(count: int, generator: torch.Generator) -> int:
    """Number of a case's world, the first thing that is drawn of it."""
    return int(torch.randint(count, (1,), generator=generator))


def flow_px(at_px: Tensor, twists: Tensor, efl_mm: float) -> Tensor:
    """Flow of a wall across the axis in a camera without distortion.

    Args:
      at_px: [W, 2] from the axis.
      twists: [N, 6] m and rad over the interval, in camera axes.
    Returns: [W, N, 2] px.
    """
    slope = torch.cat([at_px * (PITCH_MM / efl_mm), torch.ones_like(at_px[:, :1])], 1)
    later = pose.inverse(pose.se3_exp(twists))
    points = DISTANCE_M * slope @ later[:, :3, :3].mT + later[:, None, :3, 3]
    moved = points[..., :2] / points[..., 2:] - slope[:, :2]
    return moved.movedim(0, 1) * (efl_mm / PITCH_MM)
