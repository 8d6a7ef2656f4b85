"""Exposures against closed-form blur, adaptive times against dense flow and exact crossings, chunks
against the whole."""

import math

import pytest
import torch

from codesign import lens, render
from codesign.errors import DomainError
from codesign.pose import look_at, se3_exp
from codesign.render import Camera, Film, MitsubaScene, MovingScene, TexturedPlane
from codesign.render.film import coarse_pixels
from scenes import trajectories, worlds
from tests.numbers import D, close, f64, randn64
from tests.render.differences import assert_gradients
from tests.render.planes import even
from tests.render.solids import area

FOCAL_MM = 8.0
PITCH_MM = 0.1
HEIGHT_M = 2.0
PX_M = PITCH_MM / FOCAL_MM * HEIGHT_M  # a pixel on the plane


def above():
    return look_at((0, 0, HEIGHT_M), (0, 0, 0), down=(0, 1, 0))


def still(t_s):
    return above().repeat(len(t_s), 1, 1)


ALONG = float(above()[0, 0])  # the world's x in the image


def sliding(speed_px_s):
    """A camera over the plane that moves along its image's rows."""
    return lambda t_s: trajectories.translation(above(), (speed_px_s * PX_M, 0.0, 0.0), t_s)


def grating(period_px, contrast=0.8):
    """Radiance 100 exp(contrast cos(2 pi x / period)), x along the image's rows."""
    return TexturedPlane([[ALONG / (period_px * PX_M), 0.0]], [contrast], [0.3])


def camera(width=24, height=1, samples=1, optics=None):
    return Camera(optics or lens.Pinhole(FOCAL_MM), width, height, PITCH_MM, samples)


def shifting(x_m, ground, **description):
    """A bright shape over even ground, moved along x by ``x_m`` of the times."""
    light = area(200.0)
    thing = MitsubaScene({"thing": {**description, "emitter": light}})

    def scene(t_s):
        poses = torch.eye(4, dtype=D).repeat(len(t_s), 1, 1)
        poses[:, 0, 3] = x_m(t_s)
        return MovingScene(ground, {"thing": (thing, poses)})

    return scene


# ---- exposures


def middles(samples):
    """Of equal shares of an exposure, as shares of it from its middle."""
    return (torch.arange(samples, dtype=D) + 0.5) / samples - 0.5


def sweeping(speed_px_s):
    """A bright card over darker ground, whose leading edge passes the middle at 0 s."""
    ground = even(20.0, -0.5)
    return shifting(lambda t: ALONG * (speed_px_s * PX_M * t - 1.0), ground, type="rectangle")


def test_a_moving_edge_blurs_to_a_ramp_of_the_length_of_its_motion():
    """A bright card over the dark, by 12 px in an exposure: the share of it that a pixel's ray
    meets the card; midpoints step, by at most half a sample."""
    speed, exposure, samples = 400.0, 0.03, 20
    scene = sweeping(speed)
    t_s = f64([0.0, 0.005])
    found = render.exposed_frames(camera(40), scene, still, t_s, exposure, samples)[:, 0].double()
    x = torch.arange(40, dtype=D) - 19.5
    share = ((t_s[:, None] + exposure / 2 - x / speed) / exposure).clamp(0, 1)
    assert (found - (20 + 180 * share)).abs().max() <= 180 / (2 * samples) + 1e-3
    sharp = render.exposed_frames(camera(40), scene, still, t_s, 0.0, 1)
    assert set(sharp.reshape(-1).round().tolist()) == {20.0, 200.0}


def test_the_motion_of_a_blurred_edge_is_in_the_boundary_gradient(generator):
    """Each midpoint's edge lies speed * time px from the middle: the pixel that holds it brightens
    by the step of light times the share of the sample, for every px that it comes further."""
    exposure, samples, t_s = 0.03, 20, f64([0.0, 0.005])
    speed = torch.tensor(400.0, dtype=D, requires_grad=True)
    scene = sweeping(speed)
    weights = randn64(generator, 2, 40)
    found = render.exposed_frames(
        camera(40), scene, still, t_s, exposure, samples, gradient="boundary", per_px=1000
    )[:, 0]
    (slope,) = torch.autograd.grad((found * weights).sum(), speed)
    times = t_s[:, None] + middles(samples) * exposure
    pixel = (speed.detach() * times + 19.5).round().long()
    expected = (180 / samples * times * weights.gather(1, pixel)).sum()
    assert abs((slope / expected) - 1) < 1e-3
    inside = render.exposed_frames(camera(40), scene, still, t_s, exposure, samples)[:, 0]
    assert torch.equal(found.detach(), inside.detach())


