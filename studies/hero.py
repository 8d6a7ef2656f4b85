"""What a designed camera sees on a moving robot, beside the one it came with: lens, robot, frame, events, flow, velocity.

Two whole designs of the joint race drive the same way through a world that no search saw: the
pair's default, and the median answer of an arm. The loop is the one that the README shows
(docs/hero.webp).
"""

import io
import sys
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from statistics import fmean
from typing import Any, ClassVar

import matplotlib.pyplot as plt
import numpy as np
import torch
from PIL import Image
from torch import Tensor

from codesign import events, flow, lens, render
from codesign.atomic import write_atomic
from codesign.errors import DomainError
from codesign.fidelity import Task
from codesign.fidelity.levels import camera_at
from codesign.pose import se3_exp
from codesign.report.chain_figures import draw_image
from codesign.report.flow_colours import flow_colours
from codesign.report.lens_figures import draw_layout
from scenes.robots import pair as robot_pair
from scenes.robots.costs import Exposed
from studies.codesign.cells import space_of
from studies.codesign.design import Space, Whole
from studies.codesign.problem import Drawn
from studies.codesign.race import answers
from studies.frame.config import check_least
from studies.frame.fidelity import Tolerant, chosen
from studies.frame.run import Run, main
from studies.placement.figures import draw_pair
from studies.placement.problem import Samples

STEP_S = 0.06  # of the drive, between pictures
LONGEST_PX = 3.0  # flow of full colour
FIELDS_RAD = (0.0, 0.2, 0.4)  # whose rays are drawn
COLOURS = ("#7f7f7f", "#d62728")


@dataclass(frozen=True)
class Config(Tolerant):
    QUICK: ClassVar = {"pictures": 2, "rays": 1}
    answers: Path = Path("docs/joint_race_outdoors.jsonl")
    """Answers of a joint race (answers.jsonl of a run of studies.codesign)."""
    arm: str = "nested"
    """Arm whose median answer is shown."""
    world: int = robot_pair.UNSEEN_FROM
    """Number of the world."""
    speed: float = 0.8
    """Speed of the robot, m/s."""
    turn: float = 0.35
    """Its rate of turning, rad/s."""
    pictures: int = 24
    """Of the loop."""
    rays: int = 8
    """Rays per pixel."""


@dataclass(frozen=True)
class Film:
    """What one design sees in K pictures: frames [K, H, W], counts [K, 2, H, W], flow [K, 2, H, W],
    and the velocities [K, 6] that it reads beside the true ones."""

    whole: Whole
    error: float
    frames: Tensor
    counts: Tensor
    flow_px: Tensor
    velocity: Tensor
    true: Tensor


def study(run: Run[Config]) -> None:
    config = run.config
    check_least(config, 0, "world")
    check_least(config, 1, "pictures", "rays")
    setting, rows = answers(config.answers)
    drawn = Drawn(driving(space_of(setting), config), (config.world,), 1, config.pictures)
    titles = ("as it came", "designed together")
    films = {}
    with run.progress(len(titles), "designs") as bar:
        for title, arm in zip(titles, ("default", config.arm), strict=True):
            films[title] = filmed(run, title, drawn, *median(rows, arm, drawn.space))
            bar.advance(error=films[title].error)
    pictures = [drawn_at(films, k) for k in range(config.pictures)]
    write_atomic(run.path("hero.webp"), looped(pictures))
    errors = {title: film.error for title, film in films.items()}
    run.record(**{f"error_{title.replace(' ', '_')}": error for title, error in errors.items()})
    run.figure(figure_at(films, config.pictures - 1), "last", "Last picture of hero.webp.", dpi=110)
    came, together = errors.values()
    run.finish(
        "The chain on a moving robot",
        f"On the drives of {config.answers.name}, in worlds that no search saw, the camera that the robot came with has a velocity "
        f"error of {came:.2f}, the one designed as a whole {together:.2f} (0: right, 1: tells nothing). hero.webp shows both on another drive, at "
        f"{config.speed:g} m/s; the errors beside the pictures are those of all drives.",
    )


def driving(space: Space, config: Config) -> Space:
    """The space of a pair whose robot drives one even way, a window after the other."""
    pair = space.pair
    twist = torch.tensor([config.speed, 0.0, 0.0, 0.0, 0.0, config.turn], dtype=torch.float64)

    def drive(number: int, motions: int) -> tuple[Tensor, Tensor]:
        level = pair.drive(number, 1)[0][0, 0].clone()
        level[:3, :3] = torch.eye(3, dtype=torch.float64)
        since_s = STEP_S * torch.arange(config.pictures, dtype=torch.float64)
        twists = twist.expand(config.pictures, 6)
        return robot_pair.moved(level @ se3_exp(since_s[:, None] * twists), twists), twists

    return replace(space, pair=replace(pair, drive=drive))


