"""What does a camera tell of a body's motion, and what is it blind to, by where it looks? A ground robot and a quadrotor,
before anything is rendered.

The information that a flow field holds of the body's velocity follows from the mount, the lens and the depth of what is
seen. Here it is worked out for cameras that look forward, down, sideways and between, and for all directions of the
sphere, for a robot on flat ground (forward, left, yaw), and for a body with all six velocities over the ground at two
heights and in a room.
"""

import math
import sys
from dataclasses import dataclass
from typing import ClassVar

import torch

from codesign import lens, render
from codesign.errors import DomainError
from codesign.mount import PLANAR, VELOCITIES, Surroundings, scene_depth, sight_map, sight_table
from codesign.report.mount_sphere import mount_sphere
from scenes import worlds
from studies.frame.run import Run, StudyConfig, main

FOCAL_MM = 3.4
WIDTH_MM = 4.74  # of the sensor: 70 degrees


@dataclass(frozen=True)
class Config(StudyConfig):
    QUICK: ClassVar = {"rows": 9, "columns": 12}
    rows: int = 36
    """Rows of the map, from straight up to straight down."""
    columns: int = 72
    """Columns of the map, all around."""
    deviation_px_s: float = 5.0
    """Standard deviation of the flow of one window, px/s."""


def study(run: Run[Config]) -> None:
    config = run.config
    if config.rows < 2 or config.columns < 2 or not config.deviation_px_s > 0:
        raise DomainError("rows and columns must be at least 2, deviation_px_s positive.")
    camera = render.Camera(lens.Pinhole(FOCAL_MM), 32, 24, WIDTH_MM / 32, 1)
    high = torch.eye(4, dtype=torch.float64)
    high[2, 3] = 1.2
    noise = config.deviation_px_s
    cases = {
        "ground robot": Surroundings((0.2, 0.0, 0.4), axes=PLANAR, deviation_px_s=noise),
        "free over ground, 0.4 m": Surroundings((0.0, 0.0, 0.4), deviation_px_s=noise),
        "free over ground, 1.2 m": Surroundings((0.0, 0.0, 1.2), deviation_px_s=noise),
        "free in a room": Surroundings(
            (0.0, 0.0, 0.0), high, scene_depth, worlds.room(), deviation_px_s=noise
        ),
    }
    with run.progress(len(cases), "surroundings") as progress:
        for name, around in cases.items():
            show(run, camera, name, around)
            progress.advance()
    run.finish(
        "What a mount is blind to",
        "Standard deviations of the body's velocity by where its camera looks, from the geometry of the flow alone.",
    )


def show(run, camera, name, around):
    table = sight_table(camera, around)
    velocities = [VELOCITIES[axis] for axis in around.axes]
    label = name.replace(" ", "_").replace(",", "").replace(".", "_")
    for attitude, row in table.items():
        run.record(
            **{
                f"{label}_{attitude.replace(' ', '_')}_{velocity}": row[velocity]
                for velocity in velocities
                if math.isfinite(row[velocity])
            }
        )
    run.section(f"{name[0].upper()}{name[1:]}")
    run.table(
        "Standard deviations, and what shows least",
        [
            "looks",
            "sees",
            *(v.replace("_", " ", 1).replace("m_s", "m/s").replace("rad_s", "rad/s") for v in velocities),
            "blind to",
            "weakest motion",
        ],
        [
            [
                attitude,
                f"{row['seen']:.0%}",
                *(row[v] for v in velocities),
                ", ".join(row["blind"]) or "nothing",
                row["weakest"],
            ]
            for attitude, row in table.items()
        ],
        "Blind to: worse than 0.1 m/s or 0.1 rad/s. Weakest motion: shares of the units in which it is hardest to see.",
    )
    yaw, pitch, error = sight_map(camera, around, run.config.rows, run.config.columns)
    best = int(
        (error <= error.min() * (1 + 1e-9)).flatten().nonzero()[0]
    )  # of directions that are alike the first
    marked = (float(yaw[best % len(yaw)]), float(pitch[best // len(yaw)]))
    run.record(
        **{
            f"{label}_best_error": error.min(),
            f"{label}_worst_error": error.max(),
            f"{label}_best_yaw_deg": math.degrees(marked[0]),
            f"{label}_best_pitch_deg": math.degrees(marked[1]),
        }
    )
    run.figure(
        mount_sphere(yaw, pitch, error, "expected error (0.1 m/s, 0.1 rad/s)", {"best": marked}),
        f"sphere_{label}",
        "Root mean square error expected of all velocities, by where the camera looks; a velocity that leaves no trace "
        "counts its prior, 1 m/s or 1 rad/s.",
    )


if __name__ == "__main__":
    sys.exit(main(study, Config))
