"""The closed form's kernels as plain operations, and programs that hold them."""

import pytest
import torch
from torch import nn

from codesign.flow import estimate_lk, lk_kernel
from codesign.flow.export import evenly_timed, trace
from codesign.flow.lk_lanes import Grid
from codesign.flow.lk_plain import plain_operations

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
