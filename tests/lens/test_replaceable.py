"""Lenses as torch Modules: what they own, what they share, what conversions, copies and saved
states keep."""

import copy
import dataclasses

import pytest
import torch

from codesign import lens
from codesign.lens import GeoLens, Glass, Pinhole, Surface, ThinLens
from tests.lens.systems import close
from tests.numbers import D, f64

GLASS = Glass.from_indices(1.51, 1.5, 1.49, "g")


def rays(dtype=D):
    points = torch.tensor([[1.0, 2.0, -5.0], [-3.0, 0.5, -5.0]], dtype=dtype)
    return points, torch.tensor([[0.0, 0.0, 1.0]] * 2, dtype=dtype)


def tensors(module):
    """What ``state_dict`` gives, without what says whose it is."""
    return {n: value.clone() for n, value in module.state_dict().items() if "extra_state" not in n}


def same(found, wanted):
    assert found.keys() == wanted.keys()
    for name, value in wanted.items():
        assert found[name].dtype == value.dtype, name
        assert torch.equal(found[name], value), name


@pytest.mark.parametrize("medium", [None, Glass.named("air")])
def test_an_offset_of_air_or_of_a_mirror_does_nothing(medium):
    surfaces = [
        Surface(50.0, 5.0, GLASS, 10.0),
        Surface(-80.0, 20.0, medium, 10.0),
        Surface(-300.0, 30.0, medium, 10.0, mirror=True),
    ]
    geo = GeoLens(surfaces, 8.0)
    offset = torch.tensor([0.01, 0.3, 0.2], dtype=D, requires_grad=True)
    shifted = geo.replace(index_offset=offset)
    close(shifted.index(), [1.0, 1.51, 1.0, 1.0], atol=1e-15)
    f = shifted.first_order()
    path = shifted.trace(*rays()).optical_path_mm.sum()
    (slope,) = torch.autograd.grad(f.efl_mm + f.bfl_mm + path, offset)
    assert slope[0] != 0
    assert slope[1:].tolist() == [0.0, 0.0]
    assert [s.medium for s in shifted.to_surfaces()[1:]] == [medium, medium]


def test_a_twin_and_its_original_are_converted_apart():
    geo = lens.load("la1509")
    first = tensors(geo)
    twin = geo.replace(thickness_mm=geo.thickness_mm * 2).float()
    same(tensors(geo), first)
    assert {v.dtype for v in tensors(twin).values()} == {torch.float32}

    def slope(made, dtype):
        spot = made.trace(*rays(dtype)).position_mm[:, :2].square().sum()
        return torch.autograd.grad(spot, geo.curvature_per_mm)[0]

    found, wanted = (
        slope(twin, torch.float32),
        slope(geo.replace(thickness_mm=geo.thickness_mm * 2), D),
    )
    assert found.dtype == D
    # float32 rays of 1e-6 at spots of 1e-3
    close(found, wanted, 1e-3)
    other = lens.load("la1509")
    kept = other.replace(thickness_mm=other.thickness_mm * 2)
    other.to(torch.float32)
    assert (kept.trace(*rays()).position_mm.dtype, other.thickness_mm.dtype) == (D, torch.float32)


def test_the_state_of_a_twin_holds_every_tensor_and_is_its_own():
    geo = lens.load("la1509")
    twin = geo.replace(thickness_mm=geo.thickness_mm * 2)
    assert tensors(twin).keys() == tensors(geo).keys()
    assert list(twin.parameters()) == []
    first = tensors(geo)
    twin.load_state_dict(twin.state_dict() | {name: value + 0.01 for name, value in first.items()})
    same(tensors(geo), first)
    same(tensors(twin), {name: value + 0.01 for name, value in first.items()})
    twin = geo.replace(thickness_mm=geo.thickness_mm * 2)
    twin.freeze()
    assert all(p.requires_grad for p in geo.parameters())
    assert not twin.trace(*rays()).position_mm.requires_grad


def test_a_new_buffer_on_a_twin_stays_there():
    geo = lens.load("la1509")
    twin = geo.replace()
    twin.register_buffer("mark", torch.zeros(1))
    twin.add_module("part", torch.nn.Identity())
    assert not hasattr(geo, "mark") | hasattr(geo, "part")


