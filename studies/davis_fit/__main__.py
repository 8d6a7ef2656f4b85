"""A real event camera against simulations from its own frames: thresholds are fitted by gradient on one half,
judged on the other.

The recording (DAVIS346, a Newton's cradle) has 13 frames at 25 per second and 320,000 events. Events are
simulated from the frames, at mid-exposure times, by the naive emulator, by the memorised-reference sensor as
published, and by the same sensor with parameters fitted by gradient (thresholds, dark offset, blur, low-pass,
noise). Judged per pixel (signed counts) and per polarity (rates), on the half of the recording that was not
fitted.
"""

import sys
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import ClassVar, Literal

import torch

from codesign.errors import DomainError
from studies.davis_fit import limits, page, score
from studies.davis_fit.compare import LABELS, flat, judge, simulate_all
from studies.davis_fit.loss import LOSSES
from studies.davis_fit.model import FittedSensor, clip
from studies.davis_fit.recording import default_path, load
from studies.davis_fit.search import descend, scan_length, scan_naive
from studies.davis_fit.upsample import between, flows
from studies.frame.run import Run, StudyConfig, main

OFFSETS_S = [k * 1e-3 for k in range(11)]


@dataclass(frozen=True)
class Config(StudyConfig):
    QUICK: ClassVar = {"upsample": 2, "steps": 6, "resamples": 200}
    recording: Path | None = None
    """File with frames and events, .npz or .aedat4; ../shared/data/davis346_newton_cradle/demo-01.npz beside
    the repository when left out."""
    upsample: int = 4
    """Steps per frame interval, made by moving pictures along their optical flow; 1 leaves it out."""
    steps: int = 60
    """Steps of the gradient descent."""
    loss: Literal["match", "squares", "roots", "poisson"] = "match"
    """What the fit makes small: correlation and rates (match), squared error of signed counts, of square
    roots, or the Poisson likelihood."""
    resamples: int = 2000
    """Bootstrap draws of pixel blocks."""


@dataclass(frozen=True)
class Fold:
    """Which intervals are fitted and which judged. judged: name of the half that is judged."""

    judged: str
    fit: slice
    test: slice


