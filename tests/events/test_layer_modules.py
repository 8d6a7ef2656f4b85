"""Event layers as modules: the functions that they call, differences, closed forms, chunks and batches
against the whole and the single sample."""

import math

import pytest
import torch

from codesign import events
from codesign.events import LAYERS, SensorModel, layer
from codesign.events.sensor.model import draw_deviates

D = torch.float64
PLAIN = SensorModel(0.15, 0.2)
NOISY = SensorModel(0.15, 0.2, 0.03, 60.0, shot_rate_hz=20.0)
SMOOTH = ("sigmoid", "counts", "expected")


def seeded(seed=0):
    return torch.Generator().manual_seed(seed)


def drifting(*shape, frames=30, seed=1, dtype=D):
    """Intensities [*batch, T, H, W] of levels that drift at random, and their times."""
    *batch, height, width = shape
    steps = torch.randn(*batch, frames, height, width, generator=seeded(seed), dtype=dtype)
    return (4 + 0.1 * steps.cumsum(-3)).exp(), torch.arange(frames, dtype=D) * 2e-3


def spikes_of_steps(frames, theta_on, theta_off):
    """The spike response layer, written out: it follows the level by at most one threshold per frame."""
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
    assert counts.dtype == dtype
    assert counts.shape == (29, 2, 6, 5)
    assert torch.equal(counts, FUNCTIONS[name](frames, t_s).to(dtype))
    assert counts.sum() > 50


@pytest.mark.parametrize("name", SMOOTH)
def test_gradients_of_smooth_layers_are_differences(name):
    frames, t_s = drifting(1, 2, frames=5)
    made = layer(name, NOISY, learn=("theta_on", "theta_off", "cutoff_hz"))
    names, variables = zip(*made.named_parameters(), strict=True)

    def counts(frames, *values):
        given = dict(zip(names, values, strict=True))
        return torch.func.functional_call(made, given, (frames, t_s))

    assert names == ("learnt.raw.theta_on", "learnt.raw.theta_off", "learnt.raw.cutoff_hz")
    assert torch.autograd.gradcheck(counts, (frames.requires_grad_(), *variables))


