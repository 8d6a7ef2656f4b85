"""A function whose gradient is wrong by as much as one likes."""

import torch

from codesign.grad import certify


def grad_of(fn, x):
    """The gradient of fn at x."""
    x = x.detach().clone().requires_grad_(True)
    return torch.autograd.grad(fn(x), x)[0]


def certified(fn, x, error, **options):
    """Row of certify for the right gradient plus an error that the function's values do not
    show."""
    (row,) = certify(
        lambda p: fn(p["x"]) + (error * (p["x"] - p["x"].detach())).sum(), {"x": x}, **options
    )
    return row
