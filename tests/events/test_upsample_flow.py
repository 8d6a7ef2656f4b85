"""The parts of upsampling against closed forms: flow of known motions, sampling, splatting, medians."""

import pytest
import torch

from codesign.events.upsampling.between import between, visibility
from codesign.events.upsampling.flow import flow_both_ways
from codesign.events.upsampling.hidden import repaired
from codesign.events.upsampling.match import with_matches
from codesign.events.upsampling.tvl1 import median
from codesign.events.upsampling.warp import inside, sampled, splatted


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


def test_equal_frames_have_no_flow_at_all():
    frame = textured(50, 70)
    assert not bool(flow_both_ways(frame, frame).any())


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


def test_sampling_of_a_slope_is_what_the_kernels_make_of_it():
    y, x = torch.meshgrid(
        torch.arange(12, dtype=torch.float64), torch.arange(15, dtype=torch.float64), indexing="ij"
    )
    plane = (3 + 2 * x - y)[None, None]
    move = torch.tensor([0.37, -0.81], dtype=torch.float64)[None, :, None, None].expand(1, 2, 12, 15)
    truth = (3 + 2 * (x + 0.37) - (y - 0.81))[3:-3, 3:-3]
    # Keys' kernel with a displaces a slope by -(2a + 1)(2t^3 - 3t^2 + t) at the fraction t of a pixel: 0 for
    # a = -0.5, a half of the bracket for -0.75
    off = [(2 * t**3 - 3 * t**2 + t) / 2 for t in (0.37, 0.19)]
    for mode, error in (("bilinear", 0.0), ("bicubic", 2 * off[0] - off[1])):
        torch.testing.assert_close(
            sampled(plane, move, mode)[0, 0, 3:-3, 3:-3], truth + error, rtol=1e-12, atol=1e-12
        )
    assert max((2 * t**3 - 3 * t**2 + t) / 2 for t in torch.linspace(0, 1, 101).tolist()) == pytest.approx(
        0.048, abs=2e-4
    )
    assert torch.equal(inside(torch.zeros(1, 2, 4, 5)), torch.ones(1, 1, 4, 5))
    assert inside(
        torch.full((1, 2, 1, 5), 0.0) + torch.tensor([1.0, 0.0])[None, :, None, None]
    ).flatten().tolist() == [1, 1, 1, 1, 0]


def test_splatting_is_the_transpose_of_bilinear_sampling_and_loses_nothing_inside():
    generator = torch.Generator().manual_seed(3)
    values, others = (torch.rand(9, 11, 1, dtype=torch.float64, generator=generator) for _ in range(2))
    move = torch.rand(2, 9, 11, dtype=torch.float64, generator=generator) * 4 - 2
    y, x = torch.meshgrid(torch.arange(9.0), torch.arange(11.0), indexing="ij")
    move = (torch.stack((x, y)) + move).clamp_min(0).minimum(
        torch.tensor([10.0, 8.0])[:, None, None]
    ) - torch.stack((x, y))  # nothing leaves
    landed = splatted(values, move)
    assert float(landed.sum()) == pytest.approx(float(values.sum()), rel=1e-12)
    seen = sampled(others.permute(2, 0, 1)[None], move[None], "bilinear")[0, 0]
    assert float((landed * others).sum()) == pytest.approx(float((values[..., 0] * seen).sum()), rel=1e-12)
    assert float(splatted(values, move + 100).sum()) == 0


def test_median_is_that_of_sorting():
    field = torch.rand(2, 2, 7, 9, generator=torch.Generator().manual_seed(4))
    padded = torch.nn.functional.pad(field, (1, 1, 1, 1), mode="replicate")
    windows = padded.unfold(2, 3, 1).unfold(3, 3, 1).reshape(2, 2, 7, 9, 9)
    assert torch.equal(median(field), windows.sort(-1).values[..., 4])


def test_visibility_and_repair_tell_what_is_hidden():
    # the left half moves right by 6 over the still right half; its flow was carried too far, over the strip
    # it hides, which looks like the right
    forth = torch.zeros(2, 30, 60)
    back = torch.zeros(2, 30, 60)
    forth[0, :, :36], back[0, :, :36] = 6, -6
    levels = torch.full((2, 30, 60), 5.0)
    levels[0, :, :30], levels[1, :, :36] = 3.0, 3.0
    flows = torch.stack((forth, back))
    seen = visibility(flows)
    assert float(seen[0, :, :29].min()) == 1  # 6 there, 6 back
    assert float(seen[0, :, 31:36].max()) < 0.06
    found = repaired(levels, flows, seen)
    assert not bool(found[0, :, :, 31:36].any())  # as its likes on the right
    assert torch.equal(found[0, :, :, :30], forth[:, :, :30])


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
