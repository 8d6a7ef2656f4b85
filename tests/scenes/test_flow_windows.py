"""Windows made on the fly: their flow against the pictures themselves, their statistics against what was
asked for."""

import dataclasses

import numpy as np
import pytest
import torch
from scipy.ndimage import map_coordinates

from codesign.errors import DomainError
from codesign.flow.warp import along_flow
from scenes import flow_motion, flow_textures
from scenes.flow_windows import Draws, RenderedWindows, planes


@pytest.fixture(scope="module")
def layered():
    return RenderedWindows(Draws(layers=(2, 2), flow_px=(3.0, 6.0)), seed=3, height_px=48, width_px=64)


def test_the_flow_leads_to_the_same_radiance(layered):
    """Where a point stays in sight, the end frame at q + flow(q) shows what the first frame shows at q: the
    median over all pixels is far below the change in place."""
    windows = layered.batch(range(6))
    first, last = windows.frames.log().unbind(1)
    brought = along_flow(last[:, None], windows.truth.flow_px, torch.ones(1))[:, 0]
    inside = along_flow(torch.ones_like(last[:, None]), windows.truth.flow_px, torch.ones(1))[:, 0] > 0.999
    for k in range(6):
        moved = (brought - first).abs()[k][inside[k]]
        still = (last - first).abs()[k][inside[k]]
        # the mean counts occlusions and the bilinear lookup of sharp edges
        assert moved.median() < 0.05 * still.mean()
        assert moved.mean() < 0.35 * still.mean()


def test_every_pixel_has_the_flow_of_the_layer_it_shows():
    """Layers looked up pixel by pixel with scipy: where the nearest that covers a pixel leads it."""
    source = RenderedWindows(Draws(layers=(1, 3), distortion=(0.0, 0.0)), seed=6, height_px=40, width_px=56)
    y, x = np.mgrid[:40, :56]
    points = np.stack([(x - 27.5).ravel(), (y - 19.5).ravel(), np.ones(x.size)])
    for index in range(4):
        sample = source._draw(index, source.t)
        expected = np.zeros((2, points.shape[1]))
        sure = np.ones(points.shape[1], bool)
        for motion, crop, place in zip(sample["motion"], sample["crop"], sample["place"], strict=True):
            size = crop.shape[-1]
            on_texture = ((place.double().numpy() @ points)[1::-1] * size + size - 1) / 2  # row, column
            cover = map_coordinates(crop[1].double().numpy(), on_texture, order=1, mode="reflect")
            end = motion.homographies[-1].double().numpy() @ points
            expected = np.where(cover > 0.5, end[:2] / end[2] - points[:2], expected)
            sure &= abs(cover - 0.5) > 1e-3  # where rounding does not choose the layer
        found = source.batch([index]).truth.flow_px[0].flatten(1).double().numpy()
        np.testing.assert_allclose(found[:, sure], expected[:, sure], atol=1e-3)
        assert sure.mean() > 0.98


def test_similarity_flow_is_the_closed_form():
    draw = np.random.default_rng(5)
    motion = flow_motion.similarity(draw, np.array([0.0, 0.5, 1.0]), 64, 48, (2.0, 6.0))[0]
    np.testing.assert_allclose(motion[0], np.eye(3), atol=1e-15)
    a = motion[2, 0, 0]
    b = motion[2, 1, 0]
    m = complex(a, b)
    np.testing.assert_allclose(
        complex(motion[1, 0, 0], motion[1, 1, 0]), m**0.5, rtol=1e-12
    )  # half the way is the square root
    source = RenderedWindows(planes("fine"), seed=4)
    flow = source.batch([7]).truth.flow_px[0].double()
    # an affine field: second differences vanish; divergence is 2 (Re m - 1), curl 2 Im m, the same everywhere
    assert flow.diff(dim=1).diff(dim=1).abs().max() < 2e-5
    dx = flow.diff(dim=2).mean((1, 2))
    dy = flow.diff(dim=1).mean((1, 2))
    assert abs(dx[0] - dy[1]) < 1e-5
    assert abs(dx[1] + dy[0]) < 1e-5


def test_camera_motion_obeys_the_plane_homography():
    """At a small twist the flow of a plane is quadratic in the pixel; the root mean square at the probes is
    the one asked for."""
    draw = np.random.default_rng(8)
    found = flow_motion.camera(draw, np.array([0.0, 1.0]), 64, 64, (3.0, 3.0), 2)
    np.testing.assert_allclose(found[:, 0], np.broadcast_to(np.eye(3), (2, 3, 3)), atol=1e-12)
    probe = np.array([[-32, -32, 1], [32, -32, 1], [-32, 32, 1], [32, 32, 1], [0, 0, 1.0]]).T
    seen = found[:, 1] @ probe
    flow = seen[:, :2] / seen[:, 2:] - probe[:2]
    assert abs(np.sqrt(np.square(flow).sum(1).mean()) - 3.0) < 0.15


@pytest.mark.bits
def test_samples_do_not_depend_on_their_batch(layered):
    together = layered.batch([2, 5, 9])
    alone = layered.batch([5])
    assert torch.equal(together.truth.flow_px[1], alone.truth.flow_px[0])
    assert torch.equal(together.frames[1], alone.frames[0])
    # a volume is a matrix product: sums of at most 32 terms >= 0, each rounded twice by half an eps
    eps = torch.finfo(torch.float32).eps
    torch.testing.assert_close(together.volume.counts[1], alone.volume.counts[0], rtol=2 * 32 * eps, atol=0)


def test_noise_is_as_frequent_as_asked():
    """A still sensor before a uniform wall: only noise. 1 % per pixel, polarity and eighth gives 0.08 per
    pixel and polarity; Poisson within 5 sigma."""
    draws = dataclasses.replace(planes("fine", noise=(0.01, 0.01)), contrast=(1e-6, 1e-6))
    counts = RenderedWindows(draws, seed=1).batch(range(8)).volume.counts
    expected = 0.08 * 64 * 64 * 8
    for polarity in range(2):
        assert abs(float(counts[:, polarity].sum()) - expected) < 5 * expected**0.5


def test_events_are_the_log_change_over_the_threshold():
    """Without mismatch and noise, signed counts times the threshold follow the change of log radiance to
    within one threshold and the level before the window."""
    draws = dataclasses.replace(planes("fine", theta=0.1, noise=(0.0, 0.0)), mismatch=0.0)
    windows = RenderedWindows(draws, seed=2).batch(range(4))
    signed = (windows.volume.counts[:, 0] - windows.volume.counts[:, 1]).sum(1) * 0.1
    assert windows.frames is not None
    change = windows.frames[:, 1].log() - windows.frames[:, 0].log()
    assert (signed - change).abs().max() <= 0.2 + 1e-4


def test_textures_are_told_apart():
    assert len(flow_textures.pool("mixed")) == 5
    with pytest.raises(DomainError, match="texture pool 'wood' is unknown"):
        flow_textures.pool("wood")
    with pytest.raises(DomainError, match="similarity"):
        RenderedWindows(Draws(motion="similarity"))
