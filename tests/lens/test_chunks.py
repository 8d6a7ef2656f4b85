"""Sums over chunks of rays, and whatever else is computed again in the backward pass: the same gradient as in one piece."""

import pytest
import torch
from torch.utils.checkpoint import checkpoint

from codesign import events, flow, lens
from codesign.errors import CodesignError

D = torch.float64
ROWS = (1, 7, 100, 262_144)  # one each, four and a rest, all at once


def gradients(merit, geo, rays, rows=None):
    """Value and gradients of the sum of a merit of the traced rays; in one piece without ``rows``."""
    leaves = [*[p for p in geo.parameters() if p.numel()], *rays]
    total = merit(*rays) if rows is None else lens.sum_over_chunks(merit, *rays, rows=rows)
    return total.detach(), torch.autograd.grad(total, leaves)


@pytest.mark.parametrize("rows", ROWS)
def test_a_sum_over_chunks_has_the_gradient_of_the_sum_in_one_piece(rows):
    geo = lens.load("double-gauss")
    origin, direction = lens.aimed_rays(geo, 0.1, lens.pupil_grid(6))
    rays = [
        v.detach().requires_grad_() for v in (origin, direction, torch.linspace(1, 2, len(origin), dtype=D))
    ]

    def merit(origin, direction, share):
        out = geo.trace(origin, direction)
        return (share * out.weight * (out.position_mm.square().sum(1) + out.optical_path_mm)).sum()

    whole, want = gradients(merit, geo, rays)
    total, got = gradients(merit, geo, rays, rows)
    # sums of the same 32 numbers in another order
    torch.testing.assert_close(total, whole, rtol=1e-14, atol=0)
    for g, w in zip(got, want, strict=True):
        torch.testing.assert_close(g, w, rtol=1e-12, atol=1e-12 * float(w.abs().max()))


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


@pytest.mark.parametrize(
    ("rays", "rows"),
    [
        ((), 4),
        ((torch.zeros(0, 3),), 4),
        ((torch.zeros(3, 3), torch.zeros(2, 3)), 4),
        ((torch.zeros(()),), 4),
        (([0.0],), 4),
        ((torch.zeros(3, 3),), 0),
        ((torch.zeros(3, 3),), "many"),
    ],
)
def test_chunks_that_cannot_be_are_refused(rays, rows):
    with pytest.raises(CodesignError):
        lens.sum_over_chunks(torch.sum, *rays, rows=rows)
