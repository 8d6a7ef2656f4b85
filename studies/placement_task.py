"""What the placement study optimises and judges: a robot on textured ground that reads its planar velocity off event flow.

Modelled: a camera of 64 x 64 pixels and 70 degrees on a body that moves in the plane with constant forward, lateral and yaw rate over 40 ms;
ground with photographs and patterns of several scales; the event sensor's mismatch and shot noise (one fixed draw); affine flow over the image;
weighted least squares with the true depth, in which ground farther than a few metres counts less, because there a pixel covers whole patterns.
What makes one mount better than another: near ground moves fast and is seen in detail, but a turn of the body shows best in what is far; texture
finer than a pixel fires events that follow no motion; flow beyond the reach of the estimator is lost; and the sky shows nothing.
Not modelled: the robot's own body in view, uneven ground, errors of the depth, lighting.
"""

import math
from dataclasses import dataclass
from functools import cached_property

import torch

from codesign import events, flow, lens, place, render
from codesign.pose import se3_exp
from scenes import textures, worlds

WIDTH_PX, PITCH_MM, FOCAL_MM = 64, 0.074, 3.4  # the middle of a DAVIS346 read out in blocks of 4 x 4 pixels, behind a wide lens: 70 degrees
DURATION_S, FRAMES, BINS, SAMPLES = 0.04, 9, 5, 8
SENSOR = events.SensorModel(theta_on=0.2, theta_off=0.2, theta_sigma=0.03, shot_rate_hz=1.0)
NOMINAL_M, HALF_RANGE_M = (0.2, 0.0, 0.4), (0.1, 0.1, 0.1)  # where the camera may sit on the body: 40 cm above the ground, 20 cm ahead of the body's origin
SCALES = torch.tensor([0.1, 0.1, 0.1], dtype=torch.float64)  # m/s, m/s, rad/s: errors that count 1
PRIOR = (1.0, 1.0, 1.0)  # m/s, m/s, rad/s
FLOW_NOISE_PX = 0.5  # of one pixel's flow over the interval, for the weight of the prior
PRIOR_PX = 4.0  # expected flow over the interval
FAR_M = 4.0  # ground at this depth counts half
TRAINING, HELD_OUT = ("gravel", "grass", "speckle-1"), ("brick", "astronaut", "speckle-2")


@dataclass(frozen=True)
class Errors:
    """Errors of the planar velocity over all samples: [B, 3] in m/s, m/s, rad/s, estimate minus truth."""

    error: torch.Tensor

    @property
    def per_sample(self):
        """[B] task errors, dimensionless: root mean square of the three errors in units of SCALES."""
        return ((self.error / SCALES).square().mean(1) + 1e-12).sqrt()

    @property
    def task(self):
        """Root mean square over the samples."""
        return (self.error / SCALES).square().mean().sqrt()

    @property
    def rms(self):
        """[3] RMS errors in m/s, m/s, rad/s."""
        return self.error.square().mean(0).sqrt()


