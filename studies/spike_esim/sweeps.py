"""What becomes of the trained generators when thresholds, noise or chunks change."""

from dataclasses import dataclass, replace
from itertools import pairwise

import torch

from studies.spike_esim import data, score

THETA_SCALES = (0.5, 0.7, 1.0, 1.5, 2.0)
FRAME_NOISES = (0.0, 0.5, 1.0, 2.0)  # standard deviation of noise on the frames, 0-255 scale
SHOT_RATES_HZ = (0.0, 0.5, 5.0)
CHUNKS = (1, 7, 32)
GENERATORS = ("thesis", "smoothed", "esim", "ours")


@dataclass(frozen=True)
class Sweeps:
    """Rows of tables. theta: (scale, rate ratio). frame_noise: (sigma, name, loss, rate ratio). shot: (rate,
    name, loss, that of two draws). chunks: (size, events that differ of ours, of the thesis network)."""

    theta: list
    frame_noise: list
    shot: list
    chunks: list


@torch.no_grad()
def all_sweeps(run, trained, unseen, config):
    """All sweeps on rendered sequences; recorded."""
    some = unseen[:2]
    theta = [(scale, _threshold(trained.ours, some, scale)) for scale in THETA_SCALES]
    run.record(**{f"theta_times_{scale:g}_rate_ratio": value for scale, value in theta})
    frame_noise = [
        (sigma, name, *_with_noise(trained, name, some, sigma, config))
        for sigma in FRAME_NOISES
        for name in GENERATORS
    ]
    run.record(**{f"frame_noise_{sigma:g}_{name}_loss": loss for sigma, name, loss, _ in frame_noise})
    run.record(**{f"frame_noise_{sigma:g}_{name}_rate_ratio": ratio for sigma, name, _, ratio in frame_noise})
    shot = [
        (rate_hz, name, *_with_shots(trained, name, some, rate_hz, config))
        for rate_hz in SHOT_RATES_HZ
        for name in GENERATORS
    ]
    run.record(**{f"shot_noise_{rate_hz:g}_hz_{name}_loss": loss for rate_hz, name, loss, _ in shot})
    run.record(**{f"shot_noise_{rate_hz:g}_hz_sensor_again_loss": floor for rate_hz, _, _, floor in shot})
    chunks = [
        (
            size,
            _differing(trained.ours, some[0], size),
            _differing_spikes(trained.networks["thesis"], some[0], size),
        )
        for size in CHUNKS
    ]
    run.record(**{f"chunks_of_{size}_differing_events": ours + thesis for size, ours, thesis in chunks})
    return Sweeps(theta, frame_noise, shot, chunks)


def _threshold(ours, sequences, scale):
    """Events of ours with scaled thresholds over those of the sensor with scaled thresholds, both without
    noise events."""
    found = target = 0.0
    quiet = replace(
        data.SENSOR,
        theta_on=scale * data.SENSOR.theta_on,
        theta_off=scale * data.SENSOR.theta_off,
        shot_rate_hz=0.0,
        leak_rate_hz=0.0,
    )
    for k, sequence in enumerate(sequences):
        found += float(ours(sequence.frames, sequence.t_s, theta_scale=scale)[0].sum())
        target += float(data.hard(sequence.frames, sequence.t_s, quiet, k).sum())
    return found / target


def _with_noise(trained, name, sequences, sigma, config):
    pairs = []
    for k, sequence in enumerate(sequences):
        noise = torch.randn(sequence.frames.shape, generator=torch.Generator().manual_seed(config.seed + k))
        noisy = (sequence.frames + sigma * noise).clamp(min=0)  # light is not negative
        pairs.append(score.Pair(trained(name, sequence, frames=noisy), sequence))
    loss, ratio = score.losses(pairs, 10, config.seed)
    return loss.value, ratio.value


def _with_shots(trained, name, sequences, rate_hz, config):
    """Loss against a sensor of another noise rate, and that of a second draw of it."""
    sensor = replace(data.SENSOR, shot_rate_hz=rate_hz)
    pairs = []
    again = []
    for k, sequence in enumerate(sequences):
        target = replace(sequence, counts=data.hard(sequence.frames, sequence.t_s, sensor, 50 + k))
        pairs.append(score.Pair(trained(name, sequence), target))
        again.append(score.Pair(data.hard(sequence.frames, sequence.t_s, sensor, 70 + k), target))
    return score.losses(pairs, 10, config.seed)[0].value, score.losses(again, 10, config.seed)[0].value


def _differing(ours, sequence, size):
    whole = ours(sequence.frames, sequence.t_s)[0]
    parts = []
    state = None
    for frames, t_s in _chunks(sequence, size):
        counts, state = ours(frames, t_s, state)
        parts.append(counts)
    return float((torch.cat(parts) - whole).abs().sum())


def _differing_spikes(network, sequence, size):
    network.dt = 1e3 * sequence.dt_s
    whole = network(sequence.frames)[0]
    parts = []
    state = None
    for frames, _ in _chunks(sequence, size):
        spikes, _, state = network(frames, state)
        parts.append(spikes)
    return float((torch.cat(parts) - whole).abs().sum())


def _chunks(sequence, size):
    """The first two frames together, then ``size`` at a time."""
    cuts = [*range(2, len(sequence.frames), size), len(sequence.frames)]
    yield sequence.frames[:2], sequence.t_s[:2]
    for first, last in pairwise(cuts):
        yield sequence.frames[first:last], sequence.t_s[first:last]
