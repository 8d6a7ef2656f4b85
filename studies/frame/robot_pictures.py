"""A robot of a pair with its camera, and what the camera sees."""

from typing import Any

import numpy as np
import torch
from matplotlib.patches import Rectangle
from torch import Tensor

from codesign import render
from codesign.report import robot_figures
from scenes import bodies
from scenes.robot_pair import FRAMES, SENSOR_PX, WINDOW_PX, Drives, RobotPair

DRAWN_M = 0.6  # length of the drawn view


def draw_pair(axis: Any, pair: RobotPair, camera: render.Camera, T_body_cam: Tensor) -> None:
    """Robot and view, into a 3-D axis."""
    triangles = [mesh.vertices_m[mesh.faces] for mesh in pair.bodies.values()]
    shade = [np.clip(0.8 * bodies.skylight(mesh), 0, 1) for mesh in pair.bodies.values()]
    lines = robot_figures.view_lines(camera, T_body_cam, DRAWN_M)
    robot_figures.draw_robot(axis, np.concatenate(triangles), np.concatenate(shade), lines)


@torch.no_grad()
def draw_frame(axis: Any, drives: Drives, camera: render.Camera, T_body_cam: Tensor) -> None:
    """The middle frame [H, W] of the first drive on the whole sensor, with the camera's windows."""
    whole = render.Camera(camera.lens, *SENSOR_PX, camera.film.pixel_pitch_mm, 8)
    scene = drives.scene[0].during([FRAMES // 2])
    pose = (drives.T_world_body[0, :, FRAMES // 2] @ T_body_cam)[:, None]
    frame = render.frames(whole, scene, pose)[0, 0].numpy()
    axis.imshow(np.clip(frame / 255, 0, 1) ** (1 / 2.2), cmap="gray", vmin=0, vmax=1)
    for corner in camera.film.windows_px or ():
        axis.add_patch(Rectangle(corner, WINDOW_PX, WINDOW_PX, fill=False, color="tab:red", linewidth=0.6))
