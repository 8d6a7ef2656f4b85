"""Random worlds through three lenses, each judged against differences: the sweep and its page."""

import json
from collections import Counter
from typing import Any

import matplotlib.pyplot as plt
import torch

from codesign import lens, render
from codesign.atomic import write_atomic
from codesign.reading import read_json, reading
from scenes import random_worlds
from studies.silhouettes.judge import (
    HIGHEST,
    LENSES,
    RIGHT,
    WRONG,
    Case,
    Effort,
    judge,
    nearest_m,
    optics_of,
)

VERDICTS = ("right", "near", "wrong", "noisy", "doubtful", "refused", "empty")
COLOURS = dict(
    zip(VERDICTS, ("#2e8b57", "#e08e0b", "#c0392b", "#8e44ad", "#888888", "#1b6ca8", "#cccccc"), strict=True)
)
SWEEP = Effort(samples=128, seeds=(4, 10))  # of three frames each
QUICK = Effort(samples=96, seeds=(3,))
SHEET = 60  # worlds on the contact sheet
SHEET_PX = 84


def case_of(draw: random_worlds.Draw, kind: str) -> Case:
    """The draw before one of LENSES, focused as it says."""
    scale = 1.0 if kind == "pinhole" else draw.lens_scale
    optics = optics_of(kind, scale, draw.focus_m)
    pitch_mm = 2 * 11.0 * scale * draw.half_slope / random_worlds.WIDTH_PX
    near = nearest_m(draw.scene, optics, draw.T_world_cam, pitch_mm, random_worlds.WIDTH_PX)
    return Case(draw.scene, optics, draw.T_world_cam, pitch_mm, random_worlds.WIDTH_PX, near, draw.seed)


def judged_draw(seed: int, kinds: tuple[str, ...] = LENSES, effort: Effort = SWEEP) -> list[dict[str, Any]]:
    """Rows of one draw, one for each lens."""
    draw = random_worlds.draw(seed)
    facts = {**draw.facts, "lens_scale": draw.lens_scale, "focus_m": draw.focus_m}
    rows = []
    for kind in kinds:
        case = case_of(draw, kind)
        found = judge(case, effort=effort).row()
        rows.append({"seed": seed, "lens": kind, **found, "nearest_m": case.nearest_m, "facts": facts})
    return rows


def sweep(run: Any, count: int, first: int, raw: tuple[str, ...], effort: Effort = SWEEP) -> None:
    """Judge ``count`` draws from number ``first`` on, those of earlier sessions and given tables excepted, and
    show them with all that these hold."""
    rows = _earlier(run, raw)

    def save():
        run.save_state({}, {"rows": rows})
        write_atomic(run.path("random.json"), _text(rows).encode())

    run.on_interrupt(save)
    wanted = range(first, first + count)
    missing = [seed for seed in wanted if str(seed) not in rows]
    with run.progress(count, "random worlds", done=count - len(missing)) as progress:
        for seed in missing:
            rows[str(seed)] = judged_draw(seed, effort=effort)
            save()
            progress.advance()
    save()
    show(run, [row for seed in sorted(rows, key=int) for row in rows[seed]])


def _earlier(run, raw):
    stored = run.load_state()
    rows = dict(stored.numbers["rows"]) if stored is not None else {}
    for name in raw:
        given = read_json(name)
        with reading(f"--raw {name}", "it is no raw table of this study"):
            rows |= {str(int(seed)): list(group) for seed, group in given.items() if group[0]["lens"]}
    return rows


def _text(rows):
    """The raw table: a line for every draw, in their order."""
    lines = [f'"{seed}": {json.dumps(_rounded(rows[seed]))}' for seed in sorted(rows, key=int)]
    return "{\n" + ",\n".join(lines) + "\n}\n"


def _rounded(value):
    """The same plain values with floats to four digits."""
    if isinstance(value, float):
        return float(f"{value:.4g}")
    if isinstance(value, dict):
        return {key: _rounded(v) for key, v in value.items()}
    return [_rounded(v) for v in value] if isinstance(value, list) else value


def counted(rows: list[dict[str, Any]]) -> dict[str, float]:
    """Metrics out of rows: worlds and, for each lens, verdicts, how many could be judged, the worst error among these and
    the share that was refused."""
    found: dict[str, float] = {"random_worlds": len({row["seed"] for row in rows})}
    for kind in dict.fromkeys(row["lens"] for row in rows):
        mine = [row for row in rows if row["lens"] == kind]
        verdicts = Counter(row["verdict"] for row in mine)
        for name in VERDICTS:
            found[f"random_{kind}_{name}_count"] = verdicts[name]
        judged = [row for row in mine if row["verdict"] in ("right", "near", "wrong")]
        found[f"random_{kind}_judged"] = len(judged)
        found[f"random_{kind}_worst_error"] = max((row["error"] for row in judged), default=0.0)
        found[f"random_{kind}_refused_share"] = verdicts["refused"] / max(len(mine), 1)
    return found


