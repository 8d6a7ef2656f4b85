"""What the renderer asks of lenses, scenes and paths, so that a user's own fit."""

from collections.abc import Callable, Mapping
from typing import Any, Protocol, TypeAlias

import torch
from torch import Tensor

from codesign.errors import DomainError
from codesign.types import Rays


class Lens(Protocol):
    """camera_rays(film_mm [N, 2], pupil [N, 2], aim=...) -> Rays [N], as GeoLens has it; ``dtype`` where it is
    not float64, ``film_points`` for a first guess where gradients of silhouettes are asked for,
    ``entrance_pupil_diameter_mm`` where there is an aperture."""

    @property
    def camera_rays(self) -> Callable[..., Rays]: ...


class Scene(Protocol):
    """Radiance along world rays, in drjit arrays of one dtype; ``hit`` as MitsubaScene has it for truth."""

    @property
    def dtype(self) -> torch.dtype: ...

    @property
    def radiance(self) -> Callable[..., Any]: ...


def check_kind(scene: Any) -> None:
    """Raise DomainError for what is no scene: neither ``radiance`` nor ``hit`` can be asked of it."""
    if (hasattr(scene, "radiance") or hasattr(scene, "hit")) and not isinstance(scene, type):
        return
    kind = type(scene).__name__
    if isinstance(scene, type):
        cure = f"make one, as by {scene.__name__}(...)"
    elif isinstance(scene, Mapping):
        cure = "render.MitsubaScene(description) builds one"
    elif type(scene).__module__.startswith("mitsuba"):
        cure = "worlds.from_mitsuba(scene) makes one of it"
    else:
        cure = "give a MitsubaScene, TexturedPlane or MovingScene, or a list of them"
    raise DomainError(f"the scene is a {kind}, which has no radiance that could be rendered; {cure}.")


# times [n] in seconds to T_world_cam [..., n, 4, 4]
Trajectory: TypeAlias = Callable[[Tensor], Tensor]
