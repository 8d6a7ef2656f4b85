"""What studies.upsampling looks at: rendered sequences at a high rate, from easy to hard, with their true
flow."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from codesign import lens, pose, render
from scenes import silhouettes as silhouette_scenes
from scenes import textures, trajectories, worlds

SCENES = {
    "wall": "a textured wall, moved along",
    "room": "a room with objects, moved along: depth",
    "poles": "four thin poles before a smooth wall",
    "fence": "seven thinner posts before a smooth wall",
    "ball": "a ball that passes before a still wall of bricks: occlusion",
    "fading": "the room, and the light grows by half",
}
# of the fastest things, between frames
FRAMES = 81
STEP_PX = 0.375
RATE_HZ = 1000.0
FIELD_DEG = 45.0
SAMPLES = 16


@dataclass(frozen=True)
class Sequence:
    """frames: [T, H, W]. truth: {stride: (flow, seen)} between the frames 0, stride, 2 stride, ...: true flow
    [n, 2, H, W], px, and whether a point is in the later frame and not hidden there, [n, H, W] bool."""

    frames: Tensor
    truth: dict

    @property
    def t_s(self):
        return torch.arange(len(self.frames), dtype=torch.float64) / RATE_HZ


@torch.no_grad()
def sequence(name, size_px, strides):
    """Render one of SCENES at size_px (width, height), with the true flow over each of the strides."""
    width, height = size_px
    camera = render.Camera(
        lens.Pinhole(5.0), width, height, 10 * math.tan(math.radians(FIELD_DEG / 2)) / width, SAMPLES
    )
    scene, poses = _moved(name, 0.1, 2)
    fastest_px = float(
        render.true_flow(camera, scene, poses)[0].norm(dim=1).quantile(0.95 if name != "ball" else 1.0)
    )
    scene, poses = _moved(name, 0.1 * STEP_PX * (FRAMES - 1) / fastest_px, FRAMES)
    frames = render.frames(camera, scene, poses)
    truth = {}
    if name == "fading":
        frames = frames * torch.linspace(0.7, 1.05, FRAMES)[:, None, None]
    for stride in strides:
        kept = list(range(0, FRAMES, stride))
        found = render.flow_and_occlusion(
            camera, scene.during(kept) if isinstance(scene, render.MovingScene) else scene, poses[kept]
        )
        at = found.flow_px + camera.film.pixels().T.reshape(2, height, width)
        stays = (at[:, 0] >= 0) & (at[:, 0] <= width - 1) & (at[:, 1] >= 0) & (at[:, 1] <= height - 1)
        truth[stride] = found.flow_px.float(), found.valid & ~found.occluded & stays
    return Sequence(frames, truth)


def _moved(name, way_m, count):
    """Scene and poses [count, 4, 4] of a camera or an object that moves by way_m in all."""
    share = torch.linspace(0, 1, count, dtype=torch.float64)
    if name == "ball":
        stand = torch.eye(4, dtype=torch.float64).repeat(count, 1, 1)
        stand[:, :3, 3] = torch.stack(
            (way_m * (share - 0.5), torch.full_like(share, -0.6), 0.2 * way_m * (share - 0.5)), 1
        )
        still = worlds.wall(textures.shrunk(textures.photo("brick"), 2), texel_m=0.006)
        return render.MovingScene(still, {"ball": (silhouette_scenes.ball(), stand)}), pose.look_at(
            (0, -2, 0), (0, 0, 0)
        ).expand(count, 4, 4).contiguous()
    if name == "wall":
        scene = worlds.wall(textures.shrunk(textures.photo("gravel"), 2), texel_m=0.006)
        start = pose.look_at((0, -2, 0), (0, 0, 0))
        along = (1.0, 0.4, 0.0)
    elif name in ("room", "fading"):
        scene = worlds.room()
        start = pose.look_at(*worlds.VIEWS["room"])
        along = (1.0, 0.2, 0.3)
    else:
        scene = silhouette_scenes.build(name)
        start = pose.look_at((0, -1.2, 1), (0, 1, 1))
        along = (1.0, 0.0, 0.2)
    return scene, trajectories.translation(start, tuple(way_m * part for part in along), share)
