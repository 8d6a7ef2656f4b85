"""A recording to run on where there is none: a camera that turns in a rendered room, written in the layout of
the Event-Camera Dataset (events.txt, imu.txt, groundtruth.txt, calib.txt)."""

import math

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from codesign import events, lens, pose, render
from codesign.atomic import replacing, write_atomic
from codesign.events import SensorModel, SensorState
from scenes import worlds

FOCAL_PX = 200.0
FRAMES_HZ = 500.0
IMU_HZ = 1000.0
POSES_HZ = 200.0
SENSOR = SensorModel(theta_sigma=0.03, shot_rate_hz=1.0)
CHUNK = 50  # frames at a time
RATE_RAD_S = np.array([0.5, 0.7, 0.4])  # largest turn rates about the camera's axes
SWING_HZ = np.array([1.3, 0.9, 1.1])
START_S = 100.0  # recordings do not begin at zero


def turn_rate(t_s):
    """[N, 3] rad/s in the camera's axes."""
    return RATE_RAD_S * np.sin(2 * math.pi * SWING_HZ * np.asarray(t_s)[:, None] + np.array([0.3, 1.4, 2.2]))


def attitudes(duration_s, step_s=1e-4):
    """(times [N], rotations R_start_camera): the turn rate integrated in steps so short that their order does
    not matter (error 1e-9 rad)."""
    t_s = np.arange(round(duration_s / step_s) + 1) * step_s
    steps = Rotation.from_rotvec(turn_rate((t_s[1:] + t_s[:-1]) / 2) * step_s).as_matrix()
    turns = np.empty((len(t_s), 3, 3))
    turns[0] = np.eye(3)
    for k, step in enumerate(steps):
        turns[k + 1] = turns[k] @ step
    return t_s, turns


@torch.no_grad()
def make(folder, duration_s=0.2, size_px=(180, 240), seed=0):
    """Render and write a recording. size_px: (height, width); the focal length is 200 px at any size.

    Returns: camera, scene, and a function from times to T_world_cam, from which the true flow can be
      rendered.
    """
    height, width = size_px
    camera = render.Camera(lens.Pinhole(5.0), width, height, 5.0 / FOCAL_PX, 8, seed)
    scene = worlds.room()
    start = pose.look_at(*worlds.VIEWS["room"])
    fine_s, turns = attitudes(duration_s)

    def poses(t_s):
        """[N, 4, 4] at times on the fine grid, seconds after the start."""
        T = start.repeat(len(t_s), 1, 1)
        T[:, :3, :3] = start[:3, :3] @ torch.from_numpy(turns[np.rint(np.asarray(t_s) / 1e-4).astype(int)])
        return T

    t_s = np.arange(round(duration_s * FRAMES_HZ) + 1) / FRAMES_HZ
    state = SensorState(generator=torch.Generator().manual_seed(seed))
    parts = []
    for first in range(0, len(t_s), CHUNK):
        some = t_s[first : first + CHUNK]
        frames = render.frames(camera, scene, poses(some))
        parts.append(events.simulate(frames, torch.from_numpy(some), SENSOR, state=state))
    stream = events.concatenate(parts)
    folder.mkdir(parents=True, exist_ok=True)
    rows = torch.stack([stream.x, stream.y, (stream.p > 0).long()], 1).numpy()
    with replacing(folder / "events.txt") as temporary, open(temporary, "w", encoding="ascii") as file:
        file.writelines(
            f"{t * 1e-6 + START_S:.6f} {x} {y} {p}\n"
            for t, (x, y, p) in zip(stream.t_us.tolist(), rows.tolist(), strict=True)
        )
    imu_s = np.arange(round(duration_s * IMU_HZ) + 1) / IMU_HZ
    gravity = np.tile([0.0, 9.81, 0.0], (len(imu_s), 1))
    with replacing(folder / "imu.txt") as temporary:
        np.savetxt(temporary, np.column_stack([imu_s + START_S, gravity, turn_rate(imu_s)]), fmt="%.9f")
    pose_s = np.arange(round(duration_s * POSES_HZ) + 1) / POSES_HZ
    T = poses(pose_s).numpy()
    turned = Rotation.from_matrix(T[:, :3, :3]).as_quat()
    with replacing(folder / "groundtruth.txt") as temporary:
        np.savetxt(temporary, np.column_stack([pose_s + START_S, T[:, :3, 3], turned]), fmt="%.9f")
    middle = f"{(width - 1) / 2} {(height - 1) / 2}"
    write_atomic(folder / "calib.txt", f"{FOCAL_PX} {FOCAL_PX} {middle} 0 0 0 0 0\n".encode())
    return camera, scene, poses
