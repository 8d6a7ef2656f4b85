"""Do emulated events train a classifier for a real sensor? Digits moved by saccades, seen as video
by generators of events and as they move by a physical sensor; a small network is trained on the
events of each and tested on the sensor's.
"""

import math
from dataclasses import dataclass, replace
from typing import Any

import torch
import torch.nn.functional as F
from torch import nn

from codesign import events
from codesign.errors import DomainError
from codesign.events import SensorModel, SpikeEsim, TwoBranchSpikes
from codesign.types import EventStream
from scenes.digits import CLASSES, LEG_S, WINDOW_PX, draw_pictures, frame_times, frames
from studies.frame.compare import student
from studies.frame.show import pictures, table
from studies.frame.sweep import column, metrics, select, sweep
from studies.spike_esim.train import Store, descend, objective

TEST, CALIBRATION, TRAINING = 1, 2, 3  # each draws pictures, noise and weights of its own
BINS = 6
AT_ONCE = 50  # pictures
SENSOR_HZ = 1000.0
# v2e's noisy preset with unequal thresholds and a dead time
SENSOR = replace(events.PRESETS["noisy"], theta_on=0.18, theta_off=0.22, refractory_s=1e-3)
NOMINAL_THETA = 0.2  # mean of the sensor's own
THETAS = (0.05, 0.07, 0.1, NOMINAL_THETA, 0.3, 0.45)
ASKED = (
    ("spike_esim", "esim_best"),
    ("spike_esim", "esim"),
    ("esim_best", "naive_best"),
    ("esim", "naive"),
)


class Block(nn.Module):
    """Two 3x3 convolutions beside a shortcut; half the size, twice the channels."""

    def __init__(self, channels):
        super().__init__()
        wide = 2 * channels
        self.path = nn.Sequential(*_conv(channels, wide, 3, 2), nn.ReLU(), *_conv(wide, wide, 3, 1))
        self.shortcut = nn.Sequential(*_conv(channels, wide, 1, 2))

    def forward(self, x):
        return torch.relu(self.path(x) + self.shortcut(x))


def _conv(inputs, outputs, size, stride):
    return nn.Conv2d(inputs, outputs, size, stride, size // 2, bias=False), nn.BatchNorm2d(outputs)


def train(voxels, labels, epochs, seed, device="cpu"):
    """A classifier of voxels [N, 2, bins, H, W] as class scores [N, CLASSES], all of it drawn from
    the seed. Nothing is normalised per recording: how many events there are is part of what is
    learnt."""
    generator = torch.Generator().manual_seed(seed)
    voxels = voxels.flatten(1, 2)
    blocks = nn.Sequential(*_conv(voxels.shape[1], 16, 5, 2), nn.ReLU(), Block(16), Block(32))
    net = nn.Sequential(*blocks, nn.AdaptiveAvgPool2d(1), nn.Flatten(), nn.Linear(64, CLASSES))
    for layer in net.modules():
        if isinstance(layer, nn.Conv2d | nn.Linear):
            nn.init.kaiming_normal_(layer.weight, generator=generator)
            if layer.bias is not None:
                nn.init.zeros_(layer.bias)
    net = net.to(device, memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]
    scale = voxels.square().mean().sqrt()
    optimiser = torch.optim.AdamW(net.parameters(), lr=4e-3, weight_decay=1e-2)
    batches = math.ceil(len(voxels) / AT_ONCE)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, 4e-3, total_steps=epochs * batches)
    for _ in range(epochs):
        for chosen in torch.randperm(len(voxels), generator=generator).tensor_split(batches):
            # moved by up to 2 pixels
            row, column = torch.randint(5, (2,), generator=generator).tolist()
            moved = F.pad(voxels[chosen].to(device) / scale, (2,) * 4)
            moved = moved[..., row : row + voxels.shape[-2], column : column + voxels.shape[-1]]
            optimiser.zero_grad()
            F.cross_entropy(net(moved), labels[chosen].to(device)).backward()
            optimiser.step()
            schedule.step()
    net[0].weight.data /= scale
    return net.eval()


