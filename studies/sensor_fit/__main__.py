"""Fit an event sensor to a recording of a real camera, and say how true its events are where it was
not fitted.

Events are simulated from the recording's own frames, at mid-exposure times. Thresholds, dark
offset, blur, low-pass and noise are fitted by gradient to the events of the first half and judged
on those of the second, beside the ideal sensor and v2e's default one. The fitted sensor is saved as
sensor.json.
"""

import math
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import torch

from codesign import events
from codesign.errors import DomainError
from studies.frame.config import check_least
from studies.frame.run import Run, StudyConfig, main
from studies.frame.show import pictures
from studies.sensor_fit.recording import default_path, load
from studies.sensor_fit.sensor import START, Fit, FittedSensor

LABELS = {"ideal": "ideal sensor, θ 0.2", "v2e": "v2e's default sensor", "fitted": "fitted sensor"}


@dataclass(frozen=True)
class Config(StudyConfig):
    QUICK: ClassVar = {"steps": 6}
    recording: Path | None = None
    """File with frames and events, .npz or .aedat4;
    ../shared/data/davis346_newton_cradle/demo-01.npz beside the repository when left out."""
    steps: int = 60
    """Steps of the gradient descent."""


def study(run: Run[Config]) -> None:
    config = run.config
    check_least(config, 1, "steps")
    recording = load(config.recording or default_path())
    recorded = recording.counts()
    half = len(recorded) // 2
    sensor = fitted(run, recording, recorded[:half])
    sensor.save(run.path("sensor.json"))
    generator = torch.Generator().manual_seed(config.seed)
    seen = recording.frames, recording.mid_s
    simulated = {
        "ideal": events.dense_counts(*seen, events.SensorModel()),
        "v2e": events.dense_counts(*seen, events.PRESETS["default"], generator),
        "fitted": sensor.draw(*seen, generator),
    }
    figures = {name: judge(counts[half:], recorded[half:]) for name, counts in simulated.items()}
    for name, found in figures.items():
        run.record(**{f"{name}_{key}": value for key, value in found.items()})
    show(run, recording, sensor, simulated, figures)


def fitted(run, recording, recorded):
    """FittedSensor of the first intervals, whose counts are ``recorded``; a stopped fit goes on
    exactly."""
    seen = slice(0, len(recorded) + 1)
    fit = Fit(
        FittedSensor(), recording.frames[seen], recording.mid_s[seen], recorded, run.config.steps
    )
    stored = run.load_state() if run.resumed else None
    if stored:
        fit.restore(stored.tensors, stored.numbers)
    run.on_interrupt(lambda: run.save_state(*fit.state()))
    with run.progress(fit.steps, "fitting", len(fit.losses)) as progress:
        while len(fit.losses) < fit.steps:
            progress.advance(loss=fit.step())
    run.save_state(*fit.state())
    sensor = fit.keep_best()
    run.record(first_loss=fit.losses[0], best_loss=min(fit.losses))
    run.record(**{name: value.detach() for name, value in sensor.values().items()})
    return sensor


def judge(simulated, recorded):
    """Figures by name of simulated counts against recorded ones, [T, 2, H, W] both, ON first.

    rate_factor: exp of the root mean square log of the ratios by interval and polarity: 1.2 is 20 %
      off in a typical interval.
    Raises: DomainError when nothing was recorded in one polarity.
    """
    totals = recorded.double().sum((0, 2, 3))
    if (totals == 0).any():
        raise DomainError(
            "no event of one polarity was recorded in the second half; record for longer."
        )
    signed = torch.stack(
        [(counts[:, 0] - counts[:, 1]).flatten() for counts in (simulated, recorded)]
    )
    on, off = (simulated.double().sum((0, 2, 3)) / totals).tolist()
    # one event more, so that a silent interval has a ratio
    ratios = (simulated.double().sum((2, 3)) + 1) / (recorded.double().sum((2, 3)) + 1)
    return {
        "correlation": float(torch.corrcoef(signed.double())[0, 1]),
        "ratio_on": on,
        "ratio_off": off,
        "rate_factor": math.exp(float(ratios.log().square().mean().sqrt())),
    }


def show(run, recording, sensor, simulated, figures):
    recorded = recording.counts()
    half = len(recorded) // 2
    rows = [(LABELS[name], *found.values()) for name, found in figures.items()]
    run.table(
        "Judged on the second half, fitted on the first",
        ("model", "correlation of ON − OFF", "ON ratio", "OFF ratio", "rates off by"),
        rows,
        "Correlation per pixel and interval; events simulated over recorded. 'Rates off by': factor by which "
        "the events of an interval and polarity are typically too many or too few.",
    )
    totals = torch.stack(
        [counts.sum((2, 3)) for counts in (recorded, simulated["fitted"])], 2
    ).flatten(1)
    run.table(
        "Events by interval",
        ("interval", "half", "ON recorded", "ON fitted", "OFF recorded", "OFF fitted"),
        [
            (k, "first" if k < half else "second", *row)
            for k, row in enumerate(totals.long().tolist())
        ],
    )
    run.table(
        "Fitted sensor (sensor.json)",
        ("parameter", "start", "fitted"),
        [(name, START[name], f"{value.detach():.3g}") for name, value in sensor.values().items()],
    )
    run.figure(
        maps(recorded, simulated, half),
        "maps",
        "ON − OFF per pixel; red: more ON. The second half: its busiest, a middling and its quietest "
        "interval.",
    )
    best, ideal = figures["fitted"], figures["ideal"]
    truer = ["shape"] * (best["correlation"] > ideal["correlation"])
    truer += ["number"] * (best["rate_factor"] < ideal["rate_factor"])
    alone = f" in {truer[0]} alone" if len(truer) == 1 else ""
    lead = (
        f"The fitted sensor's events are {'truer' if truer else 'no truer'} than those of an ideal one{alone}. "
        f"On the half that was not fitted, signed counts correlate by **{best['correlation']:.3f}** "
        f"(ideal sensor {ideal['correlation']:.3f}); ON and OFF events number "
        f"{best['ratio_on']:.2f} and {best['ratio_off']:.2f} times the recorded ones "
        f"({ideal['ratio_on']:.2f} and {ideal['ratio_off']:.2f})."
    )
    run.finish("A sensor fitted to a recording", lead)


def maps(recorded, simulated, half):
    """Figure: signed counts of three intervals of the second half, side by side."""
    columns = {"recorded": recorded, **{LABELS[name]: counts for name, counts in simulated.items()}}
    ranked = (recorded[half:].sum((1, 2, 3)).argsort(descending=True) + half).tolist()
    chosen = (ranked[0], ranked[len(ranked) // 2], ranked[-1])
    rows = {
        f"interval {k}": {title: counts[k, 0] - counts[k, 1] for title, counts in columns.items()}
        for k in chosen
    }
    return pictures(rows, signed=columns, side=3.4)


if __name__ == "__main__":
    sys.exit(main(study, Config))
