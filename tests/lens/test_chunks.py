"""Sums over chunks of rays, and whatever else is computed again in the backward pass: the same gradient as
in one piece."""

import pytest
import torch
from torch.utils.checkpoint import checkpoint

from codesign import events, flow, lens

D = torch.float64


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
    torch.testing.assert_close(total, whole, rtol=1e-14, atol=0)
    pairs = zip(torch.autograd.grad(total, leaves), torch.autograd.grad(whole, leaves), strict=True)
    for got, want in pairs:
        torch.testing.assert_close(got, want, rtol=1e-12, atol=1e-12 * float(want.abs().max()))


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
    got = torch.autograd.grad(checkpoint(function, leaf, use_reentrant=False).square().sum(), leaf)[0]
    assert want.abs().max() > 0
    assert torch.equal(got, want)
