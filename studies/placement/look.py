"""A robot with its camera before anything is searched: its size, what its camera sees, how much of
that is the robot itself, whether the mount keeps what is required, and what motions it is blind
to."""

import itertools
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from codesign import render
from codesign.mount import (
    ATTITUDES,
    VELOCITIES,
    Body,
    OwnBody,
    Requirement,
    Sight,
    Surroundings,
    judge,
    sight,
    sight_map,
    sight_table,
    sight_units,
    yaw_pitch_roll_rad,
)
from codesign.mount.requirements import Verdict
from scenes.robots import pair as robot_pair
from scenes.robots.check import check_width
from scenes.robots.pair import RobotPair
from studies.frame.run import Run

# under it a camera over flat ground tells nothing that a picture would not
LEAST_HEIGHT_M = 0.05


def look(run: Run[Any], pair: RobotPair, camera: render.Camera) -> None:
    from studies.placement import figures

    check_width(pair, camera)
    pose = pair.design.mount()
    drives = pair.batch((0,), 1, run.config.seed)
    meshes = pair.bodies.values()
    body = Body((mesh.vertices_m, mesh.faces) for mesh in meshes)
    own_share = 1 - float(OwnBody(body, 1.0).exact(pose, camera))
    run.record(faces=sum(len(mesh.faces) for mesh in meshes), own_body_share=own_share)
    run.card(
        "Own body in view", f"{own_share:.1%}", "of the chief rays in the windows that are read"
    )
    run.section("The robot and its view", size_in_words(pair))
    run.figure(
        figures.robot_and_frame(pair, drives, camera, pose),
        "robot",
        "Left: the robot in its own axes (m) and its camera's view; right: the frame (gamma 2.2, 255 is white), the windows "
        "that are read outlined.",
    )
    verdicts = told_requirements(run, pair.requirements(), pose, camera)
    around = surroundings(pair, pose)
    told = what_it_tells(run, pair, camera, pose, "default")
    if told:
        names = [VELOCITIES[axis] for axis in around.axes]
        table = sight_table(camera, around)
        for attitude, name in itertools.product(ATTITUDES, names):
            if math.isfinite(value := table[attitude][name]):
                run.record(**{f"{attitude.replace(' ', '_')}_{name}": value})
        run.table(
            "Standard deviations from that place, by where the camera looks",
            ["looks", "sees", *names, "blind to", "weakest motion"],
            [
                [
                    attitude,
                    f"{row['seen']:.0%}",
                    *(row[name] for name in names),
                    ", ".join(row["blind"]) or "nothing",
                    row["weakest"],
                ]
                for attitude, row in table.items()
            ],
            "Blind to: worse than 0.1 m/s or 0.1 rad/s. Weakest motion: shares of the units in which it is hardest to see.",
        )
    run.finish("A robot and its camera", answer(pair, own_share, verdicts, told))


def told_requirements(
    run: Run[Any], requirements: Sequence[Requirement], pose: Tensor, camera: render.Camera
) -> Sequence[Verdict]:
    verdicts = judge(requirements, pose, camera)
    run.text("Requirements: " + "; ".join(map(str, verdicts)) + ".")
    return verdicts


def answer(
    pair: RobotPair, own_share: float, verdicts: Sequence[Verdict], told: Sight | None
) -> str:
    """What a mount is blind to, sees of its robot and keeps, in one sentence."""
    blind = "stands too low to tell any motion"
    if told:
        blind = f"is blind to {', '.join(told.blind()) or 'no motion'} over flat ground"
    missed = [each.name for each in verdicts if not each.kept]
    keeps = f"misses what is required: {', '.join(missed)}" if missed else "keeps all requirements"
    return (
        f"From its default mount the camera of '{pair.name}' {blind}; its own body fills {own_share:.1%} of the windows that are "
        f"read, and "
        f"the mount {keeps}."
    )


def size_in_words(pair: RobotPair) -> str:
    """How large a robot is, by which a wrong unit or axis is seen."""
    vertices = np.concatenate([mesh.vertices_m for mesh in pair.bodies.values()])
    length, width, height = vertices.max(0) - vertices.min(0)
    return (
        f"'{pair.name}' is {length:.2f} m long (x), {width:.2f} wide (y) and {height:.2f} high (z)."
    )


def surroundings(pair: RobotPair, pose: Tensor) -> Surroundings:
    """Flat ground, as far below a mount [4, 4] as it is in the middle of the pair's first
    drives."""
    T_world_body = torch.eye(4, dtype=torch.float64)
    T_world_body[2, 3] = pair.drive(0, 12)[0][:, robot_pair.FRAMES // 2, 2, 3].mean()
    x, y, z = pose[:3, 3].tolist()
    return Surroundings((x, y, z), T_world_body, axes=pair.axes)


def what_it_tells(
    run: Run[Any],
    pair: RobotPair,
    camera: render.Camera,
    pose: Tensor,
    marked: str,
) -> Sight | None:
    """Show what a mount [4, 4] is blind to over flat ground, and all other directions there; None
    where it is too low."""
    around = surroundings(pair, pose)
    height = pose[2, 3] + around.T_world_body[2, 3]
    if height <= LEAST_HEIGHT_M:
        return None
    told = sight(around.information(camera, pose)[0], sight_units(around), around.axes)
    run.text(
        f"{height:.2f} m over flat ground the motion that shows least from there is {told.weakest_named()} (in units of "
        f"0.1 m/s and 0.1 rad/s, deviation {told.weakest_deviation:.2f}); blind to: {', '.join(told.blind()) or 'nothing'}."
    )
    from codesign.report.mount_sphere import mount_sphere

    yaw, pitch, errors = sight_map(camera, around, rows=9, columns=18)
    now = yaw_pitch_roll_rad(pose).tolist()
    run.figure(
        mount_sphere(yaw, pitch, errors, "expected error, units", {marked: (now[0], now[1])}),
        "sight",
        "What the place allows: the error that flow over flat ground lets expect, over all directions the camera may look in "
        "(27 points of 5 px/s).",
    )
    return told
