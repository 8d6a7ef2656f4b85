"""What the renderer asks of lenses, scenes and paths, so that a user's own fit."""

from collections.abc import Callable
from typing import Any, Protocol, TypeAlias

import torch
from torch import Tensor

from codesign.types import Rays


class Lens(Protocol):
    """camera_rays(film_mm [N, 2], pupil [N, 2], aim=...) -> Rays [N], as GeoLens has it; ``dtype`` where it is
    not float64, ``film_points`` where gradients of silhouettes are asked for, ``entrance_pupil_diameter_mm``
    where there is an aperture."""

    @property
    def camera_rays(self) -> Callable[..., Rays]: ...


class Scene(Protocol):
    """Radiance along world rays, in drjit arrays of one dtype; ``hit`` as MitsubaScene has it for truth."""

    @property
    def dtype(self) -> torch.dtype: ...

    @property
    def radiance(self) -> Callable[..., Any]: ...


# times [n] in seconds to T_world_cam [..., n, 4, 4]
Trajectory: TypeAlias = Callable[[Tensor], Tensor]
