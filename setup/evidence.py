"""Run what makes the figures of README and docs, keep them in docs/evidence.json, and write them into the pages.

    make evidence                              parts whose code has changed since (all: an hour on two cores)
    make evidence ARGS="lens-motion hero"      named parts
    make evidence ARGS="--write"               runs nothing: writes the kept figures into the pages
    make evidence ARGS="--again joint-flight"  races two answers of a raw table again: are they the same?

A page names a figure as <!--fig:NAME-->text<!--/-->; the text is what this writes. A part that was
cut is taken up where it stopped (runs/evidence/PART); one that was finished begins anew.

Some parts draw what was run once from a raw table (--raw FILE): their figures are of the code of
the commit that brought the table, and they are drawn again where they are named. --again races the
first start of joint and nested by the present code: where both answers are the table's to six
digits, its figures are of this code too; else they stay old, and it says by how much they differ.

evidence.json: {"schema": 1, "parts": {PART: {"command", "commit", "seconds", "machine", "measured":
{folder: its tree in git}, "figures": {NAME: text}, "pictures": [FILE in docs],
"again": commit whose answers were the same, where it was asked}}}.
"""

import argparse
import json
import math
import re
import shlex
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from codesign.atomic import write_atomic  # noqa: E402

KEPT = ROOT / "docs" / "evidence.json"
RUNS = ROOT / "runs" / "evidence"
MARK = re.compile(r"(<!--fig:([\w.-]+)-->)(.*?)(<!--/-->)", re.S)
SAME = 1e-6  # of answers that are raced again
Metrics = Mapping[str, Any]


@dataclass(frozen=True)
class Part:
    """command: of a study, without --out. measured: folders whose code its figures are of.
    figures: name -> its text from metrics.json. pictures: file in docs -> file of the run.
    sample: command that races some answers of the raw table again."""

    command: str
    measured: tuple[str, ...]
    figures: Mapping[str, Callable[[Metrics], str]] = field(default_factory=dict)
    pictures: Mapping[str, str] = field(default_factory=dict)
    sample: str = ""


def interval(*names: str) -> Callable[[Metrics], str]:
    """A value with its interval."""
    return lambda metrics: "{:.2f} ({:.2f} to {:.2f})".format(*(metrics[name] for name in names))


def ends_of(name: str) -> list[str]:
    """Names of a value and of the ends of its interval."""
    return [name, f"{name}_low", f"{name}_high"]


def ratio(stem: str, pair: str) -> Callable[[Metrics], str]:
    """A median ratio with its interval."""
    return interval(*(f"{stem}_{end}_{pair}" for end in ("median", "low95", "high95")))


def within(
    stem: str, end: str, form: str, of: Callable[[float], float] = float
) -> Callable[[Metrics], str]:
    """The least and the largest of what is made of the metrics whose names begin and end so."""

    def text(metrics: Metrics) -> str:
        names = [name for name in metrics if name.startswith(stem) and name.endswith(end)]
        found = [of(metrics[name]) for name in names]
        return form.format(min(found), max(found))

    return text


def gains(comparison: str) -> Callable[[Metrics], str]:
    """The least and the largest gain over settings, in per cent."""
    return within(
        "", f"as_it_is_{comparison}", "{:.0f} to {:.0f} %", lambda log: 100 * (1 - math.exp(log))
    )


def foretold(arm: str) -> Callable[[Metrics], str]:
    """An arm's error over the joint one as couplings foretell it, and as measured."""
    stem = f"arm_over_joint_{arm}"
    return lambda metrics: "{:.2f}, {:.2f}".format(
        *(metrics[f"{stem}_{name}"] for name in ("at_budget", "measured"))
    )


def control(name: str) -> Callable[[Metrics], str]:
    """Median error of nested under a control, and its ratio to the best order."""
    stem = f"{name}_nested_over_lens_mount_read_out"
    return lambda metrics: "{:.2f}; {:.2f} ({:.2f} to {:.2f})".format(
        metrics[f"control_{name}_nested"],
        *(metrics[f"{stem}{end}"] for end in ("", "_low", "_high")),
    )


