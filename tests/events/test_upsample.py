"""Upsampling of video against closed forms: flow of known motions, moving patterns, occlusion,
still scenes, and the events they make."""

import math

import pytest
import torch
from torch.nn.functional import avg_pool2d

from codesign import lens, pose, render
from codesign.events import SensorModel, lin_log, simulate, to_counts, upsample, upsample_stream
from codesign.events.upsampling.flow import flow_both_ways, with_matches
from codesign.events.upsampling.upsample import between, repaired, visibility
from codesign.flow.warp import pixel_grid
from scenes import trajectories, worlds
from tests.numbers import D, close, f64, seeded


def moving(shifts, height=48, width=64):
    """[T, H, W] of smooth light on the 0-255 scale, periods of 9 to 23 px, moved by each (x, y) of
    ``shifts``, pixels."""
    x, y = pixel_grid(height, width, torch.zeros((), dtype=D))
    frames = []
    for dx, dy in shifts:
        a, b = x - dx, y - dy
        waves = (0.7 * a + 0.2 * b).sin() + (0.27 * a - 0.31 * b + 1).sin()
        frames.append(90 * torch.exp(0.25 * (waves + (0.1 * a + 0.55 * b + 2).sin())))
    return torch.stack(frames).float()


@pytest.mark.parametrize("shift", [(3.0, 0.0), (-2.2, 4.1)])
def test_a_moving_pattern_is_where_it_should_be_in_between(shift):
    frames = moving([(0, 0), shift])
    made, t_s = upsample(frames, [0.0, 0.01])
    share = t_s / 0.01
    truth = moving([(s * shift[0], s * shift[1]) for s in share.tolist()])
    straight = frames[0] + share[:, None, None].float() * (frames[1] - frames[0])
    # Light of period 9 px and more: the cubic kernel is off by at most 0.5 % of the swing (30)
    # there, and 0.1 px of wrong flow by 0.1 * 2 pi / 9 of it, 2; the straight line between the
    # frames, the control, is off by more than ten times that.
    error, blended = ((x - truth)[:, 8:-8, 8:-8].square().mean().sqrt() for x in (made, straight))
    assert error < 2
    assert blended > 10 * error
    # at least as many steps as pixels of motion, and no more than the 0.1 px of error asks for
    assert len(made) - 1 in (math.ceil(math.hypot(*shift)), math.ceil(math.hypot(*shift) + 0.3))


@pytest.mark.bits
def test_given_frames_and_times_stay_exactly_and_the_stream_gives_the_whole():
    frames = moving([(0, 0), (2.5, 1), (2.5, 1), (7, 3)])
    times = f64([1e9, 1e9 + 0.013, 1e9 + 0.02, 1e9 + 0.09])
    made, t_s = upsample(frames, times)
    assert (t_s.diff() > 0).all()
    at = torch.searchsorted(t_s, times)
    assert torch.equal(t_s[at], times)
    assert torch.equal(made[at], frames)
    assert at[2] - at[1] == 1  # equal frames: nothing between
    # even, to the 0.1 us that seconds since the epoch resolve
    steps = t_s.diff()[: int(at[1])]
    assert torch.allclose(steps, steps[0], rtol=1e-4)
    pieces = list(upsample_stream(iter(frames), iter(times)))
    assert len(pieces) == len(frames)
    for whole, parts in zip((made, t_s), zip(*pieces, strict=True), strict=True):
        assert torch.equal(torch.cat(parts), whole)


@pytest.mark.bits
def test_a_still_video_stays_bit_for_bit_and_makes_no_event(generator):
    frames = (torch.rand(30, 40, generator=generator) * 255).repeat(4, 1, 1)
    made, t_s = upsample(frames, torch.arange(4), max_log_change=0.01)
    assert torch.equal(made, frames)
    assert t_s.tolist() == [0, 1, 2, 3]
    assert len(simulate(made, t_s, SensorModel(0.01, 0.01))) == 0