@torch.no_grad()
def predict(net, voxels, device="cpu"):
    """Most likely class of every recording, [N] int64."""
    return torch.cat(
        [net(part.flatten(1, 2).to(device)).argmax(1).cpu() for part in voxels.split(500)]
    )


@dataclass(frozen=True)
class Source:
    """A generator of events. make: from frames [T, N, H, W], times and a torch.Generator to an
    EventStream of the pictures stacked on one tall sensor, or to counts [T-1, 2, N, H, W].
    physical: whether it sees the motion itself."""

    label: str
    make: Any
    physical: bool = False


def of_sensor(sensor):
    return lambda seen, t_s, generator: events.simulate(seen.flatten(1, 2), t_s, sensor, generator)


def of_esim(theta):
    return of_sensor(SensorModel(theta, theta))


def of_naive(theta):
    """At most one event per pixel and frame, from the difference of consecutive frames."""
    return lambda seen, t_s, generator: events.naive(seen.flatten(1, 2), t_s, theta)


FAMILIES = {"naive": ("naive", of_naive), "esim": ("ESIM", of_esim)}
PHYSICAL = Source("physical sensor (upper bound)", of_sensor(SENSOR), physical=True)
SOURCES = {
    "naive": Source("naive, θ 0.2", of_naive(NOMINAL_THETA)),
    "esim": Source("ESIM, θ 0.2", of_esim(NOMINAL_THETA)),
    "esim_shots": Source("ESIM, θ 0.2, with shot noise", of_sensor(
        SensorModel(NOMINAL_THETA, NOMINAL_THETA, shot_rate_hz=SENSOR.shot_rate_hz))),
    "sensor_on_video": Source("physical sensor's model on video", of_sensor(SENSOR)),
    "v2e": Source("v2e, default sensor", of_sensor(replace(events.PRESETS["default"], timing="v2e"))),
    "physical": PHYSICAL,
}  # fmt: skip


def record(config, tiles, source, purpose):
    """Voxels [N, 2, BINS, 32, 32] of what a source makes of moved pictures. purpose: part of the
    seed of its noise."""
    t_s = frame_times(SENSOR_HZ if source.physical else config.video_hz)
    generator = torch.Generator().manual_seed(config.seed + purpose)
    parts = tiles.split(AT_ONCE)
    return torch.cat(
        [voxels_of(source.make(frames(part, t_s), t_s, generator), t_s, BINS) for part in parts]
    )


def voxels_of(made, t_s, bins):
    """Voxels [N, 2, bins, H, W] of what a generator returned; every event is in them once."""
    if not isinstance(made, EventStream):
        return events.from_counts(made, t_s, bins).counts
    tall = events.from_stream(made, 0, round(1e6 * float(t_s[-1])), bins).counts[0]
    return tall.unflatten(2, (-1, WINDOW_PX)).permute(2, 0, 1, 3, 4).contiguous()


