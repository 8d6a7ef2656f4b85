"""A lens of the user's own behind every way to frames, rays that are traced once for many calls,
and cameras whose film gets no light."""

import pytest
import torch

from codesign import lens, render
from codesign.errors import DomainError
from codesign.pose import look_at, se3_exp
from codesign.render import Camera, TexturedPlane
from codesign.types import Rays
from scenes import silhouettes, textures
from tests.numbers import D, close, f64, rand64
from tests.render.planes import START

CUBES_POSE = look_at((0.05, -1.2, 1.0), (0.0, 1.0, 0.7))[None]
POSES = START @ se3_exp(f64([[0.0] * 6, [0.05, -0.03, 0.08, 0.02, -0.03, 0.05]]))
PLANE = TexturedPlane(*textures.waves(1, finest_period_m=0.2))


class Barrel(torch.nn.Module):
    """A pinhole whose rays leave with slopes s (1 + k |s|^2), s the position on the film over the
    focal length."""

    dtype = D

    def __init__(self, efl_mm=11.0, k=0.1):
        super().__init__()
        self.efl_mm_ = torch.nn.Parameter(f64(efl_mm))
        self.k = torch.nn.Parameter(f64(k))

    def camera_rays(self, film_mm, pupil, wavelength_um=None, aim=False):
        s = film_mm / self.efl_mm_
        slope = s * (1 + self.k * s.square().sum(1, keepdim=True))
        direction = torch.nn.functional.normalize(
            torch.cat([slope, torch.ones_like(slope[:, :1])], 1), dim=1
        )
        return Rays(0 * direction, direction, torch.ones_like(direction[:, 0]))

    def film_mm(self, points_m):
        slope = points_m[:, :2] / points_m[:, 2:]
        s = slope
        for _ in range(40):  # contracts by 3 k s^2 < 0.05 a step
            s = slope / (1 + self.k * s.square().sum(1, keepdim=True))
        return s * self.efl_mm_


def test_the_gradient_of_silhouettes_reaches_a_lens_of_ones_own(generator):
    scene = silhouettes.build("cubes")
    weights = torch.rand(24, 24, generator=generator)

    def loss(optics, seed, way="interior"):
        camera = Camera(optics, 24, 24, 0.33, 1024, seed)
        return (render.frames(camera, scene, CUBES_POSE, way, 32.0)[0] * weights).sum()

    def gradient(way):
        optics = Barrel()
        return torch.stack(torch.autograd.grad(loss(optics, 13, way), list(optics.parameters())))

    # 0.07 px at the corners, some spacings of samples
    with torch.no_grad():
        truth = torch.stack(
            [
                sum(
                    sign * loss(Barrel(11.0 + sign * focal, 0.1 + sign * k), seed)
                    for sign in (1, -1)
                    for seed in (11, 12)
                )
                / (4 * max(focal, k))
                for focal, k in ((0.06, 0.0), (0.0, 0.04))
            ]
        )
    plain = gradient("interior")
    # of what is missing without the term; as in test_boundary, differences of 1024 samples know 1
    # to 2 %
    assert ((gradient("boundary") - truth) / (plain - truth)).abs().max() < 0.05


def test_truth_goes_through_a_lens_of_ones_own():
    # flow of points under pixels, by the lens's own formula both ways
    camera = Camera(Barrel(8.0), 12, 10, 0.4, 1)
    found, _ = render.true_flow(camera, PLANE, POSES)
    pixels = camera.film.pixels()
    seen = render.view(camera, PLANE, POSES, 0).points_world_m.reshape(-1, 3)
    later = (seen - POSES[1, :3, 3]) @ POSES[1, :3, :3]
    truth = (camera.lens.film_mm(later) / 0.4 + camera.film.middle_px - pixels).T
    torch.testing.assert_close(found[0].flatten(1), truth, rtol=0, atol=1e-9, check_stride=False)


