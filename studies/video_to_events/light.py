"""From the digital values of a picture to the light that the sensor sees: full scale, gamma, colour, size."""

import numpy as np
import torch
from torch.nn.functional import interpolate

from codesign.errors import DomainError

LUMINANCE = (0.2126, 0.7152, 0.0722)  # red, green, blue: ITU-R BT.709, for linear light


class Light:
    """Turns frames as stored into intensity on the 0-255 scale.

    white: digital value that becomes 255. linear: undo the sRGB gamma (IEC 61966-2-1) first; else values are
      taken as they are.
    size: (width, height) of the sensor, or None for that of the frames. device: where the result lies.
    """

    def __init__(self, white, linear, size=None, device: torch.device | str = "cpu"):
        self.white = float(white)
        self.linear = linear
        self.size = size
        self.device = device
        self.largest = 0.0  # digital value seen so far
        self.tables = {}

    def __call__(self, frames, first):
        """Intensity [N, H, W] float32 of ``frames``, a list of [H, W] or [H, W, 3] arrays, the first of which
        has number ``first``.

        Red, green and blue are weighted as in BT.709, after the gamma is undone where that is asked for. A
        new size is reached by bilinear interpolation that averages all pixels it covers, on intensities.
        Raises: DomainError naming the frame that holds NaN, infinity or a negative value.
        """
        values = np.stack(frames)
        if values.dtype.kind == "f":
            self._check(values, first)
        self.largest = max(self.largest, float(values.max()))
        light = torch.from_numpy(self._curve(values)).to(self.device)
        if light.ndim == 4:
            light = light @ torch.tensor(LUMINANCE, device=light.device)
        if self.size is not None and self.size != (light.shape[2], light.shape[1]):
            light = interpolate(
                light[:, None],
                (self.size[1], self.size[0]),
                mode="bilinear",
                antialias=True,
                align_corners=False,
            )[:, 0].clamp_(min=0)
        return light

    def _curve(self, values):
        if values.dtype.kind == "u":  # every digital value is worked out once
            if values.dtype not in self.tables:
                self.tables[values.dtype] = self._intensity(
                    np.arange(np.iinfo(values.dtype).max + 1, dtype=np.float64)
                ).astype(np.float32)
            return self.tables[values.dtype][values]
        return self._intensity(values.astype(np.float64)).astype(np.float32)

    def _intensity(self, values):
        share = values / self.white
        return 255 * (
            np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)
            if self.linear
            else share
        )

    @staticmethod
    def _check(values, first):
        bad = ~np.isfinite(values) | (values < 0)
        if bad.any():
            index = tuple(int(axis[0]) for axis in bad.nonzero())
            raise DomainError(
                f"frame {first + index[0]} holds {values[index]} at row {index[1]}, column {index[2]}; "
                "intensities are finite and 0 or more: repair the input."
            )
