"""Do learnt generators make the events of a physical sensor: the spiking network of the thesis, ESIM, and
ours?

Trained on rendered sequences with hard events of a noisy, slow, unequal sensor; judged on motions and worlds
never seen by van Rossum distance, number, rates over time, flicker, delay, patches and medians. With
--classes instead by what a classifier that is trained on their events makes of the sensor's
(docs/event_classes.md).
"""

import sys
from dataclasses import dataclass
from typing import ClassVar

import torch
from matplotlib.figure import Figure

from codesign import events
from codesign.errors import DomainError
from studies.frame.run import Run, StudyConfig, main
from studies.spike_esim import classes, judge
from studies.spike_esim.train import generators, rendered

TRAINING = [
    (world, family, 10 + k)
    for world in ("room", "corridor", "checkerboard")
    for k, family in enumerate(("driving", "orbital", "flying", "vertical"))
]
UNSEEN = {
    "motion": [("room", "flying", 50), ("corridor", "driving", 51), ("room", "radial", 52)],
    "world": [
        ("outdoor", "flying", 60),
        ("outdoor", "driving", 61),
        ("tabletop", "flying", 62),
        ("tabletop", "orbital", 63),
    ],
}
PICTURE_S = 0.03
TITLES = {
    "thesis": "thesis network, SLAYER's reset",
    "own_reset": "thesis network, own reset",
    "smoothed": "thesis, smoothed, one threshold",
    "second_module": "thesis, smoothed, second module",
    "esim": "ESIM, best threshold",
    "ours": "ours",
    "sensor": "sensor, another draw",
}
PICTURED = ("thesis", "smoothed", "esim", "ours")
CAPTION = (
    "Loss: van Rossum distance, 10 ms, over that of silence. Rates of ON and OFF (the smaller correlation) in "
    "bins of 10 ms; cells and patches of 8 x 8 px; flicker: power of the rate above 50 Hz over the target's; "
    "median: events behind a 5 x 5 median over the target's. Brackets: 95 %, blocks of 16 x 16 px drawn again."
)


@dataclass(frozen=True)
class Config(StudyConfig):
    QUICK: ClassVar = {
        "frames": 60,
        "steps": 8,
        "seeds": 2,
        "training": 60,
        "test": 60,
        "calibration": 30,
        "epochs": 3,
    }
    classes: bool = False
    """Judge the generators by a classifier of moved digits."""
    frames: int = 200
    """Frames of every rendered sequence, at 500 per second."""
    steps: int = 160
    """Optimisation steps of our generator; the thesis network gets half as many from either of two starts."""
    seeds: int = 5
    """Classifiers of each generator, each with training pictures, noise and first weights of its own."""
    training: int = 800
    """Pictures that a classifier is trained on."""
    test: int = 1000
    """Pictures that it is tested on."""
    calibration: int = 200
    """Recorded pictures that thresholds and generators are fitted to."""
    epochs: int = 12
    """Passes over the training pictures."""
    video_hz: float = 100.0
    """Frame rate at which generators see the moved pictures."""


def study(run: Run[Config]) -> None:
    if run.config.frames < 40 or run.config.steps < 4:
        given = f"{run.config.frames} and {run.config.steps}"
        raise DomainError(f"frames and steps are {given}; at least 40 and 4 are needed.")
    classes.study(run) if run.config.classes else compare(run)