ARMS = {
    "joint": "joint",
    "nested": "nested",
    "lens_mount_read_out": "lens > mount > read-out",
    "mount_lens_read_out": "mount > lens > read-out",
    "lens_read_out_mount": "lens > read-out > mount",
    "mount_read_out_lens": "mount > read-out > lens",
    "read_out_lens_mount": "read-out > lens > mount",
    "read_out_mount_lens": "read-out > mount > lens",
    "alternating_4": "alternating, 4 sweeps",
    "alternating_8": "alternating, 8 sweeps",
    "cma_es": "CMA-ES",
    "tpe": "TPE",
    "random": "random",
    "book": "book",
    "default": "default",
    "default_settled": "default, settled",
}
# number of a design -> title and form in a page
ENDS = {
    "efl_mm": ("focal length, mm", "{:.1f}"),
    "fno": ("f-number", "{:.1f}"),
    "focus_per_m": ("focus, per m", "{:.1f}"),
    "x_m": ("forward, m", "{:.2f}"),
    "z_m": ("height, m", "{:.2f}"),
    "pitch_rad": ("pitch, degrees", "{:.0f}"),
    "theta": ("θ", "{:.2f}"),
    "cutoff_hz": ("bandwidth, Hz", "{:.0f}"),
}
RACED = ("codesign", "scenes", "studies/codesign", "studies/placement", "studies/frame")


def joint(pair: str, sizes: str, arms: str) -> Part:
    """The race of whole designs on a robot, from its committed answers."""
    race = f"codesign --pair {pair} --grid 2 --slopes 0 --couplings {{}} --processes 2"
    tables = {f"joint.{pair}.table": raced(pair), f"joint.{pair}.ends": ends} | {
        f"joint.{pair}.{blocks.replace('_', '-')}": coupled(blocks)
        for blocks in ("lens_and_read_out", "mount_and_read_out", "lens_and_mount")
    }
    return Part(
        f"{race.format(3)} --raw docs/joint_race_{pair}.jsonl --seeds 20 {sizes} --arms joint {arms}",
        RACED,
        {
            f"joint.{pair}.{name}": ratio(stem, pair)
            for name, stem in {
                "nested-order": "nested_over_best_order",
                "joint-order": "joint_over_best_order",
                "joint-book": "joint_over_book",
                "joint-default": "joint_over_default",
                "nested-book": "nested_over_book",
                "nested-default": "nested_over_default",
            }.items()
        }
        | {
            f"joint.{pair}.foretold-lens-first": foretold("lens_mount_read_out"),
            f"joint.{pair}.foretold-mount-first": foretold("mount_lens_read_out"),
            f"joint.{pair}.foretold-nested": foretold("nested"),
        }
        | tables,
        {f"joint_race_{pair}.png": "ratios.png", f"joint_designs_{pair}.png": "designs.png"},
        f"{race.format(0)} --seeds 1 {sizes} --arms joint nested",
    )


def coupled(blocks: str) -> Callable[[Metrics], str]:
    """The coupling of two blocks, and what noise alone would give."""

    def text(metrics: Metrics) -> str:
        found, noise = (metrics[f"parts_{blocks}_{name}"] for name in ("coupling", "by_noise"))
        return f"{found:.2f} ({noise:.2f})" + (": none is shown" if found <= noise else "")

    return text


def raced(pair: str) -> Callable[[Metrics], str]:
    """Errors of all arms of a race, the best first, and what nested and joint make of each."""

    def over(metrics: Metrics, ours: str, arm: str) -> str:
        stem = f"{ours}_over_{arm}"
        if ours == arm:
            return ""
        return f"{ratio(stem, pair)(metrics)}, p = {metrics[f'{stem}_p_{pair}']:.2g}"

    def text(metrics: Metrics) -> str:
        arms = sorted(arms_of(metrics), key=lambda arm: metrics[f"race_{arm}_median"])
        return table(
            ("arm", "error", "best, worst start", "with the head")
            + ("nested over it", "joint over it", "CPU-s"),
            [
                (
                    ARMS[arm],
                    f"{metrics[f'race_{arm}_median']:.3f}",
                    f"{metrics[f'race_{arm}_best']:.2f}, {metrics[f'race_{arm}_worst']:.2f}",
                    f"{metrics[f'race_{arm}_median_with_head']:.3f}",
                    over(metrics, "nested", arm),
                    over(metrics, "joint", arm),
                    f"{metrics[f'race_{arm}_cpu_s']:.0f}",
                )
                for arm in arms
            ],
        )

    return text


