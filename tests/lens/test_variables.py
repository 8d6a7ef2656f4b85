"""Variables in natural steps: what a unit does to rays, gradients against differences, bounds, solves, saved
states."""

import copy
import math

import pytest
import torch

from codesign import lens, pose, render
from codesign.errors import DomainError, ShapeError
from codesign.lens import GeoLens, Glass, Pinhole, Surface, ThinLens
from codesign.lens.analysis import field_rays, pupil_grid
from codesign.lens.variables import ray_motion
from scenes import worlds

D = torch.float64
GLASS = Glass.from_indices(1.51, 1.5, 1.49, "g")


def bundle(geo, fields, wavelength_um):
    """Rays of three fields through the pupil of the lens as it is now: origins and directions."""
    rays = [field_rays(geo, f, pupil_grid(12), wavelength_um) for f in fields]
    return torch.cat([o for o, _ in rays]).detach(), torch.cat([d for _, d in rays])


@pytest.mark.parametrize("factor", [1.0, 10.0])
@pytest.mark.parametrize("wavelength_um", [0.4861327, 0.5875618])
@pytest.mark.parametrize(
    ("name", "share", "names"),
    [
        ("cooke-triplet", 1e-3, ("curvature", "thickness", "focus", "index")),
        ("double-gauss", 2e-4, ("thickness", "focus", "index")),  # gaps of 0.5 mm have no room for more
        ("la1509", 1e-3, ("curvature", "thickness", "focus", "conic", "index")),
    ],
)
@torch.no_grad()
def test_a_unit_of_every_variable_moves_the_rays_by_the_natural_step(
    name, share, names, wavelength_um, factor
):
    geo = lens.load(name).scaled(factor)
    half = math.radians(geo.half_field_deg or lens.half_field_deg(name))
    fields = (0.0, 0.7 * half, half)
    step_mm = share * float(geo.first_order().efl_mm)
    start, direction = bundle(geo, fields, wavelength_um)
    variables = geo.variables(*names, step_mm=step_mm, fields_rad=fields, wavelength_um=wavelength_um)
    base = geo.trace(start, direction, wavelength_um).position_mm
    for variable in variables:
        for i in range(variable.numel()):
            for sign in (1.0, -1.0):
                variable[i] = sign
                moved = geo.trace(start, direction, wavelength_um).position_mm - base
                variable[i] = 0.0
                assert float(moved.square().sum(1).mean().sqrt()) == pytest.approx(step_mm, rel=0.1)


def test_weak_numbers_are_held_to_their_reach_and_dead_ones_left_out():
    plate = [Surface(math.inf, 2.0, GLASS, 8.0), Surface(math.inf, 30.0, None, 8.0)]
    stop = Surface(math.inf, 3.0, None, 5.0, is_stop=True)
    geo = GeoLens([Surface(40.0, 5.0, GLASS, 10.0), Surface(-60.0, 0.0, None, 10.0), stop, *plate], 8.0)
    curvature, thickness, conic = geo.variables("curvature", "thickness", "conic")
    assert curvature.numel() == 4  # flat windows bend; the stop, in air, does not
    assert thickness.numel() == 3  # a gap of 0 stays
    assert conic.numel() == 2  # planes have none
    base = geo.thickness_mm.detach().clone()
    with torch.no_grad():
        thickness[-1] = 1.0  # thickness of the plate: a millimetre shifts the focus by a third of one
    change = (geo.thickness_mm.detach() - base).abs()
    assert float(change.max()) <= 0.1 * float(geo.first_order().efl_mm.detach())


@torch.no_grad()
def test_a_unit_never_goes_beyond_the_reach():
    geo = lens.load("cooke-triplet")
    (conic,) = geo.variables("conic")
    conic.fill_(1.0)
    # the second surface, radius 435.76 mm, hardly notices: (c a)^2 changes by 0.1 and no more
    assert float(geo.conic[1]) == pytest.approx(0.1 * (435.76044 / 9.5) ** 2, rel=1e-12)
    assert float(geo.conic[2].abs()) < 0.09 * (22.21328 / 5.0) ** 2


