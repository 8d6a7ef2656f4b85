"""Which step size suits each objective: the same start and steps, judged by the flow error on development cases."""

from dataclasses import replace
from typing import Any

from studies.frame.run import Run
from studies.lens_opt.descend import development_error, prepare

GRID = {"flow": ("step_size", (0.15, 0.3, 0.6)), "edge": ("edge_step_size", (0.1, 0.2, 0.4, 0.8))}


def scan(run: Run[Any], configs: list[Any]) -> list[list[Any]]:
    """Rows [objective, step size, error in mrad per config, their mean] of every step size on every config."""
    rows = []
    jobs = sum(len(sizes) for _, sizes in GRID.values()) * len(configs)
    with run.progress(jobs, "scanning step sizes") as bar:
        for objective, (name, sizes) in GRID.items():
            for size in sizes:
                errors = []
                for config in configs:
                    job = prepare(replace(config, objective=objective, **{name: size}))
                    job.loop.run(config.steps)
                    error = development_error(job.task, job.system.flow, config.developed, 2 * config.samples)
                    errors.append(error(job.best()))
                    run.say(f"{objective} {size:g}, seed {config.seed}: {errors[-1]:.3f} mrad")
                    bar.advance()
                rows.append([objective, size, *errors, sum(errors) / len(errors)])
    return rows
