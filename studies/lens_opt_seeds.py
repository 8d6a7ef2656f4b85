"""lens_opt over several detunings: does the flow design beat its rivals every time? Its losses are
shown too."""

import dataclasses
import sys
from dataclasses import dataclass
from typing import ClassVar

import torch

from codesign.errors import DomainError
from studies.frame.compare import log_ratios, pooled, student
from studies.frame.config import configured
from studies.frame.run import Run, StudyConfig, main, open_run
from studies.lens_opt import __main__ as lens_opt
from studies.lens_opt.page import DESIGNS, RIVALS, label, verdict

COMPARED = ("refocused", "spots", "edge")


@dataclass(frozen=True)
class Config(StudyConfig):
    QUICK: ClassVar = {"seeds": (0, 1)}
    seeds: tuple[int, ...] = (0, 1, 2)
    """Seeds of the detuning and of the training cases."""
    lens: str = "cooke-triplet"
    """Lens to start from."""


def study(run: Run[Config]):
    config = run.config
    if not config.seeds or len(set(config.seeds)) < len(config.seeds):
        raise DomainError(f"seeds {config.seeds}: give at least one seed, and none twice.")
    parts = {}
    for seed in config.seeds:
        run.say(f"seed {seed}")
        parts[seed] = _one(run, seed)
    pairs = {}
    rows = []
    for design, rival in [*(("optimised", name) for name in COMPARED), ("after_spots", "spots")]:
        logs = torch.stack([_log_ratios(part, design, rival) for part in parts.values()])
        pair = pooled(logs)
        each = [student(row).percent() for row in logs]
        if design == "optimised":
            pairs[RIVALS[rival]] = pair
            name = rival
            run.record(**{f"{rival}_seeds_better": int((logs.mean(1) < 0).sum())})
            run.card(
                f"Against {RIVALS[rival]}",
                pair.percent(),
                "flow error of the flow design, all seeds",
            )
        else:
            name = design
        run.record(**pair.metrics(f"{name}_log_ratio"))
        title = RIVALS[rival] if name == rival else "flow steps after the spot designer, against it"
        rows.append([title, *each, pair.percent(), pair.outcome])
    run.section(
        "Change of flow error by the flow design",
        "Geometric mean over held-out cases, the same for every seed. An interval of all seeds is the wider of two: "
        "over cases, each averaged over the seeds, and over seeds, each averaged over its cases.",
    )
    run.table(
        "Rivals", ["rival", *(f"seed {s}" for s in parts), "all seeds", "the flow design"], rows
    )
    names = ("nominal", "detuned", *COMPARED, "optimised", "after_spots")
    run.section("Flow error and spots of every lens")
    for key, title in (
        ("flow_error_mrad_hard", "Flow error (mrad)"),
        ("rms_spot_um", "Mean RMS spot (µm)"),
    ):
        rows = [
            [seed, *(part.metrics[f"{key}_{name}"] for name in names)]
            for seed, part in parts.items()
        ]
        run.table(title, ["seed", *(label(name, "flow") for name in names)], rows)
        for seed, *figures in rows:
            run.record(
                **{f"seed{seed}_{key}_{name}": f for name, f in zip(names, figures, strict=True)}
            )
    run.record(seeds=len(parts))
    said = verdict(DESIGNS["flow"], pairs)
    run.finish(
        "Lens optimisation over seeds",
        f"**{said}**\n\n{config.lens}; every seed detunes the lens in its own way, to the same RMS spot at best focus.",
    )
    run.say(said)


def _one(run, seed):
    """A finished run of lens_opt in a folder below, going on with it when it was interrupted."""
    folder = run.folder / f"seed{seed}"
    fresh = configured(
        lens_opt.Config,
        run.config.quick,
        out=folder,
        seed=seed,
        device=run.config.device,
        lens=run.config.lens,
    )
    resume = (folder / "state.npz").exists()
    part = open_run("lens_opt", dataclasses.replace(fresh, resume=folder) if resume else fresh)
    if not (folder / "report.html").exists():
        lens_opt.study(part)
    return part


def _log_ratios(part, design, rival):
    """Of the flow errors of two lenses of a finished run on its held-out cases, [cases]."""
    found = part.load_state().numbers["found"]
    return log_ratios(
        *([row["flow_error_mrad"] for row in found[name]] for name in (design, rival))
    )


if __name__ == "__main__":
    sys.exit(main(study, Config))