@dataclass(frozen=True)
class PlacementTask:
    """Worlds, and for each the motions: velocity [W, M, 3] (m/s, m/s, rad/s) and T_world_body [W, M, T, 4, 4]; seed of the noise."""

    worlds: tuple
    velocity: torch.Tensor
    T_world_body: torch.Tensor
    seed: int

    @cached_property
    def camera(self):
        return render.Camera(lens.Pinhole(FOCAL_MM), WIDTH_PX, WIDTH_PX, PITCH_MM, SAMPLES, self.seed)

    @cached_property
    def t_s(self):
        return torch.linspace(0, DURATION_S, FRAMES, dtype=torch.float64)

    @property
    def samples(self):
        return self.velocity.shape[0] * self.velocity.shape[1]

    def frames(self, T_body_cam):
        """[T, B, H, W] of mounts [B, 4, 4], one per sample (world by world)."""
        rays, parts = self.camera.rays(), []
        for world, bodies, mounts in zip(self.worlds, self.T_world_body, T_body_cam.reshape(*self.velocity.shape[:2], 1, 4, 4), strict=True):
            poses = bodies @ mounts
            image = render.shade(rays, world, poses.reshape(-1, 4, 4), SAMPLES)
            parts.append(image.reshape(*poses.shape[:2], *self.camera.film.shape).transpose(0, 1))
        return torch.cat(parts, 1)

    def volume(self, frames, layer="memory"):
        """Event volume of frames [T, B, H, W]. layer: "memory" (hard counts, straight-through), "counts" (smooth, no noise) or "sensor" (single
        events with their times, no gradient). Mismatch is the same for all samples, as they share one sensor."""
        if layer == "counts":
            return events.from_counts(events.soft_counts(frames, SENSOR.theta_on, SENSOR.theta_off), self.t_s, BINS)
        if layer == "sensor":
            volumes = [self._recorded(frames[:, k], k) for k in range(frames.shape[1])]
            return type(volumes[0])(torch.cat([v.counts for v in volumes]), volumes[0].centroid_s, volumes[0].collected_s)
        counts, _ = events.memory(frames, *events.draw_thresholds(SENSOR, self.camera.film.shape, self._noise(0), dtype=frames.dtype))
        return events.from_counts(counts + self._shots.to(counts), self.t_s, BINS)

    def _noise(self, extra):
        return torch.Generator().manual_seed(1000 * self.seed + extra)

    @cached_property
    def _shots(self):
        return events.draw_shot_counts(SENSOR, (self.samples, *self.camera.film.shape), self.t_s.diff(), self._noise(1))

    def _recorded(self, frames, index):
        stream = events.simulate(frames, self.t_s, SENSOR, self._noise(2 + index))
        return events.from_stream(stream, 0, round(DURATION_S * 1e6), BINS)

    def depth_m(self, T_body_cam):
        """True depth [B, P] of the ground z = 0 under every pixel; infinite where a pixel sees the sky. Planar motion leaves it as it is."""
        direction = self.camera.chief_rays(self.camera.film.pixels()).direction
        slope = direction / direction[:, 2:]
        falling = -(slope @ T_body_cam[..., 2, :3, None])[..., 0]
        meets = falling.detach() > 1e-6
        return torch.where(meets, T_body_cam[..., 2, 3, None] / torch.where(meets, falling, 1.0), torch.inf)

    def estimate(self, T_body_cam, layer="memory"):
        """Velocities [B, 3] estimated behind mounts [4, 4] or [B, 4, 4]. Gradient: mounts (straight-through for "memory", exact for "counts")."""
        mounts = T_body_cam.expand(self.samples, 4, 4)
        field = flow.estimate_lk(self.volume(self.frames(mounts), layer), model="affine", prior_px=PRIOR_PX)
        depth = self.depth_m(mounts)
        near = torch.where(depth.isfinite(), depth, 1e3 * FAR_M)
        weight = (DURATION_S / FLOW_NOISE_PX) ** 2 / (1 + (near / FAR_M) ** 4)
        return place.velocity_from_flow(field.flow_px / DURATION_S, self.camera, depth, mounts, weight, PRIOR)

    def errors(self, T_body_cam, layer="memory"):
        return Errors(self.estimate(T_body_cam, layer) - self.velocity.reshape(-1, 3))


def make_world(name):
    """Ground with a photograph (8 mm a texel, averaged from 2 mm) or with speckle of periods from 24 to 256 mm."""
    if name.startswith("speckle-"):
        return worlds.ground(textures.speckle(int(name.split("-")[1])), texel_m=0.004)
    return worlds.ground(textures.shrunk(textures.photo(name), 4), texel_m=0.008)


def make_task(names, motions, seed):
    """Samples on every named texture: mostly forward drives of 0.2 to 1 m/s with some slip and turns, from random places and headings."""
    generator = torch.Generator().manual_seed(seed)
    draw = torch.randn(len(names), motions, 3, generator=generator, dtype=torch.float64)
    forward = 0.2 + 0.8 * torch.rand(len(names), motions, generator=generator, dtype=torch.float64)
    velocity = torch.stack([forward, 0.2 * draw[..., 1], 0.6 * draw[..., 2]], -1)
    start = torch.rand(len(names), motions, 3, generator=generator, dtype=torch.float64) * torch.tensor([4.0, 4.0, 2 * math.pi], dtype=torch.float64) - 2
    zero = torch.zeros_like(forward)
    at = se3_exp(torch.stack([start[..., 0], start[..., 1], zero, zero, zero, zero], -1)) @ se3_exp(torch.stack([zero, zero, zero, zero, zero, start[..., 2]], -1))
    t_s = torch.linspace(0, DURATION_S, FRAMES, dtype=torch.float64)
    twist = torch.stack([velocity[..., 0], velocity[..., 1], zero, zero, zero, velocity[..., 2]], -1)
    return PlacementTask(tuple(make_world(name) for name in names), velocity, at[..., None, :, :] @ se3_exp(t_s[:, None] * twist[..., None, :]), seed)
