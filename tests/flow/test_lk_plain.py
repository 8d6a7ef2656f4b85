"""The closed form's kernels as plain operations, and programs that hold them."""

import pytest
import torch
from torch import nn

from codesign.flow import estimate_lk, lk_kernel
from codesign.flow.export import evenly_timed, trace
from codesign.flow.lk_cells import Cells
from codesign.flow.lk_field import Polynomials
from codesign.flow.lk_lanes import Grid
from codesign.flow.lk_plain import plain_operations
from codesign.flow.lk_start import at_start

D = torch.float64


@pytest.mark.parametrize(
    ("height", "width", "stride", "cell"), [(13, 17, 1, 4), (16, 12, 2, 2), (9, 21, 4, 1), (3, 1, 1, 2)]
)
def test_plain_operations_are_the_kernels(generator, height, width, stride, cell):
    """To the rounding of sums in double precision; flows lead beyond the border."""
    grid = Grid(height, width, stride)
    rows, columns = grid.shape
    images = torch.randn(2, 5, height, width, generator=generator, dtype=D)
    flow = 4 * torch.randn(2, 2, rows, columns, generator=generator, dtype=D)
    time = torch.linspace(-0.4, 0.6, 5, dtype=D)
    contrast = torch.randn(2, 5, generator=generator, dtype=D)
    density = torch.rand(2, rows, columns, generator=generator, dtype=D)

    def run():
        rate = lk_kernel.blurred(images, grid, (0.4, 0.2, 0.1))
        seen = lk_kernel.moving(rate, flow, time, contrast, grid, 2.5)
        return rate, *seen, lk_kernel.cell_sums(*seen, density, grid, cell)

    with plain_operations():
        plain = run()
    for ours, kernel in zip(plain, run(), strict=True):
        torch.testing.assert_close(ours, kernel, rtol=1e-11, atol=1e-11)


def places(model, joined, height, width, generator):
    """Inputs of ``at_start``, and it as a function of them; flows lead beyond the border, cells differ by pixels."""
    shape = Polynomials(model, height, width, 3.0)
    cells = Cells(2, height, width, 3.0, torch.device("cpu"))

    def draw(*shape):
        return torch.randn(*shape, generator=generator, dtype=D)

    half = 0.3 * draw(2, 2 * shape.terms, 2 * shape.terms)
    given = [
        1.5 * draw(2, 2 * shape.terms),
        half @ half.mT,
        draw(*cells.value.shape),
        draw(*cells.covariance.shape),
        torch.tensor([-0.5, -0.4], dtype=D),
    ]

    def run(parameters, spread, value, covariance, start):
        cells.value = value
        cells.covariance = covariance
        return at_start(shape, parameters, spread, cells, joined, start)

    return run, [values.requires_grad_() for values in given]


@pytest.mark.parametrize("joined", [False, True])
@pytest.mark.parametrize(
    ("model", "height", "width"), [("constant", 7, 12), ("affine", 20, 9), ("quadratic", 70, 17)]
)
def test_the_step_to_the_start_is_that_of_plain_operations(model, height, width, joined, generator):
    run, given = places(model, joined, height, width, generator)
    found = run(*given)
    with plain_operations():
        plain = run(*given)
    torch.testing.assert_close(found, plain, rtol=1e-10, atol=1e-10)
    weights = [torch.randn(values.shape, generator=generator, dtype=D) for values in found]
    for wanted in (1, 3):  # the flow alone has an adjoint of its own
        grads = []
        for outcome in (found, plain):
            parts = list(zip(outcome, weights, strict=True))[:wanted]
            total = sum((values * weight).sum() for values, weight in parts)
            grads.append(
                torch.autograd.grad(
                    total, given, retain_graph=True, allow_unused=True, materialize_grads=True
                )
            )
        torch.testing.assert_close(grads[0], grads[1], rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("joined", [False, True])
def test_the_gradient_of_the_step_to_the_start_is_that_of_differences(joined, generator):
    run, given = places("affine", joined, 3, 10, generator)
    assert torch.autograd.gradcheck(run, given)


class Closed(nn.Module):
    """The closed form as a network, at one blur."""

    def __init__(self):
        super().__init__()
        self.config = {"bins": 2}

    def forward(self, volume):
        return estimate_lk(volume, levels_px=(2.0,), steps=1)


def test_a_program_follows_the_counts_it_is_given(generator):
    """A kernel that the recording does not see would be a constant: the flow of the empty volume that was recorded.
    The same sums in another order: 1e-4 px of flows of a pixel in single precision."""
    program = trace(Closed(), 16, 20).module()
    counts = torch.poisson(torch.full((1, 2, 2, 16, 20), 2.0), generator=generator)
    expected = Closed()(evenly_timed(counts))
    flow, confidence = program(counts)
    assert float(expected.flow_px.abs().max()) > 0.01
    torch.testing.assert_close(flow, expected.flow_px, rtol=0, atol=1e-4)
    torch.testing.assert_close(confidence, expected.confidence, rtol=0, atol=1e-4)
