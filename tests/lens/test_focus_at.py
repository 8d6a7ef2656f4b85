"""Focus at a distance: the thin lens's equation, paraxial rays that meet, the least spot by search, gradients."""

import math

import pytest
import torch

from codesign import lens
from codesign.errors import DomainError
from codesign.lens import Pinhole, ThinLens
from codesign.lens.analysis import pupil_grid

D = torch.float64
NAMES = ("cooke-triplet", "double-gauss", "la1509")


@pytest.mark.parametrize("distance_m", [0.06, 0.1, 1.0, 40.0, math.inf])
def test_thin_lenses_follow_their_equation(distance_m):
    found = ThinLens(50.0, 10.0, 60.0).focus_at(distance_m).image_distance_mm
    assert float(found.detach()) == pytest.approx(1 / (1 / 50 - 1 / (1e3 * distance_m)), rel=1e-14)
    assert float(Pinhole(50.0).focus_at(math.inf).image_distance_mm.detach()) == 50.0


def fan(geo, distance_m, heights, wavelength_um=0.5875618):
    """Rays from the axial point to heights [N] mm of the entrance pupil, and where they cross the axis behind the
    film, [N] mm."""
    z = float(geo.first_order().entrance_pupil_z_mm)
    toward = torch.tensor([[0.0, h, z] for h in heights], dtype=D)
    if math.isinf(distance_m):
        direction = torch.tensor([[0.0, 0.0, 1.0]], dtype=D).expand_as(toward)
        start = toward - (z + 5.0) * direction
    else:
        start = torch.tensor([[0.0, 0.0, z - 1e3 * distance_m]], dtype=D).expand_as(toward)
        direction = torch.nn.functional.normalize(toward - start, dim=1)
    out = geo.trace(start.contiguous(), direction.contiguous(), wavelength_um)
    return out, -out.position_mm[:, 1] * out.direction[:, 2] / out.direction[:, 1]


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("wavelength_um", [0.4861327, 0.5875618])
@pytest.mark.parametrize("distance_m", [0.3, 2.0, math.inf])
@torch.no_grad()
def test_paraxial_rays_of_the_point_meet_on_the_film(name, distance_m, wavelength_um):
    geo = lens.load(name).focus_at(distance_m, wavelength_um)
    heights = torch.tensor([0.02, 0.04], dtype=D)
    _, crossing = fan(geo, distance_m, heights.tolist(), wavelength_um)
    # the crossing goes as h^2, h^4, ...: two heights leave h^4, below 1e-9 mm here
    assert abs(float(4 * crossing[0] - crossing[1]) / 3) <= 1e-9


@pytest.mark.parametrize("name", NAMES)
def test_parallel_light_is_the_back_focal_length(name):
    geo = lens.load(name)
    torch.testing.assert_close(
        geo.focus_at(math.inf).thickness_mm[-1], geo.first_order().bfl_mm, rtol=1e-14, atol=0
    )
    assert geo.thickness_mm[-1].detach() == lens.load(name).thickness_mm[-1].detach()  # the lens itself stays


def test_gradients_against_differences(generator):
    geo = lens.load("cooke-triplet")
    distance = torch.tensor(1.2, dtype=D, requires_grad=True)
    tensors = {
        name: getattr(geo, name).detach().requires_grad_() for name in ("curvature_per_mm", "thickness_mm")
    }

    def image(distance, tensors, grid):
        return geo.replace(**tensors).focus_at(distance, spot_grid=grid).thickness_mm[-1]

    for grid in (None, 8):
        found = torch.autograd.grad(image(distance, tensors, grid), [distance, *tensors.values()])
        for at, (value, slope) in enumerate(zip([distance, *tensors.values()], found, strict=True)):
            direction = torch.randn(value.shape, generator=generator, dtype=D) * value.detach().abs()

            def moved(amount, at=at, value=value, direction=direction, grid=grid):
                values = [distance, *tensors.values()]
                values[at] = (value + amount * direction).detach()
                return float(image(values[0], dict(zip(tensors, values[1:], strict=True)), grid).detach())

            h = 1e-4
            truth = (8 * (moved(h) - moved(-h)) - (moved(2 * h) - moved(-2 * h))) / (12 * h)
            assert float((slope * direction).sum()) == pytest.approx(truth, rel=1e-6)


@torch.no_grad()
@pytest.mark.parametrize("distance_m", [0.5, math.inf])
def test_the_least_spot_is_the_least(distance_m):
    geo = lens.load("la1509")
    paraxial = geo.focus_at(distance_m)
    best = geo.focus_at(distance_m, spot_grid=12)
    heights = pupil_grid(12).norm(dim=1) * 10.0  # of a round lens, from a point of the axis

    def spot(shift):
        placed = best.replace(
            thickness_mm=torch.cat([best.thickness_mm[:-1], best.thickness_mm[-1:] + shift])
        )
        out, _ = fan(placed, distance_m, heights.tolist())
        return float(out.position_mm[:, 1].square().mean().sqrt())

    assert spot(0.0) < min(spot(-0.01), spot(0.01))
    assert spot(0.0) < 0.6 * spot(float(paraxial.thickness_mm[-1] - best.thickness_mm[-1]))
    assert best.thickness_mm[-1] < paraxial.thickness_mm[-1]  # undercorrected: the rim focuses short


@pytest.mark.parametrize(
    ("make", "sentence"),
    [
        (lambda: ThinLens(50.0, 10.0).focus_at(0.05), "inside the focal length"),
        (lambda: ThinLens(50.0, 10.0).focus_at(math.nan), "inside the focal length"),
        (
            lambda: lens.load("cooke-triplet").focus_at(0.03),
            "does not converge.*it needs more than 0.0[0-9]+ m",
        ),
        (lambda: lens.load("cooke-triplet").focus_at(0.005), "does not lie before the lens"),
        (
            lambda: lens.load("cooke-triplet").focus_at(1.0, spot_grid=1),
            "1 rays of a pupil of 1 samples across do not converge",
        ),
        (lambda: lens.load("cooke-triplet").focus_at(-1.0), "does not lie before the lens"),
        (
            lambda: lens.GeoLens(
                [
                    lens.Surface(-40.0, 2.0, lens.Glass.named("N-BK7"), 5.0),
                    lens.Surface(40.0, 20.0, None, 5.0),
                ],
                4.0,
            ).focus_at(1.0),
            "no distance helps, as the lens diverges",
        ),
    ],
)
def test_points_without_an_image_get_a_sentence(make, sentence):
    with pytest.raises(DomainError, match=sentence):
        make()


def test_the_limit_that_the_sentence_names_is_the_limit():
    geo = lens.load("cooke-triplet")
    with pytest.raises(DomainError) as raised:
        geo.focus_at(0.03)
    limit = float(str(raised.value).split("more than ")[1].split(" m")[0])
    assert float(geo.focus_at(limit + 1e-4).thickness_mm[-1].detach()) > 1e3
    with pytest.raises(DomainError, match="does not converge"):
        geo.focus_at(limit - 1e-4)
