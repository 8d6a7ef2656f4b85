"""The page of the race: the answer in one sentence, the arms beside one another, what the landscape
is like, every design."""

import math
import statistics
from collections.abc import Mapping, Sequence
from typing import Any

import torch

from codesign.report.prose import counted
from scenes.robots.pair import RobotPair
from studies.codesign import couplings
from studies.codesign.design import Space
from studies.codesign.gallery import handed, side_by_side
from studies.codesign.landscape import Landscape
from studies.codesign.race import ENOUGH, Judge, compared
from studies.frame.compare import Interval
from studies.frame.run import Run
from studies.frame.show import Panel, bars, panels, table, tabulate
from studies.frame.sweep import Row, plain

LEAST_DESIGNS = 16  # of which percentiles say something
SPREAD = 1.5  # of the landscape, below which there is nothing to design


def lead(run: Run[Any], space: Space, rows: Sequence[Row], judge: Judge) -> str:
    """The race at the head of the page; returns the answer in one sentence."""
    if not rows:
        return "This run looks at the landscape and races nothing."
    found = compared(rows)
    race(run, plain(space.pair.name), found, rows)
    answers(run, space, rows)
    shown(run, space, found, rows, judge)
    return answer(run, space.pair, found, rows)


def best_order(rows: Sequence[Row]) -> str:
    """The order of blocks whose own errors are least (median over starts of the mean log over
    worlds); of all rivals of joint design where none is an order."""
    arms = dict.fromkeys(row["arm"] for row in rows if row["arm"] != "joint")
    orders = [arm for arm in arms if arm.count(">") == 2]

    def error(arm: str) -> float:
        return statistics.median(
            statistics.fmean(map(math.log, row["errors"])) for row in rows if row["arm"] == arm
        )

    return min(orders or arms, key=error)


def answer(
    run: Run[Any], pair: RobotPair, found: Mapping[str, tuple[Interval, float]], rows: Sequence[Row]
) -> str:
    """What joint design, and nested where it ran, make of the best order of the blocks."""
    size = run.config
    where = f"'{pair.name}', {'full' if size.light == 1 else f'{size.light:g} of'} daylight" + (
        f", {size.speed:g} of the speed" if size.speed != 1 else ""
    )
    where += "".join(f", {each}" for each in size.hold) + ", near starts" * size.near
    if size.seeds < ENOUGH:
        few = "" if size.quick else ", and decides nothing"
        return f"{counted(size.seeds, 'start')} shows that everything works{few} ({where})."
    name = best_order(rows)
    rival = f"the best order of single blocks ({name})" if ">" in name else f"'{name}'"
    said = [f"In {where}, against {rival}:"]
    ways = {"joint": "One descent along all numbers"}
    unseen = "on unseen drives" if pair.one_world else "in unseen worlds"
    if "nested" in found and name != "nested":
        ways["nested"] = "Lens and mount together, with sensor and estimator solved at every step,"
    for arm, way in ways.items():
        over, p = compared(rows, arm)[name]
        said.append(
            f"{way} {over.outcome}: {over.ratio():.2f} times its error {unseen} (p = {p:.2g} after Holm)."
        )
    return " ".join(said)


