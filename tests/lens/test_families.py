"""Lens families: traced lenses whose focal length, f-number, focus and bending are variables;
against rays near the axis, differences, and what the film has to see."""

import itertools

import pytest
import torch

from codesign import lens, render
from codesign.lens.design.constraints import gap_mm
from codesign.lens.trace import at_surfaces
from tests.numbers import D, f64, rand64, randn64
from tests.render.differences import assert_gradients

DAVIS = render.Film(346, 260, 346, 260, 0.0185)
NAMES = lens.family_names()


@pytest.fixture(params=NAMES)
def family(request):
    return lens.family(request.param)


def efls_mm(family, count):
    """Evenly in the logarithm, nodes and what lies between them, the ends included."""
    short, long = family.efl_mm[[0, -1]].log().tolist()
    return torch.linspace(short, long, count, dtype=D).exp().tolist()


def box(family, count=5, focus_per_m=(0.0, 8.0), bending=(-1.0, 0.0, 1.0)):
    """Lenses all over the ranges of a family."""
    fastest, slowest = family.fno
    numbers = (fastest, 2 * fastest, slowest)
    return itertools.product(efls_mm(family, count), numbers, focus_per_m, bending)


def test_rays_near_the_axis_have_the_focal_length_and_the_f_number(family):
    for efl_mm, fno, _, bending in box(family, focus_per_m=(0.0,)):
        geo = family.lens(efl_mm, fno, 0.0, bending)
        share = 1e-4  # of the pupil: aberrations are its square below the paraxial figures
        height_mm = share * efl_mm / fno / 2
        start = f64([[0.0, height_mm, -1.0]])
        along = f64([[0.0, 0.0, 1.0]])
        out = geo.trace(start, along)
        slope = float(-out.direction[0, 1] / out.direction[0, 2])
        assert height_mm / slope == pytest.approx(efl_mm, rel=1e-6)
        # the marginal ray goes through the rim of the stop
        (*_, at_stop) = itertools.islice(
            at_surfaces(geo.prescription(), start, along), geo.stop_index + 1
        )
        rim_mm = float(geo.semi_aperture_mm[geo.stop_index])
        assert abs(float(at_stop.position_mm[0, 1])) == pytest.approx(share * rim_mm, rel=1e-6)
        # closed form: -1 / C of the system matrix
        assert -1 / float(lens.paraxial.system_matrix(geo)[1, 0]) == pytest.approx(efl_mm, rel=1e-9)
        assert float(geo.first_order().fno) == pytest.approx(fno, rel=1e-12)


def test_the_film_follows_the_image_of_the_point_in_focus(family):
    """As far as ``focus_at`` moves it, which knows nothing of families."""
    for efl_mm, fno, focus_per_m, bending in box(family, 3, focus_per_m=(0.5, 8.0)):
        near, far = (family.lens(efl_mm, fno, focus, bending) for focus in (focus_per_m, 0.0))
        moved = (
            far.focus_at(1 / focus_per_m).thickness_mm[-1]
            - far.focus_at(float("inf")).thickness_mm[-1]
        )
        assert float(near.thickness_mm[-1] - far.thickness_mm[-1]) == pytest.approx(
            float(moved), rel=1e-9
        )


def test_the_film_is_lit_over_the_whole_range(family):
    pixels = f64([[0.0, 0.0], [172.5, 129.5], [345.0, 129.5]])
    for efl_mm, fno, focus_per_m, bending in box(family):
        camera = render.Camera(
            family.lens(efl_mm, fno, focus_per_m, bending), 346, 260, 0.0185, film=DAVIS
        )
        camera.check()
        pupil = lens.pupil_grid(8)
        rays = camera.rays_through(pixels.repeat_interleave(len(pupil), 0), pupil.repeat(3, 1))
        corner, middle, side = rays.weight.reshape(3, -1).mean(1).tolist()
        assert middle > 0.999
        # wide open the corner may be vignetted, as with any fast lens, and not when stopped down
        # twice as far
        assert min(corner, side) > (0.3 if fno == family.fno[0] else 0.95)