def show(run: Any, rows: list[dict[str, Any]]) -> None:
    """Metrics, tables and pictures of the rows, and the end of the page."""
    run.record(**counted(rows))
    kinds = tuple(dict.fromkeys(row["lens"] for row in rows))
    counts = {kind: Counter(row["verdict"] for row in rows if row["lens"] == kind) for kind in kinds}
    wrong = sum(c["wrong"] for c in counts.values())
    total = sum(sum(c.values()) for c in counts.values())
    run.card("Wrong", f"{wrong} of {total}", f"error above {WRONG:.0%} + noise without refusal; asked: none")
    refused = sum(c["refused"] for c in counts.values())
    run.card("Refused", f"{refused / max(total, 1):.1%}", "of all cases; asked: 3 % at most")
    run.table(
        "Verdicts", ("lens", *VERDICTS), [(kind, *(counts[kind][v] for v in VERDICTS)) for kind in kinds]
    )
    bad = [row for row in rows if row["verdict"] in ("wrong", "noisy", "near", "doubtful")]
    bad.sort(key=lambda row: -row["error"])
    run.table(
        "Not right",
        ("draw", "lens", "verdict", "error", "noise", "interior only", "background", "things"),
        [
            (
                row["seed"],
                row["lens"],
                row["verdict"],
                *(round(row[name], 4) for name in ("error", "noise", "interior")),
                row["facts"]["background"],
                ", ".join(f"{kind} {how}" for kind, how, *_ in row["facts"]["things"]),
            )
            for row in bad[:60]
        ],
    )
    sentences = Counter(_kind_of(row["sentence"]) for row in rows if row["verdict"] == "refused")
    run.table("Refused", ("count", "sentence, as one of them has it"), [(n, s) for s, n in sentences.items()])
    run.figure(
        _errors(rows), "random_errors", "Error beside noise. Above the line: wrong; left of it all: judged."
    )
    run.figure(
        _sheet(rows),
        "random_worlds",
        "Worlds drawn, through the pinhole; the frame's colour is the worst verdict.",
    )
    run.finish(
        "Gradients at silhouettes of random worlds",
        f"{total} cases: " + ", ".join(f"{sum(c[v] for c in counts.values())} {v}" for v in VERDICTS) + ".",
    )


def _kind_of(sentence):
    return sentence.split("'")[0] + "…" if "'" in sentence else sentence


def _errors(rows):
    figure, axes = plt.subplots(1, 2, figsize=(10, 4), layout="constrained")
    shown = [row for row in rows if row["error"] is not None]
    for name in VERDICTS:
        mine = [row for row in shown if row["verdict"] == name]
        axes[0].loglog(
            [max(row["noise"], 1e-4) for row in mine],
            [max(row["error"], 1e-4) for row in mine],
            ".",
            color=COLOURS[name],
            label=f"{name} ({len(mine)})",
        )
    noise = torch.logspace(-4, -1, 50)
    axes[0].plot(noise, WRONG + noise, color="#c0392b", lw=0.8)
    axes[0].plot(noise, RIGHT + 2 * noise, color="#2e8b57", lw=0.8)
    axes[0].axvline(HIGHEST, color="#888888", lw=0.8)
    axes[0].set(xlabel="noise of differences and gradient", ylabel="relative L2 error")
    axes[0].legend(frameon=False, fontsize=7)
    for kind in dict.fromkeys(row["lens"] for row in shown):
        for name, style in (("error", "-"), ("interior", ":")):
            ordered = sorted(max(row[name], 1e-4) for row in shown if row["lens"] == kind)
            share = [(k + 1) / len(ordered) for k in range(len(ordered))]
            axes[1].semilogx(
                ordered, share, style, label=f"{kind}, {'with boundary' if name == 'error' else 'interior'}"
            )
    axes[1].set(xlabel="relative L2 error", ylabel="share of cases below")
    axes[1].legend(frameon=False, fontsize=7)
    return figure


def _sheet(rows):
    seeds = list(dict.fromkeys(row["seed"] for row in rows))[:SHEET]
    across = min(10, len(seeds))
    down = -(-len(seeds) // across)
    figure, axes = plt.subplots(down, across, figsize=(1.3 * across, 1.45 * down), squeeze=False)
    for axis in axes.flat:
        axis.axis("off")
    order = ("wrong", "noisy", "near", "doubtful", "refused", "right", "empty")
    for axis, seed in zip(axes.flat, seeds, strict=False):
        draw = random_worlds.draw(seed)
        pitch_mm = 2 * 11.0 * draw.half_slope / SHEET_PX
        camera = render.Camera(lens.Pinhole(11.0), SHEET_PX, SHEET_PX, pitch_mm, 16)
        with torch.no_grad():
            frame = render.frames(camera, draw.scene, draw.T_world_cam)[0]
        axis.imshow(frame.sqrt().numpy(), cmap="gray", vmin=0, vmax=16)
        verdicts = {row["verdict"] for row in rows if row["seed"] == seed}
        worst = next(name for name in order if name in verdicts)
        axis.set_title(f"{seed} {worst}", fontsize=6, color=COLOURS[worst], pad=2)
    return figure
