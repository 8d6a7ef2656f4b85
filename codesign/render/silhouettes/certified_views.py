"""FieldOfView of a scene that were looked at, and which other views need no look of their own:
those that show nothing which lies more than WITHIN_PX from what was seen, wherever it is, in view
or beside it."""

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from codesign.pose import inverse
from codesign.render.silhouettes.curve_points import FieldOfView

WITHIN_PX = 2.0
# parts of a moving scene against one another: what touched nothing does not touch then
APART_PX = 0.1
MOST = 256  # views that are kept of a scene


@dataclass(frozen=True)
class Looked:
    """A view that was found right: the camera [parts, 4, 4] in the axes of every part, the distance
    [parts] of the nearest surface of each, and what of space falls on the film."""

    cameras: Tensor
    nearest_m: Tensor
    view: FieldOfView

    def answers_for(self, cameras: Tensor, view: FieldOfView) -> Tensor:
        """Of which views [F] of cameras [parts, F, 4, 4]."""
        moved = inverse(self.cameras)[:, None] @ cameras
        lens_px = self.view.differs_px(view, float(self.nearest_m.min()))
        apart = inverse(moved[:1]) @ moved
        near_m = self.nearest_m[:, None] - view.aperture_m
        moved_px, apart_px = (
            _rad(motion, near_m).amax(0) * view.steepest for motion in (moved, apart)
        )
        return (moved_px + lens_px < WITHIN_PX) & (apart_px < APART_PX)


def _rad(motion, near_m):
    """Angle [parts, F] by which what is at least so far away seems to move as the camera does."""
    turned = motion[..., :3, :3] - torch.eye(3, dtype=motion.dtype)
    turn = 2 * (turned.flatten(2).norm(dim=2) / 8**0.5).clamp_max(1).asin()
    left = near_m - motion[..., :3, 3].norm(dim=2)
    return torch.where(left > 0, turn + motion[..., :3, 3].norm(dim=2) / left, torch.inf)


def nearest_m(parts: tuple[Any, ...], cameras: Tensor) -> Tensor:
    """Distance [parts] from cameras [parts, 4, 4] of the nearest surface of every part, 0 for those
    that do not say."""
    eyes = cameras[:, :3, 3].cpu()
    return torch.tensor(
        [
            part.nearest_m(eye) if hasattr(part, "nearest_m") else 0.0
            for part, eye in zip(parts, eyes, strict=True)
        ],
        dtype=torch.float64,
    )


def looked_at(parts: tuple[Any, ...], film: Any) -> list[Looked]:
    """The views of these parts on such a film that were found right, kept by the first part where
    it can keep anything, with the other parts, so that none of them makes way for another of its
    name."""
    kept = getattr(parts[0], "__dict__", {}).setdefault("_looked_at", {})
    return kept.setdefault((tuple(map(id, parts)), film), (parts, []))[1]
