"""What is raced, trained on rendered sequences with the hard events of a physical sensor: the
spiking network of the thesis, ESIM with its best threshold, and Spike-ESIM."""

import math
from dataclasses import dataclass
from functools import partial
from operator import attrgetter

import torch
from torch import Tensor

from codesign import events, render
from codesign.events import SensorModel, SpikeEsim, TwoBranchSpikes
from scenes.dataset_motion import LEAD_S, make_world, motion
from studies.make_dataset import __main__ as make_dataset
from studies.spike_esim.judge import TAU_S, distance

RATE_HZ = 500.0
RENDERED_TOGETHER = 40
# what an ideal sensor lacks, all at once: unequal thresholds that scatter, bandwidth, leak, noise,
# dead time
SENSOR = SensorModel(0.18, 0.22, theta_sigma=0.03, cutoff_hz=60.0, leak_rate_hz=0.1, leak_jitter=0.1,
                     rate_cov_decades=0.1, shot_rate_hz=0.5, refractory_s=1e-3)  # fmt: skip
THETAS = [0.12 * 1.15**k for k in range(18)]  # 0.12 to 1.3
CROP_PX = 32
BATCH = 2
# of potentials of the busiest sequence at the threshold when training starts: the better by
# training loss is kept
SHARES = (0.01, 0.04)
# frames are divided by it for the thesis network: weights of the order of 1, as its step of Adam
# supposes
LIGHT = 32.0


@dataclass(frozen=True)
class Sequence:
    """frames: [T, H, W], 0-255 scale. t_s: [T] float64. counts: [T-1, 2, H, W] of the physical
    sensor. again:
    the same with another draw of thresholds and noise. name: world and motion."""

    name: str
    frames: Tensor
    t_s: Tensor
    counts: Tensor
    again: Tensor

    @property
    def dt_s(self):
        return float(self.t_s[-1] - self.t_s[0]) / (len(self.t_s) - 1)


def rendered(world, family, seed, frames):
    """A sequence of ``frames`` frames at RATE_HZ. seed: of motion and sensor."""
    scene, stage = make_world(world)
    camera = make_dataset.make_camera(make_dataset.Config(size=64, samples=8, level="thin"))
    t_s = torch.arange(frames, dtype=torch.float64) / RATE_HZ
    path = motion(family, stage, scene, camera, float(t_s[-1]), torch.Generator().manual_seed(seed))
    with torch.no_grad():
        poses = path(LEAD_S + t_s).detach().split(RENDERED_TOGETHER)
        pictures = torch.cat([render.frames(camera, scene, some) for some in poses])
    draws = (torch.Generator().manual_seed(1000 * k + seed) for k in (1, 2))
    hard = [events.dense_counts(pictures, t_s, SENSOR, draw) for draw in draws]
    return Sequence(f"{world} {family}", pictures, t_s, *hard)


class Store:
    """Tensors by name, written after each training, so that a stopped run goes on behind the last
    one."""

    def __init__(self, run):
        stored = run.load_state()
        self.run = run
        self.tensors = dict(stored.tensors) if stored else {}

    def __call__(self, key, make):
        """The tensors {name: tensor} that ``make`` gives, or gave in an earlier session."""
        start = f"{key}/"
        if not any(name.startswith(start) for name in self.tensors):
            self.tensors |= {start + name: value.clone() for name, value in make().items()}
            self.run.save_state(self.tensors, {})
        return {n.removeprefix(start): x for n, x in self.tensors.items() if n.startswith(start)}

    def module(self, key, module, steps, train):
        """``module`` after ``train(module, advance)`` of so many steps; it takes no gradient any
        more."""

        def trained():
            with self.run.progress(steps, f"training {key}") as progress:
                train(module, progress.advance)
            return module.state_dict()

        module.load_state_dict(self(key, trained))
        return module.requires_grad_(False)


