"""Where does a flow objective buy a lens designer something? Five trades against the best spot designer.

What is traded: shortest track, fewest elements, largest aperture in dim light, coarsest manufacture, widest field. At
every value two designers work within the same limits from the same starts: one makes spots small over field, depth and
colour (damped least squares; weights and starts chosen by the flow error on development cases), the other lowers the
flow error itself by gradients through rays, frames, events and flow. Both are judged by the hard sensor on the same
held-out cases: textures and motions that neither saw, walls 0.3 to 5 m away.
"""

import json
import sys
from dataclasses import dataclass
from typing import Any, ClassVar

from codesign.atomic import write_atomic
from codesign.errors import DomainError
from codesign.reading import read_json, reading
from studies.frame.run import Run, StudyConfig, main
from studies.lens_trade import page
from studies.lens_trade.sweep import Effort, chain_job, lens_file, point_job, run_jobs
from studies.lens_trade.trades import TRADES


@dataclass(frozen=True)
class Config(StudyConfig):
    QUICK: ClassVar = {
        "trades": ("elements",),
        "starts": 1,
        "steps": 2,
        "batch": 1,
        "tries": 2,
        "development": 2,
        "judged": 3,
    }
    trades: tuple[str, ...] = tuple(TRADES)
    """Which trades: track, elements, aperture, tolerance, field."""
    starts: int = 5
    """Random starts of every trade."""
    steps: int = 10
    """Steps of the flow designer from every start."""
    batch: int = 5
    """Cases per step."""
    tries: int = 16
    """Lenses that the search without gradients tries after the descents."""
    development: int = 20
    """Cases by which both designers choose among their lenses."""
    judged: int = 52
    """Held-out cases."""
    workers: int = 2
    """Processes at a time, one thread each."""
    raw: str = ""
    """A raw table (raw.json of another run) whose rows are taken over instead of being worked out again."""


def study(run: Run[Config]) -> None:
    trade(run, run.config)


def trade(run: Run[Any], config: Config) -> None:
    """The study within a run, which may be that of ``lens_opt --trade``."""
    effort = _check(config)
    rows = _earlier(run, config)
    folder = run.folder / "lenses"
    folder.mkdir(exist_ok=True)

    def save():
        run.save_state({}, {"rows": rows})
        write_atomic(run.path("raw.json"), json.dumps(rows, indent=1).encode())

    run.on_interrupt(save)
    wanted = [(name, at) for name in config.trades for at in range(len(TRADES[name].values))]
    missing = [key for key in wanted if _key(*key) not in rows]
    chains = [
        ((name, seed), chain_job, (folder, name, seed))
        for name in dict.fromkeys(name for name, _ in missing)
        for seed in effort.starts
        if not lens_file(folder, name, len(TRADES[name].values) - 1, f"start{seed}").exists()
    ]
    with run.progress(len(chains), "spot optima of the random starts") as bar:
        for (name, seed), found in run_jobs(chains, config.workers):
            if isinstance(found, str):
                run.say(f"{name}, start {seed}: {found}")
            bar.advance()
    points = [((name, at), point_job, (folder, name, at, effort)) for name, at in missing]
    with run.progress(len(wanted), "both designers, value by value", done=len(wanted) - len(missing)) as bar:
        for (name, at), found in run_jobs(points, config.workers):
            rows[_key(name, at)] = (
                found if isinstance(found, dict) else {"trade": name, "at": at, "error": found}
            )
            save()
            bar.advance()
    save()
    page.write(
        run,
        {name: [rows[_key(name, at)] for at in range(len(TRADES[name].values))] for name in config.trades},
    )


def _check(config):
    unknown = set(config.trades) - set(TRADES)
    if unknown or not config.trades:
        raise DomainError(
            f"--trades {' '.join(sorted(unknown)) or '(none)'}: choose out of {', '.join(TRADES)}."
        )
    for name in ("starts", "steps", "batch", "tries", "development", "judged", "workers"):
        if getattr(config, name) < 1:
            raise DomainError(f"--{name} is {getattr(config, name)}; at least 1 is needed.")
    return Effort(
        tuple(range(config.seed, config.seed + config.starts)),
        config.steps,
        config.batch,
        config.tries,
        config.development,
        config.judged,
    )


def _earlier(run, config):
    """Rows of the session before, or of the table that was given."""
    stored = run.load_state()
    if stored is not None:
        return stored.numbers["rows"]
    if not config.raw:
        return {}
    rows = read_json(config.raw)
    with reading(f"--raw {config.raw}", "it is no raw table of this study"):
        return {_key(row["trade"], row["at"]): row for row in rows.values()}


def _key(name, at):
    return f"{name}_{at}"


if __name__ == "__main__":
    sys.exit(main(study, Config))
