"""What a robot's camera sees at a setting of its design: numbers in, pictures and geometry out."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from codesign import events, pose, render
from codesign.checks import check_whole
from codesign.errors import DomainError
from codesign.report.flow_colours import flow_colours
from codesign.system import System
from codesign.system.run import Pass
from codesign.types import Rays
from scenes.robots import pair as robot_pair
from scenes.robots.pair import Drives
from studies.codesign.design import BLOCKS, Space, Whole
from studies.placement.figures import fastest, tiled
from studies.placement.problem import Problem

# what a slider moves, and what it is called
SLIDERS = {
    "x_m": "forward, m",
    "z_m": "height, m",
    "pitch_rad": "pitch down, rad",
    "focus_per_m": "focus, 1/m",
    "fno": "f-number",
    "theta": "threshold, log",
}
SIDE = 3  # windows across the film
LEAST_FRAMES = 3  # one lies before the window
QUANTILE = 0.98  # of brightness, counts and lengths, that has full colour
NEAR_M = 0.6  # above the robot, from where the world is scanned
ROWS, COLUMNS = 240, 480  # of that scan
JUMP = 1.3  # ratio of distances beyond which neighbours in it are of two surfaces
FAR_M = 3.0  # where rays end that meet nothing
RAYS_ACROSS = 3  # points of the film whose rays are drawn


@dataclass(frozen=True)
class Drive:
    """A short drive of a robot, and the film on which its camera sees it.

    space: of the designs. batch: one world, one drive. film: nine windows that tile a sensor as
      high as the pair's, in fewer and larger pixels. rays_per_px: through the lens.
    """

    space: Space
    batch: Drives
    film: render.Film
    rays_per_px: int = 4

    @staticmethod
    def of(
        space: Space, size_px: int = 96, frames: int = 5, seed: int = 0, rays_per_px: int = 4
    ) -> "Drive":
        """The fastest of the first drives in the pair's first world.

        Args: size_px: of the square film, a multiple of three. frames: rendered of the drive, 3
          to 9, evenly. seed: of film samples and noise.
        Raises: DomainError for others.
        """
        rays_per_px = check_whole(rays_per_px, "rays", 1, 64)
        size_px = check_whole(size_px, "size", 24, 384)
        frames = check_whole(frames, "frames", LEAST_FRAMES, robot_pair.FRAMES)
        if size_px % SIDE:
            raise DomainError(f"size is {size_px}; give a multiple of {SIDE}, such as 96.")
        problem = Problem(space.pair, (0,), 1, 1)
        drives = problem.scenes(fastest(problem, seed))
        inside = np.linspace(1, robot_pair.FRAMES - 1, frames - 1).round().astype(int)
        picked = [0, *inside.tolist()]
        batch = replace(
            drives,
            T_world_body=drives.T_world_body[..., picked, :, :],
            t_s=drives.t_s[picked],
            scene=(drives.scene[0].during(picked),),
        )
        edges = range(0, size_px, size_px // SIDE)
        windows = tuple((left, top) for top in edges for left in edges)
        pitch_mm = robot_pair.SENSOR_PX[1] * robot_pair.PITCH_MM / size_px
        one = size_px // SIDE
        film = render.Film(size_px, size_px, one, one, pitch_mm, windows)
        return Drive(space, batch, film, rays_per_px)

    def camera(self, whole: Whole) -> render.Camera:
        return whole.camera.with_film(self.film).with_samples(self.rays_per_px)

    @cached_property
    def system(self) -> System:
        return self.space.pair.system(self.space.pair.design)

    @property
    def names(self) -> list[str]:
        return [name for name in SLIDERS if name in self.space.free]

    @property
    def middle(self) -> int:
        return len(self.batch.t_s) // 2

    @property
    def T_world_body(self) -> Tensor:
        """[4, 4] of the robot in the frame that is shown."""
        return self.batch.T_world_body[0, 0, self.middle]

    @torch.no_grad()
    def world(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The world as seen from over the robot: vertices [V, 3] m, faces [F, 3], grey levels [V]
        uint8."""
        down, around = torch.meshgrid(
            torch.linspace(0.01, torch.pi - 0.01, ROWS, dtype=torch.float64),
            torch.linspace(0, 2 * torch.pi, COLUMNS, dtype=torch.float64),
            indexing="ij",
        )
        ring = down.sin()
        towards = torch.stack([ring * around.cos(), ring * around.sin(), down.cos()], -1)
        towards = towards.reshape(-1, 3)
        eye = torch.eye(4, dtype=torch.float64)
        eye[:3, 3] = self.T_world_body[:3, 3] + torch.tensor([0, 0, NEAR_M])
        origin = torch.zeros_like(towards)
        world = self.batch.scene[0].static
        light = render.shade(Rays(origin, towards, torch.ones(len(towards))), world, eye[None], 1)
        points, _, met = world.hit(origin + eye[:3, 3], towards)
        away = torch.where(met, (points - eye[:3, 3]).norm(dim=1), torch.inf).numpy()
        at = np.arange(ROWS * COLUMNS).reshape(ROWS, COLUMNS)
        a, b, c, d = (each.ravel() for each in (at[:-1, :-1], at[:-1, 1:], at[1:, 1:], at[1:, :-1]))
        corners = np.stack([a, b, c, d])
        whole = away[corners].max(0) < JUMP * away[corners].min(0)
        faces = np.concatenate([np.stack([a, b, c], 1)[whole], np.stack([a, c, d], 1)[whole]])
        used, renumbered = np.unique(faces, return_inverse=True)
        return points.numpy()[used], renumbered.reshape(-1, 3), _grey(light[0].numpy())[used]


