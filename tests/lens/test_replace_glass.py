"""A medium exchanged for another: the lens must be the one that is built with it, gradients and files
included."""

import dataclasses

import pytest
import torch

from codesign import lens
from codesign.lens import GeoLens, Glass

D = torch.float64
FLINT = Glass.named("SF2")


def rays():
    points = torch.tensor([[1.0, 2.0, -5.0], [-3.0, 0.5, -5.0]], dtype=D)
    return points, torch.tensor([[0.0, 0.0, 1.0]] * 2, dtype=D)


def built_with(geo, at, medium):
    surfaces = list(geo.surfaces)
    surfaces[at] = dataclasses.replace(surfaces[at], medium=medium)
    return GeoLens(surfaces, geo.entrance_pupil_diameter_mm, half_field_deg=geo.half_field_deg)


@pytest.mark.parametrize(("surface", "glass"), [(2, FLINT), (-4, "sf2_schott"), (2, None), (1, FLINT)])
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
    offset = torch.tensor([0.01, 0.0, 0.02, 0.0, 0.03, 0.0], dtype=D)
    found = geo.replace(index_offset=offset).replace_glass(2, FLINT)
    assert found.index_offset.tolist() == [0.01, 0.0, 0.0, 0.0, 0.03, 0.0]
    assert float(found.index()[3]) == FLINT.index_d
    (focus,) = geo.variables("focus")
    moved = geo.replace_glass(2, FLINT)
    moved.trace(*rays()).position_mm.square().sum().backward()
    assert float(focus.grad.abs()) > 0
    assert [v.numel() for v in moved.variables("index", "focus")] == [3, 1]
