"""Upsampling of video against closed forms: moving patterns, occlusion, still scenes, and the events they
make."""

import math

import pytest
import torch
from torch.nn.functional import avg_pool2d

from codesign import lens, pose, render
from codesign.events import SensorModel, lin_log, simulate, to_counts
from codesign.events.upsampling.upsample import upsample, upsample_stream
from scenes import trajectories, worlds


def pattern(x, y):
    """Smooth light on the 0-255 scale at any place; periods of 9 to 23 px."""
    waves = (
        torch.sin(0.7 * x + 0.2 * y) + torch.sin(0.27 * x - 0.31 * y + 1) + torch.sin(0.1 * x + 0.55 * y + 2)
    )
    return 90 * torch.exp(0.25 * waves)


def moving(shifts, height=48, width=64, dtype=torch.float32):
    """[T, H, W] of the pattern moved by each (x, y) of ``shifts``, pixels."""
    y, x = torch.meshgrid(
        torch.arange(height, dtype=torch.float64), torch.arange(width, dtype=torch.float64), indexing="ij"
    )
    return torch.stack([pattern(x - dx, y - dy) for dx, dy in shifts]).to(dtype)


def inner(frames, margin=8):
    return frames[..., margin:-margin, margin:-margin]


@pytest.mark.parametrize("shift", [(3.0, 0.0), (-2.2, 4.1)])
def test_a_moving_pattern_is_where_it_should_be_in_between(shift):
    frames = moving([(0, 0), shift])
    made, t_s = upsample(frames, [0.0, 0.01])
    truth = moving([(float(t) / 0.01 * shift[0], float(t) / 0.01 * shift[1]) for t in t_s])
    # Light of period 9 px and more: the cubic kernel is off by at most 0.5 % of the swing (30) there, and 0.1
    # px of wrong flow by 0.1 * 2 pi / 9 of it, 2; the straight line between the frames, the control, is off
    # by more than ten times that.
    error, blended = (
        inner(each - truth).square().mean().sqrt()
        for each in (made, frames[0] + (t_s[:, None, None] / 0.01).float() * (frames[1] - frames[0]))
    )
    assert error < 2
    assert blended > 10 * error
    # at least as many steps as pixels of motion, and no more than the 0.1 px of error asks for
    assert len(made) - 1 in (math.ceil(math.hypot(*shift)), math.ceil(math.hypot(*shift) + 0.3))


@pytest.mark.bits
def test_given_frames_and_times_stay_exactly():
    frames = moving([(0, 0), (2.5, 1), (2.5, 1), (7, 3)])
    times = torch.tensor([1e9, 1e9 + 0.013, 1e9 + 0.02, 1e9 + 0.09], dtype=torch.float64)
    made, t_s = upsample(frames, times)
    assert bool((t_s.diff() > 0).all())
    at = torch.searchsorted(t_s, times)
    assert torch.equal(t_s[at], times)
    assert torch.equal(made[at], frames)
    assert int(at[2] - at[1]) == 1  # equal frames: nothing between
    steps = t_s.diff()
    assert torch.allclose(
        steps[: int(at[1])], steps[0], rtol=1e-4
    )  # even, to the 0.1 us that seconds since the epoch resolve


@pytest.mark.bits
def test_a_still_video_stays_bit_for_bit_and_makes_no_event():
    frame = torch.rand(30, 40, generator=torch.Generator().manual_seed(0)) * 255
    frames = frame.repeat(4, 1, 1)
    made, t_s = upsample(frames, torch.arange(4), max_log_change=0.01)
    assert torch.equal(made, frames)
    assert t_s.tolist() == [0, 1, 2, 3]
    assert len(simulate(made, t_s, SensorModel(0.01, 0.01))) == 0


def test_light_that_grows_is_shared_evenly_and_kept_within_the_bound():
    # nothing moves: between the frames intensity is a straight line, by conservation of the weights; ln 2 in
    # steps of at most 0.1 takes ten: the first of n equal steps of intensity is ln(1 + 1/n), 0.095 at n = 10
    # and 0.105 at 9
    frames = torch.full((2, 24, 32), 100.0)
    frames[1] *= 2
    made, t_s = upsample(frames, [0.0, 1.0], max_log_change=0.1)
    assert len(made) == 11
    # rounding of the pyramid moves even light by 1e-4 px, and the outermost pixels lose that share of the
    # weight of one frame, of a quarter of 100
    torch.testing.assert_close(
        made, (100 + 100 * t_s.float())[:, None, None].expand(-1, 24, 32), rtol=0, atol=0.005
    )
    assert float(lin_log(made).diff(dim=0).abs().max()) <= 0.1


