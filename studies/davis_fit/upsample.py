"""Frames between frames: both neighbours moved along their optical flow and blended.

Between two frames 40 ms apart an edge passes over many pixels: each sees ON and OFF, and the difference of
the two frames shows neither. Linear interpolation in time changes no count of a memorised level; moving the
picture does.
"""

import numpy as np
import torch
from scipy.ndimage import map_coordinates
from skimage.registration import optical_flow_tvl1

from codesign.errors import DomainError

DARK_OFFSET = 12.0  # flow is found on ln(I + 12), so that dark edges count as the sensor sees them
SCALE = 6.0  # ln(255 + 12) is about 6: the solver expects pictures from 0 to 1
ATTACHMENT = 15  # weight of the data against smoothness, the solver's own default


def flows(first, second):
    """Optical flow from one frame to the next and back.

    Args: first, second: [H, W] linear intensity, 0 to 255.
    Returns: forth and back, [2, H, W] float32 arrays (rows, columns), pixels.
    Source: TV-L1, Zach, Pock and Bischof 2007, as in scikit-image.
    """
    one, two = (
        np.log(np.asarray(frame, dtype=np.float32) + DARK_OFFSET) / SCALE for frame in (first, second)
    )
    return optical_flow_tvl1(one, two, attachment=ATTACHMENT), optical_flow_tvl1(
        two, one, attachment=ATTACHMENT
    )


def between(first, second, forth, back, factor):
    """The frame ``first`` and the factor - 1 frames that follow it before ``second``.

    Args:
      first, second: [H, W] tensors, linear intensity. forth, back: [2, H, W] flow (rows, columns), pixels.
        factor: whole number >= 1.
    Returns: [factor, H, W] tensor: at share a of the interval (1 - a) first(x + a back(x)) + a second(x + (1
      - a) forth(x)); outside, the nearest edge.
    Raises: DomainError when factor is not a whole number >= 1.
    """
    if isinstance(factor, bool) or not isinstance(factor, int) or factor < 1:
        raise DomainError(
            f"the upsampling factor is {factor!r}; a whole number >= 1 is needed (1: the frames as they are)."
        )
    pictures = first.numpy(), second.numpy()
    place = np.indices(pictures[0].shape, dtype=np.float32)
    made = [first]
    for step in range(1, factor):
        share = step / factor
        early, late = (
            map_coordinates(picture, place + field, order=1, mode="nearest")
            for picture, field in zip(pictures, (share * back, (1 - share) * forth), strict=True)
        )
        made.append(torch.from_numpy((1 - share) * early + share * late).to(first.dtype))
    return torch.stack(made)
