"""What gradients are measured on: a camera that passes a textured plane behind a thin lens, and one
number at a time that changes the scene, the lens or the pose."""

import math
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from codesign import lens, pose, render
from scenes import textures, trajectories

SIZE_PX = 64
PITCH_MM = 0.06
DURATION_S = 0.1
SAMPLES = 4
FOCAL_MM = 8.0
SECTIONS = 24  # of a step, each with its own derivative: counts have kinks where pixels turn


@dataclass(frozen=True)
class Direction:
    """How a number s in [-1, 1] changes the case. noun: what it changes, for people."""

    name: str
    noun: str
    contrast: float = 0.0
    focus_mm: float = 0.0
    shift_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    turn_rad: tuple[float, float, float] = (0.0, 0.0, 0.0)


# a pose moves the picture by a pixel either way, depth and roll that at its border
CONTRAST = Direction("contrast", "log contrast of the scene by 40 % either way", contrast=0.4)
FOCUS = Direction(
    "focus", "image distance by 0.1 mm either way around a defocus of 0.15 mm", focus_mm=0.1
)
SHIFT_X = Direction("shift_x", "camera by 15 mm either way to its right", shift_m=(0.015, 0.0, 0.0))
SHIFT_Y = Direction("shift_y", "camera by 15 mm either way downwards", shift_m=(0.0, 0.015, 0.0))
DEPTH = Direction("depth", "camera by 60 mm either way along its axis", shift_m=(0.0, 0.0, 0.06))
TILT = Direction(
    "tilt", "camera by 7.5 mrad either way about its x axis", turn_rad=(0.0075, 0.0, 0.0)
)
PAN = Direction(
    "pan", "camera by 7.5 mrad either way about its y axis", turn_rad=(0.0, 0.0075, 0.0)
)
ROLL = Direction("roll", "camera by 30 mrad either way about its axis", turn_rad=(0.0, 0.0, 0.03))
DIRECTIONS = (CONTRAST, FOCUS, SHIFT_X, SHIFT_Y, DEPTH, TILT, PAN, ROLL)
FEW = (CONTRAST, FOCUS, SHIFT_X)  # one of each kind, for sweeps
STILL = Direction("still", "nothing")


class Case:
    """One texture and one path before a thin lens. seed: of both. size_px: of the picture, a
    multiple of 4 for ``compare.blocks``."""

    def __init__(self, seed: int, size_px: int = SIZE_PX):
        self.size_px = size_px
        self.seed = seed
        generator = torch.Generator().manual_seed(seed)
        angle = float(torch.rand((), generator=generator)) * 2 * math.pi
        self.velocity_m_s = (
            1.2 * math.cos(angle),
            0.4 * float(torch.randn((), generator=generator)),
            1.2 * math.sin(angle),
        )
        self._along: dict[tuple[float, str, int], Tensor] = {}

    @cached_property
    def plane(self) -> render.TexturedPlane:
        """The texture; periods of 7 px and more: what a lens slightly out of focus still shows."""
        stand = torch.eye(4, dtype=torch.float64)
        stand[:3, :3] = torch.tensor([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]], dtype=torch.float64)
        return render.TexturedPlane(
            *textures.waves(
                self.seed, 12, finest_period_m=0.08, coarsest_period_m=0.5, log_contrast=1.2
            ),
            T_world_plane=stand,
            dtype=torch.float64,
        )

    @torch.no_grad()
    def frames(self, rate_hz: float, direction: Direction = STILL, s: float = 0.0) -> Tensor:
        """[T, H, W] frames at a place s of a direction, 0-255 scale, float64."""
        start = pose.look_at((0.0, -2.0, 0.0), (0.0, 0.0, 0.0))
        twist = torch.tensor([*direction.shift_m, *direction.turn_rad], dtype=torch.float64) * s
        path = trajectories.translation(
            start @ pose.se3_exp(twist), self.velocity_m_s, times(rate_hz)
        )
        # 0.15 mm behind where 2 m is sharp: a blur of one pixel at f/2.5
        image_mm = 1 / (1 / FOCAL_MM - 1 / 2000.0) + 0.15 + direction.focus_mm * s
        optics = lens.ThinLens(
            torch.tensor(image_mm, dtype=torch.float64), FOCAL_MM, FOCAL_MM / 2.5
        )
        pitch_mm = PITCH_MM * SIZE_PX / self.size_px
        frames = render.frames(
            render.Camera(optics, self.size_px, self.size_px, pitch_mm, SAMPLES), self.plane, path
        )
        if not direction.contrast:
            return frames
        level = frames.log()
        return (level.mean() + (1 + direction.contrast * s) * (level - level.mean())).exp()

    def along(self, rate_hz: float, direction: Direction, sections: int = SECTIONS) -> Tensor:
        """[sections + 1, T, H, W] frames at the ends of the sections of a step, float32; rendered
        once."""
        key = (rate_hz, direction.name, sections)
        if key not in self._along:
            places = (2 * k / sections - 1 for k in range(sections + 1))
            self._along[key] = torch.stack(
                [self.frames(rate_hz, direction, s).float() for s in places]
            )
        return self._along[key]


def times(rate_hz: float) -> Tensor:
    """[T] times of the frames, seconds, from 0 to DURATION_S."""
    count = round(DURATION_S * rate_hz)
    return torch.arange(count + 1, dtype=torch.float64) * (DURATION_S / count)
