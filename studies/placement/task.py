"""What the placement study optimises and judges: a robot on textured ground that reads its planar velocity
off event flow.

Modelled: a camera of 64 x 64 pixels and 70 degrees on a body that moves in the plane with constant forward,
  lateral and yaw rate over 40 ms; ground with photographs and patterns of several scales; the event sensor's
  mismatch and shot noise (one fixed draw); affine flow over the image; weighted least squares with the true
  depth. Since the depth is known, events of ground farther than a few metres are faded out: a pixel covers
  whole patterns there, and what it fires follows no motion.
What makes one mount better than another: near ground moves fast and is seen in detail, but flow beyond the
reach of the estimator is lost, and more ground in view means more evidence; a turn of the body and a slip to
the side look alike unless near and far ground or both sides of the turn are seen; flow over ground that
recedes is less affine; the sky shows nothing.
Not modelled: the robot's own body in view, uneven ground, errors of the depth, lighting.

Common random numbers go with the texture: a sample fixes which patch of ground the camera looks at and how it
lies in the image, whatever the mount. On ground that looks alike everywhere this changes no expectation, and
it makes the errors of neighbouring mounts vary together; with the body's place held instead, every turn of
the camera by a pixel shows new texture, and the gradient is that of the draw.
"""

import math
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from kornia.filters import gaussian_blur2d, spatial_gradient

from codesign import events, flow, lens, place, render
from codesign.pose import se3_exp
from codesign.system import Batch, System
from codesign.types import EventVolume
from scenes import textures, worlds

# the middle of a DAVIS346 read out in blocks of 4 x 4 pixels, behind a wide lens: 70 degrees
WIDTH_PX = 64
PITCH_MM = 0.074
FOCAL_MM = 3.4
DURATION_S = 0.04
FRAMES = 9
BINS = 5
SAMPLES = 8
SENSOR = events.SensorModel(theta_on=0.1, theta_off=0.1, theta_sigma=0.015, shot_rate_hz=1.0)
# where the camera may sit on the body: 40 cm above the ground, 20 cm ahead of the body's origin
NOMINAL_M = (0.2, 0.0, 0.4)
HALF_RANGE_M = (0.1, 0.1, 0.1)
SCALES = torch.tensor([0.1, 0.1, 0.1], dtype=torch.float64)  # m/s, m/s, rad/s: errors that count 1
# expected size of velocity (m/s, m/s, rad/s) and of flow over the interval (px)
PRIOR = (1.0, 1.0, 1.0)
PRIOR_PX = 4.0
FLOW_NOISE_PX = 0.5  # of one pixel's flow over the interval, for the weight of the prior
NOISE_RATE = 3.0  # events per pixel and interval
FAR_M = 1.5  # ground at this depth counts half
TRAINING = ("gravel", "grass", "speckle-1")
HELD_OUT = ("brick", "astronaut", "speckle-2")


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
    """Worlds, and for each the motions: velocity [W, M, 3] (m/s, m/s, rad/s) and the patch looked at, [W, M,
    3] (x m, y m, heading rad); seed of the noise."""

    worlds: tuple
    velocity: torch.Tensor
    patch: torch.Tensor
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

    def batch(self):
        """All worlds and motions; the poses follow from the mount (``driven``)."""
        return Batch(None, self.t_s, self.worlds, 1000 * self.seed)

    def driven(self, T_body_cam):
        """T_world_body [W, M, T, 4, 4] of drives that lead mounts [W, M, 4, 4] past each sample's patch."""
        velocity = self.velocity.reshape(-1, 3)
        zero = torch.zeros(self.samples, dtype=torch.float64)
        twist = torch.stack([velocity[:, 0], velocity[:, 1], zero, zero, zero, velocity[:, 2]], 1)
        moving = se3_exp((self.t_s - DURATION_S / 2)[:, None] * twist[:, None])
        patch = self.patch.reshape(-1, 3)
        looked_at, heading = footprint(T_body_cam.reshape(-1, 4, 4))
        start = (
            planar(patch[:, :2], patch[:, 2])
            @ planar(zero[:, None].expand(-1, 2), -heading)
            @ planar(-looked_at, zero)
        )
        return (start[:, None] @ moving).reshape(*self.velocity.shape[:2], FRAMES, 4, 4)

    def system(self, T_body_cam, layer="memory"):
        """System behind mounts [4, 4] or [B, 4, 4], one per sample (world by world).

        layer: "memory" (hard counts, straight-through), "counts" (smooth, no noise) or "sensor" (single events
          with their times, no gradient).
        """
        mounts = T_body_cam.expand(self.samples, 4, 4).reshape(*self.velocity.shape[:2], 4, 4)
        return System(
            camera=self.camera,
            mount=lambda: mounts,
            trajectory=self.driven,
            events=LAYERS[layer],
            flow=near_flow,
            estimate=near_velocity,
            objectives={"task": lambda estimate: self.scored(estimate).task, "expected": expected_error},
            bins=BINS,
        )

    def scored(self, estimate):
        """Errors of estimated velocities [B, 3]."""
        return Errors(estimate - self.velocity.reshape(-1, 3))

    def begin(self, T_body_cam, layer="memory", frames=None):
        """A pass behind mounts, to read from by name; ``frames`` of an earlier pass saves rendering them again."""
        recorded = {} if frames is None else {"frames": frames}
        return self.system(T_body_cam, layer).begin(self.batch(), recorded)

    def poses(self, T_body_cam):
        """T_world_cam [B, T, 4, 4] of mounts, one per sample (world by world)."""
        return self.begin(T_body_cam)["T_world_cam"].flatten(0, 1)

    def depth_m(self, T_body_cam):
        """True depth [B, P] of the ground under every pixel of mounts [B, 4, 4], see ``ground_depth_m``."""
        return ground_depth_m(self.camera, T_body_cam)

    def errors(self, T_body_cam, layer="memory", frames=None):
        """Errors of the velocities estimated behind mounts.

        Gradient: mounts (straight-through for "memory", exact for "counts").
        """
        return self.scored(self.begin(T_body_cam, layer, frames)["estimate"])

    def expected(self, T_body_cam, frames=None):
        """Task error [B] to be expected from event noise alone, see ``expected_error``. Gradient: mounts."""
        return expected_error(
            **{name: self.begin(T_body_cam, "counts", frames)[name] for name in SEEN_BY_BOUND}
        )


