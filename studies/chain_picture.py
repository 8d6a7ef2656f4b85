"""One pass of the whole chain as one picture: lens, frame, events, estimated and true flow.

    lens ──rays──▶ frames ──▶ events ──▶ flow

A traced lens on a drifting, turning robot looks into a room with crates and a ball. The picture is
the one at the head of docs/chain.md.
"""

import sys
from dataclasses import dataclass

import torch

import codesign
from codesign import events, flow, lens, pose, render
from codesign.system import Batch, System
from scenes import trajectories, worlds
from studies.frame.run import Run, StudyConfig, main

PITCH_MM = 0.0185
DURATION_S = 0.05


@dataclass(frozen=True)
class Config(StudyConfig):
    lens: str = "double-gauss"
    """Lens in front of the sensor, scaled to 11 mm."""
    width_px: int = 346
    """Columns of the sensor."""
    height_px: int = 260
    """Rows of the sensor."""
    samples: int = 32
    """Rays per pixel."""


def study(run: Run[Config]):
    config = run.config
    published = lens.load(config.lens)
    geo = published.scaled(11.0 / float(published.first_order().efl_mm.detach())).freeze()
    system = System(
        camera=render.Camera(
            geo, config.width_px, config.height_px, PITCH_MM, config.samples, config.seed
        ),
        events=events.HardSensor(events.SensorModel(theta_on=0.15, theta_off=0.15), 8),
        flow=flow.load("refiner"),
        objectives={
            "endpoint error": lambda field, truth: flow.metrics.aee(
                field.flow_px, truth.flow_px, truth.valid
            )
        },
        scene=worlds.room(),
    )
    t_s = torch.linspace(0, DURATION_S, 33, dtype=torch.float64)
    # m/s and rad/s in camera axes
    twist = torch.tensor([0.5, -0.1, 1.0, 0.0, 0.1, 0.25], dtype=torch.float64)
    batch = Batch(
        trajectories.body_twist(pose.look_at((0.1, -1.5, 0.7), (0.0, 1.0, 0.35)), twist, t_s), t_s
    )
    with run.progress(1, "one pass") as bar, torch.no_grad():
        seen = system.begin(batch)
        error = float(
            flow.metrics.aee(seen["field"].flow_px, seen["truth"].flow_px, seen["truth"].valid)
        )
        bar.advance(error_px=error)
    true = seen["truth"]
    moved = float(true.flow_px.square().sum(1).sqrt()[true.valid].mean())
    run.record(
        endpoint_error_px=error, true_motion_px=moved, events=float(seen["volume"].counts.sum())
    )
    run.card(
        "Endpoint error",
        f"{error:.2f} px",
        f"true motion {moved:.2f} px in {DURATION_S * 1e3:g} ms",
    )
    run.figure(
        codesign.show(seen),
        "chain",
        "Lens, middle frame, signed events, flow as estimated and as it is.",
        dpi=110,
    )
    run.finish(
        "The chain in one picture",
        f"The estimated flow is off by {error:.2f} px where the picture moves by {moved:.2f} px: one pass from glass to "
        "flow, with the hard sensor.",
    )


if __name__ == "__main__":
    sys.exit(main(study, Config))
