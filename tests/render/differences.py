"""Gradients beside central differences, for losses in double precision."""

import torch


def assert_gradients(loss, at, steps, within, seed=0):
    """Gradients of loss(*at) are its central differences within a share, each along two random directions.

    Args: at: tensors. steps: of each, small enough that the function bends by less than ``within`` over them.
    """
    leaves = [value.detach().clone().requires_grad_() for value in at]
    found = torch.autograd.grad(loss(*leaves), leaves)
    draw = torch.Generator().manual_seed(seed)
    for slot, (gradient, step) in enumerate(zip(found, steps, strict=True)):
        for _ in range(2):
            way = torch.randn(gradient.shape, generator=draw, dtype=gradient.dtype)
            with torch.no_grad():
                ahead, behind = (
                    float(loss(*(v + sign * step * way if k == slot else v for k, v in enumerate(at))))
                    for sign in (1, -1)
                )
            error = float((gradient * way).sum()) - (ahead - behind) / (2 * step)
            # relative to the gradient's own length, as a direction may lie across it
            assert abs(error) <= within * float(gradient.norm()), (slot, error / float(gradient.norm()))
