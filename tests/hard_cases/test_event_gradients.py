"""Gradients of every event layer on the worst clip (black, saturated, far beyond the film, exactly at the joint of
the front end, still) against the account that each layer's docstring gives of itself, written out for one pixel."""

import math

import pytest
import torch

from codesign.events import LAYERS, SensorModel, layer

D = torch.float64
CLIP = (0.0, 255.0, 0.0, 1e4, 1e-6, 20.0, 20.0, 300.0)
# for the layer of one event per step, which after those jumps only hurries after the level
SLOWER_CLIP = (100.0, 255.0, 300.0, 255.0, 1e-6, 20.0, 20.0, 300.0)
STEP_S = 1e-3
DEAD_S = 1e-4  # short beside the frames: taken as local
SPREAD = 0.15


def filtered(frames, cutoff_hz):
    """Lin-log level behind the photoreceptor's low-pass, exact for levels that are linear between frames."""
    level = torch.where(frames <= 20, frames * math.log(20) / 20, frames.clamp(min=20).log())
    seen = [level[0]]
    for k in range(1, len(frames)):
        a = 2 * math.pi * cutoff_hz * (0.5 * (frames[k] + frames[k - 1]) + 20) / 275 * STEP_S
        rise = level[k] - level[k - 1]
        seen.append(level[k] + (seen[-1] - level[k - 1]) * torch.exp(-a) - rise * (1 - torch.exp(-a)) / a)
    return torch.stack(seen)


def sigmoid(seen, on, off):
    step = seen.diff()
    return torch.sigmoid(5 / on * (step - on)), torch.sigmoid(5 / off * (-step - off))


def counts(seen, on, off):
    step = seen.diff()
    return step.clamp(min=0) / on, (-step).clamp(min=0) / off


def surrogate(value, slope):
    """Step of a value, with this slope for its derivative."""
    return (value >= 0).to(value) + slope.detach() * (value - value.detach())


def dense(seen, on, off):
    memorised = seen[0]
    found = []
    for now in seen[1:]:
        way = now - memorised
        pair = [way / on - 1, -way / off - 1]
        fired = [surrogate(u, 5 / (1 + 5 * u.abs()) ** 2) for u in pair]
        memorised = memorised + (fired[0] + fired[1]) * way
        found.append(torch.stack(fired))
    return torch.stack(found, 1)


def memory(seen, on, off):
    """Whole counts against the memorised level, with the slopes of a play of width (on + off) / 2."""
    half = (on + off) / 4
    centre = seen[0]
    memorised = seen[0].item()
    found = []
    for now in seen[1:]:
        way = now.item() - memorised
        whole = [math.floor(max(way, 0.0) / on.item()), math.floor(max(-way, 0.0) / off.item())]
        memorised += whole[0] * on.item() - whole[1] * off.item()
        rise = (now - centre - half).clamp(min=0)
        fall = (centre - half - now).clamp(min=0)
        centre = centre + rise - fall
        smooth = torch.stack((rise / on, fall / off))
        found.append(torch.tensor(whole, dtype=D) + smooth - smooth.detach())
    return torch.stack(found, 1)


def physical(seen, on, off):
    """The same, of which the dead time lets one in r T + 1/2 pass."""
    step = seen.diff()
    rate_hz = step.abs() / torch.where(step > 0, on, off) / STEP_S
    return memory(seen, on, off) / (rate_hz * DEAD_S + 0.5).clamp(min=1)


def expected(seen, on, off):
    """Sums over the k-th events of pixels whose thresholds scatter log-normally."""
    k = torch.arange(1, 401, dtype=D)
    memorised = seen[0]
    found = []
    for now in seen[1:]:
        pair = []
        for sign, theta in ((1, on), (-1, off)):
            way = (sign * (now - memorised)).clamp(min=1e-300)
            place = ((way / theta).log() - k.log()) / SPREAD
            pair.append(torch.special.ndtr(place).sum())
            moved = theta * math.exp(SPREAD**2 / 2) * torch.special.ndtr(place - SPREAD).sum()
            moves = bool(sign * (now - memorised) > 0)
            memorised = memorised + sign * moved if moves else memorised
        found.append(torch.stack(pair))
    return torch.stack(found, 1)


def srm(seen, on, off):
    """The slopes of the memory layer for a level that leaves its play by a threshold per step at most; of equal
    thresholds."""
    half = (on + off) / 4
    centre = seen[0]
    held = [seen[0]]
    for now in seen[1:]:
        rise = (now - centre - half).clamp(min=0)
        fall = (centre - half - now).clamp(min=0)
        late = bool((rise > on) | (fall > off))
        centre = centre + torch.minimum(rise, on) - torch.minimum(fall, off)
        held.append((centre + half if rise > 0 else centre - half) if late else now)
    return memory(torch.stack(held), on, off)


ACCOUNTS = {
    "sigmoid": sigmoid,
    "counts": counts,
    "dense": dense,
    "memory": memory,
    "expected": expected,
    "srm": srm,
    "physical": physical,
}


def test_every_layer_is_here():
    assert set(ACCOUNTS) == set(LAYERS)


@pytest.mark.parametrize("kind", LAYERS)
def test_gradients_of_every_layer_on_the_worst_clip_are_those_of_its_account(kind, generator):
    clip = torch.tensor(SLOWER_CLIP if kind == "srm" else CLIP, dtype=D)
    theta_off = 0.2 if kind == "srm" else 0.25
    sensor = SensorModel(0.2, theta_off, cutoff_hz=50.0, refractory_s=DEAD_S if kind == "physical" else 0.0)
    names = ("theta_on", "theta_off", "cutoff_hz")
    learnt = layer(kind, sensor, learn=names)
    frames = clip[:, None, None].expand(-1, 2, 3).clone().requires_grad_()
    weights = torch.randn(len(clip) - 1, 2, generator=generator, dtype=D)
    found = learnt(frames, torch.arange(len(clip), dtype=D) * STEP_S)
    variables = [learnt.learnt.raw[name] for name in names]
    by_frames, *by_variables = torch.autograd.grad(
        (found * weights[..., None, None]).sum(), [frames, *variables]
    )

    pixel = clip.clone().requires_grad_()
    values = [torch.tensor(getattr(sensor, name), dtype=D, requires_grad=True) for name in names]
    pair = ACCOUNTS[kind](filtered(pixel, values[2]), values[0], values[1])
    total = (pair[0] * weights[:, 0]).sum() + (pair[1] * weights[:, 1]).sum()
    truth, *by_values = torch.autograd.grad(total, [pixel, *values], allow_unused=True)
    # the low-pass leaves a^5 / 720 out of a series for paces a below 0.05: 4e-8 of a step in the derivative
    expanded = truth[:, None, None].expand_as(by_frames)
    torch.testing.assert_close(by_frames, expanded, rtol=1e-6, atol=1e-9 * float(truth.abs().max()))
    for mine, slope, value in zip(by_variables, by_values, values, strict=True):
        # six pixels; a unit of a variable is a tenth of the value's logarithm
        assert float(mine) == pytest.approx(6 * 0.1 * value.item() * slope.item(), rel=1e-6)