def ends(metrics: Metrics) -> str:
    """Where in their bounds the arms of a race end."""

    def line(arm: str) -> tuple[str, ...]:
        of = {name: metrics[f"ends_{arm}_{name}"] for name in ENDS}
        of["pitch_rad"] = math.degrees(of["pitch_rad"])
        return ARMS[arm], *(form.format(of[name]) for name, (_, form) in ENDS.items())

    return table(
        ("arm", *(title for title, _ in ENDS.values())), [line(arm) for arm in arms_of(metrics)]
    )


def over_all(metrics: Metrics) -> str:
    """What nested and one descent make of their rivals, on each robot and on all."""
    stem, robots = "nested_over_best_order", ("outdoors", "corridor", "flight")
    robots = [robot for robot in robots if f"{stem}_{robot}" in metrics]
    rows = []
    for way, title in (("nested", "nested"), ("joint", "one descent")):
        for rival, name in {"best_order": "best order", **ARMS}.items():
            stem = f"{way}_over_{rival}"
            if stem in metrics:
                names = [*(f"{stem}_{robot}" for robot in robots), stem]
                ratios = [interval(*ends_of(each))(metrics) for each in names]
                told = f"{metrics[f'{stem}_p']:.2g}", f"{metrics[f'{stem}_ahead']}"
                rows.append((f"{title} over {name}", *ratios, *told))
    return table(("", *robots, "all", "p", "starts ahead"), rows)


def arms_of(metrics: Metrics) -> list[str]:
    """Arms of a race, as metrics name them."""
    return [arm for arm in ARMS if f"race_{arm}_median" in metrics]


def table(titles: tuple[str, ...], rows: list[tuple[str, ...]]) -> str:
    """As pages write it, on lines of its own."""
    lines = [titles, ("---",) * len(titles), *rows]
    return "\n\n" + "\n".join(f"| {' | '.join(line)} |" for line in lines) + "\n\n"


def times(name: str) -> Callable[[Metrics], str]:
    """A rounded factor."""
    return lambda metrics: f"{metrics[name]:.0f}"


def share_of(passed: str, total: str) -> Callable[[Metrics], str]:
    """How many of how many."""
    return lambda metrics: f"{metrics[passed]} of {metrics[total]}"


