"""The page of a placement: the answer in one sentence, searches beside one another, the robot
before and after, what its place is blind to, controls, and the mount handed over."""

import math
from typing import Any

from torch import Tensor

from codesign.atomic import write_atomic
from codesign.mount import VelocityErrors
from codesign.report.prose import counted
from codesign.system import HandOver, load_hand_over, save_hand_over
from scenes.robots import pair as robot_pair
from studies.frame.run import Run
from studies.placement import figures
from studies.placement.controls import controls
from studies.placement.look import told_requirements, what_it_tells
from studies.placement.outcome import INTERVAL, LEAST_UNITS, Outcome
from studies.placement.problem import Problem
from studies.placement.race import DEFAULT, GRADIENT


def report(run: Run[Any], outcome: Outcome) -> None:
    write_atomic(run.path("race.csv"), outcome.table().encode())
    run.record(**outcome.metrics())
    run.card(
        "error of the answer",
        f"{outcome.error:.3f}",
        f"found by {outcome.found_by}; default mount: {outcome.default_error:.3f}",
    )
    for name, beside in outcome.rivals.items():
        run.card(
            f"gradient over {name}",
            f"{beside.median:.2f}",
            f"ahead {beside.ahead} of {counted(beside.count, 'start')}",
        )
    searches(run, outcome)
    seen(run, outcome)
    velocities(run, outcome, handed(run, outcome))
    left(run, outcome)
    run.record(seconds=run.seconds)
    run.finish("Where to mount the camera", answer(outcome))


def answer(outcome: Outcome) -> str:
    """In one sentence."""
    name = outcome.race.problem.pair.name
    where = place_in_words(outcome.race.problem, outcome.share)
    unseen = f"{outcome.unseen.samples} unseen samples with single events"
    beside = f"{outcome.error:.3f} against {outcome.default_error:.3f} on {unseen}."
    if outcome.best[1] == DEFAULT:
        places = outcome.starts * (1 + len(outcome.rivals))
        none = f"none of {places} places found is" if places > 1 else "the one place found is not"
        return (
            f"The camera of '{name}' stays at its default mount, {where}: on training drives "
            f"{none} better (error {outcome.default_error:.3f} on unseen samples with single "
            "events)."
        )
    if outcome.error >= outcome.default_error:
        return (
            f"The place found for the camera of '{name}' by {outcome.found_by}, {where}, is no "
            f"better than its default mount: {beside}"
        )
    ratio, low, high = outcome.over_default
    unit, of = ("group", " of drives") if outcome.unseen.pair.one_world else ("world", "")
    sure = outcome.groups >= LEAST_UNITS
    interval = (
        f" ({low:.2f} to {high:.2f}, {INTERVAL:.0%} of resampled {unit}s{of})"
        if sure
        else f" (of {counted(outcome.groups, unit)}, too few to decide)"
    )
    sits = "belongs at" if sure and high < 1 else "may be better off at"
    return (
        f"The camera of '{name}' {sits} {where}, found by {outcome.found_by}: its error there is "
        f"{ratio:.2f}{interval} times that at its default mount, {beside}"
    )


def place_in_words(problem: Problem, share: Tensor) -> str:
    x, y, z, yaw, pitch, roll = problem.ranges.numbers(share).tolist()
    turned = ", ".join(
        f"{name} {round(math.degrees(angle)):+d}°".replace("-", "−")
        for name, angle in (("yaw", yaw), ("pitch", pitch), ("roll", roll))
    )
    return f"({x:.2f}, {y:.2f}, {z:.2f}) m, {turned}"