def race(
    run: Run[Any], pair: str, found: Mapping[str, tuple[Interval, float]], rows: Sequence[Row]
) -> None:
    """The arms beside one another."""
    run.section(
        "The race",
        "Every search began at the same designs and rendered as many drives. Errors are means of q / "
        "(1 + q), q the squared error of the velocities that count in units of 0.05 m/s plus a "
        "tenth of the speed, and 0.15 rad/s, by single events on drives that no arm saw, in worlds that none "
        "saw unless there is one world alone. Sensor and estimator on recorded frames cost nothing. Velocities "
        "are by least squares; columns 'with head' use the delivered velocity head on the same flow.",
    )
    by_head = compared(rows, of="head_errors")
    lines = []
    for arm in run.config.arms:
        of_arm = [row for row in rows if row["arm"] == arm]
        errors, head_errors = (
            torch.tensor([row[kind] for row in of_arm], dtype=torch.float64).mean(1)
            for kind in ("errors", "head_errors")
        )
        line = {
            "arm": arm,
            "median": float(errors.quantile(0.5)),
            "best": float(errors.min()),
            "worst": float(errors.max()),
            "median_with_head": float(head_errors.quantile(0.5)),
            "drives": max(row["drives"] for row in of_arm),
            "cpu_s": sorted(row["cpu_s"] for row in of_arm)[len(of_arm) // 2],
        }
        if arm in found:
            over, p = found[arm]
            ratio = over.ratio()
            line |= {
                "joint_over": ratio.value,
                "low": ratio.low,
                "high": ratio.high,
                "p": p,
                "head_joint_over": math.exp(by_head[arm][0].value),
            }
        lines.append(line)
    tabulate(run, "Errors in unseen worlds", lines, "arm", prefix="race")
    if found:
        every = every_ratio(rows)
        best = best_order(rows)
        named = {plain(arm, "over", other): told for (arm, other), told in every.items()}
        for arm in ("joint", "nested"):
            if (arm, best) in every and ">" in best:
                named[f"{arm}_over_best_order"] = every[arm, best]
        for name, (ratio, p) in named.items():
            ends = {"median": ratio.value, "low95": ratio.low, "high95": ratio.high, "p": p}
            run.record(**{f"{name}_{end}_{pair}": value for end, value in ends.items()})
        arms = ["joint", *found]
        run.table(
            "Error of each arm over that of every other",
            ("arm", *(f"over {other}" for other in arms)),
            [
                (arm, *("" if arm == other else f"{every[arm, other][0]:.2f}" for other in arms))
                for arm in arms
            ],
            "Medians over starts, 95 % of resampled starts and worlds.",
        )
        ratios = {arm: every["joint", arm][0] for arm in found}
        caption = (
            "Error of the joint design over that of each arm: median over starts, 95 % of "
            "resampled starts and worlds."
        )
        run.figure(bars(ratios, "joint / arm", log=True, level=1.0), "ratios", caption)
        trails(run, rows)
        ends = f"{ratios[best].low:.2f} to {ratios[best].high:.2f}: joint {found[best][0].outcome}"
        run.card(f"joint over {best}", f"{ratios[best].value:.2f}", ends)


def every_ratio(rows: Sequence[Row]) -> dict[tuple[str, str], tuple[Interval, float]]:
    """(arm, other) -> the ratio of their errors over paired starts and worlds, and its p after
    Holm over the rivals of the arm."""
    return {
        (arm, other): (over.ratio(), p)
        for arm in dict.fromkeys(row["arm"] for row in rows)
        for other, (over, p) in compared(rows, arm).items()
    }


def answers(run: Run[Any], space: Space, rows: Sequence[Row]) -> None:
    """Where in their bounds the arms end: medians over starts."""
    lines = [
        {
            "arm": arm,
            **{
                name: statistics.median(row[name] for row in rows if row["arm"] == arm)
                for name in space.free
            },
        }
        for arm in run.config.arms
    ]
    tabulate(run, "Where they end", lines, "arm", prefix="ends", caption="Medians over starts.")


def trails(run: Run[Any], rows: Sequence[Row]) -> None:
    """Expected errors on the way, of arms all of whose answers know theirs."""
    series, bands = {}, {}
    for arm in run.config.arms:
        ways = [row.get("trail") for row in rows if row["arm"] == arm]
        if not all(ways) or len({len(way) for way in ways}) > 1:
            continue
        errors = torch.tensor(ways, dtype=torch.float64)
        low, median, high = (errors.quantile(share, 0).tolist() for share in (0.25, 0.5, 0.75))
        drives = [run.config.per_draw * (step + 1) for step in range(len(median))]
        series[arm] = (drives, median)
        bands[arm] = (drives, low, high)
    if series:
        chart = Panel(
            series, "drives rendered", "error expected, with penalty", log="y", bands=bands
        )
        caption = (
            "Errors to be expected of what each arm looks at, on its own drives, with the penalty "
            "of what is required: median over starts, and the middle half."
        )
        run.figure(panels(chart, width=8.0), "trails", caption)


def shown(
    run: Run[Any],
    space: Space,
    found: Mapping[str, tuple[Interval, float]],
    rows: Sequence[Row],
    judge: Judge,
) -> None:
    """Three designs of the start whose joint one expected the median error on its own drives."""
    mean = {(row["seed"], row["arm"]): sum(row["errors"]) / len(row["errors"]) for row in rows}
    ours = sorted((row["expected"], row["seed"]) for row in rows if row["arm"] == "joint")
    seed = ours[(len(ours) - 1) // 2][1]
    others = [best_order(rows), "book", "default"] if found else []
    arms = [arm for arm in dict.fromkeys(["joint", *others]) if (seed, arm) in mean][:3]
    designs = {}
    for row in rows:
        if row["seed"] == seed and row["arm"] in arms:
            whole = space.made(couplings.share(row))
            title = f"{row['arm']}: {mean[seed, row['arm']]:.3f}, {whole}"
            designs[row["arm"]] = title, whole
    run.section(
        "Designs side by side",
        f"Answers from start {seed}, whose joint design expected the median error on its own "
        "drives, with their errors in unseen worlds: lens, robot and view, and an unseen drive as "
        "frame, single events and flow.",
    )
    run.figure(
        side_by_side(judge, dict(designs[arm] for arm in arms)), "designs", "Whole designs.", 110
    )


def hand_over(run: Run[Any], space: Space, judge: Judge, best: Row) -> str:
    """An answer as files; returns the sentence that says which."""
    said = f"the answer of '{best['arm']}' from start {best['seed']}"
    whole = space.made(couplings.share(best))
    handed(run, judge, whole, sum(best["errors"]) / len(best["errors"]), said)
    return f" design.yaml is {said}, with the least expected error: {whole}."


def looked(run: Run[Any], space: Space, gates: Landscape) -> None:
    """What there is to design, before the race."""
    run.section(
        "The landscape",
        "Hard errors of designs spread over the bounds, and along every number through the best.",
    )
    run.record(
        landscape_spread=gates.spread,
        landscape_designs=len(gates.designs),
        blur_span_px_median=statistics.median(row["blur_span_px"] for row in gates.designs),
        blur_span_px_best=gates.best_row["blur_span_px"],
        **{f"calibration_{name}": value for name, value in vars(gates.calibration).items()},
        **{
            f"inside_{plain(name)}": float(gates.inside(name))
            for name in space.free
            if run.config.grid > 2
        },
    )
    told = ""
    if gates.rank is not None and gates.slope is not None:
        run.record(
            rank_of_expected_near_the_best=gates.rank,
            slope_of_hard_over_expected_near_the_best=gates.slope,
        )
        told = (
            f" Expected errors rank {len(gates.judged)} designs near the best, to which nothing "
            f"was fitted, by {gates.rank:.2f} (Spearman); hard ones rise by {gates.slope:.2f} "
            "where they rise by 1."
        )
    enough = "enough to design" if gates.spread >= SPREAD else "too little to design"
    if len(gates.designs) < LEAST_DESIGNS:
        enough = "too few designs to say more"
    walls = [name for name in space.free if not gates.inside(name)]
    at_walls = (
        f" The best lies on a bound of {', '.join(walls)}."
        if walls
        else " The best lies off all bounds."
    )
    if run.config.grid < 3:  # the ends alone
        at_walls = ""
    run.text(
        f"The ninetieth percentile of {len(gates.designs)} designs is {gates.spread:.2f} times the "
        f"tenth: {enough}.{at_walls}{told} Behind the best, blur differs by {gates.best_row['blur_span_px']:.1f} px between the sharpest and "
        "the softest window of a drive (diameters of even discs)."
    )
    if missed := sum(row["hard"] is None for row in gates.grid):
        run.text(
            f"{missed} of {len(gates.grid)} designs of the grid miss a requirement: they were not looked at, and curves leave them "
            "out."
        )
    charts = []
    for name in space.free:
        of = [row for row in gates.grid if row["number_of"] == name and row["hard"] is not None]
        values = [row["value"] for row in of]
        series = {kind: (values, [row[kind] for row in of]) for kind in ("hard", "expected")}
        # a lone design is no curve
        if len(of) > 1:
            charts.append(Panel(series, name, "error"))
    half = (len(charts) + 1) // 2
    for name, part in (("grid_first", charts[:half]), ("grid_last", charts[half:])):
        if part:
            run.figure(
                panels(*part, width=2.6),
                name,
                "Errors along numbers through the best of the designs.",
                110,
            )


def designs(run: Run[Any], space: Space, rows: Sequence[Row]) -> None:
    """Every answer."""
    run.section(
        "Every answer", "What each arm ended with, and whether it kept what is required there."
    )
    titles = {name: name for name in ("seed", "arm", *space.free, "kept")}
    run.table("Designs", *table(rows, **titles))