def test_a_copy_owns_its_numbers():
    geo = lens.load("la1509")
    twin = geo.replace(thickness_mm=geo.thickness_mm * 2)
    for source in (geo, twin):
        found = copy.deepcopy(source)
        same(tensors(found), tensors(source))
        assert {n for n, _ in found.named_parameters()} == {n for n, _ in geo.named_parameters()}
        found.trace(*rays()).position_mm.sum().backward()
        assert geo.curvature_per_mm.grad is None
        with torch.no_grad():
            found.curvature_per_mm.mul_(2)
        close(geo.curvature_per_mm[0], 1 / 51.5, 1e-15)
    frozen = copy.deepcopy(geo.freeze("conic").replace())
    assert not frozen.conic.requires_grad
    assert frozen.curvature_per_mm.requires_grad


def test_a_state_goes_through_a_file_without_pickle(tmp_path):
    changed = lens.load("cooke-triplet")
    with torch.no_grad():
        changed.curvature_per_mm.mul_(1.01)
    for module, fresh in (
        (changed, lens.load("cooke-triplet")),
        (ThinLens(50.0, 10.0, 51.0), ThinLens(40.0, 10.0, 40.0)),
        (Pinhole(5.0), Pinhole(6.0)),
    ):
        torch.save(module.state_dict(), tmp_path / "state.pt")
        fresh.load_state_dict(torch.load(tmp_path / "state.pt", weights_only=True))
        same(tensors(fresh), tensors(module))
        fresh.load_state_dict({name: value.float() for name, value in module.state_dict().items()})


TRIPLET = lens.load("cooke-triplet")


def test_a_state_of_before_is_taken_where_its_owner_vouches_for_it():
    other = lens.load("cooke-triplet")
    old = {name: value * 1.01 for name, value in tensors(TRIPLET).items()}
    with pytest.raises(
        RuntimeError, match=r"lens._extra_state .pupil, glasses and .* lack them: strict=False"
    ):
        torch.nn.ModuleDict({"lens": other}).load_state_dict(
            {f"lens.{n}": v for n, v in old.items()}
        )
    other.load_state_dict(old, strict=False)
    same(tensors(other), old)


def test_conversion_keeps_values_flags_and_gradients():
    geo = lens.load("la1509").freeze("conic")
    geo.first_order().efl_mm.backward()
    single = copy.deepcopy(geo).float()
    assert single.dtype == torch.float32
    assert not single.conic.requires_grad
    assert single.curvature_per_mm.requires_grad
    before = geo.curvature_per_mm.grad
    assert before is not None
    geo.float()
    close(geo.curvature_per_mm.grad, before.float())
    back = geo.double().curvature_per_mm
    close(back, lens.load("la1509").curvature_per_mm, 1e-7)
    parameter = geo.thickness_mm
    # nothing to convert: optimisers keep what they hold
    assert geo.double().thickness_mm is parameter


def test_thin_lenses_are_modules():
    thin = ThinLens(50.0, 10.0, 51.0)
    assert [n for n, _ in thin.named_parameters()] == ["efl_mm", "image_distance_mm"]
    thin.requires_grad_()
    film = f64([[0.3, -0.2]])
    pupil = f64([[0.5, 0.1]])
    out = thin.camera_rays(film, pupil).direction
    slope = out[:, :2] / out[:, 2:]
    q = 5 * pupil
    close(slope, (q + film) / 51 - q / 50, 1e-14)
    assert not thin.freeze().camera_rays(film, pupil).direction.requires_grad
    assert not Pinhole(5.0).requires_grad_().freeze().image_distance_mm.requires_grad
    assert thin.float().camera_rays(film.float(), pupil.float()).direction.dtype == torch.float32
    assert copy.deepcopy(thin).double().dtype == D


def test_the_film_of_a_pinhole_follows_its_focal_length():
    pinhole = Pinhole(5.0)
    assert [n for n, _ in pinhole.named_parameters()] == ["efl_mm"]
    optimiser = torch.optim.SGD(pinhole.requires_grad_().parameters(), lr=1.0)
    pinhole.image_distance_mm.backward()
    optimiser.step()
    assert pinhole.image_distance_mm.detach() == 4.0
    assert copy.deepcopy(pinhole).image_distance_mm.detach() == 4.0
    for optics in (pinhole, pinhole.replace(), ThinLens(4.0, 1.0)):
        twin = copy.deepcopy(optics.replace(efl_mm=f64(7.0)))
        assert (float(twin.efl_mm), float(twin.image_distance_mm)) == (7.0, 7.0)
    held = ThinLens(4.0, 1.0, 5.0).replace(efl_mm=f64(7.0))
    assert (float(held.efl_mm), float(held.image_distance_mm.detach())) == (7.0, 5.0)


