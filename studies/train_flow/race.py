"""The refiner against a plain, a spiking, a cascaded and a deblurring network of as many weights,
and networks of your own: the same windows, the same budget, several seeds.

Every training is a run of this study in a folder below; those that are done are kept when the race
goes on with --resume. Then all networks are judged on the same windows.
"""

import itertools
import operator
import re
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import fields

from codesign import flow
from codesign.errors import CodesignError, DomainError
from codesign.flow.baselines.parts import count_weights
from codesign.flow.refiner import Refiner
from codesign.report.prose import counted
from codesign.train.validation import batches, score
from scenes.windows.sets import judging
from studies.frame.config import check_unused
from studies.train_flow.setup import named_class

NAMES = {
    "refiner": "refiner",
    "flownet-events": "FlowNetEvents",
    "spike-flownet": "spiking encoder",
    "ecn": "ECN",
    "idnet": "IDNet",
}
# largest steps, found in short trials of 300 to 750 steps (1e-3 and 3e-3 for the spiking network),
# for ECN and IDNet of one processor minute (1e-3, 2e-3; IDNet also 4e-3)
RATES = {"refiner": 2e-3, "flownet-events": 2e-3, "spike-flownet": 3e-3, "ecn": 1e-3, "idnet": 2e-3}
ASKED = 0.6  # of a rival's error, at most
# to every training, or of the race itself
PASSED = (
    *("mix", "batch", "learning_rate", "steps", "cpu_minutes", "final_windows"),
    *("race", "own", "seeds", "jobs", "device", "out", "resume", "quick"),
)
SEED = 55  # of what is judged here


def race(run):
    """Train, judge and show. Of --final-windows, sets of packets and motions have a half, 3-D
    worlds a third."""
    config = run.config
    if not config.seeds or config.jobs < 1 or config.final_windows < 3:
        raise DomainError(
            "a race needs at least one of --seeds, one of --jobs, and three of --final-windows."
        )
    lost = [field.name for field in fields(config) if field.name not in PASSED]
    # the five networks have their own
    lost += [] if config.own else ["learning_rate"]
    check_unused(config, "in a race: settings are the networks' own, windows are made", *lost)
    names = NAMES | {name: name.partition(":")[2] for name in config.own}
    kinds = {name: named_class(name) for name in config.own}
    wanted = [(network, seed) for seed in config.seeds for network in names]
    _train(run, wanted)
    networks = {
        job: flow.load(_folder(run, *job) / "network.safetensors", kinds.get(job[0]))
        for job in wanted
    }
    _show(run, names, networks, _judged(run, networks))


def _folder(run, network, seed):
    return run.folder / f"{network.replace(':', '-')}_seed{seed}"


def _train(run, wanted):
    waiting = [job for job in wanted if not (_folder(run, *job) / "report.html").exists()]
    done = len(wanted) - len(waiting)
    children: list[subprocess.Popen] = []
    with (
        ThreadPoolExecutor(run.config.jobs) as pool,
        run.progress(len(wanted), "trainings", done) as progress,
    ):
        active = [pool.submit(_trained, job, _command(run, *job), children) for job in waiting]
        try:
            for each in as_completed(active):
                each.result()
                progress.advance()
        finally:
            pool.shutdown(wait=False, cancel_futures=True)
            for child in children:
                child.terminate()


def _trained(job, command, children):
    with subprocess.Popen(
        command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
    ) as child:
        children.append(child)
        said = child.communicate()[1].strip().splitlines()[-1:] or ["no word"]
    if child.returncode != 0:
        raise CodesignError(
            f"the training of {job[0]} with seed {job[1]} ended with code {child.returncode}: {said[0]}"
        )


def _command(run, network, seed):
    config = run.config
    folder = _folder(run, network, seed)
    start = [sys.executable, "-m", "studies.train_flow"]
    if (folder / "checkpoint").exists():
        return [*start, "--resume", str(folder)]
    options = {
        "network": network,
        "seed": seed,
        "device": config.device,
        "mix": config.mix,
        "batch": config.batch,
        "learning-rate": RATES.get(network, config.learning_rate),
        "out": folder,
        # all are judged together afterwards
        "final-windows": 8,
        "validate-every": 10**9,
        "validate-on": "layers",
    }
    options |= {"steps": config.steps, "cpu-minutes": config.cpu_minutes}
    if network in NAMES and network != "refiner":
        options["weights"] = count_weights(Refiner())
    given = [(f"--{name}", str(value)) for name, value in options.items() if value is not None]
    return [*start, *itertools.chain(*given)]


def _judged(run, networks):
    count = run.config.final_windows
    sets = judging(SEED, 8, count, count // 3, count // 2)
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
        ratios = {
            network: [scores[network, seed].ratio for seed in config.seeds] for network in names
        }
        shares = {
            rival: max(map(operator.truediv, ratios["refiner"], ratios[rival])) for rival in rivals
        }
        met += sum(share <= ASKED for share in shares.values())
        closed = scores["closed form"]
        figures = {"closed_form_ratio": closed.ratio, "windows": closed.windows}
        for network, values in ratios.items():
            for seed, value in zip(config.seeds, values, strict=True):
                figures[f"{_key(network)}_ratio_seed{seed}"] = value
        figures |= {f"refiner_over_{_key(rival)}_worst": x for rival, x in shares.items()}
        run.record(**{f"{name}_{figure}": value for figure, value in figures.items()})
        spread = [f"{min(values):.3f} to {max(values):.3f}" for values in ratios.values()]
        cells = (closed.windows, closed.ratio, *spread, *shares.values())
        rows.append([name.replace("_", " "), *cells])
    asked = len(rivals) * len(rows)
    weights = {name: count_weights(networks[name, config.seeds[0]]) for name in names}
    run.record(**{f"{_key(name)}_weights": number for name, number in weights.items()})
    run.record(shares_met=met, shares_asked=asked)
    run.card(
        f"At most {ASKED:g} of a rival's error", f"{met} of {asked}", "sets and rivals, worst seed"
    )
    columns = ["set", "windows", "closed form", *names.values()]
    run.table(
        "Endpoint error over that of zero flow",
        [*columns, *(f"refiner / {names[rival]}, worst seed" for rival in rivals)],
        rows,
        f"Least to largest of {len(config.seeds)} seeds. Asked: at most {ASKED:g} of every rival.",
    )
    rates = [
        [label, weights[name], RATES.get(name, config.learning_rate)]
        for name, label in names.items()
    ]
    run.table("Networks", ["network", "weights", "learning rate"], rates)
    run.finish(
        "Refiner against networks of its size",
        f"The refiner has at most {ASKED:g} of a rival's error in {met} of {counted(asked, 'comparison')}, by its worst seed. "
        "The same budget each; textures, motions and worlds of the judging were never trained on.",
    )


def _key(network):
    return re.sub(r"\W+", "_", network)
