"""Training: Spike-ESIM and the thesis network by van Rossum and count loss, ESIM's single threshold by search."""

import torch

from codesign import events
from codesign.events import SensorModel
from codesign.events.spiking.losses import count_loss, van_rossum

TAU_S = 0.01  # of the van Rossum loss, as in the thesis
COUNT_WEIGHT = 0.1
CROP_PX, BATCH = 32, 4
SLOW, FAST = 3e-3, 2e-2  # step of Adam for convolution weights and for single physical numbers
THETAS = [0.1 * 1.12**k for k in range(26)]  # 0.1 to 1.7
COUNT_BLOCK = {"side_px": 8, "steps": 8}


def distance(found, target, dt_s):
    """Van Rossum loss over that of silence: 0 for the target itself, 1 for no event at all."""
    silence = van_rossum(torch.zeros_like(target), target, tau_s=TAU_S, dt=dt_s)
    return van_rossum(found, target, tau_s=TAU_S, dt=dt_s) / silence


def pooled_distance(found, target):
    """Count loss over that of silence."""
    return count_loss(found, target, **COUNT_BLOCK) / count_loss(torch.zeros_like(target), target, **COUNT_BLOCK)


def objective(found, target, dt_s):
    """What is made small: van Rossum distance and a share of the pooled one."""
    return distance(found, target, dt_s) + COUNT_WEIGHT * pooled_distance(found, target)


def crops(sequences, generator, batch=BATCH, size_px=CROP_PX):
    """A batch of random squares out of random sequences of one length and rate: frames [T, B, h, w], t_s [T], counts [T-1, 2, B, h, w]."""
    frames, counts = [], []
    for _ in range(batch):
        sequence = sequences[_integer(len(sequences), generator)]
        y, x = (_integer(side - size_px + 1, generator) for side in sequence.frames.shape[1:])
        window = (..., slice(y, y + size_px), slice(x, x + size_px))
        frames.append(sequence.frames[window])
        counts.append(sequence.counts[window])
    return torch.stack(frames, 1), sequences[0].t_s, torch.stack(counts, 2)


def parameter_groups(model):
    """Convolutions learn slowly, single numbers fast."""
    slow = [parameter for name, parameter in model.named_parameters() if name.startswith(("branch", "prefilter"))]
    fast = [parameter for name, parameter in model.named_parameters() if not name.startswith(("branch", "prefilter", "noise"))]
    noise = [parameter for name, parameter in model.named_parameters() if name.startswith("noise")]
    return [{"params": slow, "lr": SLOW}, {"params": fast, "lr": FAST}, {"params": noise, "lr": 5 * FAST}]


def train_ours(model, sequences, steps, generator, advance, optimiser=None, first=0):
    """Adam, its step falling as a half cosine to a twentieth. ``optimiser``, ``first``: of an earlier session. Returns losses."""
    optimiser = optimiser or make_optimiser(model)
    schedule = torch.optim.lr_scheduler.LambdaLR(optimiser, lambda step: 0.05 + 0.475 * (1 + torch.cos(torch.tensor(torch.pi * step / steps)).item()))
    losses = []
    for _ in range(first, steps):
        frames, t_s, counts = crops(sequences, generator)
        found, _ = model(frames, t_s)
        dt_s = float(t_s[1] - t_s[0])
        loss = objective(found + model.expected_noise(frames, t_s), counts, dt_s)
        optimiser.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(model.parameters(), 1.0)
        optimiser.step()
        schedule.step()
        losses.append(float(loss.detach()))
        advance(loss=losses[-1])
    return losses


def make_optimiser(model):
    return torch.optim.Adam(parameter_groups(model), betas=(0.9, 0.98))


def train_thesis(network, sequences, steps, generator, advance):
    """The thesis' way: Adam at 0.01, van Rossum loss alone, one sequence after the other. Returns losses."""
    optimiser, losses = torch.optim.Adam(network.parameters(), lr=0.01), []
    for _ in range(steps):
        sequence = sequences[_integer(len(sequences), generator)]
        spikes, _, _ = network(sequence.frames / 255)
        loss = distance(spikes, sequence.counts, sequence.dt_s)
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        losses.append(float(loss.detach()))
        advance(loss=losses[-1])
    return losses


def best_theta(sequences):
    """The single threshold with which ESIM comes closest to all sequences, by van Rossum distance."""

    def mean_distance(theta):
        return sum(float(distance(esim(sequence, theta), sequence.counts, sequence.dt_s)) for sequence in sequences) / len(sequences)

    return min(THETAS, key=mean_distance)


def esim(sequence, theta):
    """Counts of the ideal sensor."""
    return events.dense_counts(sequence.frames, sequence.t_s, SensorModel(theta, theta))


def _integer(limit, generator):
    return int(torch.randint(limit, (), generator=generator))