def test_motion_counts_rays_that_arrive_in_both_states():
    ahead = torch.tensor([[[3.0, 4.0], [1.0, 1.0], [1.0, 1.0]]]), torch.tensor([[1.0, 0.0, 1.0]])
    behind = torch.tensor([[[0.0, 0.0], [0.0, 0.0], [9.0, 9.0]]]), torch.tensor([[1.0, 1.0, 0.0]])
    moved, weight = ray_motion(ahead, behind)
    assert moved.tolist() == [[[3.0, 4.0], [0.0, 0.0], [0.0, 0.0]]]
    assert weight.tolist() == [[1.0, 0.0, 0.0]]


def test_gradients_of_rays_against_differences(generator):
    geo = lens.load("cooke-triplet").scaled(0.22)
    camera = render.Camera(geo, 6, 4, 0.5, 4)
    variables = geo.variables(
        "curvature",
        "thickness",
        "conic",
        "index",
        step_mm=0.01,
        bounds={"thickness": (0.05, 3.0), "index": (None, 0.2), "curvature": (-2.0, None)},
        keep_efl=True,
        focus_at_m=1.5,
    )
    with torch.no_grad():
        for v in variables:
            v += 0.3 * torch.randn(v.shape, generator=generator, dtype=D)
    mix = torch.randn(96, 3, generator=generator, dtype=D)

    def loss():
        rays = camera.rays()
        return (mix * rays.direction).sum() + (mix * 1e3 * rays.origin_m).sum()

    found = torch.autograd.grad(loss(), variables)
    for v, slope in zip(variables, found, strict=True):
        direction = torch.randn(v.shape, generator=generator, dtype=D)
        start = v.detach().clone()

        def at(amount, v=v, start=start, direction=direction):
            with torch.no_grad():
                v.copy_(start + amount * direction)
                value = float(loss())
                v.copy_(start)
            return value

        h = 1e-3
        truth = (8 * (at(h) - at(-h)) - (at(2 * h) - at(-2 * h))) / (12 * h)
        assert float((slope * direction).sum()) == pytest.approx(truth, rel=1e-6)


def test_gradients_of_frames_reach_the_variables():
    geo = lens.load("cooke-triplet").scaled(0.22)
    wall = worlds.smooth_plane(0, pose.look_at((0, 0, 0), (0, -1, 0)))
    camera = render.Camera(geo, 12, 8, 0.2, 4)
    view = pose.look_at((0.1, -2, 0.05), (0, 0, 0))[None]
    (curvature, focus) = geo.variables("curvature", "focus", step_mm=0.02)
    weight = torch.linspace(-1, 1, 96, dtype=D).reshape(1, 8, 12)

    def loss():
        return (weight * render.frames(camera, wall, view)).sum()

    slopes = torch.autograd.grad(loss(), (curvature, focus))
    for v, slope in zip((curvature, focus), slopes, strict=True):
        direction = torch.linspace(0.5, 1.0, v.numel(), dtype=D)
        values = []
        for amount in (1e-3, -1e-3):
            with torch.no_grad():
                v += amount * direction
                values.append(float(loss()))
                v -= amount * direction
        truth = (values[0] - values[1]) / 2e-3
        assert float(slope @ direction) == pytest.approx(truth, rel=1e-5)


def test_a_step_takes_effect_and_lowers_the_spot():
    geo = lens.load("cooke-triplet")
    with torch.no_grad():
        geo.thickness_mm[-1] += 1.0
    fields = (0.0, 0.245, 0.349)
    optimiser = torch.optim.Adam(geo.variables("curvature", "focus", step_mm=0.02, keep_efl=True), lr=0.5)
    first = float(lens.rms_spot_mm(geo, fields).mean().detach())
    for _ in range(60):
        optimiser.zero_grad()
        loss = lens.rms_spot_mm(geo, fields).mean()
        loss.backward()
        optimiser.step()
    published = float(lens.rms_spot_mm(lens.load("cooke-triplet").freeze(), fields).mean())
    assert first > 5 * published
    assert float(lens.rms_spot_mm(geo, fields).mean().detach()) < 1.2 * published


