"""How good is event flow? The closed form in all its models, the delivered network or one of yours,
and rivals, beside zero flow, on textures, motions, densities, 3-D worlds and recordings that guided
no choice, with hard events.

``--sets cells`` judges on single planes, one threshold and one level of noise at a time.
"""

import math
import sys
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import ClassVar, Literal

import torch

from codesign import flow
from codesign.errors import DomainError
from codesign.report.flow_colours import flow_colours
from codesign.report.prose import counted
from codesign.train.validation import batches
from scenes.windows.rendered import planes
from scenes.windows.sets import HARSH, SETS, Shape, judging
from scenes.windows.worlds import ALL
from studies.flow_quality import recordings
from studies.flow_quality.estimators import estimators
from studies.flow_quality.measures import figures, join, mean_of_known, measure
from studies.frame.config import check_least
from studies.frame.run import Run, StudyConfig, main
from studies.frame.show import pictures
from studies.train_flow import peers  # noqa: F401  which network files know

SEED = 77  # of what is judged here: windows that guided no choice
SHOWN = 3  # windows of a set in its picture
DEVIATION_PX = 2.0  # shown white
BEST = "refiner"  # whose pictures and cards are shown, beside the closed form's
START = "closed_form_affine"
NOISE = (0.0005, 0.002, 0.01)  # of the cells: events per pixel, polarity and eighth of the window
FIGURES = {
    "ratio": ("Endpoint error over that of zero flow", "Mean over valid pixels and windows.", 3),
    "worse_percent": ("Windows worse than zero flow, %", "", 1),
    "much_worse_percent": ("Windows worse than zero flow by more than 5 %, %", "", 1),
    "within_percent": (
        "Pixels whose error lies in the claimed ellipse of 90 %, %",
        "90 for an honest claim.",
        1,
    ),
    "error_over_claimed": (
        "Error over claimed deviation, root mean square",
        "1 for an honest claim; a few windows of small claims and large errors rule it.",
        2,
    ),
    "error_over_claimed_median": (
        "Error over claimed deviation, by medians",
        "1 for an honest claim of Gaussian errors.",
        2,
    ),
    "normalised_square": (
        "Half of e^T C^-1 e, e the error and C its covariance",
        "1 when the covariance is right.",
        2,
    ),
    "rank_correlation": (
        "Rank correlation of doubt and error within a window",
        "Spearman's, of 1 - confidence; mean over the windows where the confidence is not the same "
        "everywhere.",
        2,
    ),
    "rank_correlation_if_true": (
        "Rank correlation that the claims would have if they were true",
        "Errors drawn from the claimed covariances, per pixel: what a right claim reaches on these windows.",
        2,
    ),
    "ause": (
        "Area between the sparsification curves",
        "By confidence less by true error, over the error of all pixels; 0 is best.",
        3,
    ),
    "sharpness": (
        "Flow warp loss (FWL)",
        "Of the bins, each at its centroid; above 1 is sharper.",
        3,
    ),
}


@dataclass(frozen=True)
class Config(StudyConfig):
    QUICK: ClassVar = {"windows": 8, "world_windows": 5, "real_windows": 2, "packets": 1}
    network: str = "refiner"
    """Network to judge: "refiner" (the delivered one) or the path of a network file."""
    models: tuple[str, ...] = ("constant", "affine", "quadratic", "local")
    """Models of the closed form to judge, "affine" among them."""
    clock: Literal["events", "time"] = "events"
    """Clock of the closed form and the refiner: how far a motion has come goes by the events, or is
    even over the window."""
    windows: int = 256
    """Windows of every set of flat textures and of every cell, 64 x 64."""
    world_windows: int = 75
    """Windows of 3-D worlds, 128 x 128, the worlds in turn; at least one of each."""
    real_windows: int = 128
    """Windows of every set of scenes.windows.sets: packets of few events, bent images, vibration,
    rotation."""
    sets: tuple[str, ...] = ()
    """Sets to judge on, "cells" for all cells of single planes; all but those when left out, with
    the recordings."""
    recording: tuple[Path, ...] = ()
    """Recordings (docs/flow_recordings.md) to judge on beside the two that are made."""
    focal_px: float | None = None
    """Focal length of a camera that only turned, px: those recordings are then compared with the
    sharpest rotation, else with the sharpest affine flow."""
    packet_events: tuple[int, ...] = (5_000, 10_000, 30_000)
    """Events of a packet of a recording."""
    packets: int = 6
    """Packets of each number of events, spread over a recording."""


