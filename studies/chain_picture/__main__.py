"""One pass of the whole chain as one picture, lens to flow, and each stage alone.

    lens ──rays──▶ frames ──▶ events ──▶ flow

A traced lens on a drifting, turning robot looks into a room with crates and a ball. The picture is
the one at the head of docs/chain.md; the panels below it are those of docs/gallery.md.
"""

import sys
from dataclasses import dataclass, replace

import torch

import codesign
from codesign import events, flow, lens, pose, render
from codesign.atomic import write_atomic
from codesign.system import Batch, System
from scenes import textures, trajectories, worlds
from studies.chain_picture import panels
from studies.frame.config import check_least
from studies.frame.run import Run, StudyConfig, main
from studies.frame.show import panels as charts

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
    lens_steps: int = 24
    """Steps of the lens that sharpens edges."""


def study(run: Run[Config]):
    config = run.config
    # a lens that sharpens edges is a curve
    check_least(config, 2, "lens_steps")
    published = lens.load(config.lens)
    geo = published.scaled(11.0 / float(published.first_order().efl_mm.detach())).freeze()
    size = config.width_px, config.height_px, PITCH_MM
    system = System(
        camera=render.Camera(geo, *size, config.samples, config.seed),
        events=events.HardSensor(events.SensorModel(theta_on=0.15, theta_off=0.15), 8),
        flow=flow.load("refiner"),
        objectives={"endpoint error": endpoint_error},
        scene=worlds.room(),
    )
    t_s = torch.linspace(0, DURATION_S, 33, dtype=torch.float64)
    # m/s and rad/s in camera axes
    twist = torch.tensor([0.5, -0.1, 1.0, 0.0, 0.1, 0.25], dtype=torch.float64)
    start = pose.look_at((0.1, -1.5, 0.7), (0.0, 1.0, 0.35))
    batch = Batch(trajectories.body_twist(start, twist, t_s), t_s)
    with run.progress(1, "one pass") as bar, torch.no_grad():
        seen = system.begin(batch)
        true = seen["truth"]
        error = endpoint_error(seen["field"], true)
        bar.advance(error_px=error)
    moved = true.flow_px.square().sum(1).sqrt()[true.valid].mean()
    run.record(
        endpoint_error_px=error, true_motion_px=moved, events=float(seen["volume"].counts.sum())
    )
    run.card(
        "Endpoint error",
        f"{error:.2f} px",
        f"true motion {moved:.2f} px in {DURATION_S * 1e3:g} ms",
    )
    run.figure(
        codesign.show(seen, width_in=13.0),
        "chain",
        "Lens, middle frame, signed events, flow as estimated and as it is.",
        dpi=110,
    )
    _each_stage(run, seen, t_s)
    run.finish(
        "The chain in one picture",
        f"The estimated flow is off by {error:.2f} px where the picture moves by {moved:.2f} px: one pass from glass to "
        "flow, with the hard sensor.",
    )


def endpoint_error(field, truth):
    return flow.metrics.aee(field.flow_px, truth.flow_px, truth.valid)


def _each_stage(run, seen, t_s):
    """Panels of lens, events and flow, on the frames of the pass at half the size."""
    run.section("Each stage alone", "The same drive, at half the size; one number swept in each.")
    wall = worlds.wall(textures.shrunk(textures.photo("gravel"), 2), texel_m=0.003)
    over_s = torch.linspace(0, DURATION_S, 7, dtype=torch.float64)
    drive = trajectories.translation(pose.look_at((0, -2, 0), (0, 0, 0)), (0.3, 0.1, 0.0), over_s)
    run.figure(
        charts(*panels.lens_way(wall, drive, over_s, run.config.lens_steps)),
        "lens_edge_energy",
        "A triplet that begins out of focus: its curvatures (the last one holds the focal length) and "
        "the edge energy of its events, step by step.",
        dpi=110,
    )
    frames = torch.nn.functional.avg_pool2d(seen["frames"].detach(), 2).flatten(0, -3)
    from studies.hero import looped

    write_atomic(run.path("events_decay.webp"), looped(list(panels.loop(frames, t_s))[::2]))
    run.video(
        "events_decay.webp",
        "Frame, events as they add up, and with traces that fade within "
        f"{panels.FADE_S * 1e3:g} ms; ON red, OFF blue.",
    )
    every = max(8, run.config.width_px // 22)
    middle = seen["frames"].detach().flatten(0, -3)[len(t_s) // 2]
    run.figure(
        panels.overlay(middle, {"estimated": seen["field"], "true": seen["truth"]}, every),
        "flow_overlay",
        f"Flow over the middle frame: arrows are as long as the way in {DURATION_S * 1e3:g} ms.",
        dpi=90,
    )
    ideal = events.SensorModel(panels.THETA, panels.THETA)
    noisy = replace(ideal, shot_rate_hz=40.0)
    sensors = {
        "noise": noisy,
        "noise, rest of 10 ms": replace(noisy, refractory_s=0.01),
        "neither": ideal,
    }
    for name, shown, caption in (
        (
            "events_sigmoid",
            panels.sigmoids(frames, (2, 5, 10, 20, 50, 100, 200)),
            f"Sigmoid layer, threshold θ = {panels.THETA:g} log units. Left: events of one frame pair; "
            "right: of the drive. Soft ones fire where nothing moves; sharp ones tend to the hard count.",
        ),
        (
            "events_filtered",
            [panels.rates(frames, t_s, sensors)],
            "Event rates per polarity: with 40 noise events per second and pixel in the dark, with a rest "
            "of 10 ms after each event beside them, and with neither.",
        ),
        (
            "events_smoothing",
            panels.smoothing((30, 60, 120, 240)),
            "Low pass of the photoreceptor at full light: a step comes late; 63 % of it (dashed) after one "
            "time constant.",
        ),
        (
            "events_thresholds",
            [panels.thresholds(frames, t_s, (0.025, 0.05, 0.1, 0.2, 0.4))],
            "Events of the drive over the contrast threshold: half of it gives twice the events and some more, "
            "as changes smaller than a threshold give none.",
        ),
    ):
        run.figure(charts(*shown, width=6 if len(shown) == 1 else 4.5), name, caption, dpi=110)


if __name__ == "__main__":
    sys.exit(main(study, Config))
