"""Do emulated events train a classifier for a real sensor? Digits moved by saccades, events of several
generators, tested on a physical sensor's events.

Every generator sees the same pictures as video; a small residual network is trained on voxels of its events
and tested on those of the physical sensor (mismatch, bandwidth, leak, shot noise, dead time), which sees the
motion itself. Best thresholds and fitted generators come from recordings of other pictures. In the manner of
N-MNIST and N-Caltech101: three saccades along a triangle.
"""

import math
import sys
from dataclasses import dataclass, replace
from typing import ClassVar

import torch

from codesign import events
from codesign.errors import DomainError
from codesign.types import EventStream
from studies.event_classes import page, spiking
from studies.event_classes.generators import PHYSICAL, PICTURES_AT_ONCE, SOURCES, THETAS, noise_alone, record
from studies.event_classes.network import predict, train
from studies.event_classes.pictures import CLASSES, Pictures, draw_pictures
from studies.event_classes.saccades import frame_times, frames
from studies.event_classes.score import by_seed
from studies.frame.run import Run, StudyConfig, main

FIT_STEPS = 80
# each draws pictures, noise and weights of its own
TEST = 1
CALIBRATION = 2
TRAINING = 3


@dataclass(frozen=True)
class Config(StudyConfig):
    QUICK: ClassVar = {"seeds": 2, "training": 60, "test": 60, "calibration": 30, "epochs": 3}
    seeds: int = 5
    """Repeats, each with training pictures, noise and first weights of its own. The test is the same for
    all."""
    training: int = 800
    """Pictures to train on."""
    test: int = 1000
    """Pictures to test on."""
    calibration: int = 200
    """Recorded pictures that thresholds and generators are fitted to."""
    epochs: int = 12
    """Passes over the training pictures."""
    bins: int = 6
    """Time bins of a voxel grid."""
    video_hz: float = 100.0
    """Frame rate that the generators see."""
    sensor_hz: float = 1000.0
    """Frame rate that stands for the motion itself, for the physical sensor."""


def study(run: Run[Config]) -> None:
    config = checked(run.config)
    test = draw_pictures(config.test, "test", (run.config.seed, TEST))
    heard = _record(run, test, PHYSICAL, TEST)
    store = _Store(run)
    sources = [*calibrate(run, store), PHYSICAL]
    found = repeat(run, sources, test, heard, store)
    run.record(
        noise_events_per_picture=noise_alone(test.tiles[:100], run.config.sensor_hz, run.config.seed),
        training_pictures=config.training,
        test_pictures=config.test,
    )
    page.show(
        run,
        [source.key for source in sources],
        {source.key: source.label for source in sources},
        found,
        _examples(run, test, sources),
        test.labels,
    )


def calibrate(run, store):
    """Every generator but the sensor, thresholds chosen and networks fitted with the physical sensor's
    recordings of calibration pictures."""
    seed = run.config.seed
    video_s = frame_times(run.config.video_hz)
    sensor_s = frame_times(run.config.sensor_hz)
    pictures = draw_pictures(run.config.calibration, "training", (seed, CALIBRATION))
    generator = torch.Generator().manual_seed(seed + CALIBRATION)
    counts = []
    for part in pictures.tiles.split(PICTURES_AT_ONCE):
        stream = PHYSICAL.make(frames(part, sensor_s), sensor_s, generator)
        counts.append(events.to_counts(stream, video_s).unflatten(2, (len(part), -1)))
    seen = frames(pictures.tiles, video_s)
    counts = torch.cat(counts, 2)
    made = []
    fit_steps = 3 if run.config.quick else FIT_STEPS
    for key in (
        spiking.MODELS
    ):  # fits repeat exactly from the seed and take seconds, so a resumed run makes them again
        with run.progress(fit_steps, f"fitting {key}") as progress:
            made += spiking.fitted(key, seen, counts, video_s, seed, fit_steps, progress.advance)
    heard = _record(run, pictures, PHYSICAL, CALIBRATION)
    return [
        *(
            _best_threshold(run, source, pictures, heard, store) if source.searched else source
            for source in SOURCES
        ),
        *made,
    ]


