"""Lenses as torch Modules: what they own, what they share, what conversions, copies and saved states keep."""

import copy
import dataclasses

import pytest
import torch

from codesign import lens
from codesign.errors import DomainError
from codesign.lens import GeoLens, Glass, Phase, Pinhole, Surface, ThinLens, diffraction

D = torch.float64
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


def test_air_is_no_variable(tmp_path):
    geo = lens.load("cooke-triplet")
    optimiser = torch.optim.Adam(geo.parameters(), lr=1e-5)
    for _ in range(10):
        optimiser.zero_grad()
        geo.trace(*rays()).position_mm.square().sum().backward()
        optimiser.step()
    filled = [True, False] * 3
    assert (geo.index_offset.detach() != 0).tolist() == filled
    lens.save(geo, tmp_path / "a.json")
    after = lens.load(tmp_path / "a.json").surfaces
    assert [s.medium is not None for s in after] == filled
    assert [s.medium.name for s in after[::2]] == [s.medium.name for s in geo.surfaces[::2]]


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
    assert shifted.index().tolist() == pytest.approx([1.0, 1.51, 1.0, 1.0], abs=1e-15)
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

    found, wanted = slope(twin, torch.float32), slope(geo.replace(thickness_mm=geo.thickness_mm * 2), D)
    assert found.dtype == D
    # float32 rays of 1e-6 at spots of 1e-3
    torch.testing.assert_close(found, wanted, rtol=1e-3, atol=0)
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
        assert float(geo.curvature_per_mm[0].detach()) == pytest.approx(1 / 51.5, rel=1e-15)
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


TRIPLET = lens.load("cooke-triplet")
DOUBLET = [Surface(50.0, 5.0, GLASS, 10.0, is_stop=True), Surface(-80.0, 20.0, None, 10.0)]


def surfaces_with(**changes):
    return GeoLens([dataclasses.replace(DOUBLET[0], **changes), DOUBLET[1]], 8.0)


# name of what differs in the sentence, the lens that is saved, the one it is loaded into
HYBRIDS = {
    "entrance pupil diameter": (TRIPLET.scaled(0.1), TRIPLET.scaled(0.2)),
    "index behind surface 1 at F .N-SK16 here.": (TRIPLET.replace_glass(0, "SF2"), TRIPLET),
    "index behind surface 2 at F .air here.": (TRIPLET.replace_glass(1, "SF2"), TRIPLET),
    "mirror at surface 1": (surfaces_with(mirror=True, medium=None), surfaces_with(medium=None)),
    "obstruction of surface 1": (surfaces_with(inner_semi_aperture_mm=2.0), surfaces_with()),
    "diffraction order of surface 1": (
        surfaces_with(phase=Phase((0.1,), 2)),
        surfaces_with(phase=Phase((0.1,), 1)),
    ),
    "stop": (
        GeoLens(DOUBLET, 8.0),
        GeoLens([*(dataclasses.replace(s, is_stop=not s.is_stop) for s in DOUBLET)], 8.0),
    ),
    "soft edge": (GeoLens(DOUBLET, 8.0), GeoLens(DOUBLET, 8.0, soft_edge_mm=0.1)),
    "half field": (GeoLens(DOUBLET, 8.0, half_field_deg=5.0), GeoLens(DOUBLET, 8.0)),
    "numbers describe it": (TRIPLET, lens.load("double-gauss")),
    "ThinLens: its entrance pupil": (ThinLens(50.0, 10.0), ThinLens(50.0, 5.0)),
    "term 1": tuple(diffraction.ZernikePlate({term: 1.0}, 4.0) for term in (5, 6)),
    "finest detail": tuple(diffraction.GridPlate(torch.ones(6, 6), pitch) for pitch in (1.0, 2.0)),
}


@pytest.mark.parametrize("what", HYBRIDS)
def test_no_hybrid_comes_from_a_saved_state(what):
    saved, other = HYBRIDS[what]
    before = tensors(other)
    for strict in (True, False):
        with pytest.raises(DomainError, match=what):
            other.load_state_dict(saved.state_dict(), strict=strict)
    same(tensors(other), before)
    copy.deepcopy(saved).load_state_dict({name: value.float() for name, value in saved.state_dict().items()})


def test_a_state_of_before_is_taken_where_its_owner_vouches_for_it():
    other = lens.load("cooke-triplet")
    old = {name: value * 1.01 for name, value in tensors(TRIPLET).items()}
    with pytest.raises(
        RuntimeError, match=r"lens._extra_state .pupil, glasses and .* lack them: strict=False"
    ):
        torch.nn.ModuleDict({"lens": other}).load_state_dict({f"lens.{n}": v for n, v in old.items()})
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
    torch.testing.assert_close(geo.curvature_per_mm.grad, before.float(), rtol=0, atol=0)
    back = geo.double().curvature_per_mm.detach()
    torch.testing.assert_close(back, lens.load("la1509").curvature_per_mm.detach(), rtol=1e-7, atol=0)
    parameter = geo.thickness_mm
    assert geo.double().thickness_mm is parameter  # nothing to convert: optimisers keep what they hold


def test_thin_lenses_are_modules():
    thin = ThinLens(50.0, 10.0, 51.0)
    assert [n for n, _ in thin.named_parameters()] == ["efl_mm", "image_distance_mm"]
    thin.requires_grad_()
    film = torch.tensor([[0.3, -0.2]], dtype=D)
    pupil = torch.tensor([[0.5, 0.1]], dtype=D)
    out = thin.camera_rays(film, pupil).direction
    slope = out[:, :2] / out[:, 2:]
    q = 5 * pupil
    torch.testing.assert_close(slope, (q + film) / 51 - q / 50, rtol=1e-14, atol=0)
    found = torch.autograd.grad(slope[0, 0], (thin.efl_mm, thin.image_distance_mm))
    assert [float(g) for g in found] == pytest.approx([2.5 / 50**2, -2.8 / 51**2], rel=1e-12)
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
    assert float(pinhole.image_distance_mm.detach()) == 4.0
    assert float(copy.deepcopy(pinhole).image_distance_mm.detach()) == 4.0
    twin = pinhole.replace(efl_mm=torch.tensor(7.0, dtype=D))  # names one length, moves one length
    assert (float(twin.efl_mm), float(twin.image_distance_mm.detach())) == (7.0, 4.0)


def test_gradients_reach_the_tensors_a_thin_lens_is_given():
    leaf = torch.tensor(50.0, dtype=D, requires_grad=True)
    thin = ThinLens(leaf * 1.0, 10.0, leaf * 1.02)
    assert list(thin.parameters()) == []
    film = torch.tensor([[0.3, -0.2]], dtype=D)
    out = thin.camera_rays(film, torch.zeros(1, 2, dtype=D)).direction
    (slope,) = torch.autograd.grad(out[0, 0] / out[0, 2], leaf)
    assert float(slope) == pytest.approx(-0.3 / (1.02 * 50**2), rel=1e-12)
    kept = torch.nn.Parameter(torch.tensor(50.0, dtype=D))
    assert ThinLens(kept, 10.0).efl_mm is kept
