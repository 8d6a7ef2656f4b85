"""What the first process does beside training: progress, validation, checkpoints, logs, and the
results and their page at the end."""

import json
import statistics
import sys
from dataclasses import asdict
from typing import Any

import numpy as np
import torch

from codesign import flow
from codesign.flow import checkpoint
from codesign.optional import optional
from codesign.report.flow_colours import flow_colours
from codesign.train import checkpoint as training
from codesign.train.batches import to_device
from codesign.train.validation import batches, score
from studies.frame.show import Panel, panels
from studies.frame.show import pictures as show_pictures

tensorboard = optional("torch.utils.tensorboard", "training-logs", "the log of a training")
FEW = 8  # windows, below which a set decides nothing
RECENT = 50  # steps over which the shown loss is averaged


class Watch:
    """Context around the training of a run; call ``after_step`` after each step, ``finish`` at the
    end."""

    def __init__(self, run, job, clock):
        self.run = run
        self.config = run.config
        self.job = job
        self.clock = clock
        self._earlier_s = job.progress.validation_s
        self._kept = {}
        self._closed_form = {}
        self._log = tensorboard.SummaryWriter(
            str(run.path("tensorboard")), purge_step=job.progress.step + 1 if run.resumed else None
        )
        self._units = 0
        self._bar: Any = None
        run.on_interrupt(self.save)

    def __enter__(self):
        by_step = self.config.steps is not None
        self._units = self.job.progress.step if by_step else 0
        total, what = (
            (self.config.steps, "training") if by_step else (100, "training, % of the budget")
        )
        self._bar = self.run.progress(total, what, done=self._units)
        self._bar.__enter__()
        return self

    def __exit__(self, *error):
        self._bar.__exit__(*error)
        self._log.flush()

    def after_step(self, share):
        """Log the step; validate and save when it is time. share: of the budget, spent."""
        progress = self.job.progress
        step = progress.step
        for name, key in (("loss", "loss"), ("gradient_norm", "norm"), ("learning_rate", "rate")):
            self._log.add_scalar(f"training/{name}", getattr(progress, key)[-1], step)
        if step % self.config.validate_every == 0:
            self.validate()
        if step % self.config.save_every == 0:
            self.save()
        units = step if self.config.steps is not None else int(100 * min(share, 1.0))
        for _ in range(units - self._units):
            self._units += 1  # before advance, where an interrupt leaves the loop
            self._bar.advance(loss=statistics.fmean(progress.loss[-RECENT:]), step=step)

    def save(self):
        training.save(
            self.run.path("checkpoint"), self.job.learner, self.job.progress, self.job.facts
        )

    def validate(self):
        """Judge the network on the first windows of every set, and keep the figures."""
        progress = self.job.progress
        with self.clock("validation"):
            figures = {}
            for name, source in self.job.validation.items():
                if name not in self._kept:
                    self._kept[name] = list(batches(source, self.config.validation_windows))
                    self._closed_form[name] = score(flow.estimate_lk, self._kept[name])
                found = self._judged(self._kept[name])
                figures[name] = {
                    "ratio": found.ratio,
                    "worse_percent": found.worse_percent,
                    "closed_form_ratio": self._closed_form[name].ratio,
                }
                for key, value in figures[name].items():
                    self._log.add_scalar(f"{name}/{key}", value, progress.step)
        progress.validation_s = self._earlier_s + self.clock.spent["validation"]
        progress.validation.append({"step": progress.step, **figures})
        shown = "  ".join(
            f"{name} {value['ratio']:.3f} ({value['closed_form_ratio']:.3f})"
            for name, value in figures.items()
        )
        self.run.say(f"step {progress.step}: error over that of zero flow (closed form): {shown}")

    def finish(self):
        run = self.run
        progress = self.job.progress
        learner = self.job.learner
        self.save()
        scores = {}
        with self.clock("validation"), run.progress(len(self.job.validation), "judging") as bar:
            for name, source in self.job.validation.items():
                windows = list(batches(source, self.config.final_windows))
                scores[name] = self._judged(windows), score(flow.estimate_lk, windows)
                bar.advance()
        progress.validation_s = self._earlier_s + self.clock.spent["validation"]
        figures = {
            "steps": progress.step,
            "windows_shown": progress.step * self.config.batch,
            "weights": sum(p.numel() for p in learner.network.parameters()),
            "loss_last": statistics.fmean(progress.loss[-RECENT:]),
            "gradient_norm_largest": max(progress.norm),
            "clipped_steps": progress.clipped,
            "windows_without_truth": progress.blind,
            "cpu_data_minutes": progress.data_s / 60,
            "cpu_training_minutes": progress.training_s / 60,
            "cpu_validation_minutes": progress.validation_s / 60,
        }
        for name, (ours, closed) in scores.items():
            for who, found in (("", ours), ("closed_form_", closed)):
                figures |= {f"{name}_{who}{key}": value for key, value in _figures(found).items()}
            figures |= {f"{name}_windows": ours.windows}
        run.record(**figures)
        options = json.loads((run.folder / "config.json").read_text(encoding="utf-8"))
        kept = {name: options[name] for name in options if name not in ("out", "resume")}
        checkpoint.save(
            learner.delivered,
            run.path("network.safetensors"),
            {"training": kept, "metrics": figures, "python": sys.version.split()[0]},
        )
        self._log.close()
        show(run, self.job, scores)

    def _judged(self, windows):
        network = self.job.learner.delivered
        network.eval()
        found = score(network, windows, next(network.parameters()).device)
        network.train()
        return found