def test_a_lens_that_says_nothing_of_illumination_takes_light_of_several_colours():
    """Its rays have no irradiance; the same lens in every colour gives the picture of one
    colour."""
    mono, poly = (
        render.frames(
            Camera(Barrel(), 8, 8, 0.2, samples_per_pixel=6, spectrum=light), PLANE, POSES
        )
        for light in (None, lens.Spectrum.visible_FdC())
    )
    close(mono, poly, rtol=1e-6)


# ---- rays that are traced once


@pytest.mark.bits
@pytest.mark.parametrize("way", ["interior", "boundary"])
def test_given_rays_make_the_same_frames_and_gradients(way, generator):
    """Two calls that share one trace go backward through it together."""
    scene = silhouettes.build("cubes")
    geo = lens.load("cooke-triplet").scaled(0.22)
    camera = Camera(geo, 12, 12, 0.66, 4)
    weights = torch.rand(12, 12, generator=generator)

    def gradient(frames):
        return torch.autograd.grad(
            (frames * weights).sum(), [geo.curvature_per_mm, geo.thickness_mm]
        )

    alone = render.frames(camera, scene, CUBES_POSE, way)
    rays = camera.rays()
    both = [render.frames(camera, scene, CUBES_POSE, way, rays=rays) for _ in range(2)]
    assert torch.equal(both[0], alone)
    for one, two in zip(gradient(alone), gradient(torch.stack(both)), strict=True):
        # float32 sums over 12 x 12 pixels x 4 samples in any order
        assert (two / 2 - one).norm() / one.norm() <= 256 * 2**-24


def test_recorded_rays_end_the_gradient_at_themselves(generator):
    geo = lens.load("cooke-triplet").scaled(0.2)
    camera = Camera(geo, 6, 5, 0.4, 4)
    weights = rand64(generator, 2, 5, 6)
    traced = camera.rays()
    parts = (traced.origin_m, traced.direction, traced.weight)
    recorded = [part.detach().requires_grad_() for part in parts]
    frames = render.frames(camera, PLANE, POSES, rays=Rays(*recorded))
    junction = torch.autograd.grad((frames * weights).sum(), recorded)
    # the chain rule, by hand: what arrives at the rays times what the lens makes of it
    found, truth = (
        torch.autograd.grad(total, geo.curvature_per_mm)[0]
        for total in (
            sum((part * gradient).sum() for part, gradient in zip(parts, junction, strict=True)),
            (render.frames(camera, PLANE, POSES) * weights).sum(),
        )
    )
    close(found, truth, rtol=1e-12, atol=1e-12 * float(truth.norm()))


# ---- cameras whose film is larger than what the lens lights


def test_a_film_that_gets_light_everywhere_passes():
    for optics, pitch_mm in (
        (lens.Pinhole(8.0), 5.0),
        (lens.load("cooke-triplet").scaled(0.2), 0.05),
    ):
        camera = Camera(optics, 64, 48, pitch_mm, 4)
        assert camera.check() is camera


@pytest.mark.parametrize("wide_px", [21, 200])
def test_a_film_larger_than_the_image_circle_is_named_with_its_share(wide_px):
    # the whole share by tracing every pixel; the check looks at some
    camera = Camera(lens.load("cooke-triplet"), wide_px, wide_px, 80.0 / wide_px, 16)
    with torch.no_grad():
        lit = (camera.rays().weight.reshape(-1, 16) > 0).any(1)
    dark = 1 - float(lit.double().mean())
    assert 0.1 < dark < 0.9
    with pytest.raises(DomainError, match=r"of the film's pixels get no light") as raised:
        camera.check()
    share = float(str(raised.value).split("about ")[1].split("%")[0]) / 100
    # a grid of 33 x 33: its ring of outermost pixels counts for twice its area
    assert abs(share - dark) < 0.06
    reach_mm = float(str(raised.value).split("far as ")[1].split(" mm")[0])
    radius_mm = camera.film_mm(camera.film.pixels()).norm(dim=1)
    assert abs(reach_mm - radius_mm[lit].max()) < 2 * 80.0 / min(wide_px, 32)
