"""Do the differentiable event layers point the way the hard sensor goes? Against differences of hard counts,
by layer, sensor, frame rate and direction.

A camera passes a textured plane behind a thin lens. What a layer gives is pooled over blocks, quarters of the
time and polarity; one direction each changes the contrast of the scene, the focus of the lens, or a component of
the camera's pose, by enough to move log levels by about a threshold. The derivative of every pooled number along
the direction, averaged over the step, is set beside the difference of the hard sensor's over the step. A pixel's
count is a whole number that depends on where inside its thresholds it began; the differences are means over
beginnings, the same on both sides.
"""

import sys
from dataclasses import dataclass
from typing import Any, ClassVar

import matplotlib.pyplot as plt
import numpy as np

from codesign.errors import DomainError
from studies.event_gradient import (
    dead_time,
    flow_of_events,
    layers,
    pointwise,
    sensors,
    spiking,
    thresholds,
    timing,
)
from studies.event_gradient.case import DIRECTIONS, Case
from studies.event_gradient.compare import Row
from studies.event_gradient.topic import Topic, label
from studies.frame.run import Run, StudyConfig, main

TOPICS: dict[str, Topic] = {
    "layers": layers.TOPIC,
    "counts": layers.COUNTS,
    "thresholds": thresholds.TOPIC,
    "curves": thresholds.CURVES,
    "pointwise": pointwise.TOPIC,
    "sensors": sensors.TOPIC,
    "dead_time": dead_time.TOPIC,
    "flow": flow_of_events.TOPIC,
    "timing": timing.TOPIC,
    "spiking": spiking.TOPIC,
}


@dataclass(frozen=True)
class Config(StudyConfig):
    QUICK: ClassVar = {"scenes": 1}
    topics: tuple[str, ...] = tuple(TOPICS)
    """What to measure."""
    scenes: int = 2
    """Textures and paths over which cosine and scale are taken together."""


def study(run: Run[Config]) -> None:
    config = run.config
    unknown = [name for name in config.topics if name not in TOPICS]
    if unknown or not config.topics or config.scenes < 1:
        raise DomainError(
            f"--topics is {' '.join(config.topics)}, --scenes {config.scenes}; topics are {', '.join(TOPICS)}, and at "
            "least one scene is needed."
        )
    cases = [Case(seed) for seed in range(config.seed, config.seed + config.scenes)]
    stored = run.load_state()
    found: dict[str, list[Any]] = {} if stored is None else dict(stored.numbers)
    work = [(name, job) for name in config.topics for job in TOPICS[name].jobs(config.quick)]
    left = [(name, job) for name, job in work if label((name, *job)) not in found]
    with run.progress(len(work), "differentiating", done=len(work) - len(left)) as progress:
        for name, job in left:
            rows = list(TOPICS[name].measure(cases, *job))
            for row in rows:
                run.record(**row.metrics(TOPICS[name].prefix))
            found[label((name, *job))] = [(row.names, row.numbers) for row in rows]
            run.save_state({}, found)
            progress.advance()
    report(
        run,
        {
            name: [
                Row(tuple(names), numbers)
                for job in TOPICS[name].jobs(config.quick)
                for names, numbers in found[label((name, *job))]
            ]
            for name in config.topics
        },
    )


def report(run: Run[Config], rows: dict[str, list[Row]]) -> None:
    """The page: a section for every topic, and what falls short of what is asked."""
    missed = []
    for name, mine in rows.items():
        topic = TOPICS[name]
        short = [row for row in mine if (asked := topic.asked(row)) and asked.missed(row)]
        judged = sum(topic.asked(row) is not None for row in mine)
        if judged:
            run.record(**{f"missed_{name}": len(short), f"judged_{name}": judged})
        missed += [f"{name}: {len(short)} of {judged} rows"] if short else []
        run.section(topic.title, topic.text)
        numbers = list(mine[0].numbers)
        run.table(
            topic.title,
            (*topic.columns, *(key.replace("_", " ") for key in numbers)),
            [(*row.names, *(row.numbers[key] for key in numbers)) for row in mine],
            caption="Below what is asked: " + "; ".join(" ".join(row.names) for row in short)
            if short
            else "",
        )
        if name == "layers":
            run.figure(
                figure(mine),
                "gradients",
                "Cosine and scale by frame rate; a line per direction. Scales beyond the axis are in the table.",
            )
    run.section("Directions")
    run.text("\n".join(f"- **{d.name}**: {d.noun}." for d in DIRECTIONS))
    run.finish(
        "Gradients of the event layers",
        f"**Below what is asked:** {'; '.join(missed)}." if missed else "All that is asked is met.",
    )


def figure(rows: list[Row]) -> plt.Figure:
    """Cosine and scale of the layers by frame rate."""
    chart, axes = plt.subplots(1, 2, figsize=(10, 3.6), sharex=True, layout="constrained")
    rates = sorted({int(row.names[2].removesuffix("fps")) for row in rows})
    for layer, colour in zip(layers.LAYERS, plt.get_cmap("viridis")(np.linspace(0, 0.85, 4)), strict=True):
        for number, direction in enumerate(DIRECTIONS):
            mine = [row for row in rows if row.names[:2] == (layer, direction.name)]
            for axis, key in zip(axes, ("cosine", "scale"), strict=True):
                axis.plot(
                    [int(row.names[2].removesuffix("fps")) for row in mine],
                    [row.numbers[key] for row in mine],
                    "o-",
                    color=colour,
                    label=layer if number == 0 else None,
                    markersize=4,
                    linewidth=1,
                )
    for axis, title in zip(axes, ("cosine", "scale"), strict=True):
        axis.axhline(1, color="0.6", linewidth=0.8)
        axis.set(xscale="log", xlabel="frames per second", title=title, xticks=rates, xticklabels=rates)
        axis.minorticks_off()
    axes[1].set_ylim(-0.2, 2.2)  # some of the comparator's are hundreds of times too long
    axes[0].legend(fontsize=8)
    return chart


if __name__ == "__main__":
    sys.exit(main(study, Config))
