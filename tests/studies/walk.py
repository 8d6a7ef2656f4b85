"""A walk that can be interrupted: a noisy descent, whose numbers depend on the generator, the momentum
and the step counter, so that a wrong resume shows."""

import sys
import time
from dataclasses import dataclass

import torch

from studies.frame.run import Run, StudyConfig, main


@dataclass(frozen=True)
class Config(StudyConfig):
    steps: int = 40
    """Number of steps."""
    pause_s: float = 0.0


def study(run: Run[Config]):
    generator = torch.Generator().manual_seed(run.config.seed)
    x, velocity, first = torch.ones(3), torch.zeros(3, dtype=torch.float64), 0
    if (state := run.load_state()) is not None:
        x, velocity, first = state.tensors["x"], state.tensors["velocity"], state.numbers["step"]
        generator.set_state(state.tensors["generator"])
    step = first

    def save():
        tensors = {"x": x, "velocity": velocity, "generator": generator.get_state()}
        run.save_state(tensors, {"step": step})

    run.on_interrupt(save)
    with run.progress(run.config.steps, "walking", done=first) as bar:
        while step < run.config.steps:
            velocity = (
                0.9 * velocity - 0.1 * x.double() + 0.01 * torch.randn(3, generator=generator)
            )
            x = x + velocity.float()
            time.sleep(run.config.pause_s)
            step += 1
            run.say(f"step {step}")
            bar.advance(loss=x.square().sum())
    run.record(loss_last=x.square().sum(), x_0=x[0], steps=step, first_step=first)
    run.finish("A walk", "It went on.")


if __name__ == "__main__":
    sys.exit(main(study, Config))
