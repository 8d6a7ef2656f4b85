"""How good is event flow? The closed form in all its models and the delivered network, beside zero flow, on
textures, motions, densities and 3-D worlds that guided no choice, with hard events."""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import torch

from codesign import flow
from codesign.errors import DomainError
from codesign.train.validation import batches
from scenes.flow_worlds import ALL
from studies.flow_quality import figures, packets_page
from studies.flow_quality.estimators import estimators
from studies.flow_quality.measures import join, measure
from studies.flow_quality.sets import judged
from studies.frame.run import Run, StudyConfig, main

SHOWN = 3  # windows of a set in its picture
BEST = "refiner"  # whose pictures and cards are shown, beside the closed form's
START = "closed_form_affine"
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
    "sharpness": ("Flow warp loss (FWL)", "Of the bins, each at its centroid; above 1 is sharper.", 3),
}


@dataclass(frozen=True)
class Config(StudyConfig):
    QUICK: ClassVar = {"windows": 8, "world_windows": 5, "real_windows": 2, "packets": 1}
    network: str = "refiner"
    """Network to judge: "refiner" (the delivered one) or the path of a network file."""
    models: tuple[str, ...] = ("constant", "affine", "quadratic", "local")
    """Models of the closed form to judge, "affine" among them."""
    windows: int = 256
    """Windows of every set of flat textures, 64 x 64."""
    world_windows: int = 75
    """Windows of 3-D worlds, 128 x 128, the worlds in turn."""
    real_windows: int = 128
    """Windows of every set of scenes.flow_sets: packets of few events, bent images, vibration, rotation."""
    sets: tuple[str, ...] = ()
    """Sets to judge on; all when left out, with the recordings."""
    middlebury: Path | None = None
    """Folder with Middlebury's .flo files, to move photographs by as they are and three times as far."""
    recording: tuple[Path, ...] = ()
    """Recordings (docs/flow_recordings.md) to judge on beside the two that are made."""
    focal_px: float | None = None
    """Focal length of a camera that only turned, px: those recordings are then compared with the sharpest
    rotation, else with the sharpest affine flow."""
    packet_events: tuple[int, ...] = (5_000, 10_000, 30_000)
    """Events of a packet of a recording."""
    packets: int = 6
    """Packets of each number of events, spread over a recording."""


def study(run: Run[Config]) -> None:
    config = run.config
    if min(config.windows, config.world_windows, config.real_windows) < 2:
        raise DomainError(
            f"--windows {config.windows}, --world-windows {config.world_windows}, --real-windows "
            f"{config.real_windows}: at least 2 are needed."
        )
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
    network = flow.load(config.network).eval()
    sets = judged(config, network.config["bins"])
    unknown = [name for name in config.sets if name not in sets]
    if unknown:
        raise DomainError(f"--sets {unknown[0]} is unknown; choose from {', '.join(sets)}.")
    sets = {name: sets[name] for name in config.sets or sets}
    who = estimators(network, config.models)
    found = {}
    about = {}
    with run.progress(sum(number for _, number in sets.values()), "windows") as progress:
        for name, (source, number) in sets.items():
            found[name], about[name], shown = _judged(source, number, who, progress)
            _record(run, name, found[name], about[name])
            run.figure(
                figures.windows(shown, who),
                name,
                f"{name.replace('_', ' ')}: events (red ON, blue OFF), true flow, estimates, and the deviation "
                "that the network claims. Colour: direction, strength: length.",
            )
    _show(run, found, about, who)
    if config.middlebury is None:
        run.text(
            "Middlebury's flows were left out: give the folder of its .flo files with `--middlebury`. The sets "
            "`many_depths` stand for them."
        )
    if "worlds" in found:
        _worlds(run, found["worlds"])
    if config.recording or not config.sets:
        packets_page.show(run, who, network.config["bins"])
    run.finish(
        "Quality of event flow",
        "Hard events with threshold mismatch and background noise; textures are photographs, unseen speckle "
        "and few shapes, the worlds are seen by no training.",
    )


def _judged(source, number, who, progress):
    """({estimator: Measured}, events per pixel [N], windows to show)."""
    parts = {name: [] for name in who}
    density = []
    shown = []
    for windows in batches(source, number):
        fields = {name: estimate(windows.volume) for name, estimate in who.items()}
        for name, field in fields.items():
            parts[name].append(measure(field, windows))
        density.append(windows.volume.counts.sum((1, 2)).mean((1, 2)))
        for k in range(min(SHOWN - len(shown), len(windows.truth.valid))):
            shown.append((windows, fields, k))
        for _ in windows.truth.valid:
            progress.advance()
    return {name: join(mine) for name, mine in parts.items()}, torch.cat(density), shown


def _record(run, name, found, density):
    zero = next(iter(found.values())).zero_px
    run.record(
        **{
            f"{name}_windows": len(zero),
            f"{name}_zero_flow_px": zero.mean(),
            f"{name}_events_per_px_median": density.median(),
        }
    )
    for who, measured in found.items():
        low, high = measured.ratio_interval()
        figures_of = {key: getattr(measured, key) for key in FIGURES}
        figures_of |= {"ratio_low": low, "ratio_high": high, "aee_px": measured.error_px.mean()}
        run.record(**{f"{name}_{who}_{key}": value for key, value in figures_of.items() if value is not None})
    if BEST in found and START in found:
        run.record(
            **{f"{name}_refiner_over_closed_form": found[BEST].error_px.mean() / found[START].error_px.mean()}
        )
        run.card(
            name.replace("_", " "),
            f"{found[BEST].ratio:.3f} x zero flow",
            f"closed form {found[START].ratio:.3f}",
        )


def _show(run, found, about, who):
    rows = [
        [
            name.replace("_", " "),
            len(about[name]),
            round(float(about[name].median()), 3),
            round(float(about[name].quantile(0.05)), 3),
            round(float(about[name].quantile(0.95)), 3),
            round(float(next(iter(found[name].values())).zero_px.mean()), 2),
        ]
        for name in found
    ]
    columns = ["set", "windows", "events per px, median", "5 %", "95 %", "mean flow, px"]
    run.table("Sets", columns, rows)
    for key, (title, note, digits) in FIGURES.items():
        rows = []
        for name, mine in found.items():
            cells = []
            for measured in mine.values():
                value = getattr(measured, key)
                interval = " ({:.3f} to {:.3f})".format(*measured.ratio_interval()) if key == "ratio" else ""
                cells.append(None if value is None else f"{value:.{digits}f}{interval}")
            if key == "sharpness":
                truth = next(iter(mine.values())).truth_fwl
                truth = truth[truth == truth]
                cells.append(f"{truth.mean():.3f}" if len(truth) else None)
            rows.append([name.replace("_", " "), *cells])
        extra = ["true flow"] if key == "sharpness" else []
        run.table(title, ["set", *(name.replace("_", " ") for name in who), *extra], rows, note)


def _worlds(run, found):
    rows = []
    for place, name in enumerate(ALL):
        zero = found[START].zero_px[place :: len(ALL)].mean()
        shares = {who: float(mine.error_px[place :: len(ALL)].mean() / zero) for who, mine in found.items()}
        run.record(**{f"world_{name}_{who}_ratio": share for who, share in shares.items()})
        rows.append([name, round(float(zero), 2), *(round(share, 3) for share in shares.values())])
    run.table(
        "World by world",
        ["world", "zero flow (px)", *(who.replace("_", " ") for who in found)],
        rows,
        "Endpoint error over that of zero flow.",
    )


if __name__ == "__main__":
    sys.exit(main(study, Config))
