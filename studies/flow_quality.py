"""How good is the delivered refiner? Beside the closed form and zero flow, on textures, motions and 3-D
worlds that it was never trained on, with hard events."""

import sys
from dataclasses import dataclass
from typing import ClassVar

import matplotlib.pyplot as plt
import torch

from codesign import flow
from codesign.errors import DomainError
from codesign.flow.metrics import endpoint_error
from codesign.report.flow_colours import flow_colours
from codesign.train.validation import batches
from scenes.flow_worlds import ALL, WorldWindows
from studies.flow_closed_form.score import Score
from studies.frame.run import Run, StudyConfig, main
from studies.train_flow.sources import UNSEEN, VALIDATION, Shape

SEED = 77  # of what is judged here: windows that guided no choice
SHOWN = 3  # windows of a set in its picture
DRAWS = 2000  # of the bootstrap


@dataclass(frozen=True)
class Config(StudyConfig):
    QUICK: ClassVar = {"windows": 8, "world_windows": 5}
    network: str = "refiner"
    """Network to judge: "refiner" (the delivered one) or the path of a network file."""
    windows: int = 256
    """Windows of every set of flat textures, 64 x 64."""
    world_windows: int = 75
    """Windows of 3-D worlds, 128 x 128, the worlds in turn."""


def study(run: Run[Config]) -> None:
    config = run.config
    if config.windows < 2 or config.world_windows < 2:
        raise DomainError(
            f"--windows {config.windows}, --world-windows {config.world_windows}: at least 2 are needed."
        )
    network = flow.load(config.network).eval()
    shape = Shape(64, 64, network.config["bins"])
    sets = {
        name: (make(shape, SEED + config.seed), config.windows)
        for name, make in VALIDATION.items()
        if name != "worlds"
    }
    sets["worlds"] = (
        WorldWindows(ALL, seed=UNSEEN + SEED + config.seed, bins=network.config["bins"]),
        config.world_windows,
    )
    rows = []
    with run.progress(sum(number for _, number in sets.values()), "windows") as progress:
        for name, (source, number) in sets.items():
            found, shown = _errors(source, number, network, progress)
            rows.append(_row(run, name, found))
            run.figure(
                _figure(shown),
                name,
                f"{name.replace('_', ' ')}: events (red ON, blue OFF), true flow, closed form, refiner, and "
                "the deviation it claims. Colour: direction, strength: length.",
            )
            if name == "worlds":
                _worlds(run, found)
    columns = [
        "windows",
        "zero flow (px)",
        "closed form",
        "95 %",
        "worse than zero (%)",
        "refiner",
        "95 %",
        "worse than zero (%)",
        "refiner / closed form",
        "error / claimed",
    ]
    run.table(
        "Endpoint error over that of zero flow",
        columns,
        rows,
        "Means over valid pixels; 95 % by bootstrap over windows. Error / claimed: root mean square, 1 for "
        "an honest claim.",
    )
    run.finish(
        "Quality of the delivered refiner",
        "Hard events with threshold mismatch and background noise; textures are photographs and unseen "
        "speckle, the worlds are seen by no training.",
    )


@torch.no_grad()
def _errors(source, count, network, progress):
    """Per window: mean errors of zero flow, closed form, refiner, and the refiner's squared error over its
    claim; and a few windows to show."""
    found = []
    shown = []
    for windows in batches(source, count):
        closed = flow.estimate_lk(windows.volume)
        ours = network(windows.volume)
        truth = windows.truth
        weight = truth.valid.double() / truth.valid.sum((1, 2), keepdim=True).clamp_min(1)

        def mean(values, weight=weight):
            return (values.double() * weight).sum((1, 2))

        claim = ours.covariance_px2[:, 0] + ours.covariance_px2[:, 2]
        errors = [
            mean(endpoint_error(field, truth.flow_px))
            for field in (torch.zeros_like(truth.flow_px), closed.flow_px, ours.flow_px)
        ]
        found.append(
            torch.stack([*errors, mean(endpoint_error(ours.flow_px, truth.flow_px).square() / claim)], 1)
        )
        if len(shown) < SHOWN:
            shown += [
                (
                    windows.volume.counts[k],
                    truth.flow_px[k],
                    closed.flow_px[k],
                    ours.flow_px[k],
                    (claim[k] / 2).sqrt(),
                )
                for k in range(min(SHOWN - len(shown), len(weight)))
            ]
        for _ in weight:
            progress.advance()
    return torch.cat(found).numpy(), shown


def _row(run, name, found):
    zero, closed, ours, claimed = found.T
    cells = [name.replace("_", " "), round(zero.mean(), 2)]
    for who, values in (("closed_form", closed), ("refiner", ours)):
        judged = Score(values, zero, None)
        low, high = judged.ratio_interval(0, DRAWS)
        run.record(
            **{
                f"{name}_{who}_ratio": judged.ratio,
                f"{name}_{who}_ratio_low": low,
                f"{name}_{who}_ratio_high": high,
                f"{name}_{who}_worse_percent": judged.worse_percent,
                f"{name}_{who}_aee_px": values.mean(),
            }
        )
        cells += [round(judged.ratio, 3), f"{low:.3f} to {high:.3f}", round(judged.worse_percent, 1)]
    share = ours.mean() / closed.mean()
    honest = claimed.mean() ** 0.5
    run.record(
        **{
            f"{name}_refiner_over_closed_form": share,
            f"{name}_zero_flow_px": zero.mean(),
            f"{name}_windows": len(found),
            f"{name}_error_over_claimed": honest,
        }
    )
    run.card(
        name.replace("_", " "),
        f"{ours.mean() / zero.mean():.3f} x zero flow",
        f"closed form {closed.mean() / zero.mean():.3f}",
    )
    return [*cells, round(share, 2), round(honest, 2)]


def _worlds(run, found):
    rows = []
    for place, name in enumerate(ALL):
        zero, closed, ours, _ = found[place :: len(ALL)].mean(0)
        run.record(
            **{f"world_{name}_closed_form_ratio": closed / zero, f"world_{name}_refiner_ratio": ours / zero}
        )
        rows.append([name, round(zero, 2), round(closed / zero, 3), round(ours / zero, 3)])
    run.table(
        "World by world",
        ["world", "zero flow (px)", "closed form", "refiner"],
        rows,
        "Endpoint error over that of zero flow.",
    )


def _figure(shown):
    figure, axes = plt.subplots(
        len(shown), 5, figsize=(11, 2.2 * len(shown)), constrained_layout=True, squeeze=False
    )
    titles = ("events", "true flow", "closed form", "refiner", "deviation claimed (white: 2 px)")
    for row, (counts, *flows, deviation_px) in zip(axes, shown, strict=True):
        signed = (counts[0] - counts[1]).sum(0)
        row[0].imshow(signed.numpy(), cmap="RdBu_r", vmin=-4, vmax=4)
        most = float(flows[0].square().sum(0).sqrt().max())
        for axis, field in zip(row[1:4], flows, strict=True):
            axis.imshow(flow_colours(field.numpy(), most))
        row[4].imshow(deviation_px.numpy(), cmap="gray", vmin=0, vmax=2)
    for axis, title in zip(axes[0], titles, strict=True):
        axis.set_title(title, fontsize=9)
    for axis in axes.flat:
        axis.set_axis_off()
    return figure


if __name__ == "__main__":
    sys.exit(main(study, Config))
