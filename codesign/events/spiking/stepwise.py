"""A function of pictures applied step by step, so that chunks of time round as the whole does."""

import torch


def stepwise(function, pictures):
    """Apply ``function`` to every step of a sequence.

    The matrix products behind a convolution may round by the number of pictures they get and by where these
    begin in memory (MKL documents equal bits for equal shapes at equally aligned addresses). Every step
    therefore gets a call of its own, on memory of its own, which torch aligns to 64 bytes.

    Args: function: [B, C, H, W] to [B, C', H, W]. pictures: [T, B, C, H, W].
    Returns: [T, B, C', H, W]. Gradient: pictures and what the function holds.
    """
    return torch.stack([function(step.clone(memory_format=torch.contiguous_format)) for step in pictures])
