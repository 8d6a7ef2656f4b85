"""Everything a training run needs, made and checked before its first step."""

import importlib
import inspect
import json
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from codesign.errors import DomainError, FileFormatError
from codesign.flow import checkpoint
from codesign.flow.sources import open_windows
from codesign.train import (
    Batches,
    Contrast,
    Learner,
    Part,
    Photometric,
    Progress,
    Started,
    Supervised,
    adamw,
)
from codesign.train import checkpoint as training
from codesign.train.batches import probe
from scenes.windows.sets import TRAINING, UNSEEN, VALIDATION, Shape
from studies.frame.config import check_unused
from studies.train_flow import peers  # noqa: F401  which networks files know

# the last window in so many of a data set is judged on: whole stretches, since neighbours look
# alike
HELD_OUT = 10
LOOKED_AT = 20  # windows that are asked whether they hold events
# share of the windows on which a network that refines begins from another flow than its own
FOREIGN = 0.2
POOL = 64  # batches shown in turn before windows come again
LOSSES = {
    "supervised": lambda config: Supervised(config.unit, config.claim_weight),
    "contrast": lambda config: Contrast(config.smoothness),
    "photometric": lambda config: Photometric(config.smoothness),
}
# what the numbers of a run depend on beside network, data and seed
SCHEDULE = (
    "steps",
    "cpu_minutes",
    "batch",
    "learning_rate",
    "weight_decay",
    "warm_up",
    "clip",
    "average",
    "reuse",
    "loss",
    "unit",
    "claim_weight",
    "smoothness",
)
COUNTS = (
    "batch",
    "reuse",
    "steps",
    "validate_every",
    "validation_windows",
    "final_windows",
    "save_every",
    "window_frames",
)
# options -> what they must be
LIMITS = (
    (COUNTS, lambda value: value >= 1, "at least 1"),
    (("height_px", "width_px"), lambda value: value >= 16, "at least 16"),
    (("bins",), lambda value: value >= 2, "at least 2"),
    (
        ("threads", "weights", "weight_decay", "claim_weight", "smoothness"),
        lambda value: value >= 0,
        "0 or more",
    ),
    (("cpu_minutes", "learning_rate", "clip"), lambda value: value > 0, "more than 0"),
    (("seed",), lambda value: value < UNSEEN - 10, "less than the seeds that judge"),
    (("warm_up", "average"), lambda value: 0 <= value < 1, "a share from 0 to below 1"),
)

# when options have no effect
UNUSED = (
    (lambda config: True, "without --race", ("own", "seeds", "jobs")),
    (lambda config: config.data is None, "without --data", ("window_frames", "window_ms")),
    (lambda config: config.data is not None, "with --data", ("mix", "validate_on")),
    (lambda config: config.loss != "supervised", "with that --loss", ("unit", "claim_weight")),
    (lambda config: config.loss == "supervised", "with that --loss", ("smoothness",)),
)


@dataclass
class Job:
    """Learner, batches by step, what to judge on (sources by name), and what is done already."""

    learner: Learner
    batches: Batches
    validation: dict[str, Any]
    progress: Progress
    facts: dict[str, Any]


def check_numbers(config, processes):
    """Raise DomainError for options that make no sense alone or together."""
    for names, fits, wanted in LIMITS:
        for name in names:
            value = getattr(config, name)
            if value is not None and not fits(value):
                raise DomainError(f"--{name.replace('_', '-')} is {value}; {wanted} is needed.")
    for unused, why, names in UNUSED:
        if unused(config):
            check_unused(config, why, *names)
    if config.batch % processes:
        raise DomainError(
            f"--batch {config.batch} cannot be shared evenly by {processes} processes; give a multiple."
        )
    if config.mixed_precision and config.device != "cuda":
        raise DomainError(
            "--mixed-precision needs CUDA; leave it out on the processor, where bfloat16 saves nothing."
        )


def prepare(config, folder, resumed, ranks, clock):
    """Job of a run. ``clock`` counts making the sources as data.

    Raises: CodesignError with one sentence for every unfit option, file or data set.
    """
    check_numbers(config, ranks.count)
    loss = LOSSES[config.loss](config)
    network = build_network(config)
    if config.start is not None:
        start(network, config)
    network.to(ranks.device).train()
    shape = Shape(config.height_px, config.width_px, config.bins)
    with clock("data"):
        parts, validation = sources(config, shape)
        probes = [probe(source) for _, source in parts]
    for windows in probes:
        loss.check(windows)
        if windows.volume.counts.shape[2] != config.bins:
            raise DomainError(
                f"the windows have {windows.volume.counts.shape[2]} time bins, the network {config.bins}; "
                f"give --bins {windows.volume.counts.shape[2]}."
            )
    learner = Learner(
        network,
        loss,
        adamw(network, config.learning_rate, config.weight_decay),
        clip=config.clip,
        average=config.average,
        ranks=ranks,
        seed=config.seed,
        mixed_precision=config.mixed_precision,
    )
    facts = {
        "network": config.network,
        "config": dict(network.config),
        "seed": config.seed,
        "schedule": {name: getattr(config, name) for name in SCHEDULE},
        "torch": torch.__version__,
    }
    progress = training.load(folder / "checkpoint", learner, facts) if resumed else None
    if hasattr(network, "start") and config.data is None:
        parts = [(share, Started(source, network.start, FOREIGN)) for share, source in parts]
    batches = Batches(parts, config.batch, config.reuse, POOL, ranks.mine)
    return Job(learner, batches, validation, progress or Progress(), facts)


