"""The same numbers on a CUDA device as on the CPU."""

import pytest
import torch

from codesign.events import (
    LAYERS,
    SensorModel,
    from_counts,
    from_stream,
    layer,
    memory,
    simulate,
    soft,
    soft_counts,
    to_counts,
)

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
T_S = torch.arange(9, dtype=torch.float64) / 240


def frames():
    return torch.rand(9, 12, 10, dtype=torch.float64, generator=torch.Generator().manual_seed(0)) * 255


def test_differentiable_layers_and_volumes():
    results = []
    for device in ("cpu", "cuda"):
        given = frames().to(device).requires_grad_()
        hard, _ = memory(given, 0.2, 0.3)
        layers = (hard, soft_counts(given, 0.2, 0.3), soft(given, 0.2))
        volume = from_counts(torch.stack(layers).sum(0), T_S, 4)
        (gradient,) = torch.autograd.grad((volume.counts**2).sum(), given)
        results.append([*layers, volume.counts, volume.centroid_s, gradient])
    # double precision; a logarithm may differ in its last digit, which moves no count of random frames
    for first, second in zip(*results, strict=True):
        torch.testing.assert_close(first, second.cpu(), rtol=1e-11, atol=1e-11)


@pytest.mark.parametrize("name", LAYERS)
def test_layers_and_their_sensors(name):
    dead_s = 1e-3 if name == "physical" else 0.0
    sensor = SensorModel(0.2, 0.25, theta_sigma=0.03, cutoff_hz=60.0, refractory_s=dead_s)
    results = []
    for device in ("cpu", "cuda"):
        given = frames().to(device).requires_grad_()
        made = layer(name, sensor, learn=("theta_on", "theta_off", "cutoff_hz")).to(device)
        counts = made(given, T_S, torch.Generator().manual_seed(1))
        gradients = torch.autograd.grad((counts**2).sum(), [given, *made.parameters()])
        results.append([counts.detach(), *gradients])
    for first, second in zip(*results, strict=True):
        torch.testing.assert_close(first, second.cpu(), rtol=1e-9, atol=1e-9)


def test_hard_sensor_with_noise_from_one_generator():
    sensor = SensorModel(theta_sigma=0.03, shot_rate_hz=20.0)
    on_cpu, on_cuda = (
        simulate(frames().to(device), T_S, sensor, torch.Generator().manual_seed(1))
        for device in ("cpu", "cuda")
    )
    assert torch.equal(to_counts(on_cpu, T_S), to_counts(on_cuda, T_S).cpu())
    volumes = [from_stream(events, 0, 33_334, 5).counts.cpu() for events in (on_cpu, on_cuda)]
    torch.testing.assert_close(*volumes)
