"""What one pass of a system looks at."""

from dataclasses import dataclass
from typing import Any

from torch import Tensor

from codesign.checks import check
from codesign.errors import DomainError, ShapeError
from codesign.types import FlowField


@dataclass(frozen=True)
class Batch:
    """Trajectories before a scene, or before several.

    T_world_body: [..., T, 4, 4] poses of the body at the times t_s [T], metres; of the camera
      itself where the system has no mount. None where the system has a trajectory of its own.
    t_s: [T] seconds, strictly increasing.
    scene: whatever the render stage takes; a tuple of scenes, one per first index of the poses;
      None where the system has one.
    seed: of film samples and sensor noise; None keeps the camera's samples (and its seed for the
      noise).
    truth: the true flow as recorded, in the layout of the estimator's; None has it computed through
      the lens where an objective asks for it.
    """

    T_world_body: Tensor | None
    t_s: Tensor
    scene: Any = None
    seed: int | None = None
    truth: FlowField | None = None


def check_batch(batch: Any, scene: Any, has_trajectory: bool) -> None:
    """Raise ShapeError or DomainError with one sentence where poses, times and scenes do not belong
    together."""
    poses = batch.T_world_body
    if scene is None:
        raise DomainError(
            "the render stage has no scene; give Batch(scene=...) or System(scene=...)."
        )
    if poses is None:
        if not has_trajectory:
            raise DomainError(
                "the batch has no poses and the system no trajectory; give Batch(T_world_body=...) or "
                "System(trajectory=...)."
            )
        return
    check(poses, "... T 4 4", "the batch's poses", sizes={"T": len(batch.t_s)})


def scenes_of(scene: Any, poses: Tensor) -> list[tuple[Any, Tensor]]:
    """Pairs of a scene and its poses.

    Raises: ShapeError when there are several scenes, but not one per first index of the poses.
    """
    if not isinstance(scene, (tuple, list)):
        return [(scene, poses)]
    if poses.ndim < 4 or poses.shape[0] != len(scene):
        raise ShapeError(
            f"the batch has {len(scene)} scenes and poses of shape {tuple(poses.shape)}; their first axis must "
            "count the scenes: [scenes, ..., T, 4, 4]."
        )
    return list(zip(scene, poses, strict=True))
