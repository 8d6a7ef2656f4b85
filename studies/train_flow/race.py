"""The refiner against a plain, a spiking, a cascaded and a deblurring network of as many weights, and networks of your
own: the same windows, the same budget, several seeds.

Every training is a run of this study in a folder below; those that are done are kept when the race goes on with
--resume. Then all networks are judged on the same windows.
"""

import re
import subprocess
import sys
import time

import matplotlib.pyplot as plt

from codesign import flow
from codesign.errors import CodesignError, DomainError
from codesign.flow.refiner import Refiner
from codesign.train.validation import batches, score
from scenes.windows.sets import SETS, UNSEEN, VALIDATION, Shape
from scenes.windows.worlds import ALL, WorldWindows
from studies.train_flow.setup import named_class

NAMES = {
    "refiner": "refiner",
    "flownet-events": "FlowNetEvents",
    "spike-flownet": "spiking encoder",
    "ecn": "ECN",
    "idnet": "IDNet",
}
# largest steps, found in short trials of 300 to 750 steps (1e-3 and 3e-3 for the spiking network), for ECN and IDNet of
# one processor minute (1e-3, 2e-3; IDNet also 4e-3)
RATES = {"refiner": 2e-3, "flownet-events": 2e-3, "spike-flownet": 3e-3, "ecn": 1e-3, "idnet": 2e-3}
ASKED = 0.6  # of a rival's error, at most
SEED = 55  # of what is judged here
POLL_S = 1.0


def race(run):
    """Train, judge and show. Of --final-windows, sets of packets and motions have a half, 3-D worlds a third."""
    config = run.config
    if not config.seeds or config.jobs < 1 or config.final_windows < 3:
        raise DomainError(
            "a race needs at least one of --seeds, one of --jobs, and three of --final-windows."
        )
    names = NAMES | {name: name.partition(":")[2] for name in config.own}
    kinds = {name: named_class(name) for name in config.own}
    wanted = [(network, seed) for seed in config.seeds for network in names]
    _train(run, wanted)
    networks = {
        job: flow.load(_folder(run, *job) / "network.safetensors", kinds.get(job[0])) for job in wanted
    }
    _show(run, names, networks, _judged(run, networks))


def _folder(run, network, seed):
    return run.folder / f"{network.replace(':', '-')}_seed{seed}"


def _train(run, wanted):
    """Run every training that is not done, some at a time."""
    waiting = [job for job in wanted if not (_folder(run, *job) / "report.html").exists()]
    active: dict[tuple[str, int], subprocess.Popen] = {}
    with run.progress(len(wanted), "trainings", done=len(wanted) - len(waiting)) as progress:
        try:
            while waiting or active:
                while waiting and len(active) < run.config.jobs:
                    job = waiting.pop(0)
                    active[job] = subprocess.Popen(
                        _command(run, *job), stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
                    )
                time.sleep(POLL_S)
                for job in [job for job, process in active.items() if process.poll() is not None]:
                    process = active.pop(job)
                    said = (process.stderr.read() if process.stderr else "").strip().splitlines()
                    if process.returncode != 0:
                        raise CodesignError(
                            f"the training of {job[0]} with seed {job[1]} ended with code "
                            f"{process.returncode}: {said[-1] if said else 'no word'}"
                        )
                    progress.advance()
        finally:
            for process in active.values():
                process.terminate()


def _command(run, network, seed):
    config = run.config
    folder = _folder(run, network, seed)
    start = [sys.executable, "-m", "studies.train_flow"]
    if (folder / "checkpoint").exists():
        return [*start, "--resume", str(folder)]
    options = {
        "network": network,
        "seed": seed,
        "mix": config.mix,
        "batch": config.batch,
        "learning-rate": RATES.get(network, config.learning_rate),
        "out": folder,
        # all are judged together afterwards
        "final-windows": 8,
        "validate-every": 10**9,
        "validate-on": "layers",
    }
    options |= {
        name: value
        for name, value in (("steps", config.steps), ("cpu-minutes", config.cpu_minutes))
        if value is not None
    }
    if network in NAMES and network != "refiner":
        options["weights"] = config.weights or sum(p.numel() for p in Refiner().parameters())
    return [*start, *(word for name, value in options.items() for word in (f"--{name}", str(value)))]