def test_what_a_moving_square_hides_and_bares_is_background():
    # a textured square passes 8 px before a still, textured wall; in the middle the strips beside it show
    # wall, that one of the frames still or already shows
    wall = moving([(0, 0)], 64, 96)[0]
    square = 2.2 * moving([(5, 11)], 64, 96)[0]
    frames = [torch.where(_square(shift), square.roll(shift, 1), wall) for shift in (0, 4, 8)]
    # 8 px and what the flow errs by, in steps of at most 4.5 px: two steps
    made, t_s = upsample(torch.stack((frames[0], frames[2])), [0.0, 1.0], max_displacement_px=4.5)
    assert t_s.tolist() == [0.0, 0.5, 1.0]
    wrong = (made[1] - frames[1]).abs()
    strips = _square(0) ^ _square(8)
    # blending shows half of each in the strips; one pixel of 16 there may be at a wrongly placed edge (a
    # boundary off by a pixel of 4 + 4 in a row)
    blended = ((frames[0] + frames[2]) / 2 - frames[1]).abs()
    print(
        float(wrong[strips].mean()),
        float(blended[strips].mean()),
        float(wrong[~strips].mean()),
        float(blended[~strips].mean()),
    )
    assert float(wrong[strips].mean()) < 0.25 * float(blended[strips].mean())
    assert float(wrong[~strips].mean()) < 0.5


def _square(shift):
    mask = torch.zeros(64, 96, dtype=torch.bool)
    mask[16:48, 32 + shift : 64 + shift] = True
    return mask


def test_events_of_the_upsampled_video_are_those_of_the_true_one():
    shifts = [(0.25 * k, 0.1 * k) for k in range(65)]
    frames = moving(shifts)
    t_s = torch.arange(65, dtype=torch.float64) / 1000
    sensor = SensorModel(0.1, 0.1)
    truth = simulate(frames, t_s, sensor)
    kept = frames[::16], t_s[::16]
    found = simulate(*upsample(*kept, max_displacement_px=0.5), sensor)
    control = simulate(*kept, sensor)
    # 4.3 px between frames, half of the finest period: a straight line loses what rises and falls within; at
    # 0.5 px a sinusoid of 9 px is cut by 1 - cos(pi 0.5 / 9) = 1.5 % at its peaks, and borders, 1/8 of the
    # picture, are unknown for up to half of the motion
    assert 0.9 < len(found) / len(truth) < 1.1
    assert len(control) < 0.8 * len(truth)
    for polarity in (-1, 1):
        assert 0.9 < int((found.p == polarity).sum()) / int((truth.p == polarity).sum()) < 1.1


@pytest.mark.bits
def test_the_stream_gives_the_whole_bit_for_bit():
    frames = moving([(0, 0), (2, 1), (5, 1), (5.5, 0)])
    times = [0.0, 0.1, 0.3, 0.4]
    whole, whole_s = upsample(frames, times, max_displacement_px=0.7)
    pieces = list(upsample_stream(iter(frames), iter(times), max_displacement_px=0.7))
    assert len(pieces) == len(frames)
    assert torch.equal(torch.cat([made for made, _ in pieces]), whole)
    assert torch.equal(torch.cat([t_s for _, t_s in pieces]), whole_s)
    assert [float(t_s[-1]) for _, t_s in pieces] == times


def test_a_rendered_room_gives_truer_events_upsampled_than_kept():
    """7.5 px between the frames kept: docs/upsampling.md has 0.15 wrong counts per true event in 4 x 4 px and
    5 ms, 0.69 of the kept frames alone, at twice the resolution."""
    camera = render.Camera(lens.Pinhole(5.0), 72, 54, 10 * math.tan(math.radians(22.5)) / 72, 16)
    start = pose.look_at(*worlds.VIEWS["room"])
    count, stride = 41, 20

    def moved(way_m, count):
        share = torch.linspace(0, 1, count, dtype=torch.float64)
        return trajectories.translation(start, tuple(way_m * part for part in (1.0, 0.2, 0.3)), share)

    scene = worlds.room()
    with torch.no_grad():
        far_px = float(render.true_flow(camera, scene, moved(0.05, 2))[0].norm(dim=1).quantile(0.95))
        frames = render.frames(camera, scene, moved(0.05 * 15 / far_px, count))
    t_s = torch.arange(count, dtype=torch.float64) / 1000
    edges_s = torch.linspace(0, 0.04, 9, dtype=torch.float64)

    def pooled(frames, t_s):
        counts = to_counts(simulate(frames, t_s, SensorModel()), edges_s)
        return avg_pool2d(counts.flatten(0, 1)[:, None], 4) * 16

    truth = pooled(frames, t_s)
    kept = frames[::stride], t_s[::stride]
    wrong = [
        float((pooled(*each) - truth).abs().sum() / truth.sum())
        for each in (upsample(*kept, max_displacement_px=0.5), kept)
    ]
    assert wrong[0] < 0.3
    assert wrong[1] > 0.5
