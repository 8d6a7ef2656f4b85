"""Motions of layers against their closed forms and against where they lead."""

import numpy as np
import pytest
import torch

from codesign.errors import DomainError
from scenes.windows import RenderedWindows, motion, planes
from scenes.windows.layers import Bent, pixels
from tests.numbers import close

TIMES = np.array([-0.3, -0.1, 0.0, 0.25, 0.5, 1.0])
PROBE = np.array([[-32, -24, 1], [32, -24, 1], [-32, 24, 1], [32, 24, 1], [0, 0, 1.0]]).T


def of_probe(homography):
    """Root mean square flow of the corners and the centre of 64 x 48 px."""
    seen = homography @ PROBE
    return np.sqrt(np.square(seen[..., :2, :] / seen[..., 2:, :] - PROBE[:2]).sum(-2).mean())


def test_similarity_flow_is_the_closed_form():
    found = motion.similarity(np.random.default_rng(5), TIMES, 64, 48, (2.0, 6.0))[0]
    np.testing.assert_allclose(found[2], np.eye(3), atol=1e-15)
    half, whole = (complex(found[k, 0, 0], found[k, 1, 0]) for k in (4, 5))
    # half the way is the square root
    np.testing.assert_allclose(half, whole**0.5, rtol=1e-12)
    flow = RenderedWindows(planes("fine"), seed=4).batch([7]).truth.flow_px[0].double()
    # an affine field: second differences vanish; divergence and curl are the same everywhere
    assert flow.diff(dim=1).diff(dim=1).abs().max() < 2e-5
    dx = flow.diff(dim=2).mean((1, 2))
    dy = flow.diff(dim=1).mean((1, 2))
    assert abs(dx[0] - dy[1]) < 1e-5
    assert abs(dx[1] + dy[0]) < 1e-5


def test_the_flow_of_a_camera_before_planes_is_as_long_as_asked():
    found = motion.camera(np.random.default_rng(8), np.array([0.0, 1.0]), 64, 48, (3.0, 3.0), 2)
    np.testing.assert_allclose(found[:, 0], np.broadcast_to(np.eye(3), (2, 3, 3)), atol=1e-12)
    assert abs(of_probe(found[:, 1]) - 3.0) < 0.15


def test_a_turning_camera_keeps_the_angles_between_rays():
    """H = K R K^-1: for the right focal length K^-1 H K is orthonormal up to its scale, whatever
    R."""
    found = motion.rotation(np.random.default_rng(2), TIMES, 64, 48, (4.0, 4.0))[0]
    np.testing.assert_allclose(found[2], np.eye(3), atol=1e-12)
    h = found[-1] / np.cbrt(np.linalg.det(found[-1]))
    # rows 1 and 2 of R: f-scaled products vanish for one f; solve r1 . r2 = 0 for f^2 and check the
    # rest
    f2 = -(h[0, 2] * h[1, 2]) / (h[0, 0] * h[1, 0] + h[0, 1] * h[1, 1])
    k = np.diag([f2**0.5, f2**0.5, 1.0])
    turn = np.linalg.inv(k) @ h @ k
    np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-8)
    assert 0.6 * 64 <= f2**0.5 <= 2.5 * 64
    # half the time is half the angle: R(1/2)^2 = R(1)
    np.testing.assert_allclose(found[4] @ found[4], found[5], atol=1e-9)
    assert abs(of_probe(found[-1]) - 4.0) < 0.02


def test_a_shaking_camera_moves_rigidly_and_not_evenly():
    found = motion.vibration(np.random.default_rng(1), TIMES, 64, 48, (2.0, 3.0))[0]
    np.testing.assert_allclose(found[2], np.eye(3), atol=1e-15)
    turn = found[:, :2, :2]
    unit = np.broadcast_to(np.eye(2), turn.shape)
    np.testing.assert_allclose(turn @ turn.transpose(0, 2, 1), unit, atol=1e-12)
    shift = found[:, :2, 2]
    assert np.abs(shift[4] - shift[5] / 2).max() > 0.05  # a steady motion would be half way there
    assert np.abs(shift).max() < 2 * 3.0 + 3 * 0.3 * 3.0