ORDERS = '"lens > mount > read-out" "mount > lens > read-out"'
PARTS = {
    "chain": Part(
        "chain_picture",
        ("codesign", "scenes", "studies/chain_picture"),
        pictures={"chain.png": "chain.png"}
        | {
            f"gallery/{made}": made
            for made in (
                *("lens_edge_energy.png", "events_decay.webp", "events_sigmoid.png"),
                *("events_filtered.png", "events_smoothing.png", "events_thresholds.png"),
                "flow_overlay.png",
            )
        },
    ),
    "hero": Part(
        "hero",
        (*RACED, "studies/hero.py"),
        pictures={"hero.webp": "hero.webp"},
    ),
    "gallery-lens": Part(
        "lens_opt --quick",
        ("codesign", "scenes", "studies/lens_opt"),
        pictures={
            f"gallery/lens_{name}.png": f"{made}.png"
            for name, made in {
                "frames_and_events": "frames_and_events",
                "designs": "design_curves",
                "layout": "lens_layout",
            }.items()
        },
    ),
    "gallery-events": Part(
        "spike_esim --quick",
        ("codesign/events", "studies/spike_esim"),
        pictures={
            f"gallery/events_{name}.png": f"unseen_motion_{name}.png"
            for name in ("rates", "patches", "pictures")
        },
    ),
    "gallery-flow": Part(
        "train_flow --quick",
        ("codesign/flow", "codesign/train", "studies/train_flow"),
        pictures={
            "gallery/flow_training.png": "curves.png",
            "gallery/flow_fields.png": "flows.png",
        },
    ),
    "stability": Part(
        "stability",
        ("codesign", "studies/stability"),
        {"stability.cells": share_of("cells_passed", "cells_total")},
        {"stability.png": "matrix.png"},
    ),
    "gradients": Part(
        "gradient_flow --cases scenes --draws 8 --film-samples 128 --directions 1",
        ("codesign", "scenes", "studies/gradient_flow"),
        {
            "gradients.judged": share_of("judged_scenes", "rows_scenes"),
            "gradients.wrong": lambda metrics: f"{metrics['missed_scenes'] or 'none'}",
        },
    ),
    "select": Part(
        "speed_error --stages select",
        ("codesign", "scenes", "studies/speed_error/select.py"),
        {
            "select.faster": within("select_", "_faster", "{:.1f} to {:.1f}"),
            "select.holds": times("picks_that_hold"),
            "select.over-best": within("select_", "_over_best", "{:.2f} to {:.2f}"),
        },
    ),
    "tracing": Part(
        "speed_error --stages lens",
        ("codesign/lens", "studies/speed_error/lens.py"),
        {
            f"tracing.{precision}.{kind}": times(
                f"{precision}_{kind}_optiland_with_torch_time_over_ours"
            )
            for precision in ("float32", "float64")
            for kind in ("forward", "forward_backward")
        },
    ),
    "lens-motion": Part(
        "lens_motion --raw docs/lens_motion.csv",
        ("codesign", "scenes", "studies/lens_motion"),
        {"lens-motion.spots": gains("mtf_along_spots")},
        {"lens_motion.png": "lens_motion.png"},
    ),
    "joint-outdoors": joint(
        "outdoors", "--designs 2", f'{ORDERS} book "alternating 4" CMA-ES default nested'
    ),
    "joint-corridor": joint("corridor", "--designs 64", f"{ORDERS} book nested default"),
    "joint-flight": joint("flight", "--designs 64", f"{ORDERS} book nested default"),
    "joint-arms": Part(
        "codesign --grid 2 --slopes 0 --couplings 0 --designs 2 --seeds 6 --raw docs/joint_race_arms.jsonl",
        RACED,
        {"joint.arms.table": raced("outdoors")},
    ),
    "joint-answer": Part(
        "joint_answer",
        ("studies/joint_answer.py", "studies/frame", "studies/codesign"),
        {"joint.all.table": over_all}
        | {
            f"joint.all.{way}-{name}": interval(*ends_of(f"{way}_over_{rival}"))
            for way in ("nested", "joint")
            for name, rival in (("order", "best_order"), ("book", "book"), ("default", "default"))
        },
        {"joint_answer.png": "all.png"},
    ),
    "joint-orders": Part(
        "joint_answer --raw docs/joint_race_arms.jsonl docs/joint_race_orders.jsonl",
        ("studies/joint_answer.py", "studies/frame", "studies/codesign"),
        {"joint.orders.table": over_all}
        | {
            f"joint.orders.{way}-{robot}": interval(*ends_of(f"{way}_over_best_order_{robot}"))
            for way in ("nested", "joint")
            for robot in ("outdoors", "corridor")
        },
    ),
    "joint-levers": Part(
        "joint_levers --processes 2",
        (*RACED, "studies/joint_levers.py"),
        {
            f"joint.levers.{part}": interval(*ends_of(f"share_{part}"))
            for part in ("lens", "mount", "sensor", "estimator")
        },
        {"joint_levers.png": "shares.png"},
    ),
    "joint-controls": Part(
        'joint_controls --arms nested "lens > mount > read-out"',
        (*RACED, "studies/joint_controls.py"),
        {
            f"joint.controls.{name.replace('_', '-')}": control(name)
            for name in (
                *("as_designed", "made_and_mounted_with_errors", "thresholds_a_tenth_higher"),
                *("without_blur", "order_of_events_lost", "no_contrast"),
            )
        },
    ),
}


def kept() -> dict[str, Any]:
    """What docs/evidence.json has."""
    return json.loads(KEPT.read_text(encoding="utf-8"))["parts"] if KEPT.exists() else {}


def trees(folders: tuple[str, ...], commit: str = "HEAD") -> dict[str, str]:
    """The tree that git has of each folder or file at a commit."""
    return {folder: _git("rev-parse", f"{commit}:{folder}") for folder in folders}


def run_at(command: str) -> str:
    """The commit whose code made the figures of a command: that of its raw table, or the present
    one."""
    words = shlex.split(command)
    if "--raw" not in words:
        return "HEAD"
    return _git("log", "-1", "--format=%H", "--", words[words.index("--raw") + 1])


def _git(*words: str) -> str:
    return subprocess.run(["git", *words], cwd=ROOT, capture_output=True, text=True).stdout.strip()


def stale(part: Mapping[str, Any]) -> list[str]:
    """Folders whose code has changed since the figures of what is kept of a part."""
    now = trees(tuple(part["measured"]))
    return [folder for folder, tree in part["measured"].items() if now[folder] != tree]


def run(command: str, folder: Path) -> None:
    """Run a study into a folder, or go on with it."""
    words = shlex.split(command)
    if (folder / "report.html").exists():
        shutil.rmtree(folder)
    begun = (folder / "config.json").exists()
    # what a run was begun with and what is asked now have to be the same
    more = [*words[1:], "--resume" if begun else "--out", str(folder)]
    subprocess.run([sys.executable, "-m", f"studies.{words[0]}", *more], cwd=ROOT, check=True)