def compare(run):
    """Train all generators, judge them on every unseen set, write the page."""
    seed = run.config.seed
    training, *unseen = sequences(run, [TRAINING, *UNSEEN.values()])
    made, ours, theta = generators(run, training)
    on, off = ours.thetas().tolist()
    run.record(
        esim_theta=theta, ours_theta_on=on, ours_theta_off=off, ours_refractory_s=float(ours.refractory_s())
    )
    ours.save(run.path("spike_esim.npz"))
    lead = []
    for name, some in zip(UNSEEN, unseen, strict=True):
        counts = {key: [make(one) for one in some] for key, make in made.items()}
        pairs = {key: list(zip(counts[key], some, strict=True)) for key in TITLES}
        found = {key: judge.judge(pairs[key], 100 if run.config.quick else 1000, seed) for key in TITLES}
        for key, values in found.items():
            run.record(**{f"unseen_{name}_{key}_{figure}": value for figure, value in values.items()})
        rows = []
        for key, values in found.items():
            brackets = ["{:.3f} ({:.3f} to {:.3f})".format(*list(values.values())[k : k + 3]) for k in (0, 3)]
            rows.append((TITLES[key], *brackets, *list(values.values())[6:]))
        columns = ("generator", "loss", "events / target", *list(found["ours"])[6:])
        run.table(f"Unseen {name}", columns, rows, CAPTION)
        shown = {"physical sensor": some[0].counts, **{TITLES[key]: counts[key][0] for key in PICTURED}}
        show(run, f"unseen_{name}", shown, some[0].dt_s)
        lead.append(f"unseen {name} {found['ours']['loss']:.3f} (ESIM {found['esim']['loss']:.3f})")
    run.finish("Learnt event generators", f"Loss of ours over that of silence: {', '.join(lead)}.")


def sequences(run, wanted):
    """Lists of rendered sequences."""
    wanted = [some[:2] if run.config.quick else some for some in wanted]
    with run.progress(sum(map(len, wanted)), "sequences") as progress:
        made = []
        for some in wanted:
            made.append([])
            for one in some:
                made[-1].append(rendered(*one, run.config.frames))
                progress.advance()
    return made


def show(run, name, shown, dt_s):
    """Figures of counts by title: event pictures as they are and behind a median, rates over time,
    patches."""
    steps = round(PICTURE_S / dt_s)
    for end, text in (("pictures", "events of 30 ms"), ("median", "of 10 ms behind a 5 x 5 median")):
        figure = Figure(figsize=(2.2 * len(shown), 7), layout="constrained")
        for column, (title, counts) in zip(figure.subplots(3, len(shown)).T, shown.items(), strict=True):
            for row, axis in enumerate(column):
                some = counts[len(counts) * (row + 1) // 4 :][:steps]
                picture = some.sum(0) if end == "pictures" else judge.median_filtered(some, dt_s)[0]
                axis.imshow(events.picture(picture, 3.0).numpy())
                axis.set(xticks=[], yticks=[])
            column[0].set_title(title, fontsize=8)
        run.figure(figure, f"{name}_{end}", f"{text}. Red ON, blue OFF.")
    rates = {title: judge.binned(counts, dt_s)[..., 0, 0] for title, counts in shown.items()}
    draw(run, f"{name}_rates", rates, 2, "Events of 10 ms of the whole picture, ON and OFF.")
    cells = {
        title: judge.binned(counts, dt_s, judge.CELL_PX).sum(1).flatten(1) for title, counts in shown.items()
    }
    busy = (cells["physical sensor"].sum(0) > 0).nonzero()[:, 0]
    chosen = busy[torch.randperm(len(busy), generator=torch.Generator().manual_seed(run.config.seed))[:6]]
    patches = {title: values[:, chosen] for title, values in cells.items()}
    draw(run, f"{name}_patches", patches, 6, "Events of 10 ms in random patches of 8 x 8 pixels.")


def draw(run, name, curves, count, caption):
    """Figure of curves [bins, count] by title, an axis for each of ``count``."""
    figure = Figure(figsize=(9, 3 if count == 2 else 4.5), layout="constrained")
    for place, axis in enumerate(figure.subplots(count // 3 or 1, min(count, 3), sharex=True).flat):
        for title, values in curves.items():
            times_ms = 1e3 * judge.BIN_S * (torch.arange(len(values)) + 0.5)
            axis.plot(
                times_ms, values[:, place : place + 1], lw=2 if title == "physical sensor" else 1, label=title
            )
        axis.set(xlabel="time, ms")
    axis.legend(frameon=False, fontsize=7)
    run.figure(figure, name, caption)


if __name__ == "__main__":
    sys.exit(main(study, Config))