def generators(run, sequences):
    """By name, functions from a sequence to counts [T-1, 2, H, W]; the fitted Spike-ESIM and ESIM's
    threshold."""
    store = Store(run)
    seed = run.config.seed + 1
    made = {"thesis": _thesis(store, sequences, run.config.steps // 2, seed)}
    theta = best_theta(sequences)
    ours = SpikeEsim(0.2, 0.2, refractory_s=5e-4, width=4, seed=seed)

    def train(model, advance):
        train_ours(model, sequences, run.config.steps, torch.Generator().manual_seed(seed), advance)
        calibrate(model, sequences)

    store.module("ours", ours, run.config.steps, train)

    def draw(sequence):
        return ours.draw(sequence.frames, sequence.t_s, torch.Generator().manual_seed(0))[0]

    made |= {"esim": partial(esim, theta=theta), "ours": draw, "sensor": attrgetter("again")}
    return made, ours, theta


def best_theta(sequences):
    """The single threshold with which ESIM comes closest to all sequences together."""
    return min(THETAS, key=lambda theta: distance([(esim(one, theta), one) for one in sequences]))


def esim(sequence, theta):
    return events.dense_counts(sequence.frames, sequence.t_s, SensorModel(theta, theta))


def _thesis(store, sequences, steps, seed):
    """The network of the thesis from the better of two starts, trained the thesis's way: Adam at
    0.01, van Rossum loss alone, one sequence after the other."""

    def spikes(network, sequence):
        return network(sequence.frames / LIGHT)[0]

    def train(network, advance):
        generator = torch.Generator().manual_seed(seed)

        def loss():
            sequence = sequences[_integer(len(sequences), generator)]
            found = spikes(network, sequence)
            return events.van_rossum(found, sequence.counts, tau_s=TAU_S, dt=sequence.dt_s)

        descend(torch.optim.Adam(network.parameters(), lr=0.01), loss, steps, advance)

    busiest = max(sequences, key=lambda sequence: float(sequence.counts.sum()))
    found = []
    for share in SHARES:
        network = TwoBranchSpikes(1, dt=1e3 * sequences[0].dt_s, seed=seed)
        network.wake(busiest.frames / LIGHT, share)
        network = store.module(f"thesis_{share}", network, steps, train)
        found.append((distance([(spikes(network, one), one) for one in sequences]), network))
    return partial(spikes, min(found, key=lambda pair: pair[0])[1])


def descend(optimiser, loss, steps, advance, paces=None, clip=math.inf):
    """Follow the gradient of ``loss()``; paces: one function a group of parameters, from step to
    share of its rate."""
    schedule = torch.optim.lr_scheduler.LambdaLR(optimiser, paces or (lambda step: 1.0))
    for _ in range(steps):
        value = loss()
        optimiser.zero_grad()
        value.backward()
        parameters = [p for group in optimiser.param_groups for p in group["params"]]
        torch.nn.utils.clip_grad_norm_(parameters, clip)
        optimiser.step()
        schedule.step()
        advance(loss=value.detach())


def objective(found, target, dt_s):
    """Van Rossum distance and a share of that of pooled counts, each over that of silence."""

    def over_silence(distance):
        return distance(found, target) / distance(torch.zeros_like(target), target)

    pooled = over_silence(partial(events.count_loss, side_px=8, steps=8))
    return over_silence(partial(events.van_rossum, tau_s=TAU_S, dt=dt_s)) + 0.1 * pooled


def train_ours(model, sequences, steps, generator, advance):
    """Adam, its step falling as a half cosine to a twentieth; convolutions learn slowly, single
    numbers fast, and noise, which remains when the signal is learnt, in the second half."""

    def loss():
        frames, t_s, counts = crops(sequences, generator)
        found = model(frames, t_s)[0] + model.expected_noise(frames, t_s)
        return objective(found, counts, float(t_s[1] - t_s[0]))

    def falling(step):
        return 0.05 + 0.475 * (1 + math.cos(math.pi * step / steps))

    groups = {3e-3: [], 2e-2: [], 5e-2: []}  # by their step of Adam
    for name, parameter in model.named_parameters():
        slow = name.startswith(("branch", "prefilter"))
        groups[3e-3 if slow else 5e-2 if name.startswith("noise") else 2e-2].append(parameter)
    groups = [{"params": parameters, "lr": rate} for rate, parameters in groups.items()]
    paces = [falling, falling, lambda step: float(2 * step >= steps)]
    descend(torch.optim.Adam(groups, betas=(0.9, 0.98)), loss, steps, advance, paces, clip=1.0)


def crops(sequences, generator, batch=BATCH):
    """Random squares out of random sequences: frames [T, B, h, w], t_s [T], counts
    [T-1, 2, B, h, w]. A batch without any event has no relative loss; then another is drawn."""
    while True:
        frames, counts = [], []
        for _ in range(batch):
            sequence = sequences[_integer(len(sequences), generator)]
            y, x = (_integer(side - CROP_PX + 1, generator) for side in sequence.frames.shape[1:])
            window = (..., slice(y, y + CROP_PX), slice(x, x + CROP_PX))
            frames.append(sequence.frames[window])
            counts.append(sequence.counts[window])
        if any(bool(part.any()) for part in counts):
            return torch.stack(frames, 1), sequences[0].t_s, torch.stack(counts, 2)


@torch.no_grad()
def calibrate(model, sequences, rounds=3):
    """Scale the thresholds until the generator gives as many events as the target, noise included:
    squared errors favour too few events where an edge is predicted beside its place."""
    target = sum(sequence.counts.sum((0, 2, 3)).double() for sequence in sequences)
    for _ in range(rounds):
        found = torch.zeros(2, dtype=torch.float64)
        for sequence in sequences:
            seen = sequence.frames, sequence.t_s
            found += (model(*seen)[0] + model.expected_noise(*seen)).sum((0, 2, 3)).double()
        # events go as 1/theta for a steady change and as 1/theta^2 for a random walk
        model.log_gain.add_(0.7 * (found / target).log())


def _integer(limit, generator):
    return int(torch.randint(limit, (), generator=generator))
