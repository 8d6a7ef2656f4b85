"""Words of tests of numbers: doubles, seeded draws, and how near is near enough."""

import torch

D = torch.float64


def f64(values):
    """A tensor of doubles."""
    return torch.tensor(values, dtype=D)


def seeded(seed=0):
    """A generator of its own."""
    return torch.Generator().manual_seed(seed)


def randn64(generator, *shape):
    """Normal numbers, doubles."""
    return torch.randn(*shape, generator=generator, dtype=D)


def rand64(generator, *shape):
    """Even numbers from 0 to 1, doubles."""
    return torch.rand(*shape, generator=generator, dtype=D)


def close(found, truth, rtol=0.0, atol=0.0):
    """Whether numbers of one type and shape agree: to the last bit where no tolerance is given."""
    torch.testing.assert_close(found, truth, rtol=rtol, atol=atol)
