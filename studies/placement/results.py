"""What a placement found: metrics, raw table, hand-over and page."""

import csv
import io
import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from codesign import grad, place, task
from codesign.atomic import write_atomic
from codesign.place.ranges import NAMES
from codesign.report.mount_sphere import mount_sphere
from codesign.system import HandOver, load_hand_over, save_hand_over
from scenes import robot_pair
from studies.frame.run import Run
from studies.placement import figures
from studies.placement.controls import cheat, controls
from studies.placement.problem import Problem
from studies.placement.race import GRADIENT, GRID, Race, chosen, feasible

RESAMPLED = 4000
INTERVAL = 0.9
INSIDE = 1 - 1e-9  # of a box that a mount approaches by a hyperbolic tangent


@dataclass(frozen=True)
class Paired:
    """Ratio of errors, ours over theirs, over paired starts: median and interval of resampled starts; how many below 1."""

    median: float
    low: float
    high: float
    ahead: int
    count: int

    def __str__(self):
        if self.count == 1:
            return f"{self.median:.2f}, one start"
        return f"{self.median:.2f} ({self.low:.2f} to {self.high:.2f}), ahead {self.ahead} of {self.count}"


def paired(ours: Tensor, theirs: Tensor) -> Paired:
    """Of errors [seeds] each."""
    ratio = ours / theirs
    drawn = torch.randint(len(ratio), (RESAMPLED, len(ratio)), generator=torch.Generator().manual_seed(0))
    ends = torch.tensor([(1 - INTERVAL) / 2, (1 + INTERVAL) / 2], dtype=ratio.dtype)
    low, high = torch.quantile(ratio[drawn].quantile(0.5, 1), ends).tolist()
    return Paired(float(ratio.quantile(0.5)), low, high, int((ratio < 1).sum()), len(ratio))


def over_worlds(ours: Tensor, theirs: Tensor, worlds: int) -> tuple[float, float, float]:
    """Ratio of mean errors [N], world after world, ours over theirs; and its interval over resampled worlds."""
    means = torch.stack([ours, theirs]).unflatten(1, (worlds, -1)).mean(2)
    drawn = torch.randint(worlds, (RESAMPLED, worlds), generator=torch.Generator().manual_seed(0))
    ratio = means[:, drawn].mean(2)
    ends = torch.tensor([(1 - INTERVAL) / 2, (1 + INTERVAL) / 2], dtype=ratio.dtype)
    low, high = torch.quantile(ratio[0] / ratio[1], ends).tolist()
    return float(means[0].mean() / means[1].mean()), low, high


def report(
    run: Run[Any],
    race: Race,
    unseen: Problem,
    starts: list[Tensor],
    judged: dict[tuple[int, str], Tensor],
    ways: dict[str, grad.Choice],
) -> None:
    """Metrics, raw table, hand-over and page."""
    size = run.config
    problem = race.problem
    names = [GRADIENT, *size.searches]
    errors = {
        name: torch.stack([judged[k, name].mean() for k in range(len(starts))]) for name in ["start", *names]
    }
    default = float(judged[0, "default"].mean())
    best = chosen(race, len(starts))
    share = race.answer(best, GRADIENT)
    mount = problem.ranges.pose(share)
    rivals = {name: paired(errors[GRADIENT], errors[name]) for name in size.searches}
    write_table(run, race, judged)
    run.record(
        default_error=default,
        samples_per_search=race.samples(0, GRADIENT),
        samples_judged=unseen.samples,
        chosen_start=best,
        seeds=len(starts),
        seconds=run.seconds,
        **{f"{label(name)}_median_error": values.quantile(0.5) for name, values in errors.items()},
    )
    for name, beside in rivals.items():
        run.record(
            **{
                f"over_{label(name)}_median": beside.median,
                f"over_{label(name)}_low90": beside.low,
                f"over_{label(name)}_high90": beside.high,
                f"over_{label(name)}_ahead": beside.ahead,
            }
        )
    for name, way in ways.items():
        if size.certified:
            run.record(
                **{
                    f"gradient_{name}_relative_l2": way.relative_l2,
                    f"gradient_{name}_cosine": way.cosine,
                    f"gradient_{name}_differences_noise": way.noise,
                    f"gradient_{name}_calls": way.calls,
                }
            )
    better = float(errors[GRADIENT][best]) < default
    said = "belongs at" if better else "is no better off than at its default mount at"
    found = over_worlds(judged[best, GRADIENT], judged[0, "default"], size.judged_worlds)
    ratio = f"{found[0]:.2f}"
    if size.judged_worlds > 1:
        ratio += f" ({found[1]:.2f} to {found[2]:.2f}, {INTERVAL:.0%} of resampled worlds)"
    answer = (
        f"The camera of '{problem.pair.name}' {said} {place_in_words(problem, share)}: its error there is {ratio} times that "
        f"at its default mount, {float(errors[GRADIENT][best]):.3f} against {default:.3f} on {unseen.samples} unseen samples "
        "with single events."
    )
    run.record(over_default=found[0], over_default_low90=found[1], over_default_high90=found[2])
    run.card(
        "error of the mount found", f"{float(errors[GRADIENT][best]):.3f}", f"default mount: {default:.3f}"
    )
    for name, beside in rivals.items():
        run.card(
            f"gradient over {name}", f"{beside.median:.2f}", f"ahead {beside.ahead} of {beside.count} starts"
        )
    ranked(run, race, errors, rivals, judged, ways)
    seen(run, problem, unseen, mount, share)
    handed(run, problem, unseen, mount, judged[best, GRADIENT])
    run.finish("Where to mount the camera", answer)