def _best_threshold(run, source, calibration, heard, store):
    """The source with the threshold whose events train the best classifier of the calibration recordings."""
    pictures = draw_pictures(run.config.training, "training", (run.config.seed, TRAINING, run.config.seeds))
    scores = {}
    thetas = (0.15, 0.3) if run.config.quick else THETAS
    with run.progress(len(thetas), f"θ of {source.key}") as progress:
        for theta in thetas:
            key = f"search/{source.key}/{theta}"
            if key not in store.tensors:
                voxels = _record(run, pictures, replace(source, make=source.make(theta)), TRAINING)
                store.put(
                    key,
                    predict(
                        train(voxels, pictures.labels, run.config.epochs, run.config.seed, run.device),
                        heard,
                        run.device,
                    ),
                )
            scores[theta] = float((store.tensors[key] == calibration.labels).double().mean())
            run.record(**{f"{source.key}_theta_{theta:g}_calibration_accuracy": scores[theta]})
            progress.advance(accuracy=scores[theta])
    best = max(scores, key=scores.__getitem__)
    run.record(**{f"{source.key}_theta": best})
    return replace(source, make=source.make(best), label=f"{source.label} {best:g}", searched=False)


def repeat(run, sources, test, heard, store):
    """Predictions of the test by source: [seeds, test] int64. Finished ones are taken from an earlier
    session."""
    jobs = [(seed, source) for seed in range(run.config.seeds) for source in sources]
    done = sum(f"test/{source.key}/{seed}" in store.tensors for seed, source in jobs)
    drawn = None
    with run.progress(len(jobs), "training", done) as progress:
        for seed, source in jobs:
            key = f"test/{source.key}/{seed}"
            if key in store.tensors:
                continue
            if drawn is None or drawn[0] != seed:
                drawn = (
                    seed,
                    draw_pictures(run.config.training, "training", (run.config.seed, TRAINING, seed)),
                )
            voxels = _record(run, drawn[1], source, 100 * TRAINING + seed)
            net = train(voxels, drawn[1].labels, run.config.epochs, run.config.seed + seed, run.device)
            if seed == 0:
                own = heard if source is PHYSICAL else _record(run, test, source, TEST)
                right = predict(net, own, run.device) == test.labels
                run.record(
                    **{
                        f"{source.key}_own_events_accuracy": right.double().mean(),
                        f"{source.key}_events_per_picture": voxels.sum() / len(voxels),
                    }
                )
            guesses = predict(net, heard, run.device)
            store.put(key, guesses)
            progress.advance(accuracy=float((guesses == test.labels).double().mean()))
    return {
        source.key: by_seed(
            [store.tensors[f"test/{source.key}/{seed}"] for seed in range(run.config.seeds)], test.labels
        )
        for source in sources
    }


def _record(run, pictures: Pictures, source, purpose):
    """Voxels [N, 2, bins, H, W] of a source."""
    rate_hz = run.config.sensor_hz if source.rate == "sensor" else run.config.video_hz
    return record(pictures.tiles, source.make, rate_hz, run.config.bins, run.config.seed + purpose)


def _examples(run, test, sources):
    """Signed counts of the first leg by source key, [CLASSES, H, W], and under "picture" the pictures at
    rest."""
    tiles = test.tiles[:CLASSES]
    shown = {"picture": frames(tiles, torch.zeros(1))[0]}
    for source in sources:
        t_s = frame_times(run.config.sensor_hz if source.rate == "sensor" else run.config.video_hz)
        made = source.make(frames(tiles, t_s), t_s, torch.Generator().manual_seed(run.config.seed))
        if isinstance(made, EventStream):
            made = events.to_counts(made, t_s).unflatten(2, (CLASSES, -1))
        first_leg = made[: (len(t_s) - 1) // 3].sum(0)
        shown[source.key] = first_leg[0] - first_leg[1]
    return shown


def checked(config):
    """The configuration. Raises: DomainError for numbers too small to work with."""
    if (
        config.seeds < 2
        or config.training < 2 * CLASSES
        or min(config.test, config.calibration) < CLASSES
        or min(config.epochs, config.bins) < 1
    ):
        given = f"seeds {config.seeds}, training {config.training}, test {config.test}, calibration {config.calibration}, epochs {config.epochs}, bins {config.bins}"
        raise DomainError(
            f"{given}: at least 2 seeds, {2 * CLASSES} training, {CLASSES} test and {CLASSES} calibration "
            "pictures, 1 epoch and 1 bin are needed."
        )
    for name in ("video_hz", "sensor_hz"):
        if not 0 < getattr(config, name) < math.inf:
            raise DomainError(f"{name} is {getattr(config, name)!r}; give a finite rate above 0.")
        frame_times(getattr(config, name))
    return config


class _Store:
    """Predictions by name, saved after every training, so that a run that was stopped goes on behind the last
    one."""

    def __init__(self, run):
        stored = run.load_state() if run.resumed else None
        self.run = run
        self.tensors = dict(stored.tensors) if stored else {}

    def put(self, key, predictions):
        self.tensors[key] = predictions
        self.run.save_state(self.tensors, {})


if __name__ == "__main__":
    sys.exit(main(study, Config))
