"""What is measured for README and docs: parts of a study each, and how the texts of figures are made
of its metrics.json."""

import math
import shlex
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

Metrics = Mapping[str, Any]


@dataclass(frozen=True)
class Part:
    """command: of a study, without --out. measured: folders whose code its figures are of.
    figures: name -> its text from metrics.json. pictures: file in docs -> file of the run.
    table: file in docs that keeps its answers. sample: command that finds some of them again."""

    command: str
    measured: tuple[str, ...]
    figures: Mapping[str, Callable[[Metrics], str]] = field(default_factory=dict)
    pictures: Mapping[str, str] = field(default_factory=dict)
    table: str = ""
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
ORDERS = tuple(arm for arm in ARMS.values() if arm.count(">") == 2)
# in names of figures -> in those of metrics
RIVALS = {"order": "best_order", "lens-first": "lens_mount_read_out"} | {
    name: name for name in ("book", "default")
}
# rooms that draw, choose levels, train networks or talk to the user: no figure of a race is of them
BESIDE = ("__init__.py", "__main__.py", "__pycache__", "doctor.py", "fidelity", "report", "train")
ROOMS = sorted(
    f"codesign/{path.name}"
    for path in (Path(__file__).resolve().parents[1] / "codesign").iterdir()
    if path.name not in BESIDE
)
RACED = (*ROOMS, "scenes", "studies/codesign", "studies/placement", "studies/frame")


def joint(pair: str, sizes: str, more: str = "") -> dict[str, Part]:
    """The race of whole designs on a robot, from its committed answers, and what pulls at what
    around the best of them."""
    race = f"codesign --pair {pair} --grid 2 --slopes 0 --couplings {{}} --processes 2"
    again = f"--raw docs/joint_race_{pair}.jsonl --seeds 20 {sizes} --arms joint"
    drawn = Part(
        f"{race.format(0)} {again} {shlex.join(ORDERS)} book nested default {more}".strip(),
        RACED,
        {
            f"joint.{pair}.{way}-{name}": ratio(f"{way}_over_{rival}", pair)
            for way in ("nested", "joint")
            for name, rival in RIVALS.items()
        }
        | {f"joint.{pair}.table": raced(pair), f"joint.{pair}.ends": ends},
        {f"joint_race_{pair}.png": "ratios.png", f"joint_designs_{pair}.png": "designs.png"},
        f"joint_race_{pair}.jsonl",
        f"{race.format(0)} --seeds 1 {sizes} --arms joint nested",
    )
    pulls = Part(
        f"{race.format(3)} {again} {shlex.join(ORDERS[:2])} nested",
        RACED,
        {
            f"joint.{pair}.{blocks.replace('_', '-')}": coupled(blocks)
            for blocks in ("lens_and_read_out", "mount_and_read_out", "lens_and_mount")
        }
        | {
            f"joint.{pair}.foretold-lens-first": foretold("lens_mount_read_out"),
            f"joint.{pair}.foretold-mount-first": foretold("mount_lens_read_out"),
            f"joint.{pair}.foretold-nested": foretold("nested"),
        },
    )
    return {f"joint-{pair}": drawn, f"couplings-{pair}": pulls}


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
    **joint("outdoors", "--designs 2", '"alternating 4" CMA-ES'),
    **joint("corridor", "--designs 64"),
    **joint("flight", "--designs 64"),
    "joint-arms": Part(
        "codesign --grid 2 --slopes 0 --couplings 0 --designs 2 --seeds 6 --raw docs/joint_race_arms.jsonl",
        RACED,
        {"joint.arms.table": raced("outdoors")},
        table="joint_race_arms.jsonl",
        sample="codesign --grid 2 --slopes 0 --couplings 0 --designs 2 --seeds 1 --arms joint nested",
    ),
    "joint-answer": Part(
        "joint_answer",
        ("studies/joint_answer.py", "studies/frame", "studies/codesign"),
        {"joint.all.table": over_all}
        | {
            f"joint.all.{way}-{name}": interval(*ends_of(f"{way}_over_{rival}"))
            for way in ("nested", "joint")
            for name, rival in RIVALS.items()
        },
        {"joint_answer.png": "all.png"},
    ),
    "joint-levers": Part(
        "joint_levers --processes 2",
        (*RACED, "studies/joint_levers.py"),
        {
            f"joint.levers.{part}": interval(*ends_of(f"share_{part}"))
            for part in ("lens", "mount", "sensor", "estimator")
        },
        {"joint_levers.png": "shares.png", "joint_levers.jsonl": "answers.jsonl"},
        "joint_levers.jsonl",
        "joint_levers --processes 2 --seeds 1",
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
        {"joint_controls.jsonl": "answers.jsonl"},
        "joint_controls.jsonl",
        'joint_controls --arms nested "lens > mount > read-out" --starts 1',
    ),
}
