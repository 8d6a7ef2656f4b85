"""A lens of the user's own behind every way to frames, rays that are traced once for many calls, and cameras
whose film gets no light."""

import pytest
import torch

from codesign import lens, render
from codesign.errors import DomainError
from codesign.pose import look_at, se3_exp
from codesign.render import Camera, Film, TexturedPlane
from codesign.types import Rays
from scenes import silhouettes, textures

D = torch.float64


class Barrel(torch.nn.Module):
    """A pinhole whose rays leave with slopes s (1 + k |s|^2), s the position on the film over the focal
    length."""

    dtype = D

    def __init__(self, efl_mm=11.0, k=0.1):
        super().__init__()
        self.efl_mm_ = torch.nn.Parameter(torch.tensor(efl_mm, dtype=D))
        self.k = torch.nn.Parameter(torch.tensor(k, dtype=D))

    def camera_rays(self, film_mm, pupil, wavelength_um=None, aim=False):
        s = film_mm / self.efl_mm_
        slope = s * (1 + self.k * s.square().sum(1, keepdim=True))
        direction = torch.nn.functional.normalize(torch.cat([slope, torch.ones_like(slope[:, :1])], 1), dim=1)
        return Rays(0 * direction, direction, torch.ones_like(direction[:, 0]))

    def film_points(self, points_mm, pupil, wavelength_um=None):
        slope = points_mm[:, :2] / points_mm[:, 2:]
        s = slope
        for _ in range(40):  # contracts by 3 k s^2 < 0.05 a step
            s = slope / (1 + self.k * s.square().sum(1, keepdim=True))
        return s * self.efl_mm_, pupil, points_mm.detach()[:, 2] > 0


def cubes():
    return silhouettes.build("cubes"), look_at((0.05, -1.2, 1.0), (0.0, 1.0, 0.7))[None]


def plane():
    return TexturedPlane(*textures.waves(1, finest_period_m=0.2))


def above(count=2):
    twist = torch.tensor([0.05, -0.03, 0.08, 0.02, -0.03, 0.05], dtype=D)
    start = look_at((0.2, 0.1, 2.0), (0.0, 0.0, 0.0), down=(0, 1, 0))
    return start @ se3_exp(torch.linspace(0, 1, count, dtype=D)[:, None] * twist)


def test_the_gradient_of_silhouettes_reaches_a_lens_of_ones_own(generator):
    scene, pose = cubes()
    weights = torch.rand(24, 24, generator=generator)

    def loss(optics, samples, seed, way):
        camera = Camera(optics, 24, 24, 0.33, samples, seed)
        return (render.frames(camera, scene, pose, way, 32.0)[0] * weights).sum()

    optics = Barrel()
    found = torch.stack(torch.autograd.grad(loss(optics, 1024, 13, "boundary"), list(optics.parameters())))
    plain = torch.stack(torch.autograd.grad(loss(optics, 1024, 13, "interior"), list(optics.parameters())))
    truth = []
    with torch.no_grad():
        for steps in ((0.06, 0.0), (0.0, 0.04)):  # 0.07 px at the corners, some spacings of samples
            ends = [
                sum(
                    float(loss(Barrel(11.0 + sign * steps[0], 0.1 + sign * steps[1]), 1024, seed, "interior"))
                    for seed in (11, 12)
                )
                for sign in (1, -1)
            ]
            truth.append((ends[0] - ends[1]) / 2 / (2 * max(steps)))
    truth = torch.tensor(truth, dtype=D)
    # of what is missing without the term; as in test_boundary, differences of 1024 samples know 1 to 2 %
    assert float(((found - truth) / (plain - truth)).abs().max()) < 0.05


def test_truth_goes_through_a_lens_of_ones_own():
    # flow of points under pixels, by the lens's own formula both ways
    camera = Camera(Barrel(8.0), 12, 10, 0.4, 1)
    poses = above()
    found = render.flow_and_occlusion(camera, plane(), poses)
    pixels = camera.film.pixels()
    seen = render.view(camera, plane(), poses, 0).points_world_m.reshape(-1, 3)
    later = (seen - poses[1, :3, 3]) @ poses[1, :3, :3]
    at, _, _ = camera.lens.film_points(1e3 * later, torch.zeros_like(pixels))
    truth = at / 0.4 + camera.film.middle_px - pixels
    torch.testing.assert_close(
        found.flow_px[0].reshape(2, -1).T, truth, rtol=0, atol=1e-9, check_stride=False
    )


def test_silhouettes_need_no_more_of_a_lens_than_its_rays():
    """A lens that does not say where light of a point goes has the same gradient as one that does."""
    scene, pose = cubes()

    class OneWay:
        dtype = D

        def camera_rays(self, film_mm, pupil, **options):
            return Barrel().camera_rays(film_mm, pupil)

    found = []
    for optics in (Barrel(), OneWay()):
        asks = pose.clone().requires_grad_(True)
        frames = render.frames(Camera(optics, 16, 16, 0.5, 4), scene, asks, gradient="boundary")
        found.append(torch.autograd.grad(frames.square().sum(), asks)[0])
    torch.testing.assert_close(found[1], found[0], rtol=1e-6, atol=1e-6 * float(found[0].norm()))


# ---- rays that are traced once


