"""Variables in natural steps: what a unit does to rays, gradients against differences, bounds,
solves, saved states."""

import copy
import math

import pytest
import torch

from codesign import lens, render
from codesign.lens import GeoLens, Glass, Pinhole, Surface, ThinLens
from codesign.lens.analysis import field_rays, pupil_grid
from codesign.lens.variables import ray_motion
from tests.lens.systems import PLANE, check_gradient, close, figure_of
from tests.numbers import f64, randn64

GLASS = Glass.from_indices(1.51, 1.5, 1.49, "g")


@pytest.mark.parametrize(("factor", "wavelength_um"), [(1.0, 0.4861327), (10.0, 0.5875618)])
@pytest.mark.parametrize(
    ("name", "share", "names"),
    [
        ("cooke-triplet", 1e-3, ("curvature", "thickness", "focus", "index")),
        # gaps of 0.5 mm have no room for more
        ("double-gauss", 2e-4, ("thickness", "focus", "index")),
        ("la1509", 1e-3, ("curvature", "thickness", "focus", "conic", "index")),
    ],
)
@torch.no_grad()
def test_a_unit_of_every_variable_moves_the_rays_by_the_natural_step(
    name, share, names, wavelength_um, factor
):
    geo = lens.load(name).scaled(factor)
    half = math.radians(lens.half_field_deg(name))
    fields = (0.0, 0.7 * half, half)
    step_mm = share * float(geo.first_order().efl_mm)
    # rays of three fields through the pupil of the lens as it is now
    rays = [
        torch.cat(v)
        for v in zip(
            *(field_rays(geo, f, pupil_grid(12), wavelength_um) for f in fields), strict=True
        )
    ]
    variables = geo.variables(
        *names, step_mm=step_mm, fields_rad=fields, wavelength_um=wavelength_um
    )
    base = geo.trace(*rays, wavelength_um).position_mm
    for variable in variables:
        for i in range(variable.numel()):
            for sign in (1.0, -1.0):
                variable[i] = sign
                moved = geo.trace(*rays, wavelength_um).position_mm - base
                variable[i] = 0.0
                close(moved.square().sum(1).mean().sqrt(), step_mm, 0.1)


def test_weak_numbers_are_held_to_their_reach_and_dead_ones_left_out():
    plate = Surface(PLANE, 2.0, GLASS, 8.0), Surface(PLANE, 30.0, None, 8.0)
    front = Surface(40.0, 5.0, GLASS, 10.0), Surface(-60.0, 0.0, None, 10.0)
    geo = GeoLens([*front, Surface(PLANE, 3.0, None, 5.0, is_stop=True), *plate], 8.0)
    variables = geo.variables("curvature", "thickness", "conic")
    # flat windows bend, the stop, in air, does not; a gap of 0 stays; planes have no conic
    assert [v.numel() for v in variables] == [4, 3, 2]
    base = geo.thickness_mm.detach().clone()
    # thickness of the plate: a millimetre shifts the focus by a third of one
    fill([variables[1][-1:]], 1.0)
    assert (geo.thickness_mm.detach() - base).abs().max() <= 0.1 * geo.first_order().efl_mm.item()


@torch.no_grad()
def test_a_unit_never_goes_beyond_the_reach():
    geo = lens.load("cooke-triplet")
    (conic,) = geo.variables("conic")
    conic.fill_(1.0)
    # the second surface, radius 435.76 mm, hardly notices: (c a)^2 changes by 0.1 and no more
    close(geo.conic[1], 0.1 * (435.76044 / 9.5) ** 2, 1e-12)
    assert geo.conic[2].abs() < 0.09 * (22.21328 / 5.0) ** 2


def test_motion_counts_rays_that_arrive_in_both_states():
    ahead = torch.tensor([[[3.0, 4.0], [1.0, 1.0], [1.0, 1.0]]]), torch.tensor([[1.0, 0.0, 1.0]])
    behind = torch.tensor([[[0.0, 0.0], [0.0, 0.0], [9.0, 9.0]]]), torch.tensor([[1.0, 1.0, 0.0]])
    moved, weight = ray_motion(ahead, behind)
    assert (moved.tolist(), weight.tolist()) == (
        [[[3.0, 4.0], [0.0, 0.0], [0.0, 0.0]]],
        [[1.0, 0.0, 0.0]],
    )


def test_gradients_of_rays_against_differences(generator):
    geo = lens.load("cooke-triplet").scaled(0.22)
    camera = render.Camera(geo, 6, 4, 0.5, 4)
    bounds = {"thickness": (0.05, 3.0), "index": (None, 0.2), "curvature": (-2.0, None)}
    names = ("curvature", "thickness", "conic", "index")
    variables = geo.variables(*names, step_mm=0.01, bounds=bounds, keep_efl=True, focus_at_m=1.5)
    mix = randn64(generator, 96, 3)

    def loss(_):
        rays = camera.rays()
        return (mix * rays.direction).sum() + (mix * 1e3 * rays.origin_m).sum()

    drawn = [0.3 * randn64(generator, v.shape) for v in variables]
    check_gradient(figure_of(geo, loss, variables), *drawn, step=1e-3)