def test_values_never_leave_their_bounds():
    geo = lens.load("cooke-triplet")
    start = geo.thickness_mm.detach().clone()
    low = torch.tensor([1.0, 0.5, 0.9, 0.5, 1.0], dtype=D)
    thickness, focus = geo.variables(
        "thickness", "focus", bounds={"thickness": (low, 9.0), "focus": (40.0, None)}
    )
    torch.testing.assert_close(geo.thickness_mm.detach(), start, rtol=1e-14, atol=0)
    for value in (-1e4, -30.0, 30.0, 1e4):
        with torch.no_grad():
            thickness.fill_(value)
            focus.fill_(value)
        now = geo.thickness_mm.detach()
        assert bool((now[:-1] >= low).all())
        assert float(now[:-1].max()) <= 9.0
        assert float(now[-1]) >= 40.0
    ends = torch.where(torch.tensor(value > 0), 9.0, low)
    torch.testing.assert_close(now[:-1], ends, rtol=1e-12, atol=0)
    free = lens.load("cooke-triplet")
    (gaps,) = free.variables("thickness")
    with torch.no_grad():
        gaps.fill_(-1e4)
    assert float(free.thickness_mm.detach().min()) >= 0.0  # light never travels backwards


def test_solves_hold_while_variables_move(generator):
    geo = lens.load("double-gauss")
    efl = float(geo.first_order().efl_mm.detach())
    variables = geo.variables("curvature", "thickness", keep_efl=True, focus_at_m=3.0)
    assert [v.numel() for v in variables] == [9, 10]  # all but the solved and the stop; all gaps
    with torch.no_grad():
        for v in variables:
            v += 3 * torch.randn(v.shape, generator=generator, dtype=D)
    assert float(geo.first_order().efl_mm.detach()) == pytest.approx(efl, rel=1e-12)
    moved = geo.thickness_mm.detach()
    assert float((moved - lens.load("double-gauss").thickness_mm.detach()).abs().min()) > 0
    elsewhere = torch.cat([moved[:-1], moved[-1:] + 1]).detach()
    again = geo.replace(thickness_mm=elsewhere).focus_at(3.0)
    torch.testing.assert_close(moved[-1], again.thickness_mm.detach()[-1], rtol=1e-13, atol=0)


def test_masks_choose_entries():
    geo = lens.load("cooke-triplet")
    (curvature,) = geo.variables("curvature", mask={"curvature": [True, False, False, False, True, False]})
    before = geo.curvature_per_mm.detach().clone()
    with torch.no_grad():
        curvature.fill_(1.0)
    moved = geo.curvature_per_mm.detach() != before
    assert moved.tolist() == [True, False, False, False, True, False]
    assert list(geo.parameters()) == [curvature]  # all else is held


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
            torch.testing.assert_close(getattr(found, name), getattr(geo, name), rtol=1e-15, atol=0)
    with torch.no_grad():
        variables[2].zero_()
    assert float(twin.thickness_mm[-1].detach()) != float(geo.thickness_mm[-1].detach())
    again = geo.variables("focus")[0]
    assert again.tolist() == [0.0]
    torch.testing.assert_close(geo.curvature_per_mm, twin.curvature_per_mm.detach(), rtol=1e-12, atol=0)


def test_a_twin_keeps_the_values_it_was_made_with():
    geo = lens.load("cooke-triplet")
    (focus,) = geo.variables("focus")
    twin = geo.replace()
    (slope,) = torch.autograd.grad(twin.thickness_mm[-1], focus, retain_graph=True)
    with torch.no_grad():
        focus += 1.0
    moved = geo.thickness_mm[-1] - twin.thickness_mm[-1]
    assert float(moved.detach()) == pytest.approx(float(slope), rel=1e-2)  # bent by its bound at 0


@pytest.mark.parametrize("bounds", [None, (45.0, 60.0), (45.0, None), (None, 60.0)])
def test_thin_lenses_have_natural_steps_too(bounds):
    thin = ThinLens(50.0, 10.0, 51.0)
    efl, focus = thin.variables(
        "efl", "focus", step_mm=0.02, bounds={} if bounds is None else {"efl": bounds, "focus": bounds}
    )
    assert float(thin.efl_mm.detach()) == pytest.approx(50.0, rel=1e-14)
    q = 5 * pupil_grid(12)
    slope = torch.tensor([[0.0, math.tan(f)] for f in (0.0, 0.25, 0.35)], dtype=D)[:, None]

    def landing():
        return (slope + q / thin.efl_mm.detach()) * thin.image_distance_mm.detach() - q

    base = landing()
    for v in (efl, focus):
        with torch.no_grad():
            v += 1.0
            moved = (landing() - base).square().sum(-1).mean().sqrt()
            v -= 1.0
        assert float(moved) == pytest.approx(0.02, rel=0.1)
    film = torch.tensor([[0.3, -0.2]], dtype=D)
    pupil = torch.tensor([[0.5, 0.1]], dtype=D)

    def loss(a, b):
        made = ThinLens(a, 10.0, b)
        return made.camera_rays(film, pupil).direction[0, 0]

    a, b = (t.detach().requires_grad_() for t in (thin.efl_mm, thin.image_distance_mm))
    chain = torch.autograd.grad(loss(a, b), (a, b))
    scale = [torch.autograd.grad(t, v)[0] for t, v in ((thin.efl_mm, efl), (thin.image_distance_mm, focus))]
    found = torch.autograd.grad(thin.camera_rays(film, pupil).direction[0, 0], (efl, focus))
    for slope, outer, inner in zip(found, chain, scale, strict=True):
        assert float(slope) == pytest.approx(float(outer * inner), rel=1e-12)