def label(name: str) -> str:
    """A name among metrics."""
    return name.lower().replace("-", "_").replace(" ", "_")


def place_in_words(problem: Problem, share: Tensor) -> str:
    """Position and attitude of a mount."""
    x, y, z, yaw, pitch, roll = problem.ranges.numbers(share).tolist()
    turned = ", ".join(
        f"{name} {math.degrees(angle):+.0f}°"
        for name, angle in (("yaw", yaw), ("pitch", pitch), ("roll", roll))
    )
    return f"({x:.2f}, {y:.2f}, {z:.2f}) m, {turned}"


def write_table(run: Run[Any], race: Race, judged: dict[tuple[int, str], Tensor]) -> None:
    """race.csv: every answer with its mount, what it rendered and its error."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    names = list(NAMES)
    writer.writerow(["pair", "seed", "search", *names, "samples", "error", "standard_error"])
    for (number, name), errors in sorted(judged.items()):
        if name in ("default", "start"):
            share = race.problem.start if name == "default" else race.trail(number, GRADIENT).share[0]
            samples = 0
        else:
            share, samples = race.answer(number, name), race.samples(number, name)
        row = [f"{value:.5f}" for value in race.problem.ranges.numbers(share).tolist()]
        deviation = standard_error(errors, run.config.judged_worlds)
        writer.writerow(
            [
                race.problem.pair.name,
                run.config.seed + number,
                name,
                *row,
                samples,
                f"{float(errors.mean()):.5f}",
                f"{deviation:.5f}",
            ]
        )
    write_atomic(run.path("race.csv"), text.getvalue().encode())


def standard_error(errors: Tensor, worlds: int) -> float:
    """Of the mean of errors [N], world after world: of the worlds' means, since drives in one world err alike; of one
    world's drives where there is one."""
    means = errors.unflatten(0, (worlds, -1)).mean(1) if worlds > 1 else errors
    return float(means.std() / math.sqrt(len(means))) if len(means) > 1 else 0.0


def ranked(
    run: Run[Any],
    race: Race,
    errors: dict[str, Tensor],
    rivals: dict[str, Paired],
    judged: dict[tuple[int, str], Tensor],
    ways: dict[str, grad.Choice],
) -> None:
    """The searches beside one another."""
    run.section(
        "Searches at equal renders",
        f"Every search began at the same {len(errors['start'])} mounts and rendered {race.samples(0, GRADIENT)} samples; "
        "errors are means of q / (1 + q), q the squared error of the velocities that count in units of 0.05 m/s plus a "
        "tenth of the speed, and 0.15 rad/s, with single events in worlds and drives that no search saw (a world from a file is the same for all). In brackets: "
        f"{INTERVAL:.0%} of resampled starts.",
    )
    rows: list[list[Any]] = []
    for name, values in errors.items():
        over = str(rivals[name]) if name in rivals else None
        rows.append([name, float(values.quantile(0.5)), float(values.min()), float(values.max()), over])
    if (0, GRID) in judged:
        grid = float(judged[0, GRID].mean())
        within = int((errors[GRADIENT] <= 1.02 * grid).sum())
        share = race.samples(0, GRADIENT) / race.samples(0, GRID)
        rows.append([f"grid, {race.samples(0, GRID)} samples", grid, grid, grid, None])
        run.record(
            grid_error=grid, starts_within_2_percent_of_grid=within, renders_of_gradient_over_grid=share
        )
        run.text(
            f"{within} of {len(errors[GRADIENT])} descents end within 2 % of the best of the refined grid, with {share:.3f} "
            "of its renders."
        )
    rows.append(["default mount", float(judged[0, "default"].mean()), None, None, None])
    if run.config.certified:
        run.text(
            "The gradient beside differences over a quarter of the bounds: "
            + "; ".join(f"{name} by {way}" for name, way in ways.items())
            + "."
        )
    run.table("Errors on unseen samples", ("search", "median", "best", "worst", "gradient over it"), rows)
    trails = {
        name: [race.trail(number, name) for number in range(len(errors["start"]))]
        for name in errors
        if name != "start"
    }
    if (0, GRID) in judged:
        trails[GRID] = [race.trail(0, GRID)]
    run.figure(
        figures.ways(race.problem, trails),
        "ways",
        "Left: what the searches saw of their own objective, best so far (the gradient's is the error to be expected, which "
        "is larger). Right: the map, every mount that a search without gradient looked at with its error, and the ways of the descents.",
    )


