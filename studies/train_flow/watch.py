"""What the first process does beside training: progress, validation, checkpoints, logs, and the results at
the end."""

import json
import statistics
import sys
from typing import Any

from codesign import flow
from codesign.flow import checkpoint
from codesign.optional import optional
from codesign.train import checkpoint as training
from codesign.train.validation import batches, score
from studies.train_flow import page

tensorboard = optional("torch.utils.tensorboard", "training-logs", "the log of a training")
RECENT = 50  # steps over which the shown loss is averaged


class Watch:
    """Context around the training of a run; call ``after_step`` after each step, ``finish`` at the end."""

    def __init__(self, run, config, job, clock):
        self.run = run
        self.config = config
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
        total, what = (self.config.steps, "training") if by_step else (100, "training, % of the budget")
        self._bar = self.run.progress(total, what, done=self._units)
        self._bar.__enter__()
        return self

    def __exit__(self, *error):
        self._bar.__exit__(*error)
        self._log.flush()

    def after_step(self, share):
        """Log the step; validate and save when it is time. share: of the budget, spent."""
        progress = self.job.progress
        config = self.config
        step = progress.step
        for name, values in (
            ("loss", progress.loss),
            ("gradient_norm", progress.norm),
            ("learning_rate", progress.rate),
        ):
            self._log.add_scalar(f"training/{name}", values[-1], step)
        if step % config.validate_every == 0:
            self.validate()
        if step % config.save_every == 0:
            self.save()
        units = step if config.steps is not None else int(100 * min(share, 1.0))
        for _ in range(units - self._units):
            self._units += 1  # before advance, where an interrupt leaves the loop
            self._bar.advance(loss=statistics.fmean(progress.loss[-RECENT:]), step=step)

    def save(self):
        """Write the checkpoint."""
        training.save(self.run.path("checkpoint"), self.job.learner, self.job.progress, self.job.facts)

    def validate(self):
        """Judge the network on the first windows of every set, and keep the figures."""
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
                    self._log.add_scalar(f"{name}/{key}", value, self.job.progress.step)
        self.job.progress.validation_s = self._earlier_s + self.clock.spent["validation"]
        self.job.progress.validation.append({"step": self.job.progress.step, **figures})
        shown = "  ".join(
            f"{name} {value['ratio']:.3f} ({value['closed_form_ratio']:.3f})"
            for name, value in figures.items()
        )
        self.run.say(f"step {self.job.progress.step}: error over that of zero flow (closed form): {shown}")

    def finish(self):
        """Save, judge on all windows, keep the network, write metrics and page."""
        run = self.run
        config = self.config
        progress = self.job.progress
        learner = self.job.learner
        self.save()
        scores = {}
        with self.clock("validation"), run.progress(len(self.job.validation), "judging") as bar:
            for name, source in self.job.validation.items():
                windows = list(batches(source, config.final_windows))
                scores[name] = self._judged(windows), score(flow.estimate_lk, windows)
                bar.advance()
        progress.validation_s = self._earlier_s + self.clock.spent["validation"]
        figures = {
            "steps": progress.step,
            "windows_shown": progress.step * config.batch,
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
        page.show(run, config, self.job, scores)

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
    return {
        "aee_px": found.aee_px,
        "ratio": found.ratio,
        "worse_percent": found.worse_percent,
        "zero_flow_px": found.zero_flow_px,
    }