LAYERS = {
    "memory": events.layer("memory", SENSOR, learn=()),
    "counts": events.layer("counts", replace(SENSOR, theta_sigma=0.0, shot_rate_hz=0.0), learn=()),
    "sensor": events.HardSensor(SENSOR, BINS),
}
SEEN_BY_BOUND = ("volume", "camera", "T_body_cam")


def ground_depth_m(camera, T_body_cam):
    """True depth [B, P] of the ground z = 0 under every pixel; infinite where a pixel sees the sky. Planar
    motion leaves it as it is."""
    direction = camera.chief_rays(camera.film.pixels()).direction
    slope = direction / direction[:, 2:]
    falling = -(slope @ T_body_cam[..., 2, :3, None])[..., 0]
    meets = falling.detach() > 1e-6
    return torch.where(meets, T_body_cam[..., 2, 3, None] / torch.where(meets, falling, 1.0), torch.inf)


def near_flow(volume, camera, T_body_cam):
    """Affine flow of events on near ground."""
    near = nearness(ground_depth_m(camera, T_body_cam.flatten(0, -3)))
    faded = volume.counts * near.to(volume.counts).reshape(-1, 1, 1, *camera.film.shape)
    return flow.estimate_lk(
        EventVolume(faded, volume.centroid_s, volume.collected_s), model="affine", prior_px=PRIOR_PX
    )


def near_velocity(field, camera, T_body_cam):
    """Velocities [B, 3] of the body by weighted least squares, near ground first."""
    mounts = T_body_cam.flatten(0, -3)
    depth = ground_depth_m(camera, mounts)
    weight = nearness(depth) * (DURATION_S / FLOW_NOISE_PX) ** 2
    return place.velocity_from_flow(field.flow_px / DURATION_S, camera, depth, mounts, weight, PRIOR)