def seen(run: Run[Any], problem: Problem, unseen: Problem, mount: Tensor, share: Tensor) -> None:
    """The robot with its camera before and after, what it sees, what it is blind to, and controls."""
    size = run.config
    run.section("Before and after")
    run.figure(
        figures.before_and_after(unseen, mount),
        "before_and_after",
        "The robot with its default mount (above) and the one found (below): frame of an unseen drive with the windows read, "
        "events of the hard sensor in them, flow.",
    )
    verdicts = place.judge(problem.requirements, mount, problem.camera)
    run.text("Requirements: " + "; ".join(map(str, verdicts)) + ".")
    planar = problem.pair.axes
    depth = task.ground_depth
    x, y, z = problem.ranges.numbers(share)[:3].tolist()
    T_world_body = torch.eye(4, dtype=torch.float64)
    T_world_body[2, 3] = problem.pair.drive(0, 12)[0][:, robot_pair.FRAMES // 2, 2, 3].mean()
    around = task.Surroundings((x, y, z), T_world_body, axes=planar, depth=depth)
    height = z + float(T_world_body[2, 3])
    if height > 0.05:
        information, _ = around.information(problem.camera, mount)
        sight = place.sight(information, task.sight_units(around), planar)
        run.text(
            f"{height:.2f} m over flat ground the motion that shows least from there is {sight.weakest_named()} (in units of 0.1 m/s and 0.1 "
            f"rad/s, deviation {sight.weakest_deviation:.2f}); blind to: {', '.join(sight.blind()) or 'nothing'}."
        )
        yaw, pitch, errors = task.sight_map(problem.camera, around, rows=9, columns=18)
        now = place.yaw_pitch_roll_rad(mount).tolist()
        run.figure(
            mount_sphere(yaw, pitch, errors, "expected error, units", {"found": (now[0], now[1])}),
            "sight",
            "What the place allows: the error that flow over flat ground lets expect, over all directions the camera may look "
            "in (27 points of 5 px/s).",
        )
    samples = unseen.draw(0)
    found = controls(unseen, mount, samples)
    run.section(
        "Controls",
        "Single events in unseen worlds. Errors of an answer that is always zero, of a camera that sees nothing move, and of "
        "one that looks at its own robot should be alike.",
    )
    run.table(
        "What is left",
        ("control", "mean bounded error"),
        [[k.replace("_", " "), v] for k, v in found.items()],
    )
    run.record(**{f"control_{name}_error": value for name, value in found.items()})
    mounts = torch.stack(feasible(problem, 4 if size.seeds == 1 else 12, size.seed + 500))
    pairs = torch.tensor(
        cheat(problem, torch.cat([mounts, share[None]]), problem.draw(0)), dtype=torch.float64
    )
    least = int(pairs[:, 0].argmin())
    run.record(
        cheat_least_pixel_error_px=pairs[least, 0],
        cheat_error_of_that_mount=pairs[least, 1],
        cheat_best_error=pairs[:, 1].min(),
        cheat_pixel_error_of_answer_px=pairs[-1, 0],
    )
    cheats = least != int(pairs[:, 1].argmin())
    run.text(
        f"An objective in pixels {'would cheat' if cheats else 'chose well this time'}: of {len(pairs)} mounts the one with the least error of flow "
        f"({float(pairs[least, 0]):.2f} px) has a velocity error of {float(pairs[least, 1]):.3f}, the best has "
        f"{float(pairs[:, 1].min()):.3f}. Flow is smallest, and its errors with it, where everything is far away and says "
        "little of the way the robot goes."
    )


def handed(run: Run[Any], problem: Problem, unseen: Problem, pose: Tensor, errors: Tensor) -> None:
    """Write the mount, read it back, and see that it has the same score."""
    low, high = problem.ranges.low[:3], problem.ranges.high[:3]
    yaw, pitch, roll = place.yaw_pitch_roll_rad(pose).tolist()
    half = (high - low) / 2
    middle = (low + high) / 2
    inside = torch.where(half > 0, (pose[:3, 3] - middle).clamp(-INSIDE * half, INSIDE * half), 0.0)
    mount = place.Mount(middle, half, yaw_rad=yaw, pitch_rad=pitch, roll_rad=roll, position_m=middle + inside)
    path = run.path("mount.yaml")
    notes = {
        "pair": problem.pair.name,
        "error_unseen": float(errors.mean()),
    }
    handed_over = HandOver(
        mount, problem.camera, robot_pair.SENSOR, problem.pair.frame, "camera_optical_frame", notes
    )
    save_hand_over(path, handed_over)
    back = load_hand_over(path)
    again = unseen.judged(back.mount().detach(), unseen.draw(0), "sensor").bounded()
    run.record(hand_over_score_again=again.mean(), hand_over_score=errors.mean())
    run.section(
        "Hand-over",
        f"`mount.yaml` has the transform, lens, camera and sensor; read back it scores {float(again.mean()):.4f} where the "
        f"search's mount had {float(errors.mean()):.4f}.",
    )
