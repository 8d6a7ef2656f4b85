"""The parts of upsampling against closed forms: flow of known motions, sampling, splatting, medians."""

import pytest
import torch

from codesign.events.upsampling.flow import flow_both_ways, with_matches
from codesign.events.upsampling.upsample import between, visibility


def textured(height, width, seed=0):
    """Light with detail of 4 px and more, periodic: it may be rolled."""
    y = torch.fft.fftfreq(height)[:, None]
    x = torch.fft.fftfreq(width)
    band = torch.exp(-((x**2 + y**2) / 0.09**2))
    noise = torch.randn(height, width, generator=torch.Generator().manual_seed(seed))
    field = torch.fft.ifft2(torch.fft.fft2(noise) * band).real
    return 80 * torch.exp(0.5 * field / field.std())


@pytest.mark.parametrize("shift", [(1, 0), (-5, 3), (7, -6)])
@pytest.mark.parametrize("gain", [1.0, 1.4])
def test_flow_of_a_rolled_texture_is_the_roll_both_ways(shift, gain):
    first = textured(80, 96)
    second = gain * first.roll((shift[1], shift[0]), (0, 1))
    flows = flow_both_ways(first, second)
    margin = 14  # what leaves on one side enters on the other: no flow there
    truth = torch.tensor(shift, dtype=torch.float32)[:, None, None]
    for flow, sign in zip(flows, (1, -1), strict=True):
        error = (flow - sign * truth)[:, margin:-margin, margin:-margin].norm(dim=0)
        # total variation takes lambda^-1 / contrast off peaks: hundredths of a pixel for log contrast 0.5;
        # 0.1 px is asked of it
        assert float(error.mean()) < 0.1


def test_matches_find_a_small_thing_that_jumps_far():
    # 6 x 6 px that move by 9 px, beside which nothing moves: coarse scales do not show it
    first = textured(60, 60, 1)
    second = first.clone()
    thing = textured(6, 6, 2) * 4
    first = first.clone()
    second = second
    first[20:26, 20:26], second[20:26, 29:35] = thing, thing
    levels = torch.stack((first, second))[:, None].log()
    flow = with_matches(levels, torch.zeros(2, 2, 60, 60))
    inner = flow[0, :, 21:25, 21:25]  # a window of 3 x 3 lies inside
    assert torch.equal(inner, torch.tensor([9.0, 0.0])[:, None, None].expand(2, 4, 4))
    # elsewhere, but for what one frame hides, nothing moves
    still = torch.ones(60, 60, dtype=torch.bool)
    still[18:28, 18:37] = False
    assert not bool(flow[0][:, still].any())


def test_what_leaves_the_picture_is_blended_where_it_stands_and_holes_are_filled():
    first = textured(20, 24, 5)
    second = textured(20, 24, 6)
    far = torch.full((2, 2, 20, 24), 1000.0)
    torch.testing.assert_close(
        between(first, second, far, visibility(far), 0.25), 0.75 * first + 0.25 * second
    )
    # a picture that grows fivefold from its middle leaves four of five rows and columns empty, filled from
    # their neighbours: a slope stays a slope
    y, x = torch.meshgrid(torch.arange(41.0), torch.arange(41.0), indexing="ij")
    grows = 4 * torch.stack((x - 20, y - 20))
    flows = torch.stack((grows, -grows / 5))  # at share 1 the first frame's flow has carried all the way
    made = between(10 + x, 10 + 20 + (x - 20) / 5, flows, visibility(flows), 0.999)
    # the slope of 0.2 per px there is met to a fifth of a pixel of the growing frame, and Keys' 0.05 px
    assert float((made - (30 + (x - 20) / 5))[8:-8, 8:-8].abs().max()) < 0.05


def test_gradients_of_a_frame_between_are_those_of_differences():
    first, second = (textured(9, 11, seed).double().requires_grad_() for seed in (7, 8))
    flows = torch.stack((torch.full((2, 9, 11), 1.3), torch.full((2, 9, 11), -1.2))).double()
    # piecewise linear: central differences are exact but for rounding away from the kinks, which a texture
    # meets with probability 0
    assert torch.autograd.gradcheck(
        lambda a, b: between(a, b, flows, visibility(flows), 0.4), (first, second), eps=1e-4, atol=1e-8
    )