def build_network(config):
    """A fresh network, its weights drawn from the run's seed; the global random numbers stay as
    they were.

    Raises: DomainError for an unknown name or option.
    """
    kind = named_class(config.network)
    accepted = inspect.signature(kind).parameters
    options = {name: getattr(config, name) for name in ("bins", "seed") if name in accepted}
    options |= dict(parse(option) for option in config.options)
    unknown = [name for name in options if name not in accepted]
    if unknown:
        raise DomainError(
            f"network '{config.network}' has no option '{unknown[0]}'; it has {', '.join(accepted)}."
        )
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(config.seed)
        try:
            if config.weights == 0:
                return kind(**options)
            if not hasattr(kind, "with_weights"):
                raise DomainError(
                    f"--weights is for networks that come in sizes, which '{config.network}' does not; "
                    "leave it out."
                )
            return kind.with_weights(config.weights, **options)
        except TypeError as error:
            raise DomainError(
                f"network '{config.network}' does not take these options ({error})."
            ) from error


def named_class(name):
    """The class of a network by its name, or by module:Class. Raises: DomainError where there is none."""
    module, colon, own = name.partition(":")
    if not colon:
        return checkpoint.network_class(name)
    try:
        return getattr(importlib.import_module(module), own)
    except (ImportError, AttributeError, ValueError) as error:
        raise DomainError(
            f"network '{name}' is not there ({error}); give module:Class, run from the folder of the module."
        ) from error


def parse(option):
    """("width", 32) out of "width=32"."""
    name, equals, value = option.partition("=")
    try:
        if equals:
            return name.strip(), json.loads(value)
    except ValueError:
        pass  # the sentence below says what is wanted
    raise DomainError(f"--options {option}: give name=number, for example width=32.")


def start(network, config):
    """Begin with the weights of an earlier network. Raises: FileFormatError when they are of another one."""
    stored = checkpoint.read(checkpoint.DELIVERED.get(str(config.start), Path(config.start)))
    if stored.network != config.network:
        raise FileFormatError(
            f"'{config.start}' holds a '{stored.network}', --network is '{config.network}'; give the same "
            "network."
        )
    checkpoint.fill(network, stored.weights, config.start)


def sources(config, shape):
    """Training parts, and sources to judge on with the number of windows they have
    (None: as many as wanted)."""
    if config.data is None:
        check_names("mix", (config.mix,), TRAINING)
        check_names("validate-on", config.validate_on, VALIDATION)
        chosen = config.validate_on or VALIDATION
        return TRAINING[config.mix](shape, config.seed), {
            name: VALIDATION[name](shape, 0) for name in chosen
        }
    whole = open_windows(
        config.data,
        config.bins,
        config.window_frames,
        (config.height_px, config.width_px),
        config.seed,
        config.window_ms * 1e-3,
    )
    _warn_of_empty(config, whole)
    held = max(1, len(whole) // HELD_OUT)
    shared = config.window_frames - 1  # windows before the first held one that may reach into it
    if len(whole) <= held + shared:
        raise DomainError(
            f"'{config.data}' has {len(whole)} window(s); at least {2 + shared} are needed to train on some and judge "
            "on others."
        )
    return [(1.0, Part(whole, 0, len(whole) - held - shared))], {
        "held_out": Part(whole, len(whole) - held, len(whole))
    }


def _warn_of_empty(config, whole):
    looked = range(0, len(whole), max(1, len(whole) // LOOKED_AT))
    empty = sum(not whole.batch([k]).volume.counts.any() for k in looked)
    if 2 * empty > len(looked):
        warnings.warn(
            f"{empty} of {len(looked)} windows of '{config.data}' that were looked at hold no event where they are cut; is "
            "the size of the sensor known (flow_recordings.md)? Larger --height-px and --width-px cut more.",
            stacklevel=2,
        )


def check_names(option, names, table):
    for name in names:
        if name not in table:
            raise DomainError(f"--{option} {name} is unknown; choose from {', '.join(table)}.")
