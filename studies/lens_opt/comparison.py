"""The part of a lens_opt page that says who wins: cards, paired differences over all cases and by window, and what the
rivals chose from."""

from collections.abc import Mapping

import matplotlib.pyplot as plt
import numpy as np

from studies.frame.compare import Interval, log_ratio
from studies.lens_opt.task import DISTANCE_M, FIELDS, PITCH_MM

DESIGNS = {"flow": "the flow design", "edge": "the edge design"}
RIVALS = {
    "refocused": "refocusing alone",
    "spots": "the spot designer",
    "edge": "the edge objective",
    "flow": "the flow objective",
}
LENSES = {
    "nominal": "published lens, in focus",
    "defocused": "detuned, with its focus error",
    "detuned": "detuned, in focus: the start",
    "after_spots": "flow steps after the spot designer",
}


def label(name, objective):
    """What a lens is called on the page."""
    if name == "optimised":
        return DESIGNS[objective].removeprefix("the ")
    return LENSES.get(name) or RIVALS[name].removeprefix("the ")


def verdict(design: str, rivals: Mapping[str, Interval]) -> str:
    """One sentence that says first who wins: the rivals that do, those that tie, or the design where it beats all.

    Args: design: what it is called, "the flow design". rivals: what each is called -> log ratio of the design over it.
    """
    said = []
    for outcome, words in (("loses", ("wins", "win")), ("ties", ("ties", "tie"))):
        found = {name: pair for name, pair in rivals.items() if pair.outcome == outcome}
        if found:
            several = len(found) > 1
            said.append(
                f"{' and '.join(found)} {words[several]}: the flow error of {design} against "
                f"{'them' if several else 'it'} is {' and '.join(pair.percent() for pair in found.values())}"
            )
    if not said:
        name, closest = max(rivals.items(), key=lambda item: item[1].value)
        said.append(f"{design} wins: its flow error against its best rival, {name}, is {closest.percent()}")
    cases = next(iter(rivals.values())).count
    return f"{_capital('; '.join(said))} on {cases} unseen cases."


def _capital(text):
    return text[0].upper() + text[1:]


def cards(run, pairs):
    m = run.metrics
    for name in ("optimised", *pairs):
        change = (
            f"the design against it: {pairs[name].percent()}" if name in pairs else "mean of held-out cases"
        )
        run.card(
            f"Flow error, {label(name, run.config.objective)}",
            f"{m[f'flow_error_mrad_hard_{name}']:.3f} mrad",
            f"RMS spot {m[f'rms_spot_um_{name}']:.1f} µm; {change}",
        )


def who_wins(run, course, lenses, errors, complaints):
    """Table of pairs, over all windows and by window, and their figure."""
    objective = run.config.objective
    design = label("optimised", objective)
    run.section(
        "Who wins",
        "Hard events from the physical sensor, textures and motions never optimised on, the same cases for every "
        f"lens. A change below 0 says that the {design} errs less than the lens of the row; where the interval holds "
        "0, the two tie. All lenses have the same free variables, focal length, f-number and floors of thickness; the "
        "published lens is a yardstick that no design here knows.",
    )
    for complaint in sorted(complaints):
        run.text(f"**Note**: {complaint}")
    found = course.found
    m = run.metrics
    rows = []
    for name in lenses:
        row = [label(name, objective), m[f"flow_error_mrad_hard_{name}"], m[f"rms_spot_um_{name}"]]
        pair = None if name == "optimised" else log_ratio(errors["optimised"], errors[name])
        rows.append([*row, m[f"edge_below_floor_mm_{name}"], *_change(pair)])
    run.table(
        "Lenses on held-out cases",
        [
            "lens",
            "flow error (mrad)",
            "RMS spot (µm)",
            "edge below its floor (mm)",
            f"change by the {design}",
            "it",
        ],
        rows,
        f"RMS spot: mean over three fields of a wall at {DISTANCE_M:g} m, four wavelengths; a pixel is "
        f"{PITCH_MM * 1e3:g} µm.",
    )
    if "after_spots" in lenses:
        pair = log_ratio(errors["after_spots"], errors["spots"])
        run.text(
            f"{run.config.after_steps} steps of the flow objective from the spot designer's lens change its flow error "
            f"by {pair.percent()}: that {_JUDGED[pair.outcome]}."
        )
    rivals = [name for name in RIVALS if name in lenses]
    rows = []
    for h in FIELDS:
        key = f"flow_error_mrad_field_{h:g}"
        own = [row[key] for row in found["optimised"]]
        changes = [log_ratio(own, [row[key] for row in found[name]]).percent() for name in rivals]
        rows.append([f"{h:g}", sum(own) / len(own), *changes])
    run.table(
        "Where: by window",
        [
            "window, of the way to the corner",
            f"{design} (mrad)",
            *(label(name, objective) for name in rivals),
        ],
        rows,
        "Change of flow error by the design against each rival, in one window.",
    )
    shown = [name for name in ("detuned", *rivals, "after_spots") if name in lenses]
    run.figure(
        _pair_figure({label(name, objective): (errors["optimised"], errors[name]) for name in shown}, design),
        "pairs",
        f"Flow error of the {design} over that of each lens, a dot per held-out case; bars: mean and 95 % interval.",
    )


_JUDGED = {"wins": "is better", "loses": "is worse", "ties": "is a tie"}


def _change(pair):
    return ["", ""] if pair is None else [pair.percent(), pair.outcome]


def _pair_figure(pairs, design):
    figure, axis = plt.subplots(figsize=(9, 0.8 + 0.6 * len(pairs)))
    for at, (own, rival) in enumerate(pairs.values()):
        ratios = np.array(own) / np.array(rival)
        axis.plot(ratios, np.full(len(ratios), at), "o", color="#1b6ca8", alpha=0.35, ms=4)
        pair = log_ratio(own, rival)
        low, mean, high = np.exp(
            [pair.low if pair.count > 1 else pair.value, pair.value, min(pair.high, 50.0)]
        )
        if pair.count > 1:
            axis.plot([low, high], [at, at], "-", color="#c0392b", lw=3)
        axis.plot([mean], [at], "|", color="#c0392b", ms=14, mew=3)
    axis.axvline(1.0, color="0.4", lw=1)
    axis.set_xscale("log")
    axis.set_yticks(range(len(pairs)), list(pairs))
    axis.invert_yaxis()
    axis.set_xlabel(f"flow error of the {design} / flow error of the lens")
    figure.tight_layout()
    return figure


def settings(run, course):
    config = run.config
    run.section(
        "The rivals at their best",
        f"Refocusing moves the film alone. The spot designer minimises the weighted mean square spot of the wall in the "
        f"camera's own light by damped least squares, from {config.spot_starts} starts. Both choose among the settings "
        f"below by the geometric mean flow error on {config.developed} development cases, of other textures than those "
        "optimised on and those judged on. The other gradient objective runs from the same start, for as many steps, "
        "with a clip and a step size of its own, the best of a few on development cases.",
    )
    for name, rows in course.choices.items():
        least = min(rows, key=lambda row: row["error_mrad"])
        run.table(
            f"Settings: {label(name, config.objective)}",
            ["setting", "flow error on development cases (mrad)", ""],
            [[r["setting"], r["error_mrad"], "chosen" if r is least else ""] for r in rows],
        )