def _judged(run, networks):
    """Set -> who -> Score, every network on the same windows."""
    shape = Shape(64, 64, 8)
    count = run.config.final_windows
    sets = {name: (make(shape, SEED), count) for name, make in VALIDATION.items()}
    sets["worlds"] = (WorldWindows(ALL, seed=UNSEEN + SEED, bins=8), count // 3)
    sets |= {name: (make(UNSEEN + SEED, 8), count // 2) for name, make in SETS.items()}
    estimators = {"closed form": flow.estimate_lk, **networks}
    found = {}
    with run.progress(len(sets), "judging") as progress:
        for name, (source, number) in sets.items():
            windows = list(batches(source, number))
            found[name] = {who: score(estimator, windows) for who, estimator in estimators.items()}
            progress.advance()
    return found


def _show(run, names, networks, found):
    config = run.config
    rivals = [name for name in names if name != "refiner"]
    rows = []
    met = 0
    for name, scores in found.items():
        ratios = {network: [scores[network, seed].ratio for seed in config.seeds] for network in names}
        shares = [
            max(ours / theirs for ours, theirs in zip(ratios["refiner"], ratios[rival], strict=True))
            for rival in rivals
        ]
        met += sum(share <= ASKED for share in shares)
        for network, values in ratios.items():
            for seed, value in zip(config.seeds, values, strict=True):
                run.record(**{f"{name}_{_key(network)}_ratio_seed{seed}": value})
        closed = scores["closed form"]
        run.record(
            **{f"{name}_closed_form_ratio": closed.ratio, f"{name}_windows": closed.windows},
            **{f"{name}_refiner_over_{_key(r)}_worst": s for r, s in zip(rivals, shares, strict=True)},
        )
        spread = [f"{min(values):.3f} to {max(values):.3f}" for values in ratios.values()]
        rows.append([name.replace("_", " "), closed.windows, closed.ratio, *spread, *shares])
    asked = len(rivals) * len(rows)
    weights = {name: sum(p.numel() for p in networks[name, config.seeds[0]].parameters()) for name in names}
    run.record(**{f"{_key(name)}_weights": number for name, number in weights.items()})
    run.record(shares_met=met, shares_asked=asked)
    run.card(f"At most {ASKED:g} of a rival's error", f"{met} of {asked}", "sets and rivals, worst seed")
    columns = ["set", "windows", "closed form", *names.values()]
    run.table(
        "Endpoint error over that of zero flow",
        [*columns, *(f"refiner / {names[rival]}, worst seed" for rival in rivals)],
        rows,
        f"Least to largest of {len(config.seeds)} seeds. Asked: at most {ASKED:g} of every rival.",
    )
    rates = [[label, weights[name], RATES.get(name, config.learning_rate)] for name, label in names.items()]
    run.table("Networks", ["network", "weights", "learning rate"], rates)
    run.figure(
        _figure(found, config.seeds, names),
        "compare",
        "Error over that of zero flow; a dot is a seed, the line is the closed form.",
    )
    run.finish(
        "Refiner against networks of its size",
        "The same budget each; textures, motions and worlds of the judging were never trained on.",
    )


def _key(network):
    return re.sub(r"\W+", "_", network)


def _figure(found, seeds, names):
    figure, axes = plt.subplots(figsize=(8, 0.9 + 0.5 * len(found)), layout="constrained")
    for place, scores in enumerate(found.values()):
        for shift, network in enumerate(names):
            at = place + 0.15 * (shift - (len(names) - 1) / 2)
            ratios = [scores[network, seed].ratio for seed in seeds]
            axes.plot(
                ratios, [at] * len(seeds), "o", color=f"C{shift}", label=None if place else names[network]
            )
        closed = [scores["closed form"].ratio] * 2
        axes.plot(closed, [place - 0.35, place + 0.35], color="0.4", label=None if place else "closed form")
    axes.set(
        yticks=range(len(found)),
        yticklabels=[name.replace("_", " ") for name in found],
        xlabel="endpoint error over that of zero flow",
        xlim=(0, None),
    )
    axes.invert_yaxis()
    axes.legend(loc="upper left", bbox_to_anchor=(1, 1))
    return figure