def test_light_that_grows_is_shared_evenly_and_kept_within_the_bound():
    # nothing moves: between the frames intensity is a straight line, by conservation of the
    # weights; ln 2 in steps of at most 0.1 takes ten: the first of n equal steps of intensity is
    # ln(1 + 1/n), 0.095 at n = 10 and 0.105 at 9
    frames = torch.tensor([100.0, 200.0])[:, None, None].expand(2, 24, 32)
    made, t_s = upsample(frames, [0.0, 1.0], max_log_change=0.1)
    assert len(made) == 11
    # rounding of the pyramid moves even light by 1e-4 px, and the outermost pixels lose that share
    # of the weight of one frame, of a quarter of 100
    truth = (100 + 100 * t_s.float())[:, None, None].expand_as(made)
    close(made, truth, atol=0.005)
    assert lin_log(made).diff(dim=0).abs().max() <= 0.1


def test_an_edge_between_pixels_is_neither_darker_nor_brighter_than_its_sides():
    edge = torch.where(torch.arange(16) < 8, 1.0, 200.0).double().expand(16, 16)
    flows = f64([[0.5, 0], [-0.5, 0]])[..., None, None].expand(2, 2, 16, 16)
    seen = torch.ones(2, 16, 16, dtype=D)
    frame = between(edge, edge, flows, seen, 0.3)
    assert frame.min() == 1
    assert frame.max() == 200


def test_what_a_moving_square_hides_and_bares_is_background():
    # a textured square passes 8 px before a still, textured wall; in the middle the strips beside
    # it show wall, that one of the frames still or already shows
    wall = moving([(0, 0)], 64, 96)[0]
    square = 2.2 * moving([(5, 11)], 64, 96)[0]
    masks = torch.zeros(3, 64, 96, dtype=torch.bool)
    for mask, shift in zip(masks, (0, 4, 8), strict=True):
        mask[16:48, 32 + shift : 64 + shift] = True
    frames = [
        torch.where(m, square.roll(s, 1), wall) for m, s in zip(masks, (0, 4, 8), strict=True)
    ]
    # 8 px and what the flow errs by, in steps of at most 4.5 px: two steps
    made, t_s = upsample(torch.stack((frames[0], frames[2])), [0.0, 1.0], max_displacement_px=4.5)
    assert t_s.tolist() == [0.0, 0.5, 1.0]
    wrong = (made[1] - frames[1]).abs()
    strips = masks[0] ^ masks[2]
    # blending shows half of each in the strips; one pixel of 16 there may be at a wrongly placed
    # edge (a boundary off by a pixel of 4 + 4 in a row)
    blended = ((frames[0] + frames[2]) / 2 - frames[1]).abs()
    assert wrong[strips].mean() < 0.25 * blended[strips].mean()
    assert wrong[~strips].mean() < 0.5


def test_a_rendered_room_gives_truer_events_upsampled_than_kept():
    """7.5 px between the frames kept: docs/upsampling.md has 0.15 wrong counts per true event in 4
    x 4 px and 5 ms, 0.69 of the kept frames alone, at twice the resolution."""
    camera = render.Camera(lens.Pinhole(5.0), 72, 54, 10 * math.tan(math.radians(22.5)) / 72, 16)
    start = pose.look_at(*worlds.VIEWS["room"])
    scene = worlds.room()

    def moved(way_m, count):
        way = tuple(way_m * part for part in (1.0, 0.2, 0.3))
        return trajectories.translation(start, way, torch.linspace(0, 1, count, dtype=D))

    with torch.no_grad():
        far_px = float(
            render.true_flow(camera, scene, moved(0.05, 2))[0].norm(dim=1).quantile(0.95)
        )
        frames = render.frames(camera, scene, moved(0.05 * 15 / far_px, 41))
    t_s = torch.arange(41, dtype=D) / 1000

    def pooled(frames, t_s):
        edges_s = torch.linspace(0, 0.04, 9, dtype=D)
        counts = to_counts(simulate(frames, t_s, SensorModel()), edges_s)
        return avg_pool2d(counts.flatten(0, 1)[:, None], 4) * 16

    truth = pooled(frames, t_s)
    kept = frames[::20], t_s[::20]
    made = upsample(*kept, max_displacement_px=0.5)
    found, control = (float((pooled(*x) - truth).abs().sum() / truth.sum()) for x in (made, kept))
    assert found < 0.3
    assert control > 0.5


