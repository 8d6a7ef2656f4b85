"""A lens with a phase plate, rendered by its point spread functions."""

import torch

from codesign import lens, render
from codesign.lens import diffraction
from codesign.lens.analysis import geometric_psf

D = torch.float64
PITCH = 0.00486


def moments(energy):
    """Mean [2] and central second moments [2] of a point spread about its middle pixel, px."""
    at = torch.arange(energy.shape[-1], dtype=D) - energy.shape[-1] // 2
    lines = [energy.sum(axis) / energy.sum() for axis in (0, 1)]
    mean = torch.stack([(line * at).sum() for line in lines])
    return mean, torch.stack([(line * at**2).sum() for line in lines]) - mean**2


def plated_map(plate):
    geo = lens.load("cooke-triplet").scaled(0.22).requires_grad_(False).focus_at(0.56)
    plated = diffraction.with_plate(geo, plate, z_mm=0.3)
    camera = render.Camera(plated, 33, 33, pixel_pitch_mm=PITCH)
    return plated, render.psf_map(camera, nearest_m=0.3)


def test_the_map_of_a_plated_lens_is_that_of_its_rays():
    plate = diffraction.ZernikePlate(
        {4: 0.3, 7: 0.8, 8: 0.9, 9: -0.6, 10: 0.6}, 0.9
    ).requires_grad_(False)
    plated, found = plated_map(plate)
    for at_m in (0.3, 5.0):
        mean, square = moments(found.energy(torch.tensor([at_m]))[0, 0])
        # rays the other way, on the axis; the picture is upright, the film is not
        truth, truth_square = moments(
            geometric_psf(plated, 0.0, PITCH, 64, at_m=at_m, grid=64).energy
        )
        torch.testing.assert_close(mean, -truth, rtol=0, atol=0.02)
        torch.testing.assert_close(square, truth_square, rtol=0.05, atol=0.02)
