"""The closed form's local part: its tree against a dense solve, its fields where one polynomial does
not do."""

from contextlib import nullcontext

import numpy as np
import pytest
import torch

from codesign.errors import GradientError
from codesign.flow import estimate_lk
from codesign.flow.lk import quadtree
from codesign.flow.lk.lanes import plain_operations
from codesign.types import EventVolume
from scenes.windows.rendered import RenderedWindows, planes
from tests.certain_case import certain
from tests.flow.test_lk import D, mean_error, moving

ROWS = 3
COLUMNS = 5
VARIANCES = (0.3, 0.8, 2.0)
SIZES = (1.0, 0.2)


def prior_covariance(shift):
    """Of one component on the cells: cells with a common ancestor share the steps from there on."""
    y, x = np.divmod(np.arange(ROWS * COLUMNS), COLUMNS)
    found = np.zeros((ROWS * COLUMNS, ROWS * COLUMNS))
    for scale, variance in enumerate(VARIANCES):
        at = ((y + shift[0]) >> scale) * 1000 + ((x + shift[1]) >> scale)
        found += variance * (at[:, None] == at)
    return found


def steps():
    return torch.tensor(VARIANCES, dtype=D)[:, None] * torch.tensor(SIZES, dtype=D)


@pytest.mark.parametrize("form", [nullcontext, plain_operations])
def test_the_tree_finds_the_posterior_of_a_dense_solve(form, generator):
    half = torch.randn(2, ROWS, COLUMNS, 2, 2, generator=generator, dtype=D)
    precision = half @ half.mT
    precision[0, 1] = 0  # a row of which nothing is known
    pull = (precision @ torch.randn(2, ROWS, COLUMNS, 2, 1, generator=generator, dtype=D))[..., 0]
    xx, xy, yy = precision[..., 0, 0], precision[..., 0, 1], precision[..., 1, 1]
    with form():
        found = quadtree.posterior(torch.stack([xx, xy, yy], 1), pull.movedim(-1, 1), steps())
    cells = ROWS * COLUMNS
    for number, k in np.ndindex(2, 2):
        mean, covariance, evidence = (values[number] for values in found)
        data = np.zeros((2, cells, 2, cells))
        p = precision[k].reshape(cells, 2, 2).numpy()
        for cell in range(cells):
            data[:, cell, :, cell] = p[cell]
        data = data.reshape(2 * cells, 2 * cells)
        h = pull[k].reshape(cells, 2).numpy().T.ravel()
        means, covariances, evidences = [], [], []
        for shift in quadtree.SHIFTS:
            prior = SIZES[number] * np.kron(np.eye(2), prior_covariance(shift))
            posterior = np.linalg.inv(np.linalg.inv(prior) + data)
            means.append(posterior @ h)
            covariances.append(posterior)
            sign, size = np.linalg.slogdet(np.eye(2 * cells) + prior @ data)
            assert sign == 1
            evidences.append((h @ posterior @ h - size) / 2)
        apart = np.array(means) - np.mean(means, 0)
        whole = np.mean(covariances, 0) + apart.T @ apart / len(means)
        index = np.arange(cells)
        np.testing.assert_allclose(mean[k].flatten(), np.mean(means, 0), atol=1e-10)
        np.testing.assert_allclose(covariance[k, 0].flatten(), whole[index, index], atol=1e-10)
        np.testing.assert_allclose(covariance[k, 1].flatten(), whole[index, cells + index], atol=1e-10)
        np.testing.assert_allclose(
            covariance[k, 2].flatten(), whole[cells + index, cells + index], atol=1e-10
        )
        assert float(evidence[k]) == pytest.approx(np.mean(evidences), abs=1e-9)


def test_the_trees_gradient_is_that_of_differences(generator):
    half = torch.randn(2, 9, 2, 2, 2, generator=generator, dtype=D)
    matrix = half @ half.mT
    precision = torch.stack([matrix[..., 0, 0], matrix[..., 0, 1], matrix[..., 1, 1]], 1).requires_grad_()
    pull = torch.randn(2, 2, 9, 2, generator=generator, dtype=D).requires_grad_()
    assert torch.autograd.gradcheck(
        lambda precision, pull: quadtree.posterior(precision, pull, steps()), (precision, pull)
    )
    mean, *_ = quadtree.posterior(precision, pull, steps())
    (grad,) = torch.autograd.grad(mean.square().sum(), pull, create_graph=True)
    with pytest.raises(GradientError, match="first derivatives only"):
        grad.sum().backward()


def test_two_motions_side_by_side():
    # the left half moves by (2, 1), the right one by (-2, 1) px: no polynomial of second degree comes
    # near; the best one, u = -3.75 x / w, leaves 0.7 px in the mean
    (left, left_px), (right, right_px) = moving(0, shift=(2.0, 1.0)), moving(1, shift=(-2.0, 1.0))
    counts = torch.cat([left.counts[..., :24], right.counts[..., 24:]], 4)
    truth = torch.cat([left_px[..., :24], right_px[..., 24:]], 2)
    volume = EventVolume(counts, left.centroid_s, left.collected_s)
    local = mean_error(estimate_lk(volume, "local"), truth)
    assert local <= 0.5 * mean_error(estimate_lk(volume, "quadratic"), truth)


def test_where_one_polynomial_does_the_local_part_vanishes():
    windows = RenderedWindows(planes("fine", 0.1), seed=33).batch(range(32))
    errors = {}
    for model in ("quadratic", "local"):
        with torch.no_grad():
            field = certain(estimate_lk(windows.volume, model))
        errors[model] = float((field.flow_px - windows.truth.flow_px).norm(dim=1).mean())
    # 32 windows: a twentieth of a pixel is 1 % of the flow
    assert errors["local"] <= errors["quadratic"] + 0.05