@pytest.mark.bits
@pytest.mark.parametrize("way", ["interior", "boundary"])
def test_given_rays_make_the_same_frames_and_gradients(way, generator):
    scene, pose = cubes()
    geo = lens.load("cooke-triplet").scaled(0.22)
    camera = Camera(geo, 12, 12, 0.66, 4)
    inputs = [geo.curvature_per_mm, geo.thickness_mm]
    weights = torch.rand(12, 12, generator=generator)
    alone = render.frames(camera, scene, pose, way)
    truth = torch.autograd.grad((alone * weights).sum(), inputs)
    rays = camera.rays()
    assert torch.equal(render.frames(camera, scene, pose, way, rays=rays), alone)
    # two calls that share one trace, going backward through it together
    both = [render.frames(camera, scene, pose, way, rays=rays) for _ in range(2)]
    found = torch.autograd.grad((torch.stack(both) * weights).sum(), inputs)
    for one, two in zip(truth, found, strict=True):
        # float32 sums over 12 x 12 pixels x 4 samples in any order
        assert float((two / 2 - one).norm() / one.norm()) <= 256 * 2**-24


def test_recorded_rays_end_the_gradient_at_themselves(generator):
    geo = lens.load("cooke-triplet").scaled(0.2)
    camera = Camera(geo, 6, 5, 0.4, 4)
    weights = torch.rand(2, 5, 6, generator=generator, dtype=D)
    traced = camera.rays()
    names = ("origin_m", "direction", "weight")
    recorded = [getattr(traced, name).detach().requires_grad_() for name in names]
    frames = render.frames(camera, plane(), above(), rays=Rays(*recorded))
    junction = torch.autograd.grad((frames * weights).sum(), recorded)
    # the chain rule, by hand: what arrives at the rays times what the lens makes of it
    products = [(getattr(traced, n) * g).sum() for n, g in zip(names, junction, strict=True)]
    (found,) = torch.autograd.grad(torch.stack(products).sum(), geo.curvature_per_mm)
    (truth,) = torch.autograd.grad(
        (render.frames(camera, plane(), above()) * weights).sum(), geo.curvature_per_mm
    )
    torch.testing.assert_close(found, truth, rtol=1e-12, atol=1e-12 * float(truth.norm()))


# ---- several worlds


@pytest.mark.bits
def test_a_list_of_worlds_is_each_with_its_own_poses():
    worlds = [plane(), TexturedPlane(*textures.waves(5, finest_period_m=0.3))]
    poses = torch.stack([above(3), above(3).flip(0)])[:, None].repeat(1, 2, 1, 1, 1)
    camera = Camera(lens.load("cooke-triplet").scaled(0.2), 6, 5, 0.4, 4)
    frames = render.frames(camera, worlds, poses)
    assert frames.shape == (2, 2, 3, 5, 6)
    flow, valid = render.true_flow(camera, worlds, poses)
    both = render.flow_and_occlusion(camera, worlds, poses, stride=2)
    for k, world in enumerate(worlds):
        assert torch.equal(frames[k], render.frames(camera, world, poses[k]))
        alone, seen = render.true_flow(camera, world, poses[k])
        torch.testing.assert_close(flow[k], alone, rtol=0, atol=1e-10)
        assert torch.equal(valid[k], seen)
        alone = render.flow_and_occlusion(camera, world, poses[k], stride=2)
        torch.testing.assert_close(both.flow_px[k], alone.flow_px, rtol=0, atol=1e-10)
        assert torch.equal(both.occluded[k], alone.occluded)


# ---- cameras whose film is larger than what the lens lights


def test_a_film_that_gets_light_everywhere_passes():
    for optics, pitch_mm in ((lens.Pinhole(8.0), 5.0), (lens.load("cooke-triplet").scaled(0.2), 0.05)):
        camera = Camera(optics, 64, 48, pitch_mm, 4)
        assert camera.check() is camera


@pytest.mark.parametrize("wide_px", [21, 64, 200])
def test_a_film_larger_than_the_image_circle_is_named_with_its_share(wide_px):
    # the whole share by tracing every pixel; the check looks at some
    camera = Camera(lens.load("cooke-triplet"), wide_px, wide_px, 80.0 / wide_px, 16)
    with torch.no_grad():
        lit = (camera.rays().weight.reshape(-1, 16) > 0).any(1)
    dark = 1 - float(lit.double().mean())
    assert 0.1 < dark < 0.9
    with pytest.raises(DomainError, match=r"of the film's pixels get no light") as raised:
        camera.check()
    assert "\n" not in str(raised.value)
    share = float(str(raised.value).split("about ")[1].split("%")[0]) / 100
    assert (
        abs(share - dark) < 0.06
    )  # a grid of 33 x 33: its ring of outermost pixels counts for twice its area
    reach_mm = float(str(raised.value).split("far as ")[1].split(" mm")[0])
    radius_mm = camera.film_mm(camera.film.pixels()).norm(dim=1)
    assert abs(reach_mm - float(radius_mm[lit].max())) < 2 * 80.0 / min(wide_px, 32)


def test_a_window_in_the_dark_is_named_too():
    film = Film(200, 200, 8, 8, 0.4, ((96, 96), (0, 0)))
    with pytest.raises(DomainError, match="about 50% of the film's pixels get no light"):
        Camera(lens.load("cooke-triplet"), 8, 8, 0.4, 4, film=film).check()


def test_a_lens_that_says_nothing_of_illumination_takes_light_of_several_colours():
    """Its rays have no irradiance; the same lens in every colour gives the picture of one colour."""
    pose = look_at((0.2, 0.1, 2.0), (0.0, 0.0, 0.0), down=(0, 1, 0))[None]
    mono, poly = (
        render.frames(Camera(Barrel(), 8, 8, 0.2, samples_per_pixel=6, spectrum=light), plane(), pose)
        for light in (None, lens.Spectrum.visible_FdC())
    )
    assert torch.allclose(mono, poly, rtol=1e-6)
