"""What does a camera on a robot see, its own body included? A robot from URDF, drawn with the camera and its
view, and the frame itself.

Without --urdf it is the rover that comes along (scenes/rover.urdf). The robot stands in the world "outdoor", facing
its clear lane; the camera looks along the x axis of the frame it is mounted on, z up, as ROS has camera links (REP
103).
"""

import math
import sys
import time
from dataclasses import dataclass
from typing import Any, ClassVar

import matplotlib.pyplot as plt
import numpy as np
import torch
from matplotlib.figure import Figure

from codesign import lens, render
from codesign.errors import DomainError
from codesign.report import robot_figures
from scenes import bodies, robots, worlds
from studies.frame.run import Run, StudyConfig, main

FOCAL_MM = 4.0
NOD = ("camera_nod=0.8",)  # of the rover


@dataclass(frozen=True)
class Config(StudyConfig):
    QUICK: ClassVar = {"width_px": 64, "samples": 4}
    urdf: str = ""
    """Path of a URDF file; the rover that comes along when left out."""
    frame: str = "camera_link"
    """Link the camera is mounted on."""
    joint: tuple[str, ...] = ()
    """Joint angles as NAME=RADIANS (metres of a prismatic joint); the rover nods when none is given."""
    package: tuple[str, ...] = ()
    """Folders of packages as NAME=FOLDER, for package:// paths that are not found from the URDF upwards."""
    field_deg: float = 80.0
    """Horizontal field of view of the camera, a pinhole."""
    width_px: int = 320
    """Width of the frame; its height is three quarters of it."""
    samples: int = 16
    """Rays per pixel."""
    ground: str = "gravel"
    """Picture of the ground: a path, or one of textures.PHOTOS."""
    drawn_m: float = 0.5
    """Length of the drawn view."""


def study(run: Run[Config]) -> None:
    config = run.config
    if (
        not 1 <= config.field_deg <= 170
        or config.width_px < 8
        or config.samples < 1
        or not config.drawn_m > 0
    ):
        raise DomainError(
            "field_deg must lie in 1..170, width_px be at least 8, samples at least 1, drawn_m positive."
        )
    start = time.process_time()
    joints = config.joint or (() if config.urdf else NOD)
    robot = robots.from_urdf(
        config.urdf or robots.ROVER,
        {name: _number(name, value) for name, value in _pairs(joints, "joint").items()},
        packages=_pairs(config.package, "package"),
    )
    read_s = time.process_time() - start
    T_robot_cam = robot.frame(config.frame) @ robots.T_LINK_OPTICAL
    pitch_mm = 2 * FOCAL_MM * math.tan(math.radians(config.field_deg) / 2) / config.width_px
    camera = render.Camera(
        lens.Pinhole(FOCAL_MM),
        config.width_px,
        config.width_px * 3 // 4,
        pitch_mm,
        config.samples,
        config.seed,
    )
    body = robot.scene()
    lowest_m = min(float(part.vertices_m[:, 2].min()) for part in robot.parts)
    T_world_robot = torch.tensor(
        [[0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0.001 - lowest_m], [0, 0, 0, 1]], dtype=torch.float64
    )
    T_world_cam = (T_world_robot @ T_robot_cam)[None]
    world = render.MovingScene(
        worlds.outdoor(config.seed, photo=config.ground), {"robot": (body, T_world_robot[None])}
    )
    with torch.no_grad():
        image = render.frames(camera, world, T_world_cam)[0]
        seen = render.view(camera, world, T_world_cam, 0).object_id
    body_share = float((seen == 1).double().mean())
    faces = sum(len(part.faces) for part in robot.parts)
    run.record(faces=faces, links=len(robot.frames), read_cpu_s=read_s, body_share=body_share)
    run.card("Own body in view", f"{body_share:.1%}", "of the pixels' chief rays")
    run.card("Faces", f"{faces:,}", f"{len(robot.frames)} links, read in {read_s:.2g} CPU-s")
    run.section("The robot and its view", f"Camera on '{config.frame}', {config.field_deg:g}° wide.")
    caption = (
        "Left: the robot in its own axes and the camera's view; right: the frame (gamma 2.2, 255 is white)."
    )
    run.figure(picture(robot, camera, T_robot_cam, image.numpy(), config.drawn_m), "robot", caption)
    run.finish("Robot view", "A robot out of its URDF, a camera on one of its links, and what it sees.")


def _pairs(texts, option):
    """Dictionary of NAME=VALUE."""
    found: dict[str, str] = {}
    for text in texts:
        name, _, value = text.partition("=")
        if not name or not value:
            raise DomainError(f"--{option} {text}: give NAME=VALUE.")
        found[name] = value
    return found


def _number(name, value):
    try:
        return float(value)
    except ValueError as error:
        raise DomainError(f"--joint {name}={value}: the angle must be a number of radians.") from error


def picture(
    robot: robots.Robot, camera: render.Camera, T_robot_cam: torch.Tensor, image: np.ndarray, length_m: float
) -> Figure:
    """The robot in its own axes with the camera's view, ``length_m`` long, and beside it the frame [H, W]."""
    figure = plt.figure(figsize=(11, 4.6), layout="constrained")
    axis: Any = figure.add_subplot(1, 2, 1, projection="3d")
    corners = []
    shades = []
    for part in robot.parts:
        body = bodies.Body(part.vertices_m, part.faces)
        level = part.colour if part.uv is None and not part.smooth else np.full(1, part.colour.mean())
        corners.append(part.vertices_m[part.faces])
        shades.append(np.clip(level ** (1 / 2.2) * bodies.skylight(body), 0, 1))
    lines = robot_figures.view_lines(camera, T_robot_cam, length_m)
    robot_figures.draw_robot(axis, np.concatenate(corners), np.concatenate(shades), lines)
    right = figure.add_subplot(1, 2, 2)
    right.imshow(np.clip(image / 255, 0, 1) ** (1 / 2.2), cmap="gray", vmin=0, vmax=1)
    right.set(xticks=[], yticks=[])
    return figure


if __name__ == "__main__":
    sys.exit(main(study, Config))
