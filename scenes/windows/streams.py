"""Recordings with exact flow at any time: streams of events as a real camera gives them, of a
camera that turns before a photograph and of one that slides past layers of depth."""

from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from codesign import events
from codesign.events import SensorModel, SensorState
from codesign.types import EventStream, FlowField
from scenes import textures
from scenes.windows.layers import (
    Layer,
    Plane,
    apply,
    compose,
    cover,
    gaussian,
    mirrored,
    pixels,
    topmost,
)

SENSOR = SensorModel(
    theta_on=0.27,
    theta_off=0.33,
    theta_sigma=0.03,
    cutoff_hz=300.0,
    leak_rate_hz=0.1,
    leak_jitter=0.1,
    rate_cov_decades=0.1,
    shot_rate_hz=0.5,
    refractory_s=3e-4,
    hot_pixel_share=2e-4,
    hot_pixel_rate_hz=100.0,
)
FRAMES_HZ = 1000.0
CHUNK = 40  # frames at a time
FOCAL_PX = 200.0
BLUR_PX = 0.8  # of the lens and the pixel, standard deviation
SCALE = 1.0  # texels per pixel
CONTRAST = 0.6  # on log radiance: rooms are duller than photographs taken to be looked at
SETTLING_S = 0.05  # of the sensor before the recording counts
TURN_RAD = np.array([0.10, 0.13, 0.08])  # amplitudes about x, y, z
TURN_HZ = np.array([1.3, 0.9, 1.1])
TURN_PHASE = np.array([0.3, 1.4, 2.2])
SLIDE_M_S = 0.35
DEPTHS_M = (1.6, 1.1, 0.8, 0.55)  # the wall, and layers before it
PHOTOGRAPHS = ("gravel", "astronaut", "camera", "brick")  # on them


@dataclass(frozen=True)
class Recording:
    """A stream with its flow. name: for people. focal_px: of the pinhole camera, its axis in the
    middle. layers: whose motion is a function from times to homographies."""

    name: str
    stream: EventStream
    focal_px: float
    layers: list[Layer]

    def truth(self, t0_us: int, t1_us: int) -> FlowField:
        """Flow [1, 2, H, W] px from t0 to t1 on the pixels at t0, valid everywhere."""
        points = pixels(self.stream.height_px, self.stream.width_px)

        def look(layer):
            first, last = layer.motion(np.array([t0_us, t1_us]) * 1e-6)
            origin = apply(torch.from_numpy(np.linalg.inv(first)).float(), points).movedim(0, -1)
            moved = apply(torch.from_numpy(last @ np.linalg.inv(first)).float(), points)
            return moved - points.movedim(-1, 0), origin

        flow = topmost(self.layers, look)
        valid = torch.ones(1, *points.shape[:2], dtype=torch.bool)
        return FlowField(flow[None], valid, (t1_us - t0_us) * 1e-6)


def turning(duration_s=0.3, size_px=(180, 240), seed=0) -> Recording:
    """A camera that turns about all axes before a photograph far away."""
    k = np.diag([FOCAL_PX, FOCAL_PX, 1.0])

    def move(t_s):
        swing = 2 * np.pi * TURN_HZ * np.asarray(t_s)[:, None] + TURN_PHASE
        angles = TURN_RAD * (np.sin(swing) - np.sin(TURN_PHASE))
        return k @ Rotation.from_rotvec(angles).as_matrix() @ np.linalg.inv(k)

    layers = [_layer(np.random.default_rng((31, seed)), move, "coffee", size_px, False)]
    return _recorded("turning", layers, duration_s, size_px, seed)


def sliding(duration_s=0.4, size_px=(180, 240), seed=0) -> Recording:
    """A camera that slides sideways, at a steady speed, past photographs at four depths."""
    draw = np.random.default_rng((32, seed))

    def moving(depth_m):
        def move(t_s):
            out = np.tile(np.eye(3), (len(t_s), 1, 1))
            out[:, 0, 2] = -FOCAL_PX * SLIDE_M_S / depth_m * np.asarray(t_s)
            return out

        return move

    layers = [
        _layer(draw, moving(depth_m), name, size_px, bool(number))
        for number, (depth_m, name) in enumerate(zip(DEPTHS_M, PHOTOGRAPHS, strict=True))
    ]
    return _recorded("sliding", layers, duration_s, size_px, seed)


def _layer(draw, move, name, size_px, covering):
    size = int(SCALE * (max(size_px) + 160))
    texture = torch.from_numpy(np.ascontiguousarray(textures.photo(name)))
    piece = torch.ones(2, size, size)
    if covering:
        piece[1] = cover(draw, size, SCALE, max(size_px))
    piece[0] = mirrored(texture, size) * piece[1]
    place = np.diag([2 * SCALE / size, 2 * SCALE / size, 1.0])
    return Layer(move, gaussian(piece, BLUR_PX * SCALE), torch.from_numpy(place).float())


def _recorded(name, layers, duration_s, size_px, seed):
    """Events of all frames; those of the first SETTLING_S are left out."""
    points = pixels(*size_px)
    t_s = np.arange(-round(SETTLING_S * FRAMES_HZ), round(duration_s * FRAMES_HZ) + 1) / FRAMES_HZ
    state = SensorState(generator=torch.Generator().manual_seed(seed))
    parts = []
    for first in range(0, len(t_s), CHUNK):
        some = t_s[first : first + CHUNK]
        moved = [
            replace(layer, motion=Plane(torch.from_numpy(layer.motion(some)).float()))
            for layer in layers
        ]
        frames = 255 * (compose(moved, points) / 255).clamp_min(1e-3) ** CONTRAST
        parts.append(
            events.simulate(frames, torch.from_numpy(some + SETTLING_S), SENSOR, state=state)
        )
    whole = events.concatenate(parts)
    start_us = round(SETTLING_S * 1e6)
    kept = whole.t_us >= start_us
    t_us, x, y, p = (values[kept] for values in (whole.t_us - start_us, whole.x, whole.y, whole.p))
    return Recording(name, EventStream(t_us, x, y, p, *size_px), FOCAL_PX, layers)
