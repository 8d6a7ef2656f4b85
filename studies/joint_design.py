"""Lens, mount, sensor and network behind one optimiser: is every group's gradient right, and does the loss fall?

A robot turns and drives in a textured room. Its camera (a traced triplet) sits on a mount; smooth event counts with
learnable thresholds feed a network of ten thousand weights, and the mean endpoint error against the true flow through
the current lens goes back to all of them at once. Autograd is compared with central differences group by group; one
Adam over all groups takes steps; and the cost of the Module is measured against the same stages called by hand.
"""

import sys
import time
from dataclasses import dataclass
from statistics import median
from typing import ClassVar

import torch

from codesign import events, flow, lens, render
from codesign.errors import DomainError
from codesign.grad import certify
from codesign.grad.modules import by_group
from codesign.mount import Mount
from codesign.report import chain_figures
from codesign.system import Batch, System, check
from codesign.types import FlowField
from scenes import trajectories, worlds
from studies.frame.run import Run, StudyConfig, main

GROUPS = {"lens": "lens.", "mount": "mount.", "thresholds": "events.", "network": "flow."}
SIDE_PX = 48
PITCH_MM = 0.074  # blocks of 4 x 4 pixels of a DAVIS346
BINS = 4
DURATION_S = 0.05
DEPTH_M = 1.5  # of the room, about
# pixels of motion: an untrained network answers to a tenth of a pixel with another flow, so steps are small; the
# rounding of float32 frames allows it
LADDER = (0.005, 0.0035, 0.0025, 0.0018)
ASKED_ERROR = 0.05
ASKED_COSINE = 0.99
ASKED_OVERHEAD = 0.02


@dataclass(frozen=True)
class Config(StudyConfig):
    QUICK: ClassVar = {"steps": 10, "directions": 4, "repeats": 3}
    steps: int = 50
    """Steps of Adam over all groups."""
    weights: int = 10_000
    """Weights of the network."""
    drives: int = 4
    """Trajectories per batch."""
    directions: int = 12
    """Random directions in which the network's gradient is checked; the other groups are checked number by number."""
    learning_rate: float = 0.01
    """Of Adam, the same for all groups: their units are natural steps."""
    repeats: int = 15
    """Passes timed for the cost of the Module."""


def study(run: Run[Config]):
    config = run.config
    for name in ("steps", "weights", "drives", "directions", "repeats"):
        if getattr(config, name) < 1:
            raise DomainError(f"--{name} is {getattr(config, name)}; at least 1 is needed.")
    system = make_system(config.weights, config.seed)
    batch = draw_batch(config.drives, 1000 + config.seed)
    check(system, batch)
    with run.progress(3, "certifying, optimising, timing") as bar:
        rows = certificate(system, batch, config.directions)
        bar.advance()
        descended = descend(system, config)
        bar.advance()
        inside_s, by_hand_s = cost(system, batch, config.repeats)
        bar.advance()
    report(run, rows, descended, inside_s, by_hand_s)


def make_system(weights: int, seed: int) -> System:
    """A system with learnable lens (curvatures, focus), mount, thresholds and network, in natural steps."""
    geo = lens.load("cooke-triplet").scaled(0.22)
    geo.variables("curvature", "focus", step_mm=PITCH_MM, keep_efl=True)
    camera = render.Camera(geo, SIDE_PX, SIDE_PX, PITCH_MM, samples_per_pixel=16, seed=seed)
    mount = Mount((0.1, 0.0, 0.3), (0.1, 0.1, 0.1), pitch_rad=0.1, yaw_rad=0.2)
    mount.variables(camera, DEPTH_M)
    sensor = events.layer("counts", events.SensorModel(theta_on=0.2, theta_off=0.25))
    return System(
        camera=camera,
        mount=mount,
        events=sensor,
        flow=flow.FlowNetEvents.with_weights(weights, bins=BINS, seed=seed),
        objectives={"endpoint error": endpoint_error},
        scene=worlds.room(objects=False),
    )


def endpoint_error(field, truth):
    """Mean distance of estimated from true flow, px; rounded at zero, so that it is smooth."""
    miss = (field.flow_px - truth.flow_px).square().sum(1)
    return (miss[truth.valid] + 1e-4).sqrt().mean()


def draw_batch(drives: int, seed: int, frames: int = 9) -> Batch:
    """Drives that start near the middle of the room, forward with some slip and turn."""
    generator = torch.Generator().manual_seed(seed)
    t_s = torch.linspace(0, DURATION_S, frames, dtype=torch.float64)
    poses = []
    for _ in range(drives):
        at = 0.5 * (2 * torch.rand(2, generator=generator, dtype=torch.float64) - 1)
        heading = 6.28 * float(torch.rand(1, generator=generator, dtype=torch.float64))
        start = torch.eye(4, dtype=torch.float64)
        turn = torch.tensor(heading, dtype=torch.float64)
        start[:2, :2] = torch.stack([turn.cos(), -turn.sin(), turn.sin(), turn.cos()]).reshape(2, 2)
        start[:3, 3] = torch.tensor([*at.tolist(), 0.8], dtype=torch.float64)
        forward, slip, yaw = torch.randn(3, generator=generator, dtype=torch.float64).tolist()
        twist = torch.tensor([0.8 + 0.2 * forward, 0.2 * slip, 0.0, 0.0, 0.0, 0.4 * yaw], dtype=torch.float64)
        poses.append(trajectories.body_twist(start, twist, t_s))
    return Batch(torch.stack(poses), t_s, seed=seed)


