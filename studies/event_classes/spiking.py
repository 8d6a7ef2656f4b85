"""Spiking generators fitted to recordings of the physical sensor: the network of the thesis and
Spike-ESIM."""

import torch
import torch.nn.functional as F

from codesign.events.spiking.losses import count_loss, van_rossum
from codesign.events.spiking.spike_esim import SpikeEsim
from codesign.events.spiking.two_branches import TwoBranchSpikes
from studies.event_classes.generators import PICTURES_AT_ONCE, Source

TAU_S = 0.01  # of the van Rossum loss
COUNT_WEIGHT = 0.1
COUNT_BLOCK = {"side_px": 8, "steps": 6}
BATCH = 10


class Ours:
    """Spike-ESIM; its expected noise is in the loss, drawn noise in its events."""

    count_weight = COUNT_WEIGHT

    def __init__(self, frames, seed):
        self.net = SpikeEsim(seed=seed)

    def groups(self):
        """Parameters with the rate of Adam that each kind starts with: convolutions learn slowly, single
        numbers fast."""
        peaks = {"branch": 3e-3, "prefilter": 3e-3, "noise_rate": 0.1}
        return [
            {"params": [parameter], "peak": peaks.get(name.split(".")[0], 3e-2)}
            for name, parameter in self.net.named_parameters()
        ]

    def mean_counts(self, frames, t_s):
        return self.net(frames, t_s)[0] + self.net.expected_noise(frames, t_s)

    @torch.no_grad()
    def quiet(self, frames, t_s, generator):
        return self.net(frames, t_s)[0]

    def noisy(self, frames, t_s, generator):
        return self.net.draw(frames, t_s, generator)[0]

    def sources(self):
        return [
            Source("spike_esim_quiet", "Spike-ESIM, noise left out", self.quiet),
            Source("spike_esim", "Spike-ESIM (ours)", self.noisy),
        ]


class Thesis:
    """The two-branch network, its weights scaled awake on the pictures it is fitted to. As in the thesis: van
    Rossum loss alone, Adam at 0.01."""

    count_weight = 0.0

    def __init__(self, frames, seed):
        self.net = TwoBranchSpikes(1, seed=seed)
        self.net.wake(tall(frames[:, :PICTURES_AT_ONCE]) / 255)

    def groups(self):
        return [{"params": list(self.net.parameters()), "peak": 0.01}]

    def mean_counts(self, frames, t_s):
        spikes, _, _ = self.net(tall(frames) / 255)
        return spikes.unflatten(2, (frames.shape[1], -1))[..., :-1, :]

    @torch.no_grad()
    def generate(self, frames, t_s, generator):
        return self.mean_counts(frames, t_s)

    def sources(self):
        return [Source("thesis", "thesis network, SLAYER's reset", self.generate)]


MODELS = {"thesis": Thesis, "spike_esim": Ours}


def fitted(key, frames, counts, t_s, seed, steps, advance):
    """Sources of a generator fitted by gradient to what the physical sensor made of some pictures: itself and
    its variants.

    Args: key: one of MODELS. frames: [T, N, H, W] video. counts: [T-1, 2, N, H, W] the sensor's events in the
      same intervals. t_s: [T] seconds.
      seed: of weights and batches. steps: of Adam, its rate falling to 0. advance: called with the loss after
        each step.
    """
    model = MODELS[key](frames, seed)
    generator = torch.Generator().manual_seed(seed)
    dt_s = float(t_s[1] - t_s[0])
    optimiser = torch.optim.Adam(model.groups())
    for step in range(steps):
        chosen = torch.randint(frames.shape[1], (BATCH,), generator=generator)
        for group in optimiser.param_groups:
            group["lr"] = group["peak"] * (1 - step / steps)
        optimiser.zero_grad()
        loss = objective(
            model.mean_counts(frames[:, chosen], t_s), counts[:, :, chosen], dt_s, model.count_weight
        )
        loss.backward()
        optimiser.step()
        advance(loss=float(loss.detach()))
    return model.sources()


def objective(found, target, dt_s, count_weight):
    """Van Rossum distance over that of silence, plus a share of the pooled chi-square over that of
    silence."""

    def over_silence(distance):
        return distance(found) / distance(torch.zeros_like(target))

    loss = over_silence(lambda counts: van_rossum(counts, target, tau_s=TAU_S, dt=dt_s))
    return (
        loss + count_weight * over_silence(lambda counts: count_loss(counts, target, **COUNT_BLOCK))
        if count_weight
        else loss
    )


def tall(pictures):
    """Pictures [T, N, H, W] on one sensor [T, N (H + 1), W], a dark row below each, so that a 3x3 filter of
    changes sees none of its neighbour."""
    return F.pad(pictures, (0, 0, 0, 1)).flatten(1, 2)
