"""What defocus costs a flow estimator: endpoint error on hard events against Gaussian blur of the picture, at
several levels of background noise.

Fine textures (a plane with rotation, zoom and translation up to 6 px, 64 x 64, scenes.flow_windows.planes),
blurred by a Gaussian of 0 to 3 px before the events, beside the 0.4 px of the pixel itself. The closed form,
a plain damped least-squares solve, zero flow, and the refiner network where one is installed.
"""

import sys
from dataclasses import dataclass
from typing import ClassVar

import matplotlib.pyplot as plt

from codesign import flow
from codesign.errors import DomainError, FileFormatError
from scenes.flow_windows import RenderedWindows, planes
from studies.flow_closed_form.plain import plain_lk
from studies.flow_closed_form.score import score
from studies.frame.run import Run, StudyConfig, main

BLUR_PX = (0.0, 0.5, 1.0, 1.5, 2.0, 2.5, 3.0)
NOISE = (0.0005, 0.002, 0.01)  # events per pixel, polarity and eighth of the window
COLOURS = ("tab:blue", "tab:green", "tab:orange")
STYLES = {"closed form": "o-", "plain": "s--", "refiner": "^-."}
MATTERS = 1.25  # blur matters from where the error is this many times that of a sharp picture


@dataclass(frozen=True)
class Config(StudyConfig):
    QUICK: ClassVar = {"samples": 16}
    samples: int = 96
    """Windows per blur and noise level; the same motions and textures at every blur."""
    theta: float = 0.2
    """Contrast threshold."""


def study(run: Run[Config]) -> None:
    config = run.config
    if config.samples < 8 or config.theta <= 0:
        raise DomainError(
            f"samples = {config.samples}, theta = {config.theta}; give at least 8 samples and a threshold > "
            "0."
        )
    blurs = BLUR_PX[::2] if config.quick else BLUR_PX
    estimators = {"closed form": flow.estimate_lk, "plain": plain_lk}
    refiner = installed_refiner(run)
    if refiner is not None:
        estimators["refiner"] = refiner
    scores = {}
    events = {}
    with run.progress(len(blurs) * len(NOISE), "blurs") as progress:
        for blur_px in blurs:
            for noise in NOISE:
                windows = RenderedWindows(
                    planes("fine", config.theta, (noise, noise), blur_px), seed=config.seed + 1
                ).batch(range(config.samples))
                events[blur_px, noise] = (
                    float(windows.volume.counts.sum()) / windows.volume.counts[:, 0, 0].numel()
                )
                for name, estimator in estimators.items():
                    scores[blur_px, noise, name] = score(estimator, windows)
                progress.advance()
    show(run, blurs, list(estimators), scores, events)


def installed_refiner(run):
    """The refiner network, or None with a word about it."""
    load = getattr(flow, "load", None)
    if load is None:
        run.say("No refiner network in this version: closed form and plain solve only.")
        return None
    try:
        return load("refiner")
    except FileFormatError as error:
        run.say(f"No refiner network: {error}")
        return None


def show(run, blurs, names, scores, events):
    seed = run.config.seed
    rows = []
    for (blur_px, noise, name), found in scores.items():
        low, high = found.ratio_interval(seed)
        label = f"{name.replace(' ', '_')}_blur_{blur_px:g}_px_noise_{noise:g}"
        run.record(
            **{
                f"{label}_aee_px": found.error_px.mean(),
                f"{label}_ratio": found.ratio,
                f"{label}_ratio_low": low,
                f"{label}_ratio_high": high,
                f"{label}_worse_percent": found.worse_percent,
            }
        )
        rows.append(
            [
                blur_px,
                noise,
                events[blur_px, noise],
                name,
                float(found.error_px.mean()),
                f"{found.ratio:.3f} ({low:.3f} to {high:.3f})",
                found.worse_percent,
            ]
        )
    zero_px = scores[blurs[0], NOISE[0], names[0]].zero_px.mean()
    run.record(zero_aee_px=zero_px)
    figure, axes = plt.subplots(1, len(names), figsize=(4.2 * len(names), 3.8), sharey=True)
    for axis, name in zip(axes, names, strict=True):
        for noise, colour in zip(NOISE, COLOURS, strict=True):
            axis.plot(
                blurs,
                [scores[b, noise, name].error_px.mean() for b in blurs],
                STYLES[name],
                color=colour,
                label=f"noise {noise:g}",
            )
        axis.axhline(zero_px, color="0.5", linewidth=0.8, label="zero flow")
        axis.set(title=name, xlabel="Gaussian blur, px", yscale="log")
    axes[0].set_ylabel("endpoint error, px")
    axes[0].legend(fontsize=8)
    run.section(
        "Errors",
        "Noise: background events per pixel, polarity and eighth of the window. Intervals: 95 %, bootstrap "
        "over windows.",
    )
    run.figure(
        figure,
        "flow_blur",
        "Endpoint error against blur. Where a curve is flat, a sharper lens gains nothing; at the grey line "
        "the estimate is worth no more than none.",
    )
    run.table(
        "Endpoint error",
        [
            "blur, px",
            "noise",
            "events per pixel",
            "estimator",
            "AEE, px",
            "over zero flow (95 %)",
            "worse than zero, %",
        ],
        rows,
    )
    for name in names:
        for noise in NOISE:
            curve = [float(scores[b, noise, name].error_px.mean()) for b in blurs]
            first = crossing(blurs, curve, MATTERS * curve[0])
            if first is not None:
                run.record(**{f"{name.replace(' ', '_')}_noise_{noise:g}_blur_that_matters_px": first})
            run.say(
                f"{name:12s} noise {noise:<6g} AEE px {'  '.join(f'{value:.2f}' for value in curve)}   "
                f"{MATTERS}x the sharp error at {'no blur tried' if first is None else f'{first:.2f} px'}"
            )
    whole = crossing(
        blurs,
        [float(scores[b, NOISE[1], "closed form"].error_px.mean()) for b in blurs],
        MATTERS * float(scores[blurs[0], NOISE[1], "closed form"].error_px.mean()),
    )
    run.card(
        "Blur that matters",
        "none tried" if whole is None else f"{whole:.2f} px",
        f"where the closed form's error is {MATTERS} times that of a sharp picture, noise {NOISE[1]:g}",
    )
    run.finish("What blur does to flow", "Endpoint error on hard events of fine textures against defocus.")


def crossing(at, values, level):
    """First place where the values, joined by straight lines, rise above a level; None when they never do."""
    for (x0, y0), (x1, y1) in zip(
        zip(at, values, strict=True), zip(at[1:], values[1:], strict=True), strict=False
    ):
        if y0 <= level < y1:
            return x0 + (x1 - x0) * (level - y0) / (y1 - y0)
    return None


if __name__ == "__main__":
    sys.exit(main(study, Config))
