"""What flow is judged on: motions against their closed forms, packets against the number of events asked
for."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from codesign.errors import DomainError
from codesign.flow.warp import along_flow
from scenes import flow_motion
from scenes.flow_packets import PacketWindows
from scenes.flow_sets import EVERYDAY, SETS
from scenes.flow_warps import warps
from scenes.flow_windows import Draws, RenderedWindows, planes

TIMES = np.array([-0.3, -0.1, 0.0, 0.25, 0.5, 1.0])


def grid(height, width):
    y, x = torch.meshgrid(
        torch.arange(height) - (height - 1) / 2, torch.arange(width) - (width - 1) / 2, indexing="ij"
    )
    return torch.stack([x, y], -1)


@pytest.mark.parametrize("seed", range(3))
def test_the_origins_of_a_field_lead_back_to_the_pixels(seed):
    points = grid(40, 60)
    for field in warps(np.random.default_rng(seed), TIMES, 60, 40, (5.0, 5.0), 3):
        origins = field.origins(points).double()
        for share, origin in zip(field.share, origins, strict=True):
            reached = origin + share * field.displacement(origin)
            assert float((reached - points).abs().max()) < 1e-4  # a hundredth of what flow is judged by
        assert torch.equal(origins[2].float(), points)
        # the end is the same displacement the other way round
        torch.testing.assert_close(field.end(origins[-1].float()), points, rtol=0, atol=1e-4)


def test_the_stretch_of_a_field_is_that_of_its_differences():
    field = warps(np.random.default_rng(4), TIMES, 64, 64, (4.0, 4.0), 1)[0]
    points = grid(5, 7).double() * 6
    step = 1e-4
    columns = [
        (field.displacement(points + step * axis) - field.displacement(points - step * axis)) / (2 * step)
        for axis in torch.eye(2, dtype=torch.float64)
    ]
    truth = torch.linalg.matrix_norm(torch.stack(columns, -1), 2)
    torch.testing.assert_close(field.stretch(points), truth, rtol=1e-6, atol=1e-9)


def test_three_times_the_flow_is_the_same_field_three_times():
    once, thrice = (
        warps(np.random.default_rng(6), TIMES, 128, 128, (low, high), 4)
        for low, high in ((1.0, 3.0), (3.0, 9.0))
    )
    points = grid(9, 9).double() * 14
    squares = 0.0
    for small, large in zip(once, thrice, strict=True):
        torch.testing.assert_close(3 * small.displacement(points), large.displacement(points))
        squares += float(small.displacement(points).square().sum(-1).mean())
    assert 0.7 < (squares / 4) ** 0.5 < 4.0  # asked: 1 to 3 px, over a slightly larger area


def test_a_field_that_folds_is_refused():
    with pytest.raises(DomainError, match="would stretch a field"):
        warps(np.random.default_rng(0), TIMES, 32, 32, (60.0, 60.0), 2)


@pytest.mark.parametrize(("layers", "mean_share"), [((0, 0), 0.1), ((2, 3), 0.6)])
def test_bent_layers_keep_their_radiance(layers, mean_share):
    """The end frame at q + flow(q) shows what the first shows at q, but for the bilinear lookup of edges, and
    for what gets hidden where there are layers."""
    draws = replace(Draws("mixed", "warps", layers, (3.0, 6.0)), contrast=(1.0, 1.0))
    windows = RenderedWindows(draws, seed=3, height_px=72, width_px=96).batch(range(4))
    assert windows.frames is not None
    first, last = windows.frames.log().unbind(1)
    brought = along_flow(last[:, None], windows.truth.flow_px, torch.ones(1))[:, 0]
    inside = along_flow(torch.ones_like(last[:, None]), windows.truth.flow_px, torch.ones(1))[:, 0] > 0.999
    for k in range(4):
        moved = (brought - first).abs()[k][inside[k]]
        still = (last - first).abs()[k][inside[k]]
        assert moved.median() < 0.05 * still.mean()
        assert moved.mean() < mean_share * still.mean()


def test_a_turning_camera_keeps_the_angles_between_rays():
    """H = K R K^-1: for the right focal length K^-1 H K is orthonormal up to its scale, whatever R."""
    found = flow_motion.rotation(np.random.default_rng(2), TIMES, 64, 48, (4.0, 4.0))[0]
    np.testing.assert_allclose(found[2], np.eye(3), atol=1e-12)
    h = found[-1] / np.cbrt(np.linalg.det(found[-1]))
    # rows 1 and 2 of R: f-scaled products vanish for one f; solve r1 . r2 = 0 for f^2 and check the rest
    f2 = -(h[0, 2] * h[1, 2]) / (h[0, 0] * h[1, 0] + h[0, 1] * h[1, 1])
    k = np.diag([f2**0.5, f2**0.5, 1.0])
    turn = np.linalg.inv(k) @ h @ k
    np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-8)
    assert 0.6 * 64 <= f2**0.5 <= 2.5 * 64
    # half the time is half the angle: R(1/2)^2 = R(1)
    np.testing.assert_allclose(found[4] @ found[4], found[5], atol=1e-9)
    probe = np.array([[-32, -24, 1], [32, -24, 1], [-32, 24, 1], [32, 24, 1], [0, 0, 1.0]]).T
    seen = found[-1] @ probe
    assert abs(np.sqrt(np.square(seen[:2] / seen[2:] - probe[:2]).sum(0).mean()) - 4.0) < 0.02


def test_a_shaking_camera_moves_rigidly_and_not_evenly():
    found = flow_motion.vibration(np.random.default_rng(1), TIMES, 64, 48, (2.0, 3.0))[0]
    np.testing.assert_allclose(found[2], np.eye(3), atol=1e-15)
    turn = found[:, :2, :2]
    np.testing.assert_allclose(
        turn @ turn.transpose(0, 2, 1), np.broadcast_to(np.eye(2), turn.shape), atol=1e-12
    )
    shift = found[:, :2, 2]
    assert np.abs(shift[4] - shift[5] / 2).max() > 0.05  # a steady motion would be half way there
    assert np.abs(shift).max() < 2 * 3.0 + 3 * 0.3 * 3.0


@pytest.mark.parametrize("density", [0.1, 1.0])
def test_packets_hold_the_events_asked_for(density):
    """Without noise: the number asked for within the events of a few frame intervals, unless the whole motion
    holds fewer."""
    draws = replace(EVERYDAY, motion="camera", layers=(1, 2), noise=(1e-12, 1e-12), textures="fine")
    source = PacketWindows(draws, density, seed=8, height_px=48, width_px=48)
    held = source.batch(range(6)).volume.counts.sum((1, 2, 3, 4)) / 48**2
    ends = np.array([source._times(k)[-1] for k in range(6)])
    whole = ends == 1.0
    assert not whole.all()
    np.testing.assert_allclose(held.numpy()[~whole], density, rtol=0.1)
    assert (held.numpy()[whole] <= 1.1 * density).all()


def test_a_packet_of_more_events_lasts_longer():
    draws = replace(EVERYDAY, motion="camera", layers=(0, 0), noise=(1e-12, 1e-12), textures="fine")
    few, many = (
        PacketWindows(draws, density, seed=8, height_px=48, width_px=48).batch([3]).truth.flow_px
        for density in (0.1, 0.2)
    )
    assert 1.5 < float(many.norm(dim=1).mean() / few.norm(dim=1).mean()) < 2.6


def test_unequal_thresholds_count_as_they_should():
    """theta_on ON - theta_off OFF follows the change of log radiance to within a threshold at either end."""
    draws = replace(planes("fine", theta=0.1, noise=(1e-12, 1e-12)), mismatch=0.0, on_over_off=(4.0, 4.0))
    windows = RenderedWindows(draws, seed=2).batch(range(3))
    on, off = windows.volume.counts.sum(2).unbind(1)
    assert windows.frames is not None
    change = windows.frames[:, 1].log() - windows.frames[:, 0].log()
    assert (0.2 * on - 0.05 * off - change).abs().max() <= 0.25 + 1e-4
    assert float(off.sum() / on.sum()) > 2.5


@pytest.mark.parametrize("name", ["planes_0.05", "layers_3", "warped", "vibration", "rotation"])
def test_sets_give_windows_of_their_own_for_every_seed(name):
    one, other = (SETS[name](seed, 4).batch([0]) for seed in (1, 2))
    assert one.volume.counts.shape[:3] == (1, 2, 4)
    assert one.truth.flow_px.norm(dim=1).mean() > 0.01
    assert not torch.equal(one.truth.flow_px, other.truth.flow_px)


def test_unfit_draws_are_refused():
    with pytest.raises(DomainError, match="events_per_px is 0"):
        PacketWindows(EVERYDAY, 0.0)
    with pytest.raises(DomainError, match="one plane"):
        RenderedWindows(Draws(motion="rotation"))
    with pytest.raises(DomainError, match="'walk'"):
        RenderedWindows(Draws(motion="walk"))