def test_glass_and_air_have_room_everywhere_in_the_box(family):
    """Glass to the larger of its two apertures, air as far as both surfaces reach."""
    heights = torch.linspace(0, 1, 21, dtype=D)
    for efl_mm, bending in itertools.product(efls_mm(family, 25), (-1.0, 0.0, 1.0)):
        geo = family.lens(efl_mm, family.fno[0], 0.0, bending)
        apertures = geo.semi_aperture_mm
        for gap, filled in enumerate(geo.glass.tolist()[:-1]):
            reach = apertures[gap : gap + 2].amax() if filled else apertures[gap : gap + 2].amin()
            room = gap_mm(geo, heights, reach.expand_as(apertures))[gap]
            assert room.min() > (0.3 if filled else 0.02)
        assert geo.thickness_mm[-1] > 1.0


def test_light_fades_out_and_never_jumps(family):
    """Across the pupil, wide open: the edges of apertures take a ray away before it fails, which
    would be a jump from whatever its weight was."""
    line = torch.linspace(-1, 1, 4001, dtype=D)
    turn = f64([[1.0, 0.0], [0.0, 1.0], [0.6, 0.8], [-0.6, 0.8]])
    pupil = (line[:, None] * turn[:, None]).reshape(-1, 2)
    film_mm = f64([[3.2, 2.4], [3.2, 0.0], [1.6, -1.2], [0.0, 0.0]])
    film_mm = film_mm.repeat_interleave(len(pupil), 0)
    pupil = pupil.repeat(4, 1)
    for efl_mm, bending in itertools.product(efls_mm(family, 7), (-1.0, 0.0, 1.0)):
        geo = family.lens(efl_mm, family.fno[0], 0.0, bending)
        weight = geo.camera_rays(film_mm, pupil).weight.reshape(-1, len(line))
        # a step moves rays by 0.1 to 1 % of a millimetre, a tenth of the soft edge, and where they
        # lean most by more
        assert weight.diff(dim=1).abs().max() < 0.25
        assert weight.amin(1).min() < 0.5 < weight.mean()


def test_gradients_of_rays_against_differences(family, generator):
    pupil = rand64(generator, 24, 2) - 0.5
    film_mm = rand64(generator, 24, 2) * 4 - 2
    weights = randn64(generator, 2, 24, 3)

    def landing(*variables):
        rays = family.lens(*variables).camera_rays(film_mm, pupil)
        return (torch.stack([1e3 * rays.origin_m, rays.direction]) * weights).sum()

    def spot(*variables):
        return lens.rms_spot_mm(family.lens(*variables), [0.0, 0.2], grid=8).sum()

    efl_mm = float(family.efl_mm[[0, -1]].prod().sqrt())
    at = [f64(v) for v in (efl_mm, 1.5 * family.fno[0], 0.7, 0.3)]
    for figure in (landing, spot):
        assert_gradients(figure, at, (1e-5,) * 4, 1e-6)


def test_a_larger_image_circle_scales_all_lengths(family):
    larger = lens.family(family.name, image_radius_mm=2 * family.image_radius_mm)
    efl_mm, fno = float(family.efl_mm[1]), 2 * family.fno[0]
    small, large = family.lens(efl_mm, fno, 0.4, 0.5), larger.lens(2 * efl_mm, fno, 0.2, 0.5)
    for name, power in (
        ("curvature_per_mm", -1),
        ("thickness_mm", 1),
        ("semi_aperture_mm", 1),
        ("conic", 0),
    ):
        torch.testing.assert_close(getattr(large, name), 2.0**power * getattr(small, name))


def test_families_are_named_those_of_most_elements_first():
    assert NAMES == ("retrofocus-4", "retrofocus-3", "retrofocus-2")


def test_a_family_lens_is_saved_copied_and_converted(tmp_path):
    import copy

    fno = torch.tensor(2.0, dtype=D, requires_grad=True)
    geo = lens.family("retrofocus-4").lens(4.0, fno, 0.5)
    lens.save(geo, tmp_path / "made.json")
    for twin in (lens.load(tmp_path / "made.json"), copy.deepcopy(geo), geo.scaled(1.0)):
        torch.testing.assert_close(twin.thickness_mm, geo.thickness_mm)
        assert float(twin.first_order().fno.detach()) == pytest.approx(2.0, rel=1e-12)
    assert geo.float().first_order().exit_pupil_diameter_mm.dtype == torch.float32