@pytest.mark.parametrize(("exposure", "samples"), [(0.0, 1), (0.004, 12)])
def test_a_rolling_shutter_shifts_a_moving_grating_row_by_row(exposure, samples):
    """The grating as it stands at the middles of each row's exposure; of a window, at that of its
    rows on the sensor."""
    period, speed, line, contrast = 9.0, 300.0, 2e-4, 0.8
    film = Film(24, 12, 10, 4, PITCH_MM, ((3, 1), (14, 8)))
    whole, windows = (
        render.exposed_frames(
            cam,
            grating(period, contrast),
            sliding(speed),
            [0.0, 0.01],
            exposure,
            samples,
            line_s=line,
        )
        for cam in (
            camera(height=12),
            Camera(lens.Pinhole(FOCAL_MM), 24, 12, PITCH_MM, 1, film=film),
        )
    )
    row = torch.arange(12, dtype=D)[:, None, None]
    times = f64([0.0, 0.01])[:, None, None, None] + line * row + middles(samples) * exposure
    x = torch.arange(24, dtype=D)[:, None] - 11.5 + speed * times
    truth = 100 * torch.exp(contrast * torch.cos(2 * math.pi * x / period + 0.3))
    close(whole, truth.mean(-1), rtol=1e-10)
    for number, (left, top) in enumerate(film.windows_px):
        close(windows[:, number], whole[:, top : top + 4, left : left + 10], rtol=1e-12)


def test_objects_that_would_stand_still_within_an_exposure_are_refused():
    scene = sweeping(100.0)(torch.zeros(1, dtype=D))
    for exposure_s, line_s in ((0.01, 0.0), (0.0, 1e-3)):
        for given, path in (
            (scene, still),
            ((scene, scene), lambda t: still(t).repeat(2, 1, 1, 1)),
        ):
            with pytest.raises(DomainError, match="stand still during an exposure"):
                render.exposed_frames(camera(), given, path, [0.0], exposure_s, 2, line_s=line_s)
    frame = render.frames(camera(), scene, still([0.0]))
    for exposure_s in (0.0, 0.01):  # one sample is in the middle
        exposed = render.exposed_frames(camera(), scene, still, [0.0], exposure_s, 1)
        assert torch.equal(exposed, frame)


# ---- adaptive times


def dense_displacement_px(cam, scene, trajectory, times):
    """Largest motion of any pixel between successive times, forwards and backwards, over all
    pixels."""
    found = []
    for pair in (times.unfold(0, 2, 1), times.unfold(0, 2, 1).flip(1)):
        for both in pair:
            with torch.no_grad():
                flow, valid = render.true_flow(cam, scene(both), trajectory(both))
            found.append(float(flow.norm(dim=1)[valid].max()))
    return torch.tensor(found).reshape(2, -1).amax(0)


@pytest.mark.parametrize(
    ("optics", "end_s", "varied"),
    [(lens.Pinhole(3.0), 0.9, 1.5), (lens.load("cooke-triplet").scaled(0.08), 0.3, 1.05)],
)
def test_no_pixel_moves_further_than_asked_in_a_room_with_crates(optics, end_s, varied):
    cam = camera(40, 30, 1, optics)
    room = worlds.room()
    base = look_at((0.2, -1.2, 1.2), (0.0, 1.0, 0.5))

    def path(t):
        shift = [0.3 * (7 * t).sin(), 0 * t, 0.2 * t, 0 * t, 0.3 * (4 * t).cos() - 0.3, 0.4 * t * t]
        return base @ se3_exp(torch.stack(shift, -1))

    times = render.adaptive_times(cam, room, path, 0.1, end_s, 2.0)
    moved = dense_displacement_px(cam, lambda t: room, path, times)
    assert moved.max() <= 2.0
    assert moved[3:-1].median() >= 1.6  # and not much less: frames are not wasted
    steps = times.diff()[3:-1]
    assert steps.max() / steps.min() > varied  # the speed changes, so do the steps


