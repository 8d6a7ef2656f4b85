"""Speed against error: every stage's cheaper and finer levels on one small scene, and the cheapest that is
good enough.

Stages: lens (pinhole, thin, traced), samples per pixel, scene (bitmap, analytic), event layers and frame
  rates, time bins, flow models. A level's time is the median of several repeats; its error is measured
  against the finest level of the stage or against the truth.
"""

import sys
from dataclasses import dataclass
from typing import ClassVar

import matplotlib.pyplot as plt
from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

from codesign.errors import DomainError
from studies.frame.run import Run, StudyConfig, main
from studies.frame.timing import measure
from studies.speed_error.fidelity import Setup, stages


@dataclass(frozen=True)
class Config(StudyConfig):
    QUICK: ClassVar = {"size_px": 32, "repeats": 3}
    size_px: int = 64
    """Width and height of the image."""
    repeats: int = 7
    """Timed repeats of every level; at least 3."""


@dataclass(frozen=True)
class Measured:
    """A level with its median processor and wall-clock seconds and its error."""

    name: str
    cpu_s: float
    wall_s: float
    error: float


def cheapest(levels, tolerance):
    """The level of least processor time whose error is within ``tolerance``; where none is, the one of least
    error.

    Returns: the level, and whether it is within the tolerance. Raises: DomainError when there is no level.
    """
    if not levels:
        raise DomainError("there is no level to choose from; give at least one.")
    enough = [level for level in levels if level.error <= tolerance]
    if enough:
        return min(enough, key=lambda level: level.cpu_s), True
    return min(levels, key=lambda level: level.error), False


def study(run: Run[Config]) -> None:
    config = run.config
    if config.size_px < 16 or config.repeats < 3:
        raise DomainError(f"size_px {config.size_px} and repeats {config.repeats}: give at least 16 and 3.")
    run.say("preparing the scene and its truth")
    found = stages(Setup(config.size_px, config.seed))
    table: dict[str, list[Measured]] = {}
    with run.progress(sum(len(stage.levels) for stage in found), "measuring") as progress:
        for stage in found:
            for level in stage.levels:
                error = stage.error(level.work())
                timing = measure(level.work, config.repeats, warm=1)
                table.setdefault(stage.name, []).append(Measured(level.name, timing.cpu, timing.wall, error))
                progress.advance(error=error, cpu_ms=1e3 * timing.cpu)
    lines = []
    for stage in found:
        levels = table[stage.name]
        best, enough = cheapest(levels, stage.tolerance)
        for level in levels:
            name = _metric(f"{stage.name}_{level.name}")
            run.record(
                **{f"{name}_cpu_s": level.cpu_s, f"{name}_wall_s": level.wall_s, f"{name}_error": level.error}
            )
        run.record(
            **{
                f"{_metric(stage.name)}_chosen_cpu_s": best.cpu_s,
                f"{_metric(stage.name)}_chosen_error": best.error,
                f"{_metric(stage.name)}_within_tolerance": int(enough),
            }
        )
        verdict = (
            f"**{best.name}** is the cheapest level with an error of at most {stage.tolerance:g}"
            if enough
            else f"no level stays within {stage.tolerance:g}; **{best.name}** comes closest"
        )
        lines.append(
            f"{stage.name.capitalize()}: {verdict} ({best.error:.2g}, {1e3 * best.cpu_s:.3g} CPU-ms)."
        )
        run.section(stage.name.capitalize(), lines[-1])
        run.figure(
            _figure(stage, levels, best),
            f"speed_error_{_metric(stage.name)}",
            f"Time against error. Error: {stage.measure}. Red: the tolerance; ringed: the choice. A level "
            "without error stands at the bottom.",
        )
        run.table(
            "",
            ("level", "CPU median, ms", "wall median, ms", "error"),
            [(level.name, 1e3 * level.cpu_s, 1e3 * level.wall_s, level.error) for level in levels],
        )
    run.card("Stages", str(len(found)), f"{sum(map(len, table.values()))} levels")
    run.finish(
        "Speed against error",
        "Each stage has cheaper and finer levels. The cheapest one whose error is tolerable:\n\n"
        + "\n".join(f"- {line}" for line in lines),
    )


def _metric(text):
    return "_".join("".join(c if c.isalnum() else " " for c in text).split()).lower()


def _figure(stage, levels, best):
    figure, axes = plt.subplots(figsize=(7, 3.8), layout="constrained")
    positive = [level.error for level in levels if level.error > 0]
    floor = min([*positive, stage.tolerance]) / 5
    for number, level in enumerate(levels, 1):
        at = (1e3 * level.cpu_s, max(level.error, floor))
        axes.plot(
            *at,
            "o" if level.error > 0 else "v",
            color=f"C{(number - 1) % 10}",
            markersize=7,
            alpha=0.8,
            label=f"{number}: {level.name}",
        )
        axes.annotate(
            str(number), at, textcoords="offset points", xytext=(5, 5 if number % 2 else -12), fontsize=9
        )
    axes.plot(
        1e3 * best.cpu_s,
        max(best.error, floor),
        "o",
        color="tab:green",
        markersize=14,
        fillstyle="none",
        markeredgewidth=2,
    )
    axes.axhline(stage.tolerance, color="firebrick", linewidth=1)
    axes.set(xscale="log", yscale="log", xlabel="processor time, ms (median)", ylabel="error")
    axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axes.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.margins(x=0.15, y=0.15)
    axes.grid(alpha=0.3)
    figure.legend(loc="outside right center", frameon=False, fontsize=9)
    return figure


if __name__ == "__main__":
    sys.exit(main(study, Config))