def certificate(system: System, batch: Batch, directions: int):
    """Rows of autograd against differences, one per group; the network along random directions."""
    fn, params = by_group(system, lambda call: call(batch).loss, GROUPS)
    scales = {"lens": 1.0, "mount": 1.0, "thresholds": 1.0, "network": float(params["network"].norm()) / 4}
    return [
        row
        for name in params
        for row in certify(
            lambda p, name=name: fn({**params, **p}),
            {name: params[name]},
            scales={name: scales[name]},
            ladder=LADDER if name in ("lens", "mount") else (0.1, 0.03, 0.01),
            tolerance=ASKED_ERROR,
            directions=directions if name == "network" else None,
            generator=torch.Generator().manual_seed(0),
        )
    ]


@dataclass(frozen=True)
class Descended:
    """Loss of every step on its own drives, and mean losses before and after on drives never optimised on, px."""

    losses: list[float]
    before: float
    after: float


def descend(system: System, config: Config) -> Descended:
    """Steps of one Adam over everything, each on new drives."""
    unseen = draw_batch(2 * config.drives, 777 + config.seed)
    optimiser = torch.optim.Adam([p for p in system.parameters() if p.requires_grad], lr=config.learning_rate)
    with torch.no_grad():
        before = float(system(unseen).loss)
    losses = []
    for step in range(config.steps):
        optimiser.zero_grad()
        result = system(draw_batch(config.drives, 10_000 + 1000 * config.seed + step))
        result.backward()
        optimiser.step()
        losses.append(float(result.loss.detach()))
    with torch.no_grad():
        return Descended(losses, before, float(system(unseen).loss))


def by_hand(system: System, batch: Batch) -> torch.Tensor:
    """The same loss by the stages alone."""
    seed = batch.seed or 0
    camera = system.camera.with_seed(seed)
    poses = batch.T_world_body @ system.mount()
    frames = render.frames(camera, system.scene, poses, rays=camera.rays())
    volume = system.events.volume(frames, batch.t_s, BINS, torch.Generator().manual_seed(seed))
    field = system.flow(volume)
    found, valid = render.true_flow(camera, system.scene, poses[:, [0, -1]])
    return endpoint_error(field, FlowField(found[:, 0], valid[:, 0], DURATION_S))


def cost(system: System, batch: Batch, repeats: int) -> tuple[float, float]:
    """Median processor seconds of a pass with gradient, through the Module and by hand, in turns."""

    def through_module():
        return system(batch).loss

    def without():
        return by_hand(system, batch)

    spent = {through_module: [], without: []}
    for turn in range(repeats + 1):
        for work in (through_module, without) if turn % 2 else (without, through_module):
            system.zero_grad()
            began = time.process_time()
            work().backward()
            if turn:  # the first compiles kernels
                spent[work].append(time.process_time() - began)
    return median(spent[through_module]), median(spent[without])


def report(run, rows, descended, inside_s, by_hand_s):
    losses = descended.losses
    first = descended.before
    last = descended.after
    for row in rows:
        run.record(
            **{
                f"{row.name}_relative_error": row.relative_error,
                f"{row.name}_cosine": row.cosine,
                f"{row.name}_noise_floor": row.noise_floor,
            }
        )
    worst = max(row.relative_error for row in rows)
    least = min(row.cosine for row in rows)
    overhead = inside_s / by_hand_s - 1
    run.record(
        worst_relative_error=worst,
        least_cosine=least,
        loss_before_px=first,
        loss_after_px=last,
        module_cpu_s=inside_s,
        by_hand_cpu_s=by_hand_s,
        module_overhead_share=overhead,
    )
    run.card("Relative error, worst group", f"{worst:.2%}", f"asked: at most {ASKED_ERROR:.0%}")
    run.card("Cosine, worst group", f"{least:.4f}", f"asked: at least {ASKED_COSINE}")
    run.card(
        "Loss", f"{first:.2f} → {last:.2f} px", f"on unseen drives, before and after {len(losses)} steps"
    )
    run.card("Cost of the Module", f"{overhead:+.1%}", f"asked: at most {ASKED_OVERHEAD:.0%}, processor time")
    run.section(
        "Gradient of every group", "Autograd against central differences, smooth event layer, textured room."
    )
    run.table(
        "Certificate",
        ["group", "numbers", "relative error", "cosine", "signed bias", "noise floor", "verdict"],
        [
            [r.name, len(r.autograd), r.relative_error, r.cosine, r.signed_bias, r.noise_floor, r.verdict]
            for r in rows
        ],
    )
    steps = list(range(1, len(losses) + 1))
    run.section("One optimiser over all groups")
    run.figure(
        chain_figures.curves({"each step, its own drives": (steps, losses)}, "endpoint error (px)"),
        "loss_curve",
        "Loss of one Adam over lens, mount, thresholds and network.",
    )
    run.finish(
        "Lens, mount, sensor and network behind one optimiser",
        f"The worst group's gradient is {worst:.1%} from differences; the loss falls from {first:.2f} to {last:.2f} px.",
    )


if __name__ == "__main__":
    sys.exit(main(study, Config))
