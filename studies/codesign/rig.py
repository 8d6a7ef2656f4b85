"""Cameras of several designs as one, so that all of them are looked through at once."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from codesign.mount import Readings, window_optics
from codesign.types import Rays
from studies.placement.problem import of_bodies


@dataclass(frozen=True)
class Rig:
    """A camera for placement (``ChiefRayCamera``), behind which each of N bodies looks through one
    of several.

    cameras: with films alike. of_body: [N] number of each body's camera.
    """

    cameras: Sequence[Any]
    of_body: Tensor

    @property
    def film(self) -> Any:
        """That of all."""
        return self.cameras[0].film

    def chief_rays(self, pixels: Tensor) -> Rays:
        """Of pixel coordinates [N x P, 2], those of a body side by side: Rays, float64."""
        mine = pixels.reshape(len(self.of_body), -1, 2)
        rows = self._rows()
        parts = [
            camera.chief_rays(mine[row].reshape(-1, 2))
            for camera, row in zip(self.cameras, rows, strict=True)
        ]
        back = torch.cat(rows).argsort()

        def joined(name):
            column = torch.cat([getattr(part, name) for part in parts])
            return column.unflatten(0, (len(back), -1))[back].flatten(0, 1)

        return Rays(joined("origin_m"), joined("direction"), joined("weight"))

    def optics(self, read: Readings) -> Tensor:
        """[N, windows, 2] of readings of the N bodies (``window_optics``)."""
        rows = self._rows()
        parts = [
            window_optics(camera, of_bodies(read, row, len(self.of_body)))
            for camera, row in zip(self.cameras, rows, strict=True)
        ]
        return torch.cat(parts)[torch.cat(rows).argsort()]

    def _rows(self):
        return [torch.nonzero(self.of_body == number)[:, 0] for number in range(len(self.cameras))]
