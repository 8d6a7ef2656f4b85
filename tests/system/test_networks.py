"""Every estimator of flow in the one system: the gradient of its loss to what comes before the
events and to the estimator's own weights is that of differences of the whole, in float64."""

from types import SimpleNamespace

import pytest
import torch
from torch import nn

from codesign import events, flow
from codesign.flow.baselines import FlowNetEvents, SpikeFlowNet
from codesign.system import Batch, System
from codesign.types import Rays

D = torch.float64
SIDE = 32
T_S = torch.linspace(0, 0.02, 9, dtype=D)
BATCH = Batch(torch.eye(4, dtype=D).expand(len(T_S), 4, 4), T_S, scene="waves")
ESTIMATORS = {
    "closed form": lambda: flow.estimate_lk,
    "local closed form": lambda: lambda volume: flow.estimate_lk(volume, model="local"),
    "refiner": lambda: flow.Refiner(width=16),
    "flownet-events": lambda: FlowNetEvents.with_weights(20_000, bins=8),
    "spike-flownet": lambda: SpikeFlowNet.with_weights(20_000, bins=8),
}
JUMPS = {"spike-flownet"}  # spikes jump: their derivative is a stand-in, and none of the sum's


class Lens(nn.Module):
    """Contrast, shift and speed of the picture, as a lens and a mount change them."""

    def __init__(self):
        super().__init__()
        self.efl_mm = nn.Parameter(torch.tensor([0.4, 0.3, 3.0], dtype=D))


class Camera:
    """Hands the lens's numbers on as rays."""

    seed = 0
    film = SimpleNamespace(shape=(SIDE, SIDE))

    def __init__(self, lens):
        self.lens = lens

    def with_seed(self, seed):
        return self

    def with_lens(self, lens):
        return Camera(lens)

    def rays(self):
        numbers = self.lens.efl_mm[None]
        return Rays(torch.zeros_like(numbers), numbers, torch.ones(1, dtype=D))


def waves(rays):
    """Frames [9, 32, 32] of three waves that drift."""
    contrast, shift, speed = rays.direction[0]
    x, y = torch.meshgrid(torch.arange(SIDE, dtype=D), torch.arange(SIDE, dtype=D), indexing="xy")
    u = x - shift - speed * (T_S / T_S[-1])[:, None, None]
    level = (
        torch.sin(0.9 * u + 0.4 * y) + torch.sin(0.5 * u - 0.7 * y) + torch.sin(1.3 * y - 0.2 * u)
    )
    return (contrast * level).exp()


def miss(field):
    """Distance to a flow that is wrong, and the confidence in it."""
    error = (field.flow_px - torch.tensor([2.0, 1.0], dtype=D)[:, None, None]).square().mean()
    return error + field.confidence.mean()


def system_of(name):
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        estimator = ESTIMATORS[name]()
        if isinstance(estimator, nn.Module):
            estimator = estimator.double()
            for parameter in estimator.parameters():
                if not bool(parameter.any()):
                    nn.init.normal_(parameter, std=0.05)
    return System(
        camera=Camera(Lens()),
        render=waves,
        events=events.layer("counts"),
        flow=estimator,
        objectives={"miss": miss},
    )


def differences(system, parameters, direction, step=1e-6):
    def loss(way):
        with torch.no_grad():
            for parameter, part in zip(parameters, direction, strict=True):
                parameter += way * step * part
            value = system(BATCH).loss.item()
            for parameter, part in zip(parameters, direction, strict=True):
                parameter -= way * step * part
        return value

    return (8 * (loss(1) - loss(-1)) - (loss(2) - loss(-2))) / (12 * step)


def drawn(parameters, seed):
    generator = torch.Generator().manual_seed(seed)
    return [torch.randn(p.shape, generator=generator, dtype=D) for p in parameters]


@pytest.mark.parametrize("name", [name for name in ESTIMATORS if name not in JUMPS])
def test_gradient_to_what_comes_before_the_events(name):
    system = system_of(name)
    numbers = [system.lens.efl_mm]
    found = torch.autograd.grad(system(BATCH).loss, numbers)
    for k in range(3):
        direction = [torch.eye(3, dtype=D)[k]]
        assert float(found[0][k]) == pytest.approx(
            differences(system, numbers, direction), rel=1e-5, abs=1e-8
        )


@pytest.mark.parametrize("name", [name for name in ESTIMATORS if "closed form" not in name])
def test_weights_learn_together_with_the_lens(name):
    """Their gradient is that of differences (of the spiking network, that of the layers behind the
    last spike), and a step against all gradients makes the loss of the whole smaller."""
    system = system_of(name)
    weights = [
        parameter
        for part, parameter in system.flow.named_parameters()
        if name not in JUMPS or not part.startswith("encoder")
    ]
    everything = [*weights, system.lens.efl_mm]
    loss = system(BATCH).loss
    found = torch.autograd.grad(loss, everything)
    direction = drawn(weights, 1)
    slope = sum(float((g * d).sum()) for g, d in zip(found, direction, strict=False))
    assert slope == pytest.approx(differences(system, weights, direction), rel=1e-4, abs=1e-8)
    size = float(sum(g.square().sum() for g in found))
    with torch.no_grad():
        for parameter, gradient in zip(everything, found, strict=True):
            parameter -= 1e-3 * loss.item() / size * gradient
    gained = float((loss - system(BATCH).loss).detach())
    assert gained == pytest.approx(1e-3 * loss.item(), rel=0.2)
