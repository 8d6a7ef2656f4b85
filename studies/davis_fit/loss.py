"""What the fit makes small: misfit of simulated and recorded counts [T, 2, H, W], ON first."""

import torch


def match(simulated, recorded):
    """1 - correlation of the signed counts, plus the mean squared log ratio of the event numbers per interval
    and polarity.

    The correlation does not see a common factor of the counts and the ratio sees little else, so neither is
    paid for with the other. A squared error or a likelihood makes counts too few where edges are predicted a
    pixel off (see docs/davis_fit.md for their figures).
    """
    signed, truth = (counts[:, 0] - counts[:, 1] for counts in (simulated, recorded))
    signed = signed - signed.mean()
    truth = truth - truth.mean()
    correlation = (signed * truth).sum() / (signed.square().sum() * truth.square().sum()).sqrt()
    ratio = (simulated.sum((2, 3)) + 1) / (
        recorded.sum((2, 3)) + 1
    )  # one event more, so that an empty interval has a ratio
    return 1 - correlation + ratio.log().square().mean()


def squares(simulated, recorded):
    """Mean squared error of the signed counts."""
    return ((simulated - recorded)[:, 0] - (simulated - recorded)[:, 1]).square().mean()


def roots(simulated, recorded):
    """Mean squared error of sqrt(n + 3/8): the Gaussian likelihood of Poisson counts after Anscombe's
    transform (1948)."""
    return ((simulated + 0.375).sqrt() - (recorded + 0.375).sqrt()).square().mean()


def poisson(simulated, recorded):
    """Mean negative log-likelihood of Poisson counts, up to a constant of the recording."""
    return (simulated - torch.xlogy(recorded, simulated)).mean()


LOSSES = {"match": match, "squares": squares, "roots": roots, "poisson": poisson}
