"""What every event layer keeps: it is its function, batches are their samples, chunks are the
whole, values and gradients; noise, learnt values, and the same on a CUDA device."""

import itertools
import math
from dataclasses import replace

import pytest
import torch

from codesign import events
from codesign.events import LAYERS, SensorModel, layer
from codesign.events.sensor.model import draw_deviates
from tests.numbers import D, close, randn64, seeded

PLAIN = SensorModel(0.15, 0.2)
NOISY = SensorModel(0.15, 0.2, 0.03, 60.0, shot_rate_hz=20.0)
LEAK = {"leak_rate_hz": 3.0, "leak_jitter": 0.2, "rate_cov_decades": 0.2}
PHYSICAL = replace(NOISY, refractory_s=2e-3, **LEAK)
LEARNT = ("theta_on", "theta_off", "cutoff_hz")


def drifting(*shape, frames=30, seed=1, dtype=D):
    """Intensities [*batch, T, H, W] of levels that drift at random, and their times."""
    *batch, height, width = shape
    steps = torch.randn(*batch, frames, height, width, generator=seeded(seed), dtype=dtype)
    return (4 + 0.1 * steps.cumsum(-3)).exp(), torch.arange(frames, dtype=D) * 2e-3


def clear(name):
    """A layer without noise whose sensor is learnt; thresholds near enough for the play's gradient,
    which chunks carry on."""
    dead_s = 3e-3 if name == "physical" else 0.0
    options = {"steps": 2} if name == "srm" else {}
    sensor = SensorModel(0.18, 0.2, cutoff_hz=60.0, refractory_s=dead_s)
    learnt = (*LEARNT, *["refractory_s"] * (dead_s > 0))
    return layer(name, sensor, learn=learnt, **options)


def spikes_of_steps(frames, theta_on, theta_off):
    """The spike response layer, written out: it follows the level by at most one threshold per
    frame."""
    level = events.lin_log(frames)
    reference = level[0].clone()
    counts = []
    for now in level[1:]:
        on = now - reference >= theta_on
        off = reference - now >= theta_off
        reference += theta_on * on - theta_off * off.to(reference)
        counts.append(torch.stack((on, off)))
    return torch.stack(counts).to(frames)


FUNCTIONS = {
    "sigmoid": lambda frames, t_s: torch.stack(
        (events.soft(frames, 0.15)[:, 0], events.soft(frames, 0.2)[:, 1]), 1
    ),
    "counts": lambda frames, t_s: events.soft_counts(frames, 0.15, 0.2),
    "dense": lambda frames, t_s: events.dense(frames, 0.15, 0.2)[0],
    "memory": lambda frames, t_s: events.memory(frames, 0.15, 0.2)[0],
    "expected": lambda frames, t_s: events.expected(frames, 0.15, 0.2, 0.15)[0],
    "srm": lambda frames, t_s: spikes_of_steps(frames, 0.15, 0.2),
    "physical": lambda frames, t_s: events.to_counts(events.simulate(frames, t_s, PLAIN), t_s),
}


@pytest.mark.bits
@pytest.mark.parametrize("dtype", [torch.float32, D])
@pytest.mark.parametrize("name", LAYERS)
def test_a_layer_is_its_function(name, dtype):
    frames, t_s = drifting(6, 5, dtype=dtype)
    counts = layer(name, PLAIN)(frames, t_s)
    assert (counts.dtype, counts.shape) == (dtype, (29, 2, 6, 5))
    assert torch.equal(counts, FUNCTIONS[name](frames, t_s).to(dtype))
    assert counts.sum() > 50


# not of the marker bits: where log rounds by address, equal frames may differ by eps
@pytest.mark.parametrize("dtype", [torch.float32, D])
@pytest.mark.parametrize("name", LAYERS)
def test_a_layer_is_silent_before_a_still_scene(name, dtype):
    frames, t_s = drifting(6, 5, dtype=dtype)
    made = layer(name, SensorModel(theta_sigma=0.03, cutoff_hz=30.0))
    still = made(frames[:1].expand(5, 6, 5), t_s[:5])
    ghosts = 1 / (1 + math.exp(5)) if name == "sigmoid" else 0.0
    close(still, torch.full_like(still, ghosts), rtol=1e-6)


@pytest.mark.bits
def test_the_physical_layer_gives_the_events_of_the_sensor():
    frames, t_s = drifting(6, 5)
    stream = events.simulate(frames, t_s, PHYSICAL, seeded(3))
    counts, _ = events.sensor_counts(frames, t_s, PHYSICAL, generator=seeded(3))
    assert torch.equal(counts, events.to_counts(stream, t_s, dtype=D))
    assert counts.sum() > 50