@pytest.mark.parametrize("seed", range(3))
def test_the_origins_of_a_field_lead_back_to_the_pixels(seed):
    points = pixels(40, 60)
    for field in motion.warps(np.random.default_rng(seed), TIMES, 60, 40, (5.0, 5.0), 3):
        origins = field.origins(points).double()
        for share, origin in zip(field.share, origins, strict=True):
            reached = origin + share * field.displacement(origin)
            # a hundredth of what flow is judged by
            assert (reached - points).abs().max() < 1e-4
        assert torch.equal(origins[2].float(), points)
        # the end is the same displacement the other way round
        close(field.end(origins[-1].float()), points, atol=1e-4)


def test_the_stretch_of_a_field_is_that_of_its_differences():
    field = motion.warps(np.random.default_rng(4), TIMES, 64, 64, (4.0, 4.0), 1)[0]
    points = pixels(5, 7).double() * 6
    step = 1e-4
    columns = [
        (field.displacement(points + step * axis) - field.displacement(points - step * axis))
        / (2 * step)
        for axis in torch.eye(2, dtype=torch.float64)
    ]
    truth = torch.linalg.matrix_norm(torch.stack(columns, -1), 2)
    close(field.stretch(points), truth, rtol=1e-6, atol=1e-9)


def test_three_times_the_flow_is_the_same_field_three_times():
    once, thrice = (
        motion.warps(np.random.default_rng(6), TIMES, 128, 128, limits, 4)
        for limits in ((1.0, 3.0), (3.0, 9.0))
    )
    points = pixels(9, 9).double() * 14
    squares = 0.0
    for small, large in zip(once, thrice, strict=True):
        torch.testing.assert_close(3 * small.displacement(points), large.displacement(points))
        squares += float(small.displacement(points).square().sum(-1).mean())
    assert 0.7 < (squares / 4) ** 0.5 < 4.0  # asked: 1 to 3 px, over a slightly larger area


def test_a_field_that_folds_is_refused():
    with pytest.raises(DomainError, match="would stretch a field"):
        motion.warps(np.random.default_rng(0), TIMES, 32, 32, (60.0, 60.0), 2)


def test_a_bent_layer_begins_flat_and_shows_at_the_end_what_it_showed_at_the_start():
    """The texture seen at ``end(q)`` at the last time is that of q: to the fixed point's 0.25^12 of
    a few px."""
    homographies = torch.eye(3).repeat(3, 1, 1)
    homographies[1:, 0, 2] = torch.tensor([1.0, 2.0])
    homographies[2, 0, 1] = 0.03
    field = motion.displacement(np.random.default_rng(0), 48, 40, 3.0)
    layer = Bent(homographies, field, torch.tensor([0.0, 0.5, 1.0]))
    start = pixels(40, 48)
    end = layer.end(start)
    assert (end - start).norm(dim=-1).mean() > 2.0
    seen = layer.texels(torch.eye(3), end)[-1].movedim(0, -1)
    close(seen, start, atol=1e-4)
    close(layer.texels(torch.eye(3), start)[0].movedim(0, -1), start, atol=1e-5)


def test_displacements_have_the_length_asked_for_unless_they_were_steep():
    field = motion.displacement(np.random.default_rng(1), 64, 64, 0.5)
    assert float(field.square().sum(0).mean().sqrt()) == pytest.approx(0.5, rel=1e-5)
    steep = motion.displacement(np.random.default_rng(1), 64, 64, 1e3)
    slopes = [float(steep.diff(dim=axis).abs().max()) for axis in (1, 2)]
    assert max(slopes) == pytest.approx(motion.STEEPEST, rel=1e-4)


def test_pace_keeps_both_ends_and_changes_speed_by_no_more_than_asked():
    """d/dt of swing sin(2 pi f t + phase) is at most 2 pi f swing <= most; the line that keeps the
    ends adds as much."""
    t = np.linspace(0, 1, 401)
    for seed in range(20):
        found = motion.pace(np.random.default_rng(seed), t, 0.3)
        assert found[[0, -1]] == pytest.approx([0.0, 1.0], abs=1e-12)
        assert np.abs(np.diff(found) * 400 - 1).max() <= 0.6
    assert motion.pace(np.random.default_rng(0), t, 0.0) == pytest.approx(t, abs=1e-12)
