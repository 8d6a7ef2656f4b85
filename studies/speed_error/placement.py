"""Stage "placement": what a step of a placement costs, and where."""

import statistics
import time
from dataclasses import replace
from typing import Any

from codesign import events, lens
from codesign.mount import Mount
from codesign.system import Batch, System
from scenes import textures, worlds
from scenes.robots import pair as robot_pair
from scenes.robots.pairs import PAIRS
from studies.frame.run import Run
from studies.frame.show import Asked, tabulate
from studies.frame.sweep import sweep
from studies.speed_error import Config

ASKED_CPU_S = 0.6
BOX_HALF_M = (0.05, 0.05, 0.05)
PARTS = {
    "rays": "lens",
    "frames": "render",
    "volume": "events",
    "field": "flow",
    "estimate": "estimate",
}
GROUND = "ground"


def stage(run: Run[Config]) -> list[Asked]:
    """A step of a placement, forward and backward to lens, mount and thresholds: twelve drives
    before nine windows of 32 x 32, eight rays a pixel, for the three pairs of robot and world, with
    the robot in view, and for flat ground through a pinhole. Medians of processor seconds; the
    first step, which compiles, is left out."""

    def costs(pair):
        case = case_of(pair, run.config.seed)
        steps = [one_step(*case) for _ in range(run.config.repeats + 1)][1:]
        return {name: statistics.median(step[name] for step in steps) for name in steps[0]}

    rows = sweep(run, costs, "placement", pair=(*PAIRS, GROUND))
    tabulate(run, "Processor seconds", rows, "pair", prefix="step_cpu_s")
    return [Asked(f"step, {row['pair']}, CPU-s", row["step"], most=ASKED_CPU_S) for row in rows]


def case_of(name: str, seed: int, worlds_of: int = 3, drives: int = 4) -> tuple[System, Batch, Any]:
    """A pair at its own design, everything learnable; or, of the name "ground", the drives of the
    outdoor rover over one textured ground, without a body, through a pinhole."""
    pair: Any = PAIRS["outdoors" if name == GROUND else name]()
    batch = pair.batch(robot_pair.training(worlds_of), drives, seed)
    design = pair.design
    camera = design.camera()
    if name == GROUND:
        scene = worlds.ground(textures.speckle(0, finest_px=3.0, coarsest_px=128.0))
        batch = replace(batch, T_world_body=batch.T_world_body.flatten(0, 1), scene=scene)
        camera = camera.with_lens(lens.Pinhole(design.efl_mm))
    camera.lens.requires_grad_()
    angles = {"yaw_rad": design.yaw_rad, "pitch_rad": design.pitch_rad, "roll_rad": design.roll_rad}
    mount = Mount((design.x_m, design.y_m, design.z_m), BOX_HALF_M, **angles)
    layer = events.Settled(events.layer("memory", robot_pair.SENSOR), robot_pair.LEAD_S)
    return pair.system(design).replaced(camera=camera, mount=mount, events=layer), batch, pair


def one_step(system: System, batch: Batch, pair: Any) -> dict[str, float]:
    """Processor seconds of one step: "forward", then by part both ways together, and "step" for
    all. Forward parts are timed as each is asked for, backward ones as gradients arrive at the
    junctions between them."""
    system.zero_grad()
    passed = system.begin(batch)
    clock = [time.process_time()]
    for name in PARTS:
        passed[name]
        if name == "rays":
            passed["T_world_cam"]
        clock.append(time.process_time())
    loss = pair.errors(passed["estimate"], batch).bounded().mean()
    arrived: dict[str, float] = {}
    junctions = {
        "field": (passed["field"].flow_px, passed["field"].covariance_px2),
        "volume": (passed["volume"].counts,),
        "frames": (passed["frames"],),
        "rays": (passed["rays"].origin_m, passed["rays"].direction),
    }
    for name, tensors in junctions.items():
        for tensor in tensors:
            tensor.register_hook(
                lambda grad, name=name: arrived.__setitem__(name, time.process_time())
            )
    begun = time.process_time()
    loss.backward()
    ended = time.process_time()
    # a junction's gradient has arrived when the part behind it is done
    back = [ended, *(arrived[name] for name in list(PARTS)[:-1]), begun]
    both = {
        label: clock[k + 1] - clock[k] + max(back[k] - back[k + 1], 0.0)
        for k, label in enumerate(PARTS.values())
    }
    return {"forward": begun - clock[0], **both, "step": ended - clock[0]}
