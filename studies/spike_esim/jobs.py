"""What is trained, on rendered sequences and on the recording's first half; finished jobs are kept, so that a
stopped run goes on with the next."""

from functools import partial

import torch
from torch import nn

from codesign.events.spiking.spike_esim import SpikeEsim
from codesign.events.spiking.srm import srm
from codesign.events.spiking.two_branches import TwoBranchSpikes
from studies.spike_esim import train as training
from studies.spike_esim.data import Sequence

# of potentials of the busiest sequence at the threshold when training starts: the better by training loss is kept
SHARES = (0.01, 0.04)
SMOOTHING_MS = 10.0
START = {"theta_on": 0.2, "theta_off": 0.2, "refractory_s": 5e-4, "width": 4}
COMPARED_STEPS = 0.4  # share of the steps after which the two comparators are compared
# frames are divided by it for the thesis network: weights of the order of 1, as its step of Adam supposes
LIGHT = 32.0


class SecondModule(nn.Module):
    """The thesis network, own reset, and a spike module behind it: its spikes, times one weight per polarity,
    through an alpha response to a threshold of their own."""

    def __init__(self, channels, *, dt, seed):
        super().__init__()
        self.first = TwoBranchSpikes(channels, kernel="thesis", dt=dt, seed=seed)
        self.wake = self.first.wake
        self.dt = dt
        self.weight = nn.Parameter(torch.full((2, 1, 1), 1.05))  # a lone spike gives one

    def forward(self, frames):
        self.first.dt = self.dt
        return self.second(self.first(frames)[0])

    def second(self, spikes, **options):
        times = {"tau_r": 1.0, "tau_s": SMOOTHING_MS, "dt": self.dt}
        return srm(self.weight * spikes, theta=1.0, kernel="thesis", response="alpha", **times, **options)


VARIANTS = {
    "thesis": TwoBranchSpikes,
    "own_reset": partial(TwoBranchSpikes, kernel="thesis"),
    "smoothed": partial(TwoBranchSpikes, smoothing_tau=SMOOTHING_MS),
    "second_module": SecondModule,
}


class Trained:
    """Everything that generates events, by name, for one kind of training data; call with a name and a
    Sequence."""

    def __init__(self, networks, theta, ours):
        self.networks = networks
        self.theta = theta
        self.ours = ours

    @torch.no_grad()
    def __call__(self, name, sequence: Sequence, noise_seed=0, frames=None):
        """Counts [T-1, 2, H, W]. ``frames`` replace those of the sequence (noise sweep)."""
        frames = sequence.frames if frames is None else frames
        if name == "esim":
            return training.esim_counts(frames, sequence.t_s, self.theta)
        if name in self.networks:
            network = self.networks[name]
            network.dt = 1e3 * sequence.dt_s
            return network(frames / LIGHT)[0]
        if name == "ours":
            return self.ours.draw(frames, sequence.t_s, torch.Generator().manual_seed(noise_seed))[0]
        counts, _ = self.ours(frames, sequence.t_s)
        return counts if name == "ours_signal" else counts + self.ours.expected_noise(frames, sequence.t_s)


class Jobs:
    """Runs training jobs, or takes them from the state of an earlier session."""

    def __init__(self, run):
        stored = run.load_state() if run.resumed else None
        self.run = run
        self.tensors = dict(stored.tensors) if stored else {}
        self.numbers = dict(stored.numbers) if stored else {}

    def steps_done(self):
        """Optimisation steps of finished jobs."""
        return sum(len(value) for name, value in self.numbers.items() if name.endswith("_losses"))

    def module(self, key, module, train):
        """``module`` after ``train(module)`` (returns the losses), and the losses."""
        if f"{key}_losses" in self.numbers:
            module.load_state_dict({name: self.tensors[f"{key}/{name}"] for name in module.state_dict()})
        else:
            self.numbers[f"{key}_losses"] = train(module)
            self.tensors.update(
                {f"{key}/{name}": value.detach().clone() for name, value in module.state_dict().items()}
            )
            self.run.save_state(self.tensors, self.numbers)
        return module, self.numbers[f"{key}_losses"]

    def number(self, key, find):
        if key not in self.numbers:
            self.numbers[key] = find()
            self.run.save_state(self.tensors, self.numbers)
        return self.numbers[key]


def train_all(jobs, kind, sequences, steps, seed, options, advance):
    """All generators on one kind of data. options: of ``training.train_ours``. Returns Trained and the losses
    of ours."""
    theta = jobs.number(f"{kind}_theta", lambda: training.best_theta(sequences))
    networks = {
        name: _thesis(jobs, f"{kind}_{name}", made, sequences, steps // 2, seed, advance)
        for name, made in VARIANTS.items()
    }
    ours, losses = jobs.module(
        f"{kind}_ours",
        SpikeEsim(**START, seed=seed),
        lambda model: _ours(model, sequences, steps, steps, seed, options, advance),
    )
    scale = jobs.number(f"{kind}_ours_scale", lambda: training.calibrated_scale(ours, sequences))
    with torch.no_grad():
        ours.log_gain.add_(torch.tensor(scale, dtype=torch.float64).log())
    return Trained(networks, theta, ours), losses


def train_spiking_comparator(jobs, sequences, steps, seed, options, advance):
    """The first steps of the same training with the spike response layer as comparator. Returns its
    losses."""
    model = SpikeEsim(**{**START, "refractory_s": 0.0}, comparator="srm", seed=seed)
    return jobs.module(
        "srm_ours",
        model,
        lambda model: _ours(model, sequences, steps, round(COMPARED_STEPS * steps), seed, options, advance),
    )[1]


def job_steps(steps):
    """Optimisation steps of ``train_all``."""
    return steps + len(VARIANTS) * len(SHARES) * (steps // 2)


def _ours(model, sequences, steps, until, seed, options, advance):
    return training.train_ours(
        model, sequences, steps, torch.Generator().manual_seed(seed), advance, until=until, **options
    )


def _thesis(jobs, key, made, sequences, steps, seed, advance):
    found = []
    busiest = max(sequences, key=lambda sequence: float(sequence.counts.sum()))
    for share in SHARES:
        network = made(1, dt=1e3 * sequences[0].dt_s, seed=seed)
        network.wake(busiest.frames / LIGHT, share)
        network, _ = jobs.module(
            f"{key}_{share}",
            network,
            lambda model: training.train_thesis(
                model, sequences, steps, torch.Generator().manual_seed(seed), advance
            ),
        )
        with torch.no_grad():
            loss = training.total_distance(lambda sequence: network(sequence.frames / LIGHT)[0], sequences)  # noqa: B023
        found.append((loss, network))
    return min(found, key=lambda pair: pair[0])[1]
