import pytest
import torch

from codesign.errors import DomainError
from codesign.events.spiking.srm import srm
from codesign.events.spiking.surrogate import FastSigmoid, Laplace, Triangular

KINDS = [Laplace, FastSigmoid, Triangular]


@pytest.mark.parametrize("kind", KINDS)
def test_the_density_is_the_derivative_of_the_integral(kind):
    surrogate = kind(alpha=1.4, beta=2.2)
    x = torch.linspace(-3, 3, 401, dtype=torch.float64) + 1e-4  # off the kinks at 0 and +-1/beta
    step = 1e-6
    slope = (surrogate.torch_integral(x + step) - surrogate.torch_integral(x - step)) / (2 * step)
    # differences: rounding 1e-16 / 2e-6, curvature beyond 1e-11
    assert (slope - surrogate.torch_density(x)).abs().max() < 1e-9
    assert float(surrogate.torch_density(torch.zeros(1, dtype=torch.float64))) == pytest.approx(
        1 / 1.4, rel=1e-15
    )


@pytest.mark.parametrize("kind", KINDS)
def test_unit_mass_rises_from_zero_to_one(kind):
    surrogate = kind.unit(width=0.3)
    far = torch.tensor([-1e9, 0.0, 1e9], dtype=torch.float64)
    assert surrogate.torch_integral(far).tolist() == pytest.approx([0, 0.5, 1], abs=1e-9)


def test_laplace_is_the_published_formula():
    x = torch.tensor([-0.7, 0.2], dtype=torch.float64)
    assert torch.allclose(Laplace(1.4, 1 / 0.7).torch_density(x), (-x.abs() / 0.7).exp() / 1.4, rtol=1e-14)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    ("alpha", "beta", "word"),
    [
        (0.0, 1.0, "alpha"),
        (1.0, -1.0, "beta"),
        (float("nan"), 1.0, "alpha"),
        (1.0, float("inf"), "beta"),
        ("1", 1.0, "alpha"),
    ],
)
def test_parameters_are_checked(kind, alpha, beta, word):
    with pytest.raises(DomainError, match=word):
        kind(alpha, beta)


@pytest.mark.parametrize(
    "x", [None, "1", 0.5, [0.1], torch.ones(2, dtype=torch.int64), torch.ones(2).to_sparse()]
)
def test_surrogates_of_what_is_no_potential_are_refused(x):
    for function in (Laplace(1.0, 1.0).torch_density, Laplace(1.0, 1.0).torch_integral):
        with pytest.raises(DomainError, match="tensor of real numbers"):
            function(x)


@pytest.mark.parametrize("kernel", ["slayer", "thesis", "exp", "step"])
def test_one_neuron_without_an_axis_is_truncated_as_with_one(kernel):
    drive = torch.rand(30, dtype=torch.float64, generator=torch.Generator().manual_seed(3)) * 2
    options = {
        "theta": 1.0,
        "tau_r": 2.0,
        "kernel": kernel,
        "response": "alpha",
        "tau_s": 3.0,
        "truncation": 1e-2,
    }
    bare, alone = srm(drive, **options), srm(drive[:, None], **options)
    assert torch.equal(bare[0], alone[0][:, 0])
    assert bare[0].sum() > 0
    assert torch.equal(bare[1], alone[1][:, 0])