def test_gradients_reach_the_tensors_a_thin_lens_is_given():
    leaf = torch.tensor(50.0, dtype=D, requires_grad=True)
    thin = ThinLens(leaf * 1.0, 10.0, leaf * 1.02)
    assert list(thin.parameters()) == []
    film = f64([[0.3, -0.2]])
    out = thin.camera_rays(film, torch.zeros(1, 2, dtype=D)).direction
    (slope,) = torch.autograd.grad(out[0, 0] / out[0, 2], leaf)
    close(slope, -0.3 / (1.02 * 50**2), 1e-12)
    kept = torch.nn.Parameter(f64(50.0))
    assert ThinLens(kept, 10.0).efl_mm is kept


FLINT = Glass.named("SF2")


def built_with(geo, at, medium):
    surfaces = list(geo.surfaces)
    surfaces[at] = dataclasses.replace(surfaces[at], medium=medium)
    return GeoLens(surfaces, geo.entrance_pupil_diameter_mm, half_field_deg=geo.half_field_deg)


@pytest.mark.parametrize(
    ("surface", "glass"), [(2, FLINT), (-4, "sf2_schott"), (2, None), (1, FLINT)]
)
def test_it_is_the_lens_built_with_that_medium(surface, glass):
    geo = lens.load("cooke-triplet")
    before = geo.index().tolist()
    at = surface % 6
    found = geo.replace_glass(surface, glass)
    truth = built_with(geo, at, FLINT if glass else None)
    for w in (0.4861327, 0.6562725):
        assert torch.equal(found.index(w), truth.index(w))
    assert torch.equal(found.trace(*rays()).position_mm, truth.trace(*rays()).position_mm)
    assert found.glass.tolist() == truth.glass.tolist()
    assert found.to_surfaces() == truth.to_surfaces()
    assert geo.index().tolist() == before
    assert list(found.parameters()) == []


def test_a_saved_lens_has_the_new_glass(tmp_path):
    lens.save(lens.load("cooke-triplet").replace_glass(2, "SF2"), tmp_path / "a.json")
    assert lens.load(tmp_path / "a.json").surfaces[2].medium == FLINT


def test_gradients_are_those_of_the_lens_built_with_it():
    geo = lens.load("cooke-triplet")
    truth = built_with(geo, 2, FLINT)
    for made, owner in ((geo.replace_glass(2, "SF2"), geo), (truth, truth)):
        made.trace(*rays()).position_mm.square().sum().backward()
        owner.slopes = {name: p.grad for name, p in owner.named_parameters() if p.numel()}
    for name, slope in truth.slopes.items():
        wanted = slope.clone()
        if name == "index_offset":
            assert wanted[2] != 0
            wanted[2] = 0  # the offset of the glass that went
        assert torch.equal(geo.slopes[name], wanted), name


def test_the_offset_of_the_old_glass_goes_with_it_and_variables_stay_what_they_are():
    geo = lens.load("cooke-triplet")
    offset = f64([0.01, 0.0, 0.02, 0.0, 0.03, 0.0])
    found = geo.replace(index_offset=offset).replace_glass(2, FLINT)
    assert found.index_offset.tolist() == [0.01, 0.0, 0.0, 0.0, 0.03, 0.0]
    assert found.index()[3] == FLINT.index_d
    (focus,) = geo.variables("focus")
    moved = geo.replace_glass(2, FLINT)
    moved.trace(*rays()).position_mm.square().sum().backward()
    assert focus.grad.abs() > 0
    assert [v.numel() for v in moved.variables("index", "focus")] == [3, 1]


def test_a_pupil_has_one_diameter_whoever_set_it_last():
    diameter = f64(5.0).requires_grad_()
    geo = lens.load("cooke-triplet").with_pupil(diameter)
    with torch.no_grad():
        diameter.mul_(1.6)
    found = (geo, geo.scaled(0.5).scaled(2.0), geo.thin(), geo.replace())
    assert [g.entrance_pupil_diameter_mm for g in found] == [8.0] * 4
    member = lens.family("retrofocus-4").lens(4.0, 2.0)
    member.entrance_pupil_diameter_mm = 1.0
    close(member.first_order().fno, 4.0, 1e-12)