def expected_error(volume, camera, T_body_cam):
    """Task error [B] to be expected from event noise alone: the Cramér-Rao bound of the velocity, given the
    edges that the events draw.

    A pixel's event rate V ties one component of the velocity, by grad V . flow = -V_t with noise NOISE_RATE;
    place.planar_flow makes it a row. Squares summed over thousands of pixels: unlike the error of one draw it has
    no sign that changes when the image shifts by a pixel, and its gradient points where the task error falls.
    Gradient: mounts, and events.
    """
    mounts = T_body_cam.flatten(0, -3)
    depth = ground_depth_m(camera, mounts)
    counts = volume.counts.sum(2)
    rate = gaussian_blur2d(counts[:, :1] - counts[:, 1:], (7, 7), (1.0, 1.0))
    edges = spatial_gradient(rate, mode="diff")[:, 0].flatten(2).double()  # [B, 2, P]
    flow_rows, _ = place.planar_flow(camera, depth, mounts)
    rows = torch.einsum("bcp,bpck->bpk", edges, flow_rows)
    rows = rows * (nearness(depth) * DURATION_S / NOISE_RATE)[..., None]
    normal = rows.mT @ rows + torch.diag(torch.tensor(PRIOR, dtype=torch.float64) ** -2)
    return (torch.linalg.inv(normal).diagonal(dim1=1, dim2=2) / SCALES**2).mean(1).sqrt()


def nearness(depth_m):
    """Weight of events and flow of ground at a depth: near 1 close by, 1/2 at FAR_M, 0 in the sky."""
    return 1 / (1 + (torch.where(depth_m.isfinite(), depth_m, 1e3 * FAR_M) / FAR_M) ** 4)


def footprint(T_body_cam):
    """Where mounts [B, 4, 4] look: point on the ground [B, 2] m (drawn in smoothly when the view nears the
    horizon), and heading [B] of the image about the vertical."""
    view = T_body_cam[:, :3, 2]
    height = T_body_cam[:, 2, 3]
    looked_at = T_body_cam[:, :2, 3] + (height * (view[:, 2] ** 2 + 0.1**2).rsqrt())[:, None] * view[:, :2]
    down = T_body_cam[:, :3, :3] * torch.tensor(
        [1.0, -1.0, -1.0], dtype=torch.float64
    )  # against a camera that looks straight down
    return looked_at, torch.atan2(down[:, 1, 0] - down[:, 0, 1], down[:, 0, 0] + down[:, 1, 1])


def planar(place_m, heading_rad):
    """Rigid motions [B, 4, 4] in the plane: places [B, 2] and headings [B]."""
    c = heading_rad.cos()
    s = heading_rad.sin()
    zero = torch.zeros_like(heading_rad)
    one = torch.ones_like(heading_rad)
    rows = [torch.stack([c, -s, zero, place_m[:, 0]], 1), torch.stack([s, c, zero, place_m[:, 1]], 1)]
    return torch.stack(
        [*rows, torch.stack([zero, zero, one, zero], 1), torch.stack([zero, zero, zero, one], 1)], 1
    )


def make_world(name):
    """Ground with a photograph laid out over 2 m, or with speckle of periods from 64 to 512 mm: nothing finer
    than a few pixels at the near ground."""
    if name.startswith("speckle-"):
        return worlds.ground(
            textures.speckle(int(name.split("-")[1]), finest_px=8.0, coarsest_px=64.0), texel_m=0.008
        )
    return worlds.ground(textures.shrunk(textures.photo(name), 4), texel_m=0.016)


def make_task(names, motions, seed):
    """Samples on every named texture: mostly forward drives of 0.2 to 1 m/s with some slip and turns, over
    random patches of ground."""
    generator = torch.Generator().manual_seed(seed)
    draw = torch.randn(len(names), motions, 2, generator=generator, dtype=torch.float64)
    uniform = torch.rand(len(names), motions, 4, generator=generator, dtype=torch.float64)
    velocity = torch.stack([0.2 + 0.8 * uniform[..., 0], 0.2 * draw[..., 0], 0.6 * draw[..., 1]], -1)
    patch = (uniform[..., 1:] - 0.5) * torch.tensor([4.0, 4.0, 2 * math.pi], dtype=torch.float64)
    return PlacementTask(tuple(make_world(name) for name in names), velocity, patch, seed)
