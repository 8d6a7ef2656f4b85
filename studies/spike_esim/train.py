"""Training: Spike-ESIM and the thesis network by van Rossum and count loss, ESIM's single threshold by
search."""

import math

import torch

from codesign import events
from codesign.events import SensorModel
from codesign.events.spiking.losses import count_loss, van_rossum

TAU_S = 0.01  # of the van Rossum loss, as in the thesis
CROP_PX = 32
BATCH = 2
# step of Adam for convolution weights and for single physical numbers, for noise rates (Hz)
SLOW = 3e-3
FAST = 2e-2
NOISE = 5e-2
THETAS = [0.12 * 1.15**k for k in range(18)]  # 0.12 to 1.3
COUNT_BLOCK = {"side_px": 8, "steps": 8}


def distance(found, target, dt_s):
    """Van Rossum loss over that of silence: 0 for the target itself, 1 for no event at all."""
    silence = van_rossum(torch.zeros_like(target), target, tau_s=TAU_S, dt=dt_s)
    return van_rossum(found, target, tau_s=TAU_S, dt=dt_s) / silence


def pooled_distance(found, target):
    """Count loss over that of silence."""
    return count_loss(found, target, **COUNT_BLOCK) / count_loss(
        torch.zeros_like(target), target, **COUNT_BLOCK
    )


def objective(found, target, dt_s, count_weight):
    """What is made small: van Rossum distance and a share of the pooled one."""
    return distance(found, target, dt_s) + count_weight * pooled_distance(found, target)


def crops(sequences, generator, batch=BATCH, size_px=CROP_PX):
    """A batch of random squares out of random sequences of one length and rate: frames [T, B, h, w], t_s [T],
    counts [T-1, 2, B, h, w].

    A batch without any event has no relative loss; then another is drawn.
    """
    while True:
        frames = []
        counts = []
        for _ in range(batch):
            sequence = sequences[_integer(len(sequences), generator)]
            y, x = (_integer(side - size_px + 1, generator) for side in sequence.frames.shape[1:])
            window = (..., slice(y, y + size_px), slice(x, x + size_px))
            frames.append(sequence.frames[window])
            counts.append(sequence.counts[window])
        if any(bool(part.any()) for part in counts):
            return torch.stack(frames, 1), sequences[0].t_s, torch.stack(counts, 2)


def parameter_groups(model, fast=FAST):
    """Convolutions learn slowly, single numbers fast."""
    slow = [
        parameter for name, parameter in model.named_parameters() if name.startswith(("branch", "prefilter"))
    ]
    single = [
        parameter
        for name, parameter in model.named_parameters()
        if not name.startswith(("branch", "prefilter", "noise"))
    ]
    noise = [parameter for name, parameter in model.named_parameters() if name.startswith("noise")]
    return [{"params": slow, "lr": SLOW}, {"params": single, "lr": fast}, {"params": noise, "lr": NOISE}]


def train_ours(
    model, sequences, steps, generator, advance, until=None, *, count_weight=0.1, fast=FAST, **options
):
    """Adam, its step falling as a half cosine to a twentieth over ``steps``; stops after ``until`` steps.
    options: of ``crops``. Returns losses."""
    optimiser = torch.optim.Adam(parameter_groups(model, fast), betas=(0.9, 0.98))
    losses = []

    def falling(step):
        return 0.05 + 0.475 * (1 + math.cos(math.pi * step / steps))

    def late(step):
        return float(2 * step >= steps)  # noise is what remains when the signal is learnt

    schedule = torch.optim.lr_scheduler.LambdaLR(optimiser, [falling, falling, late])
    for _ in range(steps if until is None else until):
        frames, t_s, counts = crops(sequences, generator, **options)
        found, _ = model(frames, t_s)
        loss = objective(
            found + model.expected_noise(frames, t_s), counts, float(t_s[1] - t_s[0]), count_weight
        )
        optimiser.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(model.parameters(), 1.0)
        optimiser.step()
        schedule.step()
        losses.append(float(loss.detach()))
        advance(loss=losses[-1])
    return losses


def train_thesis(network, sequences, steps, generator, advance, light=32.0):
    """The thesis' way: Adam at 0.01, van Rossum loss alone, one sequence after the other. Returns losses."""
    optimiser = torch.optim.Adam(network.parameters(), lr=0.01)
    losses = []
    for _ in range(steps):
        sequence = sequences[_integer(len(sequences), generator)]
        spikes, _, _ = network(sequence.frames / light)
        loss = van_rossum(spikes, sequence.counts, tau_s=TAU_S, dt=sequence.dt_s)
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        losses.append(float(loss.detach()))
        advance(loss=losses[-1])
    return losses


def total_distance(generate, sequences):
    """Van Rossum loss of all sequences together over that of silence. generate: function from a sequence to
    counts."""
    sums = torch.zeros(2, dtype=torch.float64)
    for sequence in sequences:
        for k, found in enumerate((generate(sequence), torch.zeros_like(sequence.counts))):
            sums[k] += float(van_rossum(found, sequence.counts, tau_s=TAU_S, dt=sequence.dt_s))
    return float(sums[0] / sums[1])


def best_theta(sequences):
    """The single threshold with which ESIM comes closest to all sequences together, by van Rossum
    distance."""
    return min(
        THETAS,
        key=lambda theta: total_distance(
            lambda sequence: esim_counts(sequence.frames, sequence.t_s, theta), sequences
        ),
    )


def esim_counts(frames, t_s, theta):
    """Counts of the ideal sensor."""
    return events.dense_counts(frames, t_s, SensorModel(theta, theta))


def _integer(limit, generator):
    return int(torch.randint(limit, (), generator=generator))


@torch.no_grad()
def calibrated_scale(model, sequences, rounds=3):
    """Factors on the thresholds ON and OFF with which the generator gives as many events as the target, noise
    included, on these sequences.

    Squared errors favour too few events where an edge is predicted beside its place; the number of events is
    set right afterwards.
    """
    target = sum(sequence.counts.sum((0, 2, 3)).double() for sequence in sequences)
    scale = torch.ones(2, dtype=torch.float64)
    for _ in range(rounds):
        found = torch.zeros(2, dtype=torch.float64)
        for sequence in sequences:
            counts, _ = model(sequence.frames, sequence.t_s, theta_scale=scale)
            found += (counts + model.expected_noise(sequence.frames, sequence.t_s)).sum((0, 2, 3)).double()
        scale = (
            scale * (found / target) ** 0.7
        )  # events go as 1/theta for a steady change and as 1/theta^2 for a random walk
    return scale.tolist()