def study(run: Run[Config]) -> None:
    config = run.config
    check(config)
    network = flow.load(config.network).eval()
    bins = network.config["bins"]
    sets = judged(config, bins)
    who = estimators(network, config.models, config.clock)
    # opened first: a wrong path ends the study before its windows are judged
    packets, left_out = [], []
    if config.recording or not config.sets:
        packets, left_out = recordings.cases(config, run.say)
    found = {}
    about = {}
    with run.progress(sum(number for _, number in sets.values()), "windows") as progress:
        for name, (source, number) in sets.items():
            rows, density, shown = _measured(source, number, who, progress)
            found[name] = {each: figures(mine) for each, mine in rows.items()}
            about[name] = (density, rows)
            _record(run, name, found[name], density, rows)
            run.figure(
                _pictures(shown, who),
                name,
                f"{name.replace('_', ' ')}: events (red ON, blue OFF), true flow, estimates, and the "
                "deviation that the network claims. Colour: direction, strength: length.",
            )
    _tables(run, found, about, who)
    if "worlds" in found:
        _worlds(run, about["worlds"][1])
    if packets:
        recordings.show(run, who, bins, packets, left_out)
    worlds = ", the worlds are seen by no training" if "worlds" in found else ""
    run.finish(
        "Quality of event flow",
        f"{answer(found, config.network)} Hard events with threshold mismatch and background noise; textures are photographs, unseen speckle "
        f"and few shapes{worlds}.",
    )


def answer(found, network=BEST):
    """How good a network's flow is: its error over that of zero flow on the sets."""
    ratios = {name: mine[BEST]["ratio"] for name, mine in found.items()}
    if not ratios:
        return "On recordings alone the tables below tell."
    least, most = min(ratios, key=ratios.__getitem__), max(ratios, key=ratios.__getitem__)
    ahead = sum(mine[BEST]["aee_px"] < mine[START]["aee_px"] for mine in found.values())
    return (
        f"The flow of {f'the {BEST}' if str(network) == BEST else f'{network}'} errs by {ratios[least]:.2f} ({least.replace('_', ' ')}) to {ratios[most]:.2f} "
        f"({most.replace('_', ' ')}) times what zero flow does, and by less than the closed form's on {ahead} of "
        f"{counted(len(ratios), 'set')}."
    )


def check(config):
    """Raises: DomainError for numbers and models that give no figures."""
    check_least(config, 2, "windows", "real_windows")
    check_least(config, len(ALL), "world_windows")
    if config.packets < 1 or not config.packet_events or min(config.packet_events) < 100:
        raise DomainError(
            f"--packets {config.packets}, --packet-events {config.packet_events}: at least 1 packet of at "
            "least 100 events is needed."
        )
    if config.focal_px is not None and not config.focal_px > 0:
        raise DomainError(f"--focal-px is {config.focal_px}; a focal length > 0 px is needed.")
    if START.removeprefix("closed_form_") not in config.models:
        raise DomainError(
            f"--models {' '.join(config.models)}: affine is needed, which others are compared with."
        )


def judged(config, bins):
    """Name -> (source, number of windows) of the sets that are asked for.

    Raises: DomainError for an unknown name.
    """
    counts = config.windows, config.world_windows, config.real_windows
    found = judging(SEED + config.seed, bins, *counts, SETS | HARSH)
    if not config.sets:
        return found
    cells = {}
    for kind, theta, noise in product(("fine", "mixed"), (0.1, 0.2), NOISE):
        source = Shape(64, 64, bins)(planes(kind, theta, (noise, noise)), config.seed + 1)
        cells[f"{kind}_theta_{theta:g}_noise_{noise:g}"] = (source, config.windows)
    chosen = [each for name in config.sets for each in (cells if name == "cells" else (name,))]
    unknown = [name for name in chosen if name not in found | cells]
    if unknown:
        raise DomainError(
            f"--sets {unknown[0]} is unknown; choose from cells, {', '.join(found | cells)}."
        )
    return {name: (found | cells)[name] for name in chosen}


