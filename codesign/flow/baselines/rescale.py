"""Flow on another pixel grid: the vectors are rescaled whenever the field is."""

import torch
from torch import Tensor
from torch.nn.functional import interpolate

from codesign.errors import ShapeError
from codesign.flow.checks import check_real, check_size


def rescale_flow(flow_px: Tensor, size: tuple[int, int] | torch.Size) -> Tensor:
    """The same motion on a grid of ``size`` (height, width) pixels over the same image.

    Args:
      flow_px: [B, 2, H, W] in pixels of its own grid.
      size: (height, width) of the new grid, >= 1.
    Returns: [B, 2, height, width] in pixels of the new grid: resampled bilinearly between pixel centres
      (constant beyond the outermost), x times width / W, y times height / H.
    Gradient: flow_px.
    Raises: ShapeError.
    """
    height, width = check_size(tuple(size) if isinstance(size, torch.Size) else size, "the new size")
    check_real(flow_px, "the flow")
    if flow_px.ndim != 4 or flow_px.shape[1] != 2 or min(height, width, *flow_px.shape[2:]) < 1:
        raise ShapeError(
            f"a flow is [B, 2, H, W] and its new size at least 1 x 1; got {tuple(flow_px.shape)} and "
            f"{height} x {width}."
        )
    if (height, width) == tuple(flow_px.shape[2:]):
        return flow_px
    factor = torch.tensor(
        [width / flow_px.shape[3], height / flow_px.shape[2]], dtype=flow_px.dtype, device=flow_px.device
    )
    return interpolate(flow_px, (height, width), mode="bilinear", align_corners=False) * factor[:, None, None]