def searches(run: Run[Any], outcome: Outcome) -> None:
    race = outcome.race
    samples = race.samples(0, GRADIENT)
    begun = f"{outcome.starts} mounts" if outcome.starts > 1 else "mount"
    resampled = f" In brackets: {INTERVAL:.0%} of resampled starts."
    told = "drives through the one world" if outcome.unseen.pair.one_world else "worlds and drives"
    run.section(
        "Searches at equal renders",
        f"Every search began at the same {begun} and rendered {samples} samples; errors are means "
        "of q / (1 + q), q the squared error of the velocities that count in units of 0.05 m/s "
        f"plus a tenth of the speed, and 0.15 rad/s, with single events in {told} that no search "
        f"saw.{resampled if outcome.starts >= LEAST_UNITS else ''}",
    )
    rows: list[list[Any]] = []
    for name, values in outcome.errors.items():
        over = str(outcome.rivals[name]) if name in outcome.rivals else None
        rows.append(
            [name, float(values.quantile(0.5)), float(values.min()), float(values.max()), over]
        )
    rows.append(["default mount", outcome.default_error, None, None, None])
    run.table(
        "Errors on unseen samples", ("search", "median", "best", "worst", "gradient over it"), rows
    )
    trails = {
        name: [race.trail(number, name) for number in range(outcome.starts)]
        for name in (GRADIENT, *outcome.rivals)
    }
    run.figure(
        figures.ways(race.problem, trails, outcome.errors, samples),
        "ways",
        "Left: errors on unseen samples at the start and the end, median over starts (thin: each "
        "start); dashed the least that searches without gradient have seen of the errors of their "
        "own drives. Right: the map, every mount that these looked at with its error, and the "
        "ways of the descents.",
    )


def seen(run: Run[Any], outcome: Outcome) -> None:
    """The robot with its camera before and after, what it sees, and what it is blind to."""
    unseen, mount = outcome.unseen, outcome.pose
    run.section("Before and after")
    run.figure(
        figures.before_and_after(unseen, mount),
        "before_and_after",
        "The robot with its default mount (above) and that of the answer (below): frame of an "
        "unseen drive with the windows read, events of the hard sensor in them, flow.",
    )
    told_requirements(run, unseen.requirements, mount, unseen.camera)
    what_it_tells(run, unseen.pair, unseen.camera, mount, "answer")


def left(run: Run[Any], outcome: Outcome) -> None:
    unseen, mount = outcome.unseen, outcome.pose
    found = controls(unseen, mount, unseen.draw(0))
    run.section(
        "Controls",
        "Single events on unseen samples. Errors of an answer that is always zero, of a camera "
        "that sees nothing move, and of one that looks at its own robot should be alike.",
    )
    rows = [(name.replace("_", " "), value) for name, value in found.items()]
    run.table("What is left", ("control", "mean bounded error"), rows)
    run.record(**{f"control_{name}_error": value for name, value in found.items()})


def handed(run: Run[Any], outcome: Outcome) -> VelocityErrors:
    """Write the mount, read it back, and see that it has the same score; returns its errors."""
    unseen, pose = outcome.unseen, outcome.pose
    mount = robot_pair.mount_at(unseen.ranges, pose)
    path = run.path("mount.yaml")
    notes = {
        "pair": unseen.pair.name,
        "found_by": outcome.found_by,
        "error_unseen": outcome.error,
        "error_unseen_default": outcome.default_error,
    }
    handed_over = HandOver(
        mount, unseen.camera, robot_pair.SENSOR, unseen.pair.frame, "camera_optical_frame", notes
    )
    save_hand_over(path, handed_over)
    back = load_hand_over(path)
    unseen.camera = back.camera
    found = unseen.judged(back.mount().detach(), unseen.draw(0), "sensor")
    unseen.camera = unseen.real
    again = found.bounded().mean()
    run.record(hand_over_score_again=again, hand_over_score=outcome.error)
    run.section(
        "Hand-over",
        "`mount.yaml` has the transform, lens, camera and sensor; read back it scores "
        f"{float(again):.4f} where the answer had {outcome.error:.4f}.",
    )
    return found


def velocities(run: Run[Any], outcome: Outcome, found: VelocityErrors) -> None:
    unseen = outcome.unseen
    default = unseen.judged(unseen.ranges.pose(unseen.start), unseen.draw(0), "sensor")
    rows: list[list[Any]] = []
    for (name, before), after in zip(default.table().items(), found.table().values(), strict=True):
        unit = "m_s" if "p50_m_s" in before else "rad_s"
        kinds = [f"p50_{unit}", f"p90_{unit}", "median_over_speed"]
        rows.append(
            [
                f"{name}, {unit.replace('_', '/')}",
                *(each.get(kind) for kind in kinds for each in (before, after)),
            ]
        )
        for kind in kinds[:2]:
            run.record(**{f"{name.replace(' ', '_')}_error_{kind}": after[kind]})
    heads = [
        f"{kind}, {who}"
        for kind in ("median", "nine tenths below", "median over speed")
        for who in ("default", "answer")
    ]
    run.section(
        "Errors of the velocities",
        "Sizes of errors on unseen samples with single events, all speeds together.",
    )
    run.table("Errors in their own units", ("velocity", *heads), rows)
