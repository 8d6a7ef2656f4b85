"""Lens, mount, thresholds and network in one graph: gradients against differences, one optimiser, one figure."""

import pytest
import torch

from codesign.system import check
from studies import joint_design


@pytest.fixture(scope="module")
def system():
    return joint_design.make_system(10_000, 0)


@pytest.fixture(scope="module")
def batch():
    return joint_design.draw_batch(4, 1000)


def test_every_group_has_the_gradient_of_differences(system, batch):
    assert sum(p.numel() for p in system.flow.parameters()) >= 10_000
    for row in joint_design.certificate(system, batch, directions=4):
        assert row.relative_error <= 0.05, row
        assert row.cosine >= 0.99, row


def test_the_module_computes_what_its_stages_do_by_hand(system, batch):
    result = system(batch)
    by_hand = joint_design.by_hand(system, batch)
    torch.testing.assert_close(result.loss, by_hand, rtol=1e-6, atol=0)


def test_one_optimiser_lowers_the_loss_of_all_groups_together(batch):
    system = joint_design.make_system(10_000, 0)
    optimiser = torch.optim.Adam(
        [
            *(p for p in system.lens.parameters() if p.requires_grad),
            *system.mount.parameters(),
            *system.events.parameters(),
            *system.flow.parameters(),
        ],
        lr=0.01,
    )
    first = check(system, batch, optimiser).loss.item()
    before = [p.detach().clone() for p in system.parameters() if p.requires_grad]
    for _ in range(25):
        optimiser.zero_grad()
        system(batch).backward()
        optimiser.step()
    assert system(batch).loss.item() < 0.8 * first
    after = [p.detach() for p in system.parameters() if p.requires_grad]
    assert all(not torch.equal(a, b) for a, b in zip(after, before, strict=True))
