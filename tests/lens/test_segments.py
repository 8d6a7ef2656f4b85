"""Long lenses are traced in segments: the same rays, failures and gradients as in one kernel."""

import math

import pytest
import torch
from torch.utils.checkpoint import checkpoint

from codesign import events, flow, lens
from codesign.lens import GeoLens, Glass, Status, Surface, trace
from tests.lens.systems import close
from tests.numbers import D

GLASS = Glass.from_indices(1.51, 1.5, 1.49, "g")


STRONG = {1: 11.0, 4: 9.0, 7: 7.5}  # radii that outer rays miss


def long_lens():
    """Weak and strong surfaces, an asphere, a mirror, a shifted face and a stop; 9 surfaces."""
    surfaces = []
    for i in range(9):
        surfaces.append(
            Surface(
                math.inf if i == 5 else STRONG.get(i, 300.0) * (-1 if i % 2 else 1),
                1.0 + 0.1 * i,
                None if i % 2 else GLASS,
                4.0 if i == 2 else 7.0 if i in STRONG else 14.0,
                conic=0.0 if i in STRONG else 0.3 * (i % 3),
                asphere=(0.0, 1e-6) if i == 4 else (),
                is_stop=i == 2,
                decentre_mm=(0.05, -0.02) if i == 6 else (0.0, 0.0),
            )
        )
    surfaces[8] = Surface(-400.0, 3.0, None, 14.0, mirror=True)
    return GeoLens(surfaces, 8.0)


def run(geo):
    y = torch.linspace(-13, 13, 53, dtype=D)
    origin = torch.stack([0.2 * y, y, torch.full_like(y, -5.0)], 1).requires_grad_()
    direction = torch.nn.functional.normalize(
        torch.stack([0 * y, 0.02 * y, torch.ones_like(y)], 1), dim=1
    )
    out = geo.trace(origin, direction)
    total = (
        (out.position_mm.square().sum(1) + out.optical_path_mm)[out.status == Status.OK].sum()
        + out.weight.sum()
        + out.deficit.sum()
    )
    learned = [p for p in geo.parameters() if p.numel()]
    return out, torch.autograd.grad(total, [origin, *learned])


@pytest.mark.parametrize("to_plane", [True, False])
def test_segments_give_what_one_kernel_gives(monkeypatch, to_plane):
    geo = long_lens()
    if not to_plane:
        whole = geo.prescription
        monkeypatch.setattr(
            geo, "prescription", lambda wavelength_um: whole(wavelength_um).until(8)
        )
    one, wanted = run(geo)
    # kernels of three surfaces
    monkeypatch.setattr(trace, "LONGEST", 6)
    monkeypatch.setattr(trace, "SEGMENT", 3)
    parts, slopes = run(geo)
    assert (one.status == Status.OK).sum() > 5
    assert len({at // trace.SEGMENT for at in one.failed_surface.tolist() if at >= 0}) > 1
    for name in ("status", "failed_surface", "inside"):
        assert torch.equal(getattr(parts, name), getattr(one, name)), name
    alive = one.status == Status.OK
    for name in ("position_mm", "direction", "optical_path_mm"):
        # rounding of 20 mm, magnified by 9 surfaces
        close(getattr(parts, name)[alive], getattr(one, name)[alive], atol=1e-11)
    close(parts.weight, one.weight, atol=1e-12)
    close(parts.deficit, one.deficit, atol=1e-11)
    for slope, other in zip(slopes, wanted, strict=True):
        close(slope, other, 1e-10, atol=1e-10 * float(other.abs().max()))


def test_a_short_lens_stays_one_kernel():
    assert len(lens.load("double-gauss").surfaces) <= trace.LONGEST


# one ray each, four and a rest, all at once
@pytest.mark.parametrize("rows", [1, 7, 262_144])
def test_a_sum_over_chunks_has_the_gradient_of_the_sum_in_one_piece(rows):
    geo = lens.load("double-gauss")
    origin, direction = lens.aimed_rays(geo, 0.1, lens.pupil_grid(6))
    shares = torch.linspace(1, 2, len(origin), dtype=D)
    rays = [v.detach().requires_grad_() for v in (origin, direction, shares)]

    def merit(origin, direction, share):
        out = geo.trace(origin, direction)
        return (share * out.weight * (out.position_mm.square().sum(1) + out.optical_path_mm)).sum()

    leaves = [*[p for p in geo.parameters() if p.numel()], *rays]
    whole, total = merit(*rays), lens.sum_over_chunks(merit, *rays, rows=rows)
    # sums of the same 32 numbers in another order
    close(total, whole, 1e-14)
    pairs = zip(torch.autograd.grad(total, leaves), torch.autograd.grad(whole, leaves), strict=True)
    for got, want in pairs:
        close(got, want, 1e-12, atol=1e-12 * float(want.abs().max()))


def spike_potentials(drive):
    return events.srm(drive, theta=0.5, tau_s=2.0, tau_r=2.0)[0]


def closed_form(frames):
    counts, _ = events.memory(frames, 0.2, 0.2)
    t_s = torch.linspace(0, 0.05, len(frames), dtype=D)
    return flow.estimate_lk(events.from_counts(counts, t_s, bins=4)).flow_px


@pytest.mark.parametrize("function", [spike_potentials, closed_form])
def test_event_and_flow_kernels_can_be_computed_again_too(function, generator):
    steps = torch.rand(5, 16, 16, generator=generator) + 0.5
    leaf = steps.cumsum(0).requires_grad_()
    want = torch.autograd.grad(function(leaf).square().sum(), leaf)[0]
    got = torch.autograd.grad(checkpoint(function, leaf, use_reentrant=False).square().sum(), leaf)[
        0
    ]
    assert want.abs().max() > 0
    assert torch.equal(got, want)