@pytest.mark.bits
@pytest.mark.parametrize("name", LAYERS)
def test_a_batch_is_its_samples_and_chunks_are_the_whole(name):
    frames, t_s = drifting(2, 3, 4, 5, frames=12)
    made = layer(name, PHYSICAL if name == "physical" else NOISY)
    together, alone = seeded(7), seeded(7)
    counts = made(frames, t_s, together)
    singles = [made(sample, t_s, alone) for sample in frames.flatten(0, 1)]
    assert counts.shape == (2, 3, 11, 2, 4, 5)
    close(counts.flatten(0, 1), torch.stack(singles), rtol=1e-12, atol=1e-12)
    assert torch.equal(together.get_state(), alone.get_state())
    each = made(frames, t_s, [seeded(k) for k in range(6)])
    close(each[1, 2], made(frames[1, 2], t_s, seeded(5)), rtol=1e-12, atol=1e-12)
    # without a low-pass some layers keep the last frame itself
    sharp = layer(name, PLAIN)
    for one, given in ((made, frames), (made, frames[0, 0]), (sharp, frames[0, 0])):
        state, parts = None, []
        for start, stop in ((0, 4), (4, 5), (5, 12)):
            buffer = given[..., start:stop, :, :].clone()
            one.advance(buffer, t_s[start:stop], state)  # which the state does not feel
            part, state = one.advance(buffer, t_s[start:stop], state)
            parts.append(part)
            buffer.fill_(math.nan)  # the next chunk is read into the same memory
        close(torch.cat(parts, -4), one(given, t_s), atol=1e-12)


@pytest.mark.bits
def test_chunks_of_spikes_between_frames_are_the_whole():
    """Levels on the brink of a spike: an eighth of a threshold apart."""
    levels = 0.2 / 8 * torch.randint(0, 40, (12, 60, 60), generator=seeded(0)).to(D)
    t_s = torch.arange(12, dtype=D) / 100
    made = layer("srm", SensorModel(0.2, 0.2), steps=5, log_input=True)
    first, state = made.advance(levels[:5], t_s[:5])
    second, _ = made.advance(levels[5:], t_s[5:], state)
    assert torch.equal(torch.cat((first, second)), made(levels, t_s))


@pytest.mark.parametrize("name", LAYERS)
def test_gradients_of_batches_and_chunks_are_those_of_samples_and_the_whole(name):
    frames, t_s = drifting(2, 4, 5, frames=12)
    weight = randn64(seeded(2), 2, 11, 2, 4, 5)
    made = clear(name)
    inputs = (frames.requires_grad_(), *made.parameters())
    whole = torch.autograd.grad((weight * made(frames, t_s)).sum(), inputs)
    samples = sum((w * made(f, t_s)).sum() for w, f in zip(weight, frames, strict=True))
    state, chunks = None, 0.0
    for start, stop in ((0, 5), (5, 6), (6, 12)):
        counts, state = made.advance(frames[:, start:stop], t_s[start:stop], state)
        chunks = chunks + (weight[:, max(start - 1, 0) : stop - 1] * counts).sum()
    assert whole[0].abs().sum() > 0.1
    for loss in (samples, chunks):
        for mine, wanted in zip(torch.autograd.grad(loss, inputs), whole, strict=True):
            close(mine, wanted, rtol=1e-7, atol=1e-9 * float(wanted.abs().max()))


def test_noise_is_that_of_the_drawing_functions():
    frames, t_s = drifting(6, 5)
    sensor = SensorModel(0.15, 0.2, 0.03, shot_rate_hz=200.0)
    noise = seeded(3)
    thetas = events.draw_thresholds(sensor, (6, 5), noise, dtype=D)
    shots = events.draw_shot_counts(sensor, (6, 5), t_s.diff(), noise, dtype=D)
    assert shots.sum() > 50
    counts = layer("memory", sensor)(frames, t_s, seeded(3))
    assert torch.equal(counts, events.memory(frames, *thetas)[0] + shots)