def test_a_pinhole_has_one_variable():
    pinhole = Pinhole(5.0)
    (efl,) = pinhole.variables("efl", step_mm=0.01)
    with torch.no_grad():
        efl += 1.0
    assert float(pinhole.image_distance_mm.detach()) == float(pinhole.efl_mm.detach())
    slopes = [math.tan(f) for f in (0.0, 0.25, 0.35)]
    rms = math.sqrt(sum(s * s for s in slopes) / 3)
    assert float(pinhole.efl_mm.detach()) - 5.0 == pytest.approx(0.01 / rms, rel=1e-3)
    with pytest.raises(DomainError, match="no efl moves a ray"):
        ThinLens(5.0, 0.0, 5.0).variables("efl")  # no blur and a film of its own: nothing depends on it


@pytest.mark.parametrize(
    ("make", "error", "sentence"),
    [
        (
            lambda g: g.variables(),
            DomainError,
            "name the numbers that become variables, of curvature, thickness",
        ),
        (lambda g: g.variables("radius"), DomainError, "variables 'radius'.*of curvature, thickness, focus"),
        (lambda g: g.variables("focus", "focus"), DomainError, "name each once"),
        (lambda g: g.variables("focus", bounds={"conic": (0, 1)}), DomainError, "bounds of 'conic'"),
        (lambda g: g.variables("focus", focus_at_m=2.0), DomainError, "no focus moves a ray"),
        (lambda g: g.variables("asphere"), DomainError, "no asphere moves a ray"),
        (lambda g: g.variables("curvature", mask={"curvature": [False] * 6}), DomainError, "all are masked"),
        (lambda g: g.variables("curvature", mask={"curvature": [True]}), ShapeError, "needs 6 entries"),
        (lambda g: g.variables("focus", bounds={"focus": (50.0, 60.0)}), DomainError, "not strictly inside"),
        (lambda g: g.variables("focus", bounds={"focus": (1.0, 2.0, 3.0)}), ShapeError, "are .low, high."),
        (lambda g: g.variables("focus", bounds={"focus": ([1.0, 2.0], 90.0)}), ShapeError, "a number or 1"),
        (lambda g: g.variables("focus", step_mm=0.0), DomainError, "must be positive and finite"),
    ],
)
def test_what_cannot_vary_gets_a_sentence(make, error, sentence):
    with pytest.raises(error, match=sentence):
        make(lens.load("cooke-triplet"))


def test_variables_are_replaced_by_a_functional_call():
    # what a certificate of a Module does: plain tensors stand where Parameters were
    geo = lens.load("cooke-triplet")
    geo.variables("curvature", "focus")
    name = next(n for n, _ in geo.named_parameters() if n.endswith("focus"))
    step = torch.tensor([3.0], dtype=D, requires_grad=True)
    before = geo.thickness_mm[-1].detach()

    def image_distance(shift):
        return torch.func.functional_call(_Last(geo), {f"geo.{name}": shift}, ())

    moved = image_distance(step)
    (slope,) = torch.autograd.grad(moved, step)
    assert float((moved - before).detach()) == pytest.approx(
        3 * float(slope), rel=0.05
    )  # a bound far away bends it a little
    assert float(geo.thickness_mm[-1].detach()) == float(before)


class _Last(torch.nn.Module):
    def __init__(self, geo):
        super().__init__()
        self.geo = geo

    def forward(self):
        return self.geo.thickness_mm[-1]
