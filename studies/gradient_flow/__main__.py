"""Are the gradients right, from the lens to the loss? Against central differences with common
random numbers, by case.

scenes: every junction and every group on five scenes, each right, wrong or not judgeable; its
count is the first line of the page, without it that of the other cases. chain, joint: more
precisely, junction by junction, and the whole graph with lens, mount, thresholds and network.
silhouettes: where objects hide one another.
"""

import json
import sys
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from codesign.errors import DomainError
from codesign.report import chain_figures
from studies.frame.config import check_least
from studies.frame.run import Run, StudyConfig, main
from studies.frame.sweep import sweep
from studies.gradient_flow import chain, silhouettes
from studies.gradient_flow.certificates import topic as certificates
from studies.gradient_flow.topic import NOT_JUDGEABLE, Row, Topic, label

CASES: dict[str, Topic] = {
    "scenes": certificates.TOPIC,
    "chain": chain.CHAIN,
    "joint": chain.JOINT,
    "silhouettes": silhouettes.TOPIC,
}


@dataclass(frozen=True)
class Config(StudyConfig):
    QUICK: ClassVar = {
        "cases": ("scenes",),
        "film_samples": 32,
        "draws": 4,
        "directions": 1,
        "hard_cases": 2,
        "samples": 512,
        "seeds": 2,
    }
    cases: tuple[str, ...] = ("scenes", "chain", "joint")
    """What to measure: scenes, chain, joint, silhouettes."""
    film_samples: int = 256
    """Samples per pixel of the frames of the five scenes."""
    draws: int = 16
    """Draws of these samples, over which gradients and differences are averaged, at least 2."""
    directions: int = 2
    """Random directions of a lens tensor or of an object's pose (scenes); 0: every number by
    itself."""
    hard_cases: int = 32
    """Motions and textures averaged for the straight-through layer against the hard loss
    (chain)."""
    samples: int = 1024
    """Samples per pixel of differences and precise gradients at silhouettes."""
    seeds: int = 4
    """Seeds of these, at least 2."""


def study(run: Run[Config]) -> None:
    config = run.config
    unknown = [name for name in config.cases if name not in CASES]
    if unknown or not config.cases:
        raise DomainError(
            f"--cases is {' '.join(config.cases)!r}; choose among {', '.join(CASES)}."
        )
    check_least(config, 0, "directions")
    check_least(config, 1, "film_samples", "hard_cases")
    check_least(config, 2, "draws", "seeds")
    check_least(config, 64, "samples")
    if config.quick:
        run.say(
            "quick form: few samples and directions; frames with silhouettes are left to the full form."
        )
    done = []
    try:
        for name in config.cases:
            done.append(name)
            measured(run, name)
    except KeyboardInterrupt:
        report(run, done, interrupted=True)
        raise
    report(run, done)


def report(run: Run[Config], cases: list[str], interrupted: bool = False) -> None:
    rows = {name: found for name in cases if (found := stored(run, name))}
    missed = [short for name, found in rows.items() for short in show(run, name, found)]
    lead = [(certificates.headline(rows["scenes"]) if "scenes" in rows else headline(rows))]
    if interrupted:
        lead.append("**Interrupted**: the rows below are those that were done.")
    if missed:
        lead.append(f"**Below what is asked:** {'; '.join(missed)}.")
    elif not run.config.quick:
        lead.append("All that is asked is met.")
    run.say(lead[0])
    run.finish("Gradients beside differences", "\n\n".join(lead))


def headline(rows: dict[str, list[Row]]) -> str:
    """One sentence: how many gradients of the cases are judged, and how many of those are right.
    rows: by case."""
    asked = [
        bound.missed(row)
        for name, found in rows.items()
        for row in found
        if (bound := CASES[name].asked(row))
    ]
    return (
        f"{len(asked)} of {sum(map(len, rows.values()))} gradients ({', '.join(rows) or 'none yet'}) are "
        f"judged, and {asked.count(False)} of these are right within what is asked."
    )


def measured(run: Run[Config], name: str) -> None:
    topic = CASES[name]

    def cell(job):
        rows = list(topic.measure(run.config, *job))
        for row in rows:
            run.record(**row.metrics(name))
        return [{"names": list(row.names), "state": row.state, **row.numbers} for row in rows]

    sweep(run, cell, name, job={label(job): job for job in topic.jobs(run.config.quick)})


def stored(run: Run[Config], name: str) -> list[Row]:
    path = run.path(f"{name}.jsonl")
    lines = path.read_text(encoding="utf-8").splitlines() if path.exists() else []
    found = [row for line in lines for row in json.loads(line)[1]]
    return [Row(tuple(row.pop("names")), state=row.pop("state"), numbers=row) for row in found]


def show(run: Run[Config], name: str, rows: list[Row]) -> list[str]:
    """The section of a case; returns what falls short of what is asked."""
    topic = CASES[name]
    short = [row for row in rows if (asked := topic.asked(row)) and asked.missed(row)]
    judged = sum(topic.asked(row) is not None for row in rows)
    counts = {"missed": len(short), "judged": judged, "rows": len(rows)}
    run.record(**{f"{word}_{name}": count for word, count in counts.items()})
    run.card(topic.title, f"{judged - len(short)} of {judged}", "rows that reach what is asked")
    run.section(topic.title, topic.text)
    numbers = list(rows[0].numbers)
    states = ("state",) if rows[0].state else ()
    run.table(
        topic.title,
        (*topic.columns, *states, *(key.replace("_", " ") for key in numbers)),
        [
            (*row.names, *(row.state for _ in states), *(row.numbers[key] for key in numbers))
            for row in rows
        ],
        caption="Below what is asked: " + "; ".join(" ".join(row.names) for row in short)
        if short
        else "",
    )
    if "relative_error" in numbers:
        lines, columns = (list(dict.fromkeys(row.names[k] for row in rows)) for k in (0, 1))
        errors = np.full((len(lines), len(columns)), np.nan)
        for row in rows:
            if row.state != NOT_JUDGEABLE:
                at = lines.index(row.names[0]), columns.index(row.names[1])
                errors[at] = np.fmax(errors[at], row.numbers["relative_error"])
        figure = chain_figures.heat_map(errors, lines, columns, "relative error")
        caption = f"{topic.title}: largest relative error of what can be judged."
        run.figure(figure, f"heat_map_{name}", caption)
    return [f"{name}: {len(short)} of {judged} rows"] if short else []


if __name__ == "__main__":
    sys.exit(main(study, Config))