def _measured(source, number, who, progress):
    """({estimator: Rows}, events per pixel [N], windows to show)."""
    parts = {name: [] for name in who}
    density = []
    shown = []
    for windows in batches(source, number):
        fields = {name: estimate(windows.volume) for name, estimate in who.items()}
        for name, field in fields.items():
            parts[name].append(measure(field, windows))
        density.append(windows.volume.counts.sum((1, 2)).mean((1, 2)))
        for k in range(len(windows.truth.valid)):
            shown.append((windows, fields, k))
            progress.advance()
    return {name: join(mine) for name, mine in parts.items()}, torch.cat(density), shown[:SHOWN]


def _record(run, name, found, density, rows):
    zero = rows[START]["zero_px"]
    told = {
        "windows": len(zero),
        "zero_flow_px": zero.mean(),
        "events_per_px_median": density.median(),
        "refiner_over_closed_form": found[BEST]["aee_px"] / found[START]["aee_px"],
    }
    told |= {f"{who}_{key}": value for who, mine in found.items() for key, value in mine.items()}
    run.record(**{f"{name}_{key}": value for key, value in told.items()})
    run.card(
        name.replace("_", " "),
        f"{found[BEST]['ratio']:.3f} x zero flow",
        f"closed form {found[START]['ratio']:.3f}",
    )


def _tables(run, found, about, who):
    rows = []
    for name, (density, measured) in about.items():
        shares = density.quantile(density.new_tensor([0.5, 0.05, 0.95])).tolist()
        zero = round(measured[START]["zero_px"].mean(), 2)
        rows.append([name.replace("_", " "), len(density), *(round(x, 3) for x in shares), zero])
    run.table(
        "Sets", ["set", "windows", "events per px, median", "5 %", "95 %", "mean flow, px"], rows
    )
    for name, mine in found.items():
        truth = mean_of_known(about[name][1][START]["truth_fwl"])
        mine["true flow"] = {} if math.isnan(truth) else {"sharpness": truth}
    for key, (title, note, digits) in FIGURES.items():
        shown = [*who, "true flow"] if key == "sharpness" else [*who]
        rows = [
            [name.replace("_", " "), *(_cell(mine[each], key, digits) for each in shown)]
            for name, mine in found.items()
        ]
        run.table(title, ["set", *(name.replace("_", " ") for name in shown)], rows, note)


def _cell(figures, key, digits):
    if key not in figures:
        return None
    said = f"{figures[key]:.{digits}f}"
    if key != "ratio":
        return said
    return f"{said} ({figures['ratio_low']:.3f} to {figures['ratio_high']:.3f})"


def _worlds(run, measured):
    rows = []
    for place, name in enumerate(ALL):
        zero = measured[START]["zero_px"][place :: len(ALL)].mean()
        shares = {
            who: float(mine["error_px"][place :: len(ALL)].mean() / zero)
            for who, mine in measured.items()
        }
        run.record(**{f"world_{name}_{who}_ratio": share for who, share in shares.items()})
        rows.append([name, round(float(zero), 2), *(round(share, 3) for share in shares.values())])
    run.table(
        "World by world",
        ["world", "zero flow (px)", *(who.replace("_", " ") for who in measured)],
        rows,
        "Endpoint error over that of zero flow.",
    )


def _pictures(shown, who):
    """Figure: a row per window of its events, true flow, every estimate, and the network's
    claim."""
    rows = {}
    for number, (given, fields, k) in enumerate(shown, 1):
        counts = given.volume.counts[k]
        flows = {"true flow": given.truth.flow_px[k]}
        flows |= {name.replace("_", " "): fields[name].flow_px[k] for name in who}
        most = float(flows["true flow"].square().sum(0).sqrt().max())
        label = f"{number}, full colour {most:.1f} px"
        rows[label] = {"events": (counts[0] - counts[1]).sum(0)} | {
            name: flow_colours(flow.numpy(), most) for name, flow in flows.items()
        }
        covariance = fields[BEST].covariance_px2
        if covariance is not None:
            claimed = ((covariance[k, 0] + covariance[k, 2]) / 2).sqrt() / DEVIATION_PX
            grey = claimed.clamp(max=1)[..., None].expand(-1, -1, 3)
            rows[label][f"claimed (white: {DEVIATION_PX:g} px)"] = grey
    return pictures(rows, signed=["events"], side=1.5, flow=True)


if __name__ == "__main__":
    sys.exit(main(study, Config))
