"""What one step of a placement costs, and where the time goes: twelve drives before nine windows of 32 x 32, eight rays
a pixel, forward and backward to lens, mount and thresholds.

The three pairs of robot and world, with the robot in view, and flat ground through a pinhole. A step is timed stage by
stage, forward as each stage is asked for and backward as gradients arrive at the junctions between them.
"""

import statistics
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, ClassVar

from codesign import events, lens
from codesign.errors import DomainError
from codesign.mount import Mount
from codesign.system import Batch, System
from scenes import textures, worlds
from scenes.robots import pair as robot_pair
from scenes.robots.pairs import PAIRS
from studies.frame.run import Run, StudyConfig, main

ASKED_CPU_S = 0.6
BOX_HALF_M = (0.05, 0.05, 0.05)
STAGES = ("rays", "frames", "volume", "field", "estimate")
NAMES = {"rays": "lens", "frames": "render", "volume": "events", "field": "flow", "estimate": "estimate"}


@dataclass(frozen=True)
class Config(StudyConfig):
    QUICK: ClassVar = {"repeats": 2}
    worlds: int = 3
    """Worlds of a batch."""
    drives: int = 4
    """Drives in each of them."""
    repeats: int = 9
    """Timed steps of each case, after one that compiles."""


def study(run: Run[Config]) -> None:
    config = run.config
    if min(config.worlds, config.drives) < 1 or config.repeats < 2:
        raise DomainError("give at least one world, one drive and two repeats.")
    cases: dict[str, Callable[[Config], tuple[System, Batch, Any]]] = {
        **{name: pair_case(name) for name in PAIRS},
        "ground": ground_case,
    }
    rows = []
    with run.progress(len(cases) * (config.repeats + 1), "steps") as progress:
        for name, case in cases.items():
            found = costs(case(config), config.repeats, progress.advance)
            run.record(**{f"{name}_{stage}_cpu_s": cost for stage, cost in found.items()})
            step = found["step"]
            rows.append(
                [name, *(f"{cost:.2f} ({cost / step:.0%})" for cost in list(found.values())[1:-1]), step]
            )
            run.card(name, f"{step:.2f} CPU-s", f"forward {found['forward']:.2f}; asked {ASKED_CPU_S:g}")
    run.table(
        "Processor seconds of a step, and shares",
        ["case", *list(found)[1:-1], "step"],
        rows,
        "Medians; the first step, which compiles, is left out.",
    )
    run.finish("What a step of placement costs", __doc__.split("\n\n")[1].replace("\n", " "))


def pair_case(name: str) -> Callable[[Config], tuple[System, Batch, Any]]:
    """A pair at its own design, everything learnable."""

    def made(config):
        pair = PAIRS[name]()
        batch = pair.batch(robot_pair.training(config.worlds), config.drives, config.seed)
        return learnable(pair, pair.design.camera()), batch, pair

    return made


def ground_case(config: Config) -> tuple[System, Batch, Any]:
    """The drives of the outdoor rover over one textured ground, without a body, through a pinhole."""
    pair = PAIRS["outdoors"]()
    batch = pair.batch(robot_pair.training(config.worlds), config.drives, config.seed)
    poses = batch.T_world_body.flatten(0, 1)
    scene = worlds.ground(textures.speckle(0, finest_px=3.0, coarsest_px=128.0))
    camera = pair.design.camera().with_lens(lens.Pinhole(pair.design.efl_mm))
    return learnable(pair, camera), replace(batch, T_world_body=poses, scene=scene), pair


def learnable(pair: Any, camera: Any) -> System:
    """System of a pair whose lens, mount and thresholds ask for gradients."""
    design = pair.design
    camera.lens.requires_grad_()
    mount = Mount(
        (design.x_m, design.y_m, design.z_m),
        BOX_HALF_M,
        yaw_rad=design.yaw_rad,
        pitch_rad=design.pitch_rad,
        roll_rad=design.roll_rad,
    )
    layer = events.Settled(events.layer("memory", robot_pair.SENSOR), robot_pair.LEAD_S)
    return pair.system(design).replaced(camera=camera, mount=mount, events=layer)


def costs(
    case: tuple[System, Batch, Any], repeats: int, after_each: Callable[[], object] = lambda: None
) -> dict[str, float]:
    """Median processor seconds: "forward", then by stage both ways together ("lens", "render", "events", "flow",
    "estimate"), and "step" for all."""
    steps = []
    for _ in range(repeats + 1):
        steps.append(one_step(*case))
        after_each()
    return {name: statistics.median(step[name] for step in steps[1:]) for name in steps[0]}


def one_step(system: System, batch: Batch, pair: Any) -> dict[str, float]:
    """Processor seconds of one step."""
    system.zero_grad()
    passed = system.begin(batch)
    clock = [time.process_time()]
    for stage in STAGES:
        passed[stage]
        if stage == "rays":
            passed["T_world_cam"]
        clock.append(time.process_time())
    loss = pair.errors(passed["estimate"], batch).bounded().mean()
    arrived: dict[str, float] = {}

    def watch(tensor, stage):
        tensor.register_hook(lambda grad: arrived.__setitem__(stage, time.process_time()))

    field = passed["field"]
    for tensor in (field.flow_px, field.covariance_px2):
        watch(tensor, "field")
    watch(passed["volume"].counts, "volume")
    watch(passed["frames"], "frames")
    for tensor in (passed["rays"].origin_m, passed["rays"].direction):
        watch(tensor, "rays")
    begun = time.process_time()
    loss.backward()
    ended = time.process_time()
    # a junction's gradient has arrived when the stage behind it is done
    back = [ended, *(arrived[stage] for stage in STAGES[:-1]), begun]
    both = {
        NAMES[stage]: clock[k + 1] - clock[k] + max(back[k] - back[k + 1], 0.0)
        for k, stage in enumerate(STAGES)
    }
    return {"forward": begun - clock[0], **both, "step": ended - clock[0]}


if __name__ == "__main__":
    sys.exit(main(study, Config))