def fitted(run, store, tiles):
    """The network of the thesis and Spike-ESIM, fitted to what the physical sensor makes of moved
    pictures."""
    seed, steps = run.config.seed, run.config.steps // 2
    video_s, sensor_s = frame_times(run.config.video_hz), frame_times(SENSOR_HZ)
    generator = torch.Generator().manual_seed(seed + CALIBRATION)
    counts = []
    for part in tiles.split(AT_ONCE):
        stream = PHYSICAL.make(frames(part, sensor_s), sensor_s, generator)
        counts.append(events.to_counts(stream, video_s).unflatten(2, (len(part), -1)))
    target = torch.cat(counts, 2)
    seen = frames(tiles, video_s)
    thesis = TwoBranchSpikes(1, seed=seed)
    thesis.wake(tall(seen[:, :AT_ONCE]) / 255)
    ours = SpikeEsim(seed=seed)

    def mean(seen):
        return ours(seen, video_s)[0] + ours.expected_noise(seen, video_s)

    # convolutions learn slowly, single numbers fast; the thesis: van Rossum loss alone, Adam at
    # 0.01
    rates = {"branch": 3e-3, "prefilter": 3e-3, "noise_rate": 0.1}
    of_ours = [
        {"params": [p], "lr": rates.get(name.split(".")[0], 3e-2)}
        for name, p in ours.named_parameters()
    ]
    of_thesis = [{"params": list(thesis.parameters()), "lr": 0.01}]

    def fit(key, net, groups, made, weight):
        def train(net, advance):
            generator = torch.Generator().manual_seed(seed)

            def loss():
                chosen = torch.randint(seen.shape[1], (10,), generator=generator)
                found, wanted = made(seen[:, chosen]), target[:, :, chosen]
                return objective(found, wanted, float(video_s[1]), weight, block_steps=6)

            descend(
                torch.optim.Adam(groups),
                loss,
                steps,
                advance,
                [lambda step: 1 - step / steps] * len(groups),
            )

        store.module(f"fit_{key}", net, steps, train)

    fit("thesis", thesis, of_thesis, lambda seen: spikes_of(thesis, seen), 0.0)
    fit("spike_esim", ours, of_ours, mean, 0.1)
    return {
        "thesis": Source("thesis network, fitted", lambda seen, *_: spikes_of(thesis, seen)),
        "spike_esim_quiet": Source(
            "Spike-ESIM, its noise left out", lambda seen, t_s, _: ours(seen, t_s)[0]
        ),
        "spike_esim": Source(
            "Spike-ESIM, fitted (ours)", lambda seen, *given: ours.draw(seen, *given)[0]
        ),
    }


def spikes_of(network, seen):
    """Spikes [T-1, 2, N, H, W] of the network of the thesis, each picture by itself."""
    return network(tall(seen) / 255)[0].unflatten(2, (seen.shape[1], -1))[..., :-1, :]


def tall(pictures):
    """Pictures [T, N, H, W] on one sensor [T, N (H + 1), W], a dark row below each, so that a 3x3
    filter of changes sees none of its neighbour."""
    return F.pad(pictures, (0, 0, 0, 1)).flatten(1, 2)


def study(run):
    """Train on every source with every seed, test on the physical sensor, write the page."""
    config = run.config
    least = {
        "seeds": 2,
        "training": 2 * CLASSES,
        "test": CLASSES,
        "calibration": CLASSES,
        "epochs": 1,
    }
    for name, number in least.items():
        if getattr(config, name) < number:
            raise DomainError(f"{name} is {getattr(config, name)}; at least {number} are needed.")
    tiles, labels = draw_pictures(config.test, "test", (config.seed, TEST))
    heard = record(config, tiles, PHYSICAL, TEST)
    sources = {**SOURCES, **best_thresholds(run), **fitted(run, Store(run), calibration(config)[0])}

    def cell(seed, source):
        pictures, of = draw_pictures(config.training, "training", (config.seed, TRAINING, seed))
        voxels = record(config, pictures, source, 100 * TRAINING + seed)
        net = train(voxels, of, config.epochs, config.seed + seed, run.device)
        found = {"accuracy": accuracy(run, net, heard, labels)}
        if seed == 0:
            found["own_events_accuracy"] = accuracy(
                run, net, record(config, tiles, source, TEST), labels
            )
            found["events_per_picture"] = float(voxels.sum() / len(voxels))
        return found

    rows = sweep(run, cell, "classifiers", seed=range(config.seeds), source=sources)
    show(run, sources, rows, tiles[:CLASSES])


def accuracy(run, net, voxels, labels):
    """Share of recordings whose class a classifier finds."""
    return float((predict(net, voxels, run.device) == labels).double().mean())