def _figures(found):
    """{name: value} of a Score; errors only where there is truth."""
    if found.blur is not None:
        return {"blur_ratio": found.blur, "worse_percent": found.worse_percent}
    figures = asdict(found) | {"ratio": found.ratio}
    return {name: figures[name] for name in ("aee_px", "ratio", "worse_percent", "zero_flow_px")}


def show(run, job, scores):
    config = run.config
    progress = job.progress
    rows = []
    for name, (ours, closed) in scores.items():
        run.card(
            f"{'error' if ours.blur is None else 'blur'} over zero flow's, {name.replace('_', ' ')}",
            f"{ours.ratio:.3f}",
            f"closed form {closed.ratio:.3f}; network worse than zero flow on {ours.worse_percent:.1f} %",
        )
        errors = (ours.aee_px, closed.aee_px, ours.zero_flow_px)
        errors = (*(errors if ours.blur is None else [None] * 3), ours.ratio, closed.ratio)
        rows.append((name, *errors, ours.worse_percent, closed.worse_percent, ours.windows))
    run.section(
        "On windows never trained on",
        "Error: mean endpoint error over valid pixels. Worse: windows whose own mean error is above that of "
        "zero flow. Windows without any true flow are judged by the blur of their warped events "
        "over that of zero flow.",
    )
    errors = ("error px", "closed form px", "zero flow px", "ratio", "closed form ratio")
    run.table("Errors", ("set", *errors, "worse %", "closed form worse %", "windows"), rows)
    run.section(
        "Training",
        f"{progress.step} steps of {config.batch} windows. Processor time: {progress.data_s / 60:.2f} min "
        f"making windows, {progress.training_s / 60:.2f} min training, "
        f"{progress.validation_s / 60:.2f} min validation (not part of the budget). Gradients shortened in "
        f"{progress.clipped} of {progress.step} steps.",
    )
    run.figure(
        curves(progress),
        "curves",
        "Loss and gradient norm (running means), and validation by step.",
    )
    run.figure(
        pictures(job, scores),
        "flows",
        "One window of each set: events (ON less OFF), true flow, closed form, network. Hue: direction; "
        "white: no flow; grey: no truth.",
    )
    cpu = (progress.data_s + progress.training_s) / 60
    run.finish(
        f"Training of {config.network}",
        f"{answer(scores)} {cpu:.1f} processor minutes, seed {config.seed}, loss {config.loss}.",
    )


def answer(scores):
    """How the network fares on sets never trained on."""
    said = [
        f"{ours.ratio:.2f} on {name.replace('_', ' ')} (closed form {closed.ratio:.2f})"
        for name, (ours, closed) in scores.items()
    ]
    few = min((ours.windows for ours, _ in scores.values()), default=FEW)
    decides = f" So few windows ({few}) decide nothing." if few < FEW else ""
    return f"The network's error or blur over that of zero flow: {', '.join(said)}.{decides}"


def curves(progress):
    width = max(1, min(RECENT, progress.step // 5))
    at = np.arange(width, progress.step + 1)
    charts = [
        Panel(
            {label: (at, np.convolve(values, np.ones(width) / width, "valid"))}, "step", label, "y"
        )
        for label, values in (("loss", progress.loss), ("gradient norm", progress.norm))
    ]
    series = {}
    for name in [name for entry in progress.validation[-1:] for name in entry if name != "step"]:
        entries = [entry for entry in progress.validation if name in entry]
        for key, label in (("ratio", name), ("closed_form_ratio", f"{name}, closed form")):
            series[label] = (
                [entry["step"] for entry in entries],
                [entry[name][key] for entry in entries],
            )
    if series:
        charts.append(Panel(series, "step", "error over zero flow's"))
    return panels(*charts)


@torch.no_grad()
def pictures(job, scores):
    network = job.learner.delivered.eval()
    device = next(network.parameters()).device
    rows = {}
    for name in scores:
        windows = job.validation[name].batch([0])
        counts = windows.volume.counts[0]
        truth = windows.truth
        lengths = truth.flow_px.square().sum(1).sqrt()[truth.valid]
        longest = max(float(lengths.max()), 1e-6) if len(lengths) else 1.0
        flows = {
            "truth": truth.flow_px,
            "closed form": flow.estimate_lk(windows.volume).flow_px,
            "network": network(to_device(windows, device).volume).flow_px.float().cpu(),
        }
        shown = {title: flow_colours(each[0].numpy(), longest) for title, each in flows.items()}
        shown["truth"] = np.where(truth.valid[0].numpy()[..., None], shown["truth"], 0.6)
        label = f"{name}, up to {longest:.1f} px"
        rows[label] = {"events": (counts[0] - counts[1]).sum(0), **shown}
    return show_pictures(rows, signed=["events"], flow=True)
