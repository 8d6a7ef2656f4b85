"""A picture-by-picture function over time, in groups of one size, so that chunks of time round as the whole
does."""

import torch
import torch.nn.functional as F

GROUP = 8


def grouped(function, pictures):
    """Apply ``function`` to all pictures of a sequence.

    A convolution may choose its algorithm by the number of pictures it gets; it always gets GROUP steps here,
    the last ones filled up with zeros.

    Args: function: [N, C, H, W] to [N, C', H, W], each picture for itself. pictures: [T, B, C, H, W].
    Returns: [T, B, C', H, W]. Gradient: pictures and what the function holds.
    """
    made = []
    for group in pictures.split(GROUP):
        filled = F.pad(group, (0, 0) * 4 + (0, GROUP - len(group)))
        made.append(function(filled.flatten(0, 1)).unflatten(0, filled.shape[:2])[: len(group)])
    return torch.cat(made)