def calibration(config):
    """Pictures whose recordings thresholds and generators are fitted to."""
    return draw_pictures(config.calibration, "training", (config.seed, CALIBRATION))


def best_thresholds(run):
    """Naive and ESIM, each with the threshold whose events train the best classifier of the
    calibration recordings."""
    config = run.config
    tiles, labels = calibration(config)
    heard = record(config, tiles, PHYSICAL, CALIBRATION)
    pictures, of = draw_pictures(config.training, "training", (config.seed, TRAINING, config.seeds))

    def cell(family, theta):
        voxels = record(config, pictures, Source("", FAMILIES[family][1](theta)), TRAINING)
        net = train(voxels, of, config.epochs, config.seed, run.device)
        return {"accuracy": accuracy(run, net, heard, labels)}

    thetas = (0.15, 0.3) if config.quick else THETAS
    rows = sweep(run, cell, "thresholds", family=list(FAMILIES), theta=thetas)
    found = {}
    for key, (label, make) in FAMILIES.items():
        best = max(select(rows, family=key), key=lambda row: row["accuracy"])["theta"]
        run.record(**{f"{key}_best_theta": best})
        found[f"{key}_best"] = Source(f"{label}, best θ {best:g}", make(best))
    return found


def show(run, sources, rows, tiles):
    """Tables of accuracies and of what was asked, and a picture of every source's events."""
    right = {key: torch.tensor(column(rows, "accuracy", source=key)) for key in sources}
    means = {key: student(values) for key, values in right.items()}
    gains = {(a, b): student(right[a] - right[b]) for a, b in ASKED}
    order = sorted(sources, key=lambda key: -means[key].value)
    for name, mean in {
        **means,
        **{f"{a}_over_{b}": gain for (a, b), gain in gains.items()},
    }.items():
        run.record(
            **{f"{name}_mean": mean.value, f"{name}_low": mean.low, f"{name}_high": mean.high}
        )
    first = {row["source"]: row for row in select(rows, seed=0)}
    run.record(
        **metrics(
            [
                {k: v for k, v in row.items() if k not in ("seed", "accuracy")}
                for row in first.values()
            ],
            "source",
        )
    )
    shown = [
        {**first[key], "source": sources[key].label, "mean": f"{means[key]:.1%}"} for key in order
    ]
    titles = {
        "source": "trained on events of",
        "mean": "physical events",
        "own_events_accuracy": "its own events",
    }
    caption = f"95 % intervals over {run.config.seeds} seeds; chance is {1 / CLASSES:.0%}."
    run.table("Accuracy", *table(shown, **titles, events_per_picture="events per picture"), caption)
    asked = [
        {
            "gain in accuracy": f"{sources[a].label} over {sources[b].label}",
            "paired over seeds": f"{gain:+.1%}",
            "first at least second": "met" if gain.value >= 0 else "missed",
        }
        for (a, b), gain in gains.items()
    ]
    run.table("What was asked", *table(asked))
    grid = {}
    for key in order:
        t_s = frame_times(SENSOR_HZ if sources[key].physical else run.config.video_hz)
        made = sources[key].make(
            frames(tiles, t_s), t_s, torch.Generator().manual_seed(run.config.seed)
        )
        if isinstance(made, EventStream):
            made = events.to_counts(made, t_s).unflatten(2, (CLASSES, -1))
        leg = made[: (len(t_s) - 1) // 3].sum(0)
        grid[sources[key].label] = {str(k): image for k, image in enumerate(leg[0] - leg[1])}
    caption = f"Signed counts of the first {LEG_S:g} s. Red: more ON, blue: more OFF."
    run.figure(pictures(grid, signed=map(str, range(CLASSES)), side=1), "events", caption)
    best = ", ".join(f"{sources[key].label} {means[key].value:.1%}" for key in order[:4])
    run.finish(
        "Emulated events for a real sensor's classifier",
        f"Accuracy on a physical sensor's events: {best}.",
    )