def textured(height, width, seed=0):
    """Light with detail of 4 px and more, periodic: it may be rolled."""
    y, x = torch.fft.fftfreq(height)[:, None], torch.fft.fftfreq(width)
    noise = torch.randn(height, width, generator=seeded(seed))
    field = torch.fft.ifft2(torch.fft.fft2(noise) * torch.exp(-((x**2 + y**2) / 0.09**2))).real
    return 80 * torch.exp(0.5 * field / field.std())


@pytest.mark.parametrize(("shift", "gain"), [((1, 0), 1.0), ((-5, 3), 1.4), ((7, -6), 1.0)])
def test_flow_of_a_rolled_texture_is_the_roll_both_ways(shift, gain):
    first = textured(80, 96)
    flows = flow_both_ways(first, gain * first.roll((shift[1], shift[0]), (0, 1)))
    truth = torch.tensor(shift, dtype=torch.float32)[:, None, None]
    for flow, sign in zip(flows, (1, -1), strict=True):
        # what leaves on one side enters on the other: no flow there
        error = (flow - sign * truth)[:, 14:-14, 14:-14].norm(dim=0)
        # total variation takes lambda^-1 / contrast off peaks: hundredths of a pixel for log
        # contrast 0.5; 0.1 px is asked of it
        assert error.mean() < 0.1


def test_matches_find_a_small_thing_that_jumps_far():
    # 6 x 6 px that move by 9 px, beside which nothing moves: coarse scales do not show it
    frames = textured(60, 60, 1).repeat(2, 1, 1)
    frames[0, 20:26, 20:26] = frames[1, 20:26, 29:35] = 4 * textured(6, 6, 2)
    flow = with_matches(frames[:, None].log(), torch.zeros(2, 2, 60, 60))[0]
    # a window of 3 x 3 lies inside
    assert torch.equal(
        flow[:, 21:25, 21:25], torch.tensor([9.0, 0.0])[:, None, None].expand(2, 4, 4)
    )
    # elsewhere, but for what one frame hides, nothing moves
    flow[:, 18:28, 18:37] = 0
    assert not flow.any()


def test_a_doubted_flow_is_taken_from_what_looks_alike_not_from_what_is_nearest():
    levels = torch.zeros(2, 24, 24)
    levels[:, :, 12:] = 1  # log units: the thing on the right is e times as bright
    flows = torch.zeros(2, 2, 24, 24)
    flows[:, 0, :, 12:] = 3  # and moves by 3 px, before a ground at rest
    seen = torch.ones(2, 24, 24)
    seen[:, :, 9:12] = 0  # the ground beside it is hidden in the other frame
    truth = flows.clone()
    flows[:, 0, :, 9:12] = 3  # so its flow was guessed: that of the thing
    assert torch.equal(repaired(levels, flows, seen), truth)


def test_what_leaves_the_picture_is_blended_where_it_stands_and_holes_are_filled():
    first, second = textured(20, 24, 5), textured(20, 24, 6)
    far = torch.full((2, 2, 20, 24), 1000.0)
    made = between(first, second, far, visibility(far), 0.25)
    torch.testing.assert_close(made, 0.75 * first + 0.25 * second)
    # a picture that grows fivefold from its middle leaves four of five rows and columns empty,
    # filled from their neighbours: a slope stays a slope
    x, y = pixel_grid(41, 41, torch.zeros(()))
    grows = 4 * torch.stack((x - 20, y - 20))
    # at share 1 the first frame's flow has carried all the way
    flows = torch.stack((grows, -grows / 5))
    truth = 30 + (x - 20) / 5
    made = between(10 + x, truth, flows, visibility(flows), 0.999)
    # the slope of 0.2 per px there is met to a fifth of a pixel of the growing frame, and Keys'
    # 0.05 px
    assert (made - truth)[8:-8, 8:-8].abs().max() < 0.05


def test_gradients_of_a_frame_between_are_those_of_differences():
    frames = [textured(9, 11, seed).double().requires_grad_() for seed in (7, 8)]
    flows = f64([1.3, -1.2])[:, None, None, None].expand(2, 2, 9, 11)
    # piecewise linear: central differences are exact but for rounding away from the kinks, which a
    # texture meets with probability 0
    assert torch.autograd.gradcheck(
        lambda a, b: between(a, b, flows, visibility(flows), 0.4), frames, eps=1e-4, atol=1e-8
    )