def test_a_layer_counts_what_a_fresh_one_counts_call_after_call():
    sensor = SensorModel(theta_sigma=0.03, shot_rate_hz=50.0)
    frames, t_s = drifting(3, 6, 5, frames=4)
    kept = layer("memory", sensor)
    # drawn, remembered, another seed, longer intervals of more noise, fewer samples
    for seed, pace, samples in ((0, 1, 3), (0, 1, 3), (1, 1, 3), (1, 50, 3), (0, 1, 3), (0, 1, 1)):
        found = []
        for made in (kept, layer("memory", sensor)):
            source = seeded(seed)
            counts = made(frames[:samples], pace * t_s, source)
            found.append((counts, torch.rand(1, generator=source)))
        assert all(torch.equal(mine, fresh) for mine, fresh in zip(*found, strict=True))


def test_a_unit_step_of_a_variable_is_a_tenth_and_moves_every_pixel():
    frames, t_s = drifting(6, 5)
    sensor = SensorModel(0.15, 0.2, 0.03, 60.0)
    made = layer("memory", sensor, learn=("theta_on", "cutoff_hz"))
    assert made.fitted() == sensor
    with torch.no_grad():
        made.learnt.raw["theta_on"] += 2
        made.learnt.raw["cutoff_hz"] -= 1
    theta_on = 0.15 * math.exp(0.2)
    moved = made.fitted()
    assert moved.theta_on == pytest.approx(theta_on, rel=1e-15)
    assert moved.cutoff_hz == pytest.approx(60 * math.exp(-0.1), rel=1e-15)
    on, off = draw_deviates((6, 5), seeded(0), dtype=D)
    level = events.low_pass(events.lin_log(frames), frames, t_s.diff(), moved.cutoff_hz)
    truth, _ = events.memory(level, theta_on + 0.03 * on, 0.2 + 0.03 * off, log_input=True)
    assert torch.equal(made(frames, t_s), truth)
    again = layer("memory", SensorModel(0.4, cutoff_hz=1.0), learn=("theta_on", "cutoff_hz"))
    again.load_state_dict(made.state_dict())
    assert (again.fitted().theta_on, again.fitted().cutoff_hz) == (moved.theta_on, moved.cutoff_hz)


def test_a_comparator_of_ones_own_fits():
    class Steps:
        mismatched = True

        def __call__(self, frames, theta_on, theta_off, state, log_input):
            step = frames.diff(dim=0)
            on, off = step.clamp(min=0) / theta_on, (-step).clamp(min=0) / theta_off
            return torch.stack((on, off), 1), None

    frames, t_s = drifting(4, 5)
    own = events.ComparatorLayer(Steps(), PLAIN, log_input=True)
    ours = layer("counts", PLAIN, log_input=True)
    torch.testing.assert_close(own(frames.log(), t_s), ours(frames.log(), t_s))


@pytest.mark.parametrize("name", LAYERS)
@pytest.mark.cuda
def test_a_cuda_device_gives_the_same(name):
    frames, t_s = drifting(12, 10, frames=9)
    results = []
    for device in ("cpu", "cuda"):
        made = clear(name).to(device)
        given = frames.to(device).requires_grad_()
        counts = made(given, t_s)
        volume = events.from_counts(counts, t_s, 4).counts
        slopes = torch.autograd.grad((volume**2).sum(), [given, *made.parameters()])
        stream = events.simulate(given.detach(), t_s, NOISY, seeded(1))
        shares = events.from_stream(stream, 0, 16_000, 5).counts
        results.append(
            [counts.detach(), volume.detach(), *slopes, events.to_counts(stream, t_s), shares]
        )
    for first, second in zip(*results, strict=True):
        close(first, second.cpu(), rtol=1e-9, atol=1e-9)


def test_a_leak_has_the_slope_of_the_whole_in_chunks():
    """A still scene under a leak: a larger threshold has as many events, as the leak is a share of
    it; to the event under way."""
    frames, t_s = torch.full((101, 2, 2), 3.0, dtype=D), torch.linspace(0, 2, 101, dtype=D)
    leaking = SensorModel(leak_rate_hz=10.0)
    slopes = []
    for cuts in ([0, 101], [0, *range(11, 101, 10), 101]):
        theta = torch.tensor(0.2, dtype=D, requires_grad=True)
        state, total = None, 0.0
        for first, last in itertools.pairwise(cuts):
            chunk = slice(first, last)
            options = {"state": state, "log_input": True, "theta_on": theta}
            counts, state = events.sensor_counts(frames[chunk], t_s[chunk], leaking, **options)
            total = total + counts[:, 0].sum() / 4
        total.backward()
        slopes.append(float(theta.grad))
    assert slopes[1] == pytest.approx(slopes[0], rel=1e-9)
    assert abs(slopes[0]) * 0.2 < 0.5  # of 19 events