def test_values_never_leave_their_bounds():
    geo = lens.load("cooke-triplet")
    start = geo.thickness_mm.detach().clone()
    low = f64([1.0, 0.5, 0.9, 0.5, 1.0])
    variables = geo.variables(
        "thickness", "focus", bounds={"thickness": (low, 9.0), "focus": (40.0, None)}
    )
    close(geo.thickness_mm, start, 1e-14)
    for value in (-1e4, -30.0, 30.0, 1e4):
        fill(variables, value)
        now = geo.thickness_mm.detach()
        assert ((now[:-1] >= low) & (now[:-1] <= 9.0)).all()
        assert now[-1] >= 40.0
    close(now[:-1], torch.full_like(low, 9.0), 1e-12)
    free = lens.load("cooke-triplet")
    fill(free.variables("thickness"), -1e4)
    # light never travels backwards
    assert free.thickness_mm.detach().min() >= 0.0


def test_solves_hold_while_variables_move(generator):
    geo = lens.load("double-gauss")
    efl = geo.first_order().efl_mm
    variables = geo.variables("curvature", "thickness", keep_efl=True, focus_at_m=3.0)
    # all but the solved and the stop; all gaps
    assert [v.numel() for v in variables] == [9, 10]
    for v in variables:
        fill([v], 3 * randn64(generator, v.shape))
    close(geo.first_order().efl_mm, efl, 1e-12)
    moved = geo.thickness_mm.detach()
    assert (moved != lens.load("double-gauss").thickness_mm.detach()).all()
    elsewhere = torch.cat([moved[:-1], moved[-1:] + 1])
    again = geo.replace(thickness_mm=elsewhere).focus_at(3.0).thickness_mm.detach()
    close(moved[-1], again[-1], 1e-13)


def test_masks_choose_entries():
    geo = lens.load("cooke-triplet")
    mask = [True, False, False, False, True, False]
    (curvature,) = geo.variables("curvature", mask={"curvature": mask})
    before = geo.curvature_per_mm.detach().clone()
    fill([curvature], 1.0)
    assert (geo.curvature_per_mm.detach() != before).tolist() == mask
    # all else is held
    assert list(geo.parameters()) == [curvature]


def test_variables_are_saved_and_restored(tmp_path):
    geo = lens.load("cooke-triplet")
    options = {"keep_efl": True, "bounds": {"thickness": (0.2, None)}}
    variables = geo.variables("curvature", "thickness", "focus", **options)
    with torch.no_grad():
        for v in variables:
            v += 0.7
    torch.save(geo.state_dict(), tmp_path / "state.pt")
    other = lens.load("cooke-triplet")
    with torch.no_grad():
        other.thickness_mm.mul_(1.01)  # starts elsewhere; what the state says counts
    other.variables("curvature", "thickness", "focus", **options)
    other.load_state_dict(torch.load(tmp_path / "state.pt", weights_only=True))
    twin = copy.deepcopy(geo)
    single = copy.deepcopy(geo).float()
    assert single.dtype == single.curvature_per_mm.dtype == torch.float32
    lens.save(geo, tmp_path / "lens.json")
    for found in (other, twin, lens.load(tmp_path / "lens.json")):
        for name in ("curvature_per_mm", "thickness_mm"):
            close(getattr(found, name), getattr(geo, name), 1e-15)
    with torch.no_grad():
        variables[2].zero_()
    assert twin.thickness_mm[-1].detach() != geo.thickness_mm[-1].detach()
    again = geo.variables("focus")[0]
    assert again.tolist() == [0.0]
    close(geo.curvature_per_mm, twin.curvature_per_mm, 1e-12)


def test_a_twin_keeps_the_values_it_was_made_with():
    geo = lens.load("cooke-triplet")
    (focus,) = geo.variables("focus")
    twin = geo.replace()
    (slope,) = torch.autograd.grad(twin.thickness_mm[-1], focus, retain_graph=True)
    with torch.no_grad():
        focus += 1.0
    moved = geo.thickness_mm[-1] - twin.thickness_mm[-1]
    close(moved, float(slope), 1e-2)  # bent by its bound at 0


@pytest.mark.parametrize("bounds", [None, (45.0, 60.0), (45.0, None), (None, 60.0)])
def test_thin_lenses_have_natural_steps_too(bounds):
    thin = ThinLens(50.0, 10.0, 51.0)
    given = {} if bounds is None else {"efl": bounds, "focus": bounds}
    variables = thin.variables("efl", "focus", step_mm=0.02, bounds=given)
    lengths = (thin.efl_mm, thin.image_distance_mm)
    close(lengths[0], 50.0, 1e-14)
    q = 5 * pupil_grid(12)
    slope = f64([[0.0, math.tan(f)] for f in (0.0, 0.25, 0.35)])[:, None]

    def landing():
        return ((slope + q / thin.efl_mm) * thin.image_distance_mm - q).detach()

    base = landing()
    for v in variables:
        fill([v], 1.0)
        moved = float((landing() - base).square().sum(-1).mean().sqrt())
        fill([v], 0.0)
        close(moved, 0.02, 0.1)
    rays = f64([[0.3, -0.2]]), f64([[0.5, 0.1]])
    figure = figure_of(thin, lambda thin: thin.camera_rays(*rays).direction[0, 0], variables)
    check_gradient(figure, *(torch.full_like(v, 0.3) for v in variables), step=1e-3)


def test_a_pinhole_has_one_variable():
    pinhole = Pinhole(5.0)
    fill(pinhole.variables("efl", step_mm=0.01), 1.0)
    assert pinhole.image_distance_mm.item() == pinhole.efl_mm.item()
    rms = math.sqrt(sum(math.tan(f) ** 2 for f in (0.0, 0.25, 0.35)) / 3)
    close(pinhole.efl_mm.item() - 5.0, 0.01 / rms, 1e-3)


def fill(variables, value):
    with torch.no_grad():
        for v in variables:
            v.copy_(torch.as_tensor(value).expand_as(v))