def median(rows: list[dict[str, Any]], arm: str, space: Space) -> tuple[Whole, float]:
    """The answer of an arm in the middle by its error in unseen worlds, and that error."""
    found = sorted((fmean(row["errors"]), row["share"]) for row in rows if row["arm"] == arm)
    if not found:
        raise DomainError(f"--arm {arm}: no answer of it is there.")
    error, share = found[len(found) // 2]
    return space.made(torch.tensor(share, dtype=torch.float64)), error


@torch.no_grad()
def filmed(run: Run[Config], title: str, drawn: Drawn, whole: Whole, error: float) -> Film:
    """The whole sensor in every picture, and the velocities that its nine windows tell."""
    config = run.config
    looked = drawn.looked(
        whole, Samples((config.world,), tuple(range(config.pictures)), config.seed), "sensor"
    )
    sensor = render.Film(*robot_pair.SENSOR_PX, *robot_pair.SENSOR_PX, robot_pair.PITCH_MM)
    camera = whole.camera.with_film(sensor).with_samples(config.rays)
    stage = events.HardSensor(whole.sensor, robot_pair.BINS, robot_pair.LEAD_S)
    exposed = Exposed(stage, whole.space.costs.gain(whole.numbers["fno"]), None, 1)
    batch = looked.batch
    poses = batch.T_world_body[0] @ whole.T_body_cam
    estimate = partial(flow.estimate_lk, prior_px=whole.numbers["prior_px"])
    if config.tolerance:
        task = Task(camera, whole.sensor, poses, batch.t_s, estimate)
        found = chosen(run, batch.scene[0].static, task, "hard", robot_pair.BINS, title)
        camera = camera_at(camera, found)
    frames = render.frames(camera, batch.scene[0], poses)
    generator = torch.Generator().manual_seed(config.seed)
    volume = exposed.volume(frames, batch.t_s, robot_pair.BINS, generator)
    flow_px = estimate(volume).flow_px
    velocity = looked.run["estimate"].velocity
    middle = frames[:, robot_pair.FRAMES // 2]
    return Film(whole, error, middle, volume.counts.sum(2), flow_px, velocity, batch.twist)


def drawn_at(films: Mapping[str, Film], k: int) -> Image.Image:
    figure = figure_at(films, k)
    figure.canvas.draw()
    picture = Image.fromarray(np.asarray(figure.canvas.buffer_rgba())[..., :3])
    plt.close(figure)
    return picture


def figure_at(films: Mapping[str, Film], k: int) -> Any:
    """A row for each design."""
    figure = plt.figure(figsize=(13.2, 2.5 * len(films)), layout="constrained", dpi=80)
    grid = figure.add_gridspec(len(films), 6, width_ratios=(1.1, 1.1, 1.3, 1.3, 1.3, 1.2))
    for row, ((title, film), colour) in enumerate(zip(films.items(), COLOURS, strict=True)):
        whole = film.whole
        axes = [
            figure.add_subplot(grid[row, column], projection="3d" if column == 1 else None)
            for column in range(6)
        ]
        if isinstance(whole.camera.lens, lens.GeoLens):
            draw_layout(axes[0], whole.camera.lens, FIELDS_RAD, rays=3)
            axes[0].get_legend().remove()
        axes[0].set_title(f"{title}:\nvelocity error {film.error:.2f}", fontsize=11, color=colour)
        draw_pair(axes[1], whole.space.pair, whole.camera, whole.T_body_cam)
        for axis in axes[:2]:
            axis.set_axis_off()
        draw_image(axes[2], film.frames[k], film.frames)
        axes[3].imshow(events.picture(film.counts[k], 2.0).squeeze().numpy())
        axes[4].imshow(flow_colours(film.flow_px[k].double().numpy(), LONGEST_PX))
        _draw_velocity(axes[5], film, k, colour)
        for axis, name in zip(axes[2:5], ("frame", "events", "flow"), strict=True):
            axis.set(xticks=[], yticks=[], title=name if row == 0 else "")
    return figure


def _draw_velocity(axis, film, k, colour):
    """Forward speed, as it is and as it was read so far."""
    forward = film.true[:, 0].numpy()
    since_s = STEP_S * np.arange(len(forward))
    read = film.velocity[: k + 1, 0].numpy()
    axis.plot(since_s, forward, color="black", linewidth=1, label="true")
    axis.plot(since_s[: k + 1], read, "o", ms=3, color=colour, label="read from flow")
    axis.legend(loc="upper right", fontsize=7, frameon=False)
    low, high = sorted((0.0, 2 * forward[0] or 0.1))
    axis.set(xlim=(-STEP_S, since_s[-1] + STEP_S), ylim=(low, high), xticks=[0, 0.5, 1])
    axis.set_title("forward speed, m/s, over time, s", fontsize=9)
    axis.tick_params(labelsize=7)


def looped(pictures: list[Image.Image]) -> bytes:
    buffer = io.BytesIO()
    first, *rest = pictures
    how = {"duration": 120, "loop": 0, "quality": 60, "method": 6}
    first.save(buffer, "WEBP", save_all=True, append_images=rest, **how)
    return buffer.getvalue()


if __name__ == "__main__":
    sys.exit(main(study, Config))
