"""Gradients beside central differences, for losses in double precision; what frames are weighed and
moved by."""

import torch

from tests.numbers import seeded


def assert_gradients(loss, at, steps, within, seed=0):
    """Gradients of loss(*at) are its central differences within a share, each along two random
    directions.

    Args:
      at: tensors.
      steps: of each, small enough that the function bends by less than ``within`` over them.
    """
    leaves = [value.detach().clone().requires_grad_() for value in at]
    found = torch.autograd.grad(loss(*leaves), leaves)
    draw = seeded(seed)
    for slot, (gradient, step) in enumerate(zip(found, steps, strict=True)):
        for _ in range(2):
            way = torch.randn(gradient.shape, generator=draw, dtype=gradient.dtype)
            with torch.no_grad():
                ahead, behind = (
                    float(
                        loss(*(v + sign * step * way if k == slot else v for k, v in enumerate(at)))
                    )
                    for sign in (1, -1)
                )
            error = float((gradient * way).sum()) - (ahead - behind) / (2 * step)
            # relative to the gradient's own length, as a direction may lie across it
            assert abs(error) <= within * gradient.norm(), (
                slot,
                error / float(gradient.norm()),
            )


def to_twist(loss):
    """Gradient [6] of loss(twist [1, 6]) about no motion."""
    twist = torch.zeros(1, 6, dtype=torch.float64, requires_grad=True)
    return torch.autograd.grad(loss(twist), twist)[0][0]


def smooth_weights(size_px):
    """Weights [size_px, size_px] of pixels, from a picture of 5 x 5."""
    coarse = torch.randn(1, 1, 5, 5, generator=seeded(3))
    return torch.nn.functional.interpolate(coarse, size=(size_px, size_px), mode="bicubic")[0, 0]