@dataclass(frozen=True)
class Setting:
    """One design before a drive; each of its pictures is computed when it is first asked for.

    run: the pass through the chain, with what is kept of another setting.
    """

    drive: Drive
    whole: Whole
    run: Pass

    @staticmethod
    def of(drive: Drive, whole: Whole, **kept: Tensor) -> "Setting":
        """A design, and what its pass keeps (``System.begin``)."""
        T_body_cam = whole.T_body_cam
        system = drive.system.replaced(
            camera=drive.camera(whole),
            mount=lambda: T_body_cam,
            events=whole.events("memory"),
            flow=whole.flow,
        )
        return Setting(drive, whole, system.begin(drive.batch, kept))

    @torch.no_grad()
    def at(self, **numbers: float) -> "Setting":
        """The setting with other numbers: itself where none changes, with the same frames where
        only sensor and estimator do."""
        changed = {name: n for name, n in numbers.items() if n != self.whole.numbers[name]}
        if not changed:
            return self
        read_out = set(changed) <= {*BLOCKS["sensor"], *BLOCKS["network"]}
        kept = {"frames": self.run["frames"]} if read_out else {}
        return Setting.of(self.drive, self.whole.with_numbers(**changed), **kept)

    @torch.no_grad()
    def frame(self) -> np.ndarray:
        """[H, W] uint8, the middle one, with the gamma of a screen."""
        return _grey(tiled(self.run["frames"][0, 0, self.drive.middle].numpy()))

    @torch.no_grad()
    def events(self) -> np.ndarray:
        """[H, W, 3] uint8 of the window: ON red, OFF blue."""
        counts = self.run["volume"].counts.sum(2)
        full = float(torch.quantile(counts.amax(1), QUANTILE).clamp_min(1))
        return tiled(events.picture(counts, full).numpy())

    @torch.no_grad()
    def flow(self) -> np.ndarray:
        """[H, W, 3] uint8: hue where to, saturation how far."""
        flow_px = tiled(self.run["field"].flow_px.movedim(1, -1).numpy()).transpose(2, 0, 1)
        full = max(float(np.quantile(np.hypot(*flow_px), QUANTILE)), 1e-9)
        return (255 * flow_colours(flow_px, full)).astype(np.uint8)

    @torch.no_grad()
    def rays(self) -> np.ndarray:
        """[L, 2, 3] metres in camera axes: through the middle and the edge of the lens's pupil, from
        there to what they meet."""
        across = torch.linspace(0, self.drive.film.sensor_width_px - 1, RAYS_ACROSS).double()
        film_px = torch.cartesian_prod(across, across)
        pupil = torch.tensor([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]], dtype=torch.float64)
        count = len(film_px)
        found = self.run["camera"].rays_through(
            film_px.repeat_interleave(len(pupil), 0), pupil.repeat(count, 1)
        )
        T_world_cam = self.drive.T_world_body @ self.whole.T_body_cam
        origin = pose.apply(T_world_cam, found.origin_m.double())
        towards = found.direction.double() @ T_world_cam[:3, :3].T
        points, _, met = self.drive.batch.scene[0].static.hit(origin, towards)
        away = torch.where(met, (points - origin).norm(dim=1), FAR_M)
        lines = torch.stack([found.origin_m, found.origin_m + away[:, None] * found.direction], 1)
        return lines[found.weight > 0].numpy()

    @torch.no_grad()
    def view_rad(self) -> float:
        """Angle that the film spans from top to bottom."""
        middle = self.drive.film.middle_px
        ends = torch.stack([middle, middle])
        ends[:, 1] += self.drive.film.sensor_height_px / 2 * torch.tensor([-1.0, 1.0])
        first, last = self.run["camera"].chief_rays(ends).direction
        return float((first @ last).clamp(-1, 1).arccos())

    @torch.no_grad()
    def words(self) -> str:
        """Events, speed as estimated and as it is, and the bounded error of the velocity."""
        found, true = self.run["estimate"], self.drive.batch.twist
        error = float(self.drive.space.pair.errors(found, self.drive.batch).bounded())
        return (
            f"{self.run['volume'].counts.sum():,.0f} events; forward {found.velocity[0, 0]:.2f} m/s, "
            f"in truth {true[0, 0]:.2f}; error of the velocity {error:.3f} (0 none, 1 all)"
        )


def _grey(light):
    full = max(float(np.quantile(light, QUANTILE)), 1e-9)
    return (255 * np.clip(light / full, 0, 1) ** (1 / 2.2)).astype(np.uint8)
