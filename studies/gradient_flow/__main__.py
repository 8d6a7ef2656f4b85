"""Are the gradients right, from the lens to the loss? Against central differences with common
random numbers, by case.

chain, joint: junction by junction, and the whole graph with lens, mount, thresholds and network.
  layers,
sensors, timing: the event layers against differences of hard counts. silhouettes,
  silhouettes_chain:
where objects hide one another.
"""

import sys
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from codesign.errors import DomainError
from codesign.report import chain_figures
from studies.frame.run import Run, StudyConfig, main
from studies.frame.sweep import sweep
from studies.gradient_flow import chain
from studies.gradient_flow.events import topics
from studies.gradient_flow.silhouettes import flow, frames
from studies.gradient_flow.topic import Row, Topic, label

CASES: dict[str, Topic] = {
    "chain": chain.CHAIN,
    "joint": chain.JOINT,
    "layers": topics.LAYERS,
    "sensors": topics.SENSORS,
    "timing": topics.TIMING,
    "silhouettes": frames.TOPIC,
    "silhouettes_chain": flow.TOPIC,
}


@dataclass(frozen=True)
class Config(StudyConfig):
    QUICK: ClassVar = {"hard_cases": 2, "scenes": 1, "samples": 512, "seeds": 2}
    cases: tuple[str, ...] = ("chain", "joint")
    """What to measure: chain, joint, layers, sensors, timing, silhouettes, silhouettes_chain."""
    hard_cases: int = 32
    """Motions and textures averaged for the straight-through layer against the hard loss
    (chain)."""
    scenes: int = 2
    """Textures and paths over which cosine and scale are taken together (event layers,
    silhouettes_chain)."""
    samples: int = 1024
    """Samples per pixel of differences and precise gradients at silhouettes; a quarter of them
    along the chain."""
    seeds: int = 4
    """Seeds of these; twice as many along the chain."""


def study(run: Run[Config]) -> None:
    config = run.config
    unknown = [name for name in config.cases if name not in CASES]
    if unknown or not config.cases:
        raise DomainError(
            f"--cases is {' '.join(config.cases)!r}; choose among {', '.join(CASES)}."
        )
    for name, least in (("hard_cases", 1), ("scenes", 1), ("samples", 64), ("seeds", 2)):
        if getattr(config, name) < least:
            raise DomainError(f"{name} = {getattr(config, name)} must be at least {least}.")
    missed = []
    for name in config.cases:
        missed += show(run, name, measured(run, name))
    run.finish(
        "Gradients beside differences",
        f"**Below what is asked:** {'; '.join(missed)}." if missed else "All that is asked is met.",
    )


def measured(run: Run[Config], name: str) -> list[Row]:
    """The rows of a case, job by job."""
    topic = CASES[name]

    def cell(job):
        rows = list(topic.measure(run.config, *job))
        for row in rows:
            run.record(**row.metrics(name))
        return [{"names": list(row.names), **row.numbers} for row in rows]

    rows = sweep(run, cell, name, job={label(job): job for job in topic.jobs(run.config.quick)})
    return [
        Row(tuple(row["names"]), {k: v for k, v in row.items() if k not in ("job", "names")})
        for row in rows
    ]


def show(run: Run[Config], name: str, rows: list[Row]) -> list[str]:
    """The section of a case; returns what falls short of what is asked."""
    topic = CASES[name]
    short = [row for row in rows if (asked := topic.asked(row)) and asked.missed(row)]
    judged = sum(topic.asked(row) is not None for row in rows)
    run.record(**{f"missed_{name}": len(short), f"judged_{name}": judged})
    run.card(topic.title, f"{judged - len(short)} of {judged}", "rows that reach what is asked")
    run.section(topic.title, topic.text)
    numbers = list(rows[0].numbers)
    run.table(
        topic.title,
        (*topic.columns, *(key.replace("_", " ") for key in numbers)),
        [(*row.names, *(row.numbers[key] for key in numbers)) for row in rows],
        caption="Below what is asked: " + "; ".join(" ".join(row.names) for row in short)
        if short
        else "",
    )
    if "relative_error" in numbers:
        lines, columns = (list(dict.fromkeys(row.names[k] for row in rows)) for k in (0, 1))
        errors = np.full((len(lines), len(columns)), np.nan)
        for row in rows:
            errors[lines.index(row.names[0]), columns.index(row.names[1])] = row.numbers[
                "relative_error"
            ]
        figure = chain_figures.heat_map(errors, lines, columns, "relative error")
        run.figure(
            figure, f"heat_map_{name}", f"{topic.title}: relative error against differences."
        )
    return [f"{name}: {len(short)} of {judged} rows"] if short else []


if __name__ == "__main__":
    sys.exit(main(study, Config))