def study(run: Run[Config]) -> None:
    config = run.config
    if min(config.upsample, config.steps, config.resamples) < 1:
        raise DomainError(
            f"upsample, steps and resamples are {config.upsample}, {config.steps} and {config.resamples}; "
            "each must be at least 1."
        )
    recording = load(config.recording or default_path())
    recorded = recording.counts()
    last = len(recording.frames) - 1
    folds = [
        Fold("second", slice(0, last // 2), slice(last // 2, last)),
        Fold("first", slice(last // 2, last), slice(0, last // 2)),
    ]
    clips, forth = make_clips(run, recording, config.upsample)
    sensors = fit_all(run, clips, recorded, folds, config.steps)
    naives = scan_all(run, clips, recorded, folds)
    simulated = {}
    figures = {}
    for fold in folds:
        generator = torch.Generator().manual_seed(config.seed)
        simulated[fold.judged] = simulate_all(
            recording, clips, sensors[fold.judged], naives[fold.judged], generator
        )
        figures[fold.judged] = {
            name: judge(counts[fold.test], recorded[fold.test], config.resamples, config.seed)
            for name, counts in simulated[fold.judged].items()
        }
        for name, found in figures[fold.judged].items():
            run.record(**flat(name, fold, found))
        record_gains(run, fold, figures[fold.judged])
    curves = measure_limits(run, recording, recorded, forth, folds, simulated)
    page.show(
        run, page.Results(recording, clips, folds, sensors, naives, simulated, figures, OFFSETS_S, curves)
    )


def make_clips(run, recording, factor):
    """Clips by name: "frames" as recorded, "moved" with steps between (where factor > 1); and the flow [T-1,
    2, H, W] or None."""
    frames = recording.frames
    step_s = float((recording.mid_s[-1] - recording.mid_s[0]) / (len(recording.frames) - 1))
    spread = float((recording.mid_s.diff() - step_s).abs().max())
    if spread > 0.01 * step_s:
        raise DomainError(
            f"frame intervals differ by up to {spread:.2g} s from their mean {step_s:.3g} s; a recording "
            "with even frame times is needed."
        )
    clips = {"frames": clip(frames, step_s, 1)}
    forth = None
    if factor > 1:
        parts = []
        forth = []
        with run.progress(len(frames) - 1, "optical flow") as progress:
            for first, second in pairwise(frames):
                there, back = flows(first, second)
                parts.append(between(first, second, there, back, factor))
                forth.append(torch.from_numpy(there))
                progress.advance()
        clips["moved"], forth = (
            clip(torch.cat((*parts, frames[-1:])), step_s / factor, factor),
            torch.stack(forth),
        )
    return clips, forth


def fit_all(run, clips, recorded, folds, steps):
    """FittedSensor by judged half and clip name. Fits that an earlier session finished are taken from its
    state."""
    jobs = [(fold, name) for fold in folds for name in clips]
    stored = run.load_state() if run.resumed else None
    done = dict(stored.numbers) if stored else {}
    sensors = {fold.judged: {} for fold in folds}
    run.on_interrupt(
        lambda: run.save_state({}, done)
    )  # a fit that was cut begins anew: it takes a minute, and nothing in it is random
    with run.progress(len(jobs) * steps, "fitting", len(done) * steps) as progress:
        for fold, name in jobs:
            sensor = FittedSensor()
            key = f"{fold.judged}_{name}"
            if key in done:
                sensor.load_state_dict({parameter: torch.tensor(raw) for parameter, raw in done[key].items()})
            else:
                losses = descend(
                    sensor, clips[name], recorded, fold.fit, LOSSES[run.config.loss], steps, progress.advance
                )
                done[key] = {parameter: float(raw) for parameter, raw in sensor.state_dict().items()}
                run.record(
                    **{
                        f"{model_name(name)}_for_{fold.judged}_half_{end}_loss": losses[k]
                        for k, end in ((0, "first"), (-1, "last"))
                    }
                )
            run.record(
                **{
                    f"{model_name(name)}_for_{fold.judged}_half_{parameter}": value.detach()
                    for parameter, value in sensor.values().items()
                }
            )
            sensors[fold.judged][name] = sensor
    run.save_state({}, done)
    return sensors


def model_name(clip_name):
    """Name of the fitted model on a clip, as in metrics.json."""
    return "fitted" if clip_name == "frames" else f"fitted_{clip_name}"


def scan_all(run, clips, recorded, folds):
    """Fitted (theta, dark offset) of the naive emulator by judged half and clip name."""
    found = {fold.judged: {} for fold in folds}
    with run.progress(len(folds) * len(clips) * scan_length(), "naive grid") as progress:
        for fold in folds:
            for name, frames in clips.items():
                found[fold.judged][name] = scan_naive(frames, recorded, fold.fit, progress.advance)
                for kind, (theta, dark_offset) in found[fold.judged][name].items():
                    start = f"naive_{model_name(name).replace('fitted', kind)}_for_{fold.judged}_half"
                    run.record(**{f"{start}_theta": theta, f"{start}_dark_offset": dark_offset})
    return found


def record_gains(run, fold, figures):
    """Gain in correlation at 1 px of the best fitted model over every other, paired over bootstrap draws."""
    best = [name for name in LABELS if name in figures][-1]
    for name, other in figures.items():
        if name != best:
            gain = score.interval(figures[best].draws - other.draws)
            start = f"{best}_over_{name}_on_{fold.judged}_half_correlation_1px"
            run.record(
                **{
                    f"{start}_gain": gain.value,
                    f"{start}_gain_low": gain.low,
                    f"{start}_gain_high": gain.high,
                }
            )


def measure_limits(run, recording, recorded, forth, folds, simulated):
    """Record what limits the comparison; returns curves over OFFSETS_S by label, for the intervals that stay
    within the recording when moved."""
    run.record(**limits.still_events(recording))
    exposed = recording.exposure_s / float(recording.mid_s.diff().mean())
    run.record(cancelled_share_recorded=limits.cancelled_share(recorded), exposed_share_of_time=exposed)
    for name in simulated["second"]:
        run.record(
            **{
                f"cancelled_share_{name}": limits.cancelled_share(
                    torch.cat([simulated[fold.judged][name][fold.test] for fold in folds])
                )
            }
        )
    if forth is not None:
        run.record(
            **{
                f"motion_px_interval_{k}": motion
                for k, motion in enumerate(limits.median_motion_px(forth, recorded))
            }
        )
    end_s = float(recording.stream.t_us.max()) * 1e-6
    whole = sum(
        float(time_s) + OFFSETS_S[-1] <= end_s for time_s in recording.mid_s[1:]
    )  # the recording may end before the last moved interval does
    curves = {}
    for fold in folds:
        fit, test = (slice(part.start, min(part.stop, whole)) for part in (fold.fit, fold.test))
        for name in ("fitted", "fitted_moved"):
            if name in simulated[fold.judged]:
                counts = simulated[fold.judged][name]
                chosen = max(
                    zip(limits.offset_curve(counts, recording, OFFSETS_S, fit), OFFSETS_S, strict=True)
                )[1]
                curve = curves[name, fold.judged] = limits.offset_curve(counts, recording, OFFSETS_S, test)
                start = f"{name}_on_{fold.judged}_half_moved_times"
                run.record(
                    **{
                        f"{start}_offset_s": chosen,
                        f"{start}_correlation_1px": curve[OFFSETS_S.index(chosen)],
                        f"{start}_correlation_1px_unmoved": curve[0],
                    }
                )
        curves["recording", fold.judged] = limits.self_curve(recording, OFFSETS_S, test)
        for offset_s, value in zip(OFFSETS_S, curves["recording", fold.judged], strict=True):
            run.record(
                **{
                    f"recording_on_{fold.judged}_half_against_itself_{round(1e3 * offset_s)}_ms_later_correlation_1px": value
                }
            )
    return curves


if __name__ == "__main__":
    sys.exit(main(study, Config))
