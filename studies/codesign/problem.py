"""What a search for a whole design looks at: drives of a robot through worlds, rendered for one
design; the errors of its velocities, hard ones and those to be expected."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from codesign.mount import (
    EgoVelocity,
    FlowErrors,
    Readings,
    Requirement,
    expected_errors,
    velocity_errors,
)
from codesign.pose import se3_exp
from codesign.system import System
from scenes.robots import pair as robot_pair
from scenes.robots.pair import Drives
from studies.codesign.calibration import Calibration, Conditions
from studies.codesign.design import Space, Whole
from studies.codesign.rig import Rig
from studies.placement.problem import Problem, Samples

BLURS_PX = (0.1, 2.0)  # root mean square radius, that recorded frames are blurred by
BLUR_TAPS = (13, 13)
DRAWS = 64  # of an error that is to be expected
EVERY_PX = 2  # of the pixels that tell what the robot covers


@dataclass(frozen=True)
class Seen:
    """Drives as one design sees them.

    twist: [N, 6] of the bodies. seen_twist: [N, 6] of what the camera moves with, the sway of its
      mast in it.
    read: by the depth that the estimator believes in. surfaces: the same with true depths.
      true_rows: [N, P, 2, 6]. flow_px: [N, P, 2], true. covered: [N, windows] by the robot.
    """

    twist: Tensor
    seen_twist: Tensor
    read: Readings
    surfaces: Readings
    true_rows: Tensor
    flow_px: Tensor
    covered: Tensor


class Drawn:
    """Worlds and drives by number, for any whole design of a space.

    numbers: of the worlds. spread: worlds of a draw, per_world: drives in each.
    """

    def __init__(
        self,
        space: Space,
        numbers: Sequence[int],
        spread: int = 12,
        per_world: int = 1,
        calibration: Calibration | None = None,
    ) -> None:
        self.space = space
        self.calibration = calibration or Calibration()
        self.base = Problem(space.pair, numbers, spread, per_world)
        self.rendered = 0

    def draw(self, number: int) -> Samples:
        """Samples of that number (``Problem.draw``)."""
        return self.base.draw(number)

    @cached_property
    def _system(self):
        return self.space.pair.system(self.space.pair.design)

    @property
    def estimate(self) -> EgoVelocity:
        """Velocities by least squares, as the pair has them."""
        return self._system.estimate

    @cached_property
    def requirements(self) -> list[Requirement]:
        """Of the mount."""
        return self.base.requirements

    def scenes(self, mounts: Tensor, samples: Samples) -> tuple[Drives, Tensor]:
        """Drives behind mounts [M, 4, 4], those of a world one mount after the other, and the
        twists [N, 6] that the camera moves with; a mast sways."""
        count, each = len(mounts), len(samples.which)
        plain = self.base.scenes(replace(samples, which=samples.which * count))
        worlds = len(samples.numbers)
        speed = plain.twist[:, :3].norm(dim=1)
        generator = torch.Generator().manual_seed(1 + samples.seed)
        deviates = torch.randn(worlds, 1, each, 2, generator=generator, dtype=torch.float64)
        deviates = deviates.expand(-1, count, -1, -1).reshape(-1, 2)
        of_drive = mounts.repeat_interleave(each, 0).repeat(worlds, 1, 1)
        beside = self.space.costs.sway(of_drive, self.space.pair.low.z_m, speed, deviates)
        since_s = robot_pair.MIDDLE_S - float(plain.t_s[0])
        middle = plain.T_world_body[..., 0, :, :].flatten(0, -3) @ se3_exp(since_s * plain.twist)
        poses = robot_pair.moved(middle, plain.twist + beside).reshape(plain.T_world_body.shape)
        return replace(plain, T_world_body=poses), plain.twist + beside

    def system(self, whole: Whole, kind: str, head: Any = None) -> System:
        """The chain of a design; ``head`` in place of least squares."""
        parts = {"estimate": head} if head is not None else {}
        pose = whole.T_body_cam
        return self._system.replaced(
            camera=whole.camera,
            mount=lambda: pose,
            events=whole.events(kind),
            flow=whole.flow,
            **parts,
        )

    @torch.no_grad()
    def looked(
        self,
        whole: Whole,
        samples: Samples,
        kind: str = "memory",
    ) -> "Looked":
        """Drives rendered for a design."""
        self.rendered += self.base.samples
        batch, twist = self.scenes(whole.T_body_cam[None], samples)
        run = self.system(whole, kind).begin(batch)
        return Looked(self, whole, samples, batch, twist, run)

    @torch.no_grad()
    def seen(
        self,
        cameras: Sequence[Any],
        mounts: Tensor,
        batch: Drives,
        twist: Tensor,
        field: Any,
        known: Seen | None = None,
    ) -> tuple[Seen, Tensor]:
        """What flow in the windows is of, behind mounts [M, 4, 4] (``scenes``) and a camera each,
        and its optics [N, windows, 2] (``window_optics``).

        known: of other flow seen alike, in which surfaces are as far, and as hidden, as in this.
        """
        estimator = self.estimate
        each = batch.T_world_body.shape[1] // len(mounts)
        of_drive = mounts.repeat_interleave(each, 0)
        T_world_cam = batch.T_world_body @ of_drive[:, None]
        unlike = list(dict.fromkeys(cameras))
        of_mount = torch.tensor([unlike.index(camera) for camera in cameras])
        worlds = len(batch.T_world_body)
        rig = Rig(unlike, of_mount.repeat_interleave(each).repeat(worlds))
        given = (field, rig, batch.scene, of_drive, T_world_cam, batch.t_s)
        if known is None:
            read, true = estimator.read_beside_truth(*given)
            covered = torch.cat(
                [
                    self.base.own_body.met(mounts[of_mount == number], camera, EVERY_PX)
                    for number, camera in enumerate(unlike)
                ]
            )[of_mount.argsort(stable=True).argsort()]
            covered = covered.repeat_interleave(each, 0).repeat(worlds, 1)
        else:
            covered = known.covered
            depths_m = known.read.depth_m, known.surfaces.depth_m
            read, true = estimator.read_beside_truth(*given, depths_m=depths_m)
        flow_px = (true.rows @ twist[:, None, :, None])[..., 0]
        surfaces = replace(read, depth_m=true.depth_m)
        return Seen(batch.twist, twist, read, surfaces, true.rows, flow_px, covered), rig.optics(
            read
        )

    def expected(self, seen: Seen, read: Readings, errors: FlowErrors) -> Tensor:
        """Mean bounded error [N] to be expected of drives: over errors drawn from their normal
        distribution, the same for all designs."""
        estimator = self.estimate
        axes = list(self.space.pair.axes)
        found = expected_errors(estimator, read, seen.seen_twist, seen.true_rows, errors)
        mean = (found.mean + seen.seen_twist - seen.twist)[:, axes]
        covariance = found.covariance[:, axes][:, :, axes]
        unit = velocity_errors(torch.zeros_like(mean), seen.twist, tuple(axes)).unit
        root = torch.linalg.cholesky(covariance + 1e-12 * torch.eye(len(axes), dtype=mean.dtype))
        draws = _normal(len(axes)) @ root.mT
        squared = ((mean[:, None] + draws) / unit[:, None]).square().mean(2)
        return (squared / (1 + squared)).mean(1)


def _normal(axes):
    """[DRAWS, axes] standard normal numbers, evenly spread."""
    points = torch.quasirandom.SobolEngine(axes, scramble=True, seed=0).draw(
        DRAWS, dtype=torch.float64
    )
    return torch.special.ndtri(points.clamp(1e-6, 1 - 1e-6))


@dataclass(frozen=True)
class Looked:
    """A design's drives: what ran, and what is read off it when it is asked for."""

    drawn: Drawn
    whole: Whole
    samples: Samples
    batch: Drives
    twist: Tensor
    run: Any
    known: Seen | None = None

    def again(self, other: Whole, kind: str = "memory", **kept: Any) -> "Looked":
        """The same frames, and what else is kept of the run, through another sensor and estimator,
        or in the light of another f-number."""
        kept = {"frames": self.run["frames"], **kept}
        with torch.no_grad():
            run = self.drawn.system(other, kind).begin(self.batch, kept)
        alike = other.camera is self.whole.camera
        return replace(self, whole=other, run=run, known=self.seen if alike else None)

    def blurred(self, generator: torch.Generator) -> tuple["Looked", Tensor]:
        """The same frames behind a blur that is drawn for every window, and the optics [N, windows,
        2] of what is read there."""
        from kornia.filters import gaussian_blur2d

        frames, own = self.run["frames"], self.optics
        low, high = BLURS_PX
        drawn = torch.rand(own.shape[:2], generator=generator, dtype=own.dtype)
        more_px = low * (high / low) ** drawn
        # an even spread of light of that root mean square radius
        deviation = (more_px / 2**0.5).to(frames).reshape(-1, 1).expand(-1, 2)
        # [worlds, drives, T, windows, h, w] -> [N x windows, T, h, w]
        stack = frames.flatten(0, 1).movedim(2, 1)
        soft = gaussian_blur2d(stack.flatten(0, 1), BLUR_TAPS, deviation, border_type="replicate")
        soft = soft.reshape(stack.shape).movedim(1, 2).reshape(frames.shape)
        radius = (own[..., 1].expm1() ** 2 + more_px**2).sqrt()
        looked = self.again(self.whole, frames=soft)
        return looked, torch.stack([own[..., 0], radius.log1p()], -1)

    @cached_property
    def seen(self) -> Seen:
        """What its flow is of."""
        return self._seen[0]

    @property
    def optics(self) -> Tensor:
        """[N, windows, 2] of its readings (``window_optics``)."""
        return self._seen[1]

    @cached_property
    def _seen(self):
        whole = self.whole
        given = (self.batch, self.twist, self.run["field"], self.known)
        return self.drawn.seen([whole.camera], whole.T_body_cam[None], *given)

    @cached_property
    def conditions(self) -> Conditions:
        """Under which its flow was read."""
        whole, costs = self.whole, self.whole.space.costs
        counts = self.run["volume"].counts
        per_px = float(counts.sum()) / (counts.shape[0] * counts.shape[-1] * counts.shape[-2])
        level = costs.gain(whole.numbers["fno"]) * float(self.run["frames"].mean())
        return Conditions.of(
            whole.sensor, per_px, level, robot_pair.DURATION_S, whole.numbers["prior_px"]
        )

    @cached_property
    def errors(self) -> FlowErrors:
        """Of its flow beyond what that claims."""
        return self.drawn.calibration.errors(self.conditions)

    @cached_property
    def expected(self) -> Tensor:
        """[N] bounded errors to be expected."""
        return self.drawn.expected(self.seen, self.seen.read, self.errors)

    @torch.no_grad()
    def hard(self, head: Any = None) -> Tensor:
        """[N] bounded errors of the estimates, by least squares or a head on the same flow."""
        run = self.run
        if head is not None:
            kept = {"frames": run["frames"], "events": run["volume"], "flow": run["field"]}
            run = self.drawn.system(self.whole, "memory", head).begin(self.batch, kept)
        return self.drawn.space.pair.errors(run["estimate"], self.batch).bounded()