def test_moving_objects_shorten_the_steps():
    """The ball's top is 1.8 m away: it runs 4 x 0.2 m, 0.0225 m to the pixel."""
    ground = TexturedPlane([[1.0, 0.0]], [0.0], [0.0])
    scene = shifting(lambda t: 0.2 * torch.sin(6 * math.pi * t), ground, type="sphere", radius=0.2)
    cam = camera(32, 24)
    times = render.adaptive_times(cam, scene, still, 0.0, 1 / 3, 1.0)
    assert dense_displacement_px(cam, scene, still, times).max() <= 1.0
    least = 0.8 / (PITCH_MM / FOCAL_MM * 1.8)
    assert least <= len(times) <= 1.6 * least


def test_a_world_at_rest_needs_few_times():
    # 1/64 of the interval, doubled until the end
    assert len(render.adaptive_times(camera(), grating(9.0), still, 0.0, 2.0, 0.5)) == 8


def test_the_coarse_grid_spans_every_window():
    grid = coarse_pixels(Film(40, 30, 12, 9, 0.1, ((0, 0), (20, 11))), 4)
    assert [grid.amin(0).tolist(), grid.amax(0).tolist(), len(grid)] == [
        [0, 0],
        [31, 19],
        2 * 3 * 4,
    ]
    whole = Film(7, 5, 7, 5, 0.1)
    assert torch.equal(coarse_pixels(whole, 1), whole.pixels())


# ---- chunks


@pytest.mark.bits
@pytest.mark.parametrize(
    ("kind", "size"), [("room", 3), ("plane", 1), ("moving", 7), ("moving", 20)]
)
def test_chunks_joined_are_the_sequence_bit_for_bit(kind, size):
    cam = camera(13, 9, 4, lens.load("cooke-triplet").scaled(0.1))
    t_s = trajectories.times(7, 100.0)
    poses = trajectories.translation(look_at((0.5, -1.2, 1.4), (0, 1, 0.8)), (1.0, 0.3, 0.5), t_s)
    scene = worlds.smooth_plane(3) if kind == "plane" else worlds.room()
    if kind == "moving":
        card = trajectories.translation(
            look_at((0.0, 0.5, 1.0), (0.5, -1.2, 1.4)), (-1.0, 0.5, 0.2), t_s
        )
        scene = MovingScene(scene, {"card": (worlds.smooth_plane(1), card)})
    chunks = list(render.frame_chunks(cam, scene, poses, size))
    assert [len(c) for c in chunks] == [min(size, 7 - k) for k in range(0, 7, size)]
    assert torch.equal(torch.cat(chunks), render.frames(cam, scene, poses))


def test_the_lens_is_traced_once_and_its_gradient_is_the_sum_over_chunks(monkeypatch):
    geo = lens.load("cooke-triplet").scaled(0.1)
    cam = camera(9, 6, 4, geo)
    scene = worlds.smooth_plane(3)
    poses = sliding(50.0)(trajectories.times(5, 100.0))
    (truth,) = torch.autograd.grad(
        render.frames(cam, scene, poses).square().sum(), geo.curvature_per_mm
    )
    traced = []
    rays = cam.rays
    monkeypatch.setattr(cam, "rays", lambda: traced.append(1) or rays())
    total = sum(
        torch.autograd.grad(chunk.square().sum(), geo.curvature_per_mm, retain_graph=True)[0]
        for chunk in render.frame_chunks(cam, scene, poses, 2)
    )
    assert len(traced) == 1
    # the same terms, summed in another order
    close(total, truth, rtol=1e-12)


def test_no_exposure_is_the_frame_and_the_lens_keeps_its_gradient(generator):
    geo = lens.load("cooke-triplet").scaled(0.16)
    cam = camera(12, 8, 4, geo)
    scene = worlds.smooth_plane(3)
    t_s = f64([0.0, 0.01])
    unblurred = render.exposed_frames(cam, scene, sliding(100.0), t_s, 0.0, 3)
    close(unblurred, render.frames(cam, scene, sliding(100.0)(t_s)), rtol=1e-13)
    weights = randn64(generator, 2, 8, 12)

    def loss(speed, curvature):
        changed = cam.with_lens(
            geo.replace(curvature_per_mm=geo.curvature_per_mm.detach() * (1 + curvature))
        )

        def path(t):
            return above() @ se3_exp(t[:, None] * torch.cat([speed, torch.zeros(3, dtype=D)]))

        return (render.exposed_frames(changed, scene, path, t_s, 0.02, 4) * weights).sum()

    speed = f64([0.5, -0.3, 0.2])
    # as in test_gradients: smooth textures
    assert_gradients(loss, (speed, torch.zeros(6, dtype=D)), (1e-5, 1e-6), 1e-7)
