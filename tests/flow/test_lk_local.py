"""The closed form's local part: its tree against a dense solve, its fields where one polynomial
does not do."""
# pyright: reportCallIssue=false

from contextlib import nullcontext
from dataclasses import replace

import numpy as np
import pytest
import torch

from codesign.errors import GradientError
from codesign.flow import estimate_lk
from codesign.flow.lk import quadtree
from codesign.flow.lk.lanes import plain_operations
from tests.flow.test_lk import mean_error, moving
from tests.numbers import f64, randn64

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
    return f64(VARIANCES)[:, None] * f64(SIZES)


@pytest.mark.parametrize("form", [nullcontext, plain_operations])
def test_the_tree_finds_the_posterior_of_a_dense_solve(form, generator):
    half = randn64(generator, 2, ROWS, COLUMNS, 2, 2)
    precision = half @ half.mT
    precision[0, 1] = 0  # a row of which nothing is known
    pull = (precision @ randn64(generator, 2, ROWS, COLUMNS, 2, 1))[..., 0]
    xx, xy, yy = precision[..., 0, 0], precision[..., 0, 1], precision[..., 1, 1]
    with form():
        found = quadtree.posterior(torch.stack([xx, xy, yy], 1), pull.movedim(-1, 1), steps())
    cells = ROWS * COLUMNS
    for number, k in np.ndindex(2, 2):
        mean, covariance, evidence = (values[number, k] for values in found)
        # by component, then by cell
        blocks = precision[k].reshape(cells, 2, 2).permute(1, 2, 0)
        data = torch.diag_embed(blocks).transpose(1, 2).reshape(2 * cells, 2 * cells).numpy()
        h = pull[k].reshape(cells, 2).T.flatten().numpy()
        means, covariances, evidences = [], [], []
        for shift in quadtree.SHIFTS:
            prior = SIZES[number] * np.kron(np.eye(2), prior_covariance(shift))
            posterior = np.linalg.inv(np.linalg.inv(prior) + data)
            means.append(posterior @ h)
            covariances.append(posterior)
            evidences.append(
                (h @ posterior @ h - np.linalg.slogdet(np.eye(2 * cells) + prior @ data)[1]) / 2
            )
        whole = np.mean(covariances, 0) + np.cov(np.transpose(means), bias=True)
        np.testing.assert_allclose(mean.flatten(), np.mean(means, 0), atol=1e-10)
        ends = whole.reshape(2, cells, 2, cells).diagonal(axis1=1, axis2=3)
        truth = ends[[0, 0, 1], [0, 1, 1]]
        np.testing.assert_allclose(covariance.flatten(1), truth, atol=1e-10)
        assert float(evidence) == pytest.approx(np.mean(evidences), abs=1e-9)


def test_the_trees_gradient_is_that_of_differences(generator):
    half = randn64(generator, 2, 5, 2, 2, 2)
    xx, xy, _, yy = (half @ half.mT).flatten(3).unbind(3)
    precision = torch.stack([xx, xy, yy], 1).requires_grad_()
    pull = randn64(generator, 2, 2, 5, 2).requires_grad_()
    assert torch.autograd.gradcheck(
        lambda *given: quadtree.posterior(*given, steps()), (precision, pull)
    )
    mean, *_ = quadtree.posterior(precision, pull, steps())
    (grad,) = torch.autograd.grad(mean.square().sum(), pull, create_graph=True)
    with pytest.raises(GradientError, match="first derivatives only"):
        grad.sum().backward()


def test_two_motions_side_by_side():
    # the left half moves by (2, 1), the right one by (-2, 1) px: no polynomial of second degree
    # comes near; the best one, u = -3.75 x / w, leaves 0.7 px in the mean
    (left, left_px), (right, right_px) = moving(0, shift=(2.0, 1.0)), moving(1, shift=(-2.0, 1.0))
    on_left = torch.arange(48) < 24
    truth = torch.where(on_left, left_px, right_px)
    volume = replace(left, counts=torch.where(on_left, left.counts, right.counts))
    local = mean_error(estimate_lk(volume, "local"), truth)
    assert local <= 0.5 * mean_error(estimate_lk(volume, "quadratic"), truth)
