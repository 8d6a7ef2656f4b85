"""How alike derivatives and differences are, and seeds of what they are taken of."""

import torch


def seeded(seed=0):
    return torch.Generator().manual_seed(seed)


def cosine_and_scale(found, truth):
    """Of two vectors: whether one points where the other does, and how long it is beside it."""
    return float(found @ truth / (found.norm() * truth.norm())), float(
        found @ truth / (truth @ truth)
    )