def raced_again(name: str, part: dict[str, Any]) -> dict[str, Any]:
    """What is kept of a part, of this code too where it races the same answers."""
    folder = RUNS / f"{name}-again"
    run(PARTS[name].sample, folder)
    words = shlex.split(PARTS[name].command)
    known = answers_of(ROOT / words[words.index("--raw") + 1])
    now = answers_of(folder / "answers.jsonl")
    apart = max(abs(a - b) for row in now for a, b in zip(now[row], known[row], strict=True))
    print(f"{name}: {len(now)} answers raced again, at most {apart:.1g} apart")
    if apart > SAME:
        return part
    at = trees(tuple(part["measured"]))
    return {**part, "measured": at, "again": _git("rev-parse", "HEAD")}


def answers_of(table: Path) -> dict[tuple[int, str], list[float]]:
    """Design and errors in unseen worlds of every answer of a table, by start and arm."""
    rows = [json.loads(line) for line in table.read_text(encoding="utf-8").splitlines()]
    return {(at["seed"], at["arm"]): [*row["share"], *row["errors"]] for at, (row, *_) in rows}


def measured(name: str) -> dict[str, Any]:
    """Run a part, or go on with it, and give what is kept of it."""
    part, folder = PARTS[name], RUNS / name
    since = time.monotonic()
    run(part.command, folder)
    for picture, made in part.pictures.items():
        (ROOT / "docs" / picture).parent.mkdir(exist_ok=True)
        write_atomic(ROOT / "docs" / picture, (folder / made).read_bytes())
    metrics = json.loads((folder / "metrics.json").read_text(encoding="utf-8"))
    return {
        "command": f"python -m studies.{part.command}",
        "commit": metrics["versions"]["commit"],
        "seconds": round(time.monotonic() - since),
        "machine": f"{metrics['hardware']['cpu']}, {metrics['hardware']['cores']} cores",
        "measured": trees(part.measured, run_at(part.command)),
        "figures": {figure: text(metrics) for figure, text in part.figures.items()},
        "pictures": list(part.pictures),
    }


def pages() -> list[Path]:
    """Those that may name figures."""
    return [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]


def written(text: str, figures: Mapping[str, str]) -> str:
    """A page with its figures as they are kept.

    Raises: KeyError for a figure that no part has.

    >>> written("gains <!--fig:a-->?<!--/--> less", {"a": "16 %"})
    'gains <!--fig:a-->16 %<!--/--> less'
    """
    return MARK.sub(lambda found: found[1] + figures[found[2]] + found[4], text)


def main(arguments: list[str] | None = None) -> int:
    """Returns the exit code."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "parts", nargs="*", metavar="PART", help=f"of {', '.join(PARTS)}; else those that are old"
    )
    parser.add_argument("--write", action="store_true", help="run nothing")
    parser.add_argument("--again", action="store_true", help="race two answers of each again")
    asked = parser.parse_args(arguments)
    choice = [name for name, part in PARTS.items() if part.sample or not asked.again]
    unknown = [name for name in asked.parts if name not in choice]
    if unknown:
        print(f"error: {unknown[0]} is no part; choose from {', '.join(choice)}.", file=sys.stderr)
        return 2
    known = kept()
    old = [
        name
        for name, part in PARTS.items()
        if name not in known or (stale(known[name]) and "--raw" not in part.command)
    ]
    for name in [] if asked.write else asked.parts or (choice if asked.again else old):
        known[name] = raced_again(name, known[name]) if asked.again else measured(name)
        text = json.dumps({"schema": 1, "parts": known}, indent=1, ensure_ascii=False)
        write_atomic(KEPT, f"{text}\n".encode())
    figures = {name: text for part in known.values() for name, text in part["figures"].items()}
    for page in pages():
        before = page.read_text(encoding="utf-8")
        if missing := {name for _, name, *_ in MARK.findall(before)} - set(figures):
            print(f"error: {page.name} names {min(missing)}, not measured yet.", file=sys.stderr)
            return 2
        if (after := written(before, figures)) != before:
            write_atomic(page, after.encode())
            print(f"{page.relative_to(ROOT)}: figures written")
    for name, part in known.items():
        for folder in stale(part):
            print(f"{name}: {folder} has changed since {part['commit'][:8]}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