@pytest.mark.bits
@pytest.mark.parametrize("sensor", [PLAIN, NOISY], ids=["plain", "noisy"])
@pytest.mark.parametrize("name", LAYERS)
def test_a_batch_is_its_samples_one_by_one(name, sensor):
    frames, t_s = drifting(2, 3, 4, 5, frames=12)
    made = layer(name, sensor)
    together = seeded(7)
    alone = seeded(7)
    counts = made(frames, t_s, together)
    singles = [made(sample, t_s, alone) for sample in frames.flatten(0, 1)]
    assert counts.shape == (2, 3, 11, 2, 4, 5)
    torch.testing.assert_close(counts.flatten(0, 1), torch.stack(singles), rtol=1e-12, atol=1e-12)
    assert torch.equal(together.get_state(), alone.get_state())
    each = made(frames, t_s, [seeded(k) for k in range(6)])
    torch.testing.assert_close(each[1, 2], made(frames[1, 2], t_s, seeded(5)), rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("name", LAYERS)
def test_gradients_of_a_batch_are_those_of_its_samples(name):
    frames, t_s = drifting(3, 4, 5, frames=12)
    weight = torch.randn(3, 11, 2, 4, 5, generator=seeded(2), dtype=D)
    made = layer(name, SensorModel(0.15, 0.2, cutoff_hz=60.0))
    frames.requires_grad_()
    inputs = (frames, *made.parameters())
    whole = torch.autograd.grad((weight * made(frames, t_s)).sum(), inputs)
    parts = [
        torch.autograd.grad((w * made(f, t_s)).sum(), inputs) for w, f in zip(weight, frames, strict=True)
    ]
    for found, *each in zip(whole, *parts, strict=True):
        torch.testing.assert_close(found, sum(each))


@pytest.mark.bits
@pytest.mark.parametrize("batch", [(), (2,)])
@pytest.mark.parametrize("name", LAYERS)
def test_chunks_are_the_whole(name, batch):
    frames, t_s = drifting(*batch, 6, 5)
    made = layer(name, NOISY)
    whole = made(frames, t_s)
    parts = []
    state = None
    for start, stop in ((0, 10), (10, 11), (11, 30)):
        counts, state = made.advance(frames[..., start:stop, :, :], t_s[start:stop], state)
        parts.append(counts)
    torch.testing.assert_close(torch.cat(parts, -4), whole, rtol=0, atol=1e-12)


@pytest.mark.parametrize("name", LAYERS)
def test_a_static_scene_is_silent(name):
    frames, t_s = drifting(6, 5)
    dead_s = 1e-3 if name == "physical" else 0.0
    silent = layer(name, SensorModel(theta_sigma=0.03, cutoff_hz=30.0, refractory_s=dead_s))
    still = silent(frames[:1].expand(5, 6, 5), t_s[:5])
    ghosts = 1 / (1 + math.exp(5)) if name == "sigmoid" else 0.0
    torch.testing.assert_close(still, torch.full_like(still, ghosts), rtol=1e-12, atol=0)


def test_noise_is_that_of_the_drawing_functions():
    frames, t_s = drifting(6, 5)
    sensor = SensorModel(0.15, 0.2, 0.03, shot_rate_hz=200.0)
    counts = layer("memory", sensor)(frames, t_s, seeded(3))
    noise = seeded(3)
    thetas = events.draw_thresholds(sensor, (6, 5), noise, dtype=D)
    shots = events.draw_shot_counts(sensor, (6, 5), t_s.diff(), noise, dtype=D)
    assert shots.sum() > 50
    assert torch.equal(counts, events.memory(frames, *thetas)[0] + shots)


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
    assert (moved.theta_off, moved.theta_sigma) == (0.2, 0.03)
    on, off = draw_deviates((6, 5), seeded(0), dtype=D)
    level = events.low_pass(events.lin_log(frames), frames, t_s.diff(), moved.cutoff_hz)
    truth, _ = events.memory(level, theta_on + 0.03 * on, 0.2 + 0.03 * off, log_input=True)
    assert torch.equal(made(frames, t_s), truth)
    again = layer("memory", SensorModel(0.4, cutoff_hz=1.0), learn=("theta_on", "cutoff_hz"))
    again.load_state_dict(made.state_dict())
    assert again.fitted().theta_on == moved.theta_on
    assert again.fitted().cutoff_hz == moved.cutoff_hz


@pytest.mark.parametrize("name", ["memory", "physical"])
def test_learnt_thresholds_find_those_behind_the_counts(name):
    # steep smooth waves: many events per pixel, so that thresholds show in the totals
    x = torch.arange(24.0, dtype=D)
    t_s = torch.arange(60, dtype=D) / 240
    wave = (0.4 * x[:, None] + 0.23 * x + 40 * t_s[:, None, None]).sin()
    level = 4.2 + 0.7 * wave + 0.3 * (0.3 * x - 25 * t_s[:, None, None]).cos()
    truth, _ = events.memory(level, 0.17, 0.23, log_input=True)
    made = layer(name, SensorModel(0.3, 0.3), log_input=True)
    optimiser = torch.optim.Adam(made.parameters(), lr=0.5)  # of a tenth
    for step in range(80):
        optimiser.param_groups[0]["lr"] = 0.5 * 0.95**step
        optimiser.zero_grad()
        ((made(level, t_s).sum(0) - truth.sum(0)) ** 2).mean().backward()
        optimiser.step()
    assert made.fitted().theta_on == pytest.approx(0.17, rel=0.02)
    assert made.fitted().theta_off == pytest.approx(0.23, rel=0.02)


def test_a_comparator_of_ones_own_fits():
    class Steps:
        mismatched = True

        def __call__(self, frames, theta_on, theta_off, state, log_input):
            step = frames.diff(dim=0)
            return torch.stack((step.clamp(min=0) / theta_on, (-step).clamp(min=0) / theta_off), 1), None

    frames, t_s = drifting(4, 5)
    own = events.ComparatorLayer(Steps(), PLAIN, log_input=True)
    torch.testing.assert_close(
        own(frames.log(), t_s), layer("counts", PLAIN, log_input=True)(frames.log(), t_s)
    )
