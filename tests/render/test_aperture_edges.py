"""Light that apertures take away, sampled at their edges: its gradient against plain samples of the
whole pupil, many of them, and how much less it scatters with few."""

import pytest
import torch

from codesign import lens, pose, render
from codesign.render.aperture_edges import _edge_points, aperture_edge_term
from codesign.render.moving import views_of
from scenes import silhouettes as silhouette_scenes
from tests.numbers import close
from tests.render.differences import smooth_weights

START = pose.look_at((0.05, -1.2, 1.0), (0.0, 1.0, 0.7))[None]
WEIGHT = smooth_weights(32)


def gradient(way, samples, seed, of="thickness_mm", **options):
    """To the six thicknesses (or another tensor) of a triplet whose film reaches beyond its field,
    before a textured wall."""
    optics = lens.load("cooke-triplet").scaled(0.22).freeze()
    held = getattr(optics, of).detach().clone().requires_grad_()
    camera = render.Camera(optics.replace(**{of: held}), 32, 32, 0.25, samples, seed, **options)
    frames = render.frames(camera, silhouette_scenes.build("wall"), START, way)
    return torch.autograd.grad((WEIGHT * frames).double().mean(), held)[0]


def several(way, samples, count, **options):
    return torch.stack([gradient(way, samples, 20 + k, **options) for k in range(count)])


@pytest.mark.parametrize(
    "options",
    [{}, {"falloff": True}, {"spectrum": lens.Spectrum.visible_FdC((1.0, 2.0, 1.0))}],
    ids=["plain", "falloff", "spectrum"],
)
def test_the_edge_of_the_light_has_the_gradient_of_the_whole_pupil(options):
    truth = several("interior", 768, 4, **options)
    found = several("boundary", 24, 16, **options)
    error = (truth.std(0).square() / 4 + found.std(0).square() / 16).sum().sqrt() / truth.mean(
        0
    ).norm()
    assert error < 0.03
    assert (found.mean(0) - truth.mean(0)).norm() / truth.mean(0).norm() < 3 * error


def test_every_pixel_meets_the_edge_in_each_colour_as_often():
    """One pixel in many windows, with more points than colours; by chance some find no edge."""
    light, optics = lens.Spectrum.visible_FdC(), lens.load("cooke-triplet").scaled(0.22)
    camera = render.Camera(optics, 32, 32, 0.25, 3, spectrum=light)
    film = render.Film(32, 32, 1, 1, 0.25, ((28, 28),) * 900)
    points = _edge_points(camera.with_film(film), 4)
    assert points is not None
    _, _, colour, pixel, _ = points
    found = torch.bincount(3 * (pixel % 3) + colour).reshape(3, 3).double()
    assert (found / found.mean(1, keepdim=True) - 1).abs().max() < 0.25


def test_differences_to_semi_apertures_have_the_gradient_of_the_same_samples():
    truth, found = (gradient(way, 16, 20, "semi_aperture_mm") for way in ("interior", "difference"))
    # over a step of a twentieth of the soft edge
    close(found, truth, atol=0.02 * float(truth.norm()))


def test_a_lens_with_no_edge_in_its_pupil_has_none_and_an_obstructed_one_is_left_to_plain_samples():
    scene = silhouette_scenes.build("wall")
    narrow = render.Camera(lens.load("cooke-triplet").scaled(0.22), 8, 8, 0.1, 4)
    term = aperture_edge_term(narrow, views_of(scene, START), 4)
    assert term is not None
    assert term.abs().max() == 0.0
    assert not term.requires_grad

    class Ring(lens.ThinLens):
        def camera_rays(self, film_mm, pupil, **options):
            rays = super().camera_rays(film_mm, pupil, **options)
            share = 1 / (1 + torch.exp(40 * (0.3 - pupil.norm(dim=1))))
            return type(rays)(rays.origin_m, rays.direction, share.to(rays.weight), rays.irradiance)

    assert (
        aperture_edge_term(render.Camera(Ring(11.0, 2.2), 8, 8, 0.1, 4), views_of(scene, START), 4)
        is None
    )
