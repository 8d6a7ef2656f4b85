"""A world with objects that move: every object is a scene in its own frame, with a pose per frame
of the sequence."""

import copy
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

import torch
from torch import Tensor

from codesign.errors import DomainError, ShapeError
from codesign.pose import Poses, as_poses, check_poses, inverse
from codesign.types import Rays


class Scene(Protocol):
    """Radiance along world rays, in drjit arrays of one dtype; ``hit`` as MitsubaScene has it for
    truth."""

    @property
    def dtype(self) -> torch.dtype: ...

    @property
    def radiance(self) -> Callable[..., Any]: ...


def check_kind(scene: Any) -> None:
    """Raise DomainError for what is no scene: neither ``radiance`` nor ``hit`` can be asked of
    it."""
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
    raise DomainError(
        f"the scene is a {kind}, which has no radiance that could be rendered; {cure}."
    )


class MovingScene:
    """A static scene and rigid objects that move through it; what is nearest along a ray is seen.

    Args:
      static: a scene in world axes (MitsubaScene, TexturedPlane). Where a ray meets nothing at all,
        the background of this scene is seen.
      objects: {name: (scene in the object's own axes, T_world_object [T, 4, 4])}, the same T for
        all; frame t of a sequence has its objects at pose t. Before cameras on several trajectories
        [..., T, 4, 4] objects move the same way for each, or, with poses [..., T, 4, 4] too, their
        own way.
    Computes in float32 when one of the scenes does, otherwise in float64.
    Gradient: to T_world_object, as to the camera's poses; silhouettes with gradient "boundary".
    Raises: DomainError when poses are not rigid or a scene cannot say how far away it is;
      ShapeError when the numbers of poses differ.
    """

    def __init__(self, static: Scene, objects: Mapping[str, tuple[Scene, Poses]]):
        if not isinstance(objects, Mapping) or not all(
            isinstance(pair, tuple | list) and len(pair) == 2 for pair in objects.values()
        ):
            raise DomainError(
                "moving scene: objects are a dictionary {name: (scene, T_world_object [T, 4, 4])}; give a "
                "scene and poses for each name."
            )
        self.static = static
        self.names = tuple(objects)
        self.scenes = (static, *(scene for scene, _ in objects.values()))
        for name, scene in zip(("static", *self.names), self.scenes, strict=True):
            if isinstance(scene, MovingScene):
                raise DomainError(
                    f"moving scene: part '{name}' is itself a moving scene; give its objects one by one, "
                    "with poses in the world."
                )
            check_kind(scene)
            if not says_distance(type(scene)):
                raise DomainError(
                    f"moving scene: part '{name}', a {type(scene).__name__}, does not say how far away its "
                    "light comes from; give a MitsubaScene or a TexturedPlane."
                )
        self.T_world_object = tuple(_checked(name, poses) for name, (_, poses) in objects.items())
        lengths = {
            name: poses.shape[-3]
            for name, poses in zip(self.names, self.T_world_object, strict=True)
        }
        if len(set(lengths.values())) > 1:
            raise ShapeError(
                f"moving scene: the objects have {lengths} poses; give each one pose per frame."
            )
        self.dtype = (
            torch.float32
            if any(scene.dtype == torch.float32 for scene in self.scenes)
            else torch.float64
        )

    def during(self, frames: slice | Sequence[int]) -> "MovingScene":
        """The same scene for some of the frames only: a slice or a list of frame numbers."""
        return self._with(poses[..., frames, :, :] for poses in self.T_world_object)

    def _with(self, poses):
        twin = copy.copy(self)
        twin.T_world_object = tuple(poses)
        return twin

    def check_length(self, count: int) -> None:
        """Raise ShapeError unless every object has ``count`` poses."""
        for name, poses in zip(self.names, self.T_world_object, strict=True):
            if poses.shape[-3] != count:
                raise ShapeError(
                    f"moving scene: object '{name}' has {poses.shape[-3]} poses for {count} frames; give one "
                    "per frame, or cut the scene with ``during``."
                )

    def in_one_row(self, batch: Sequence[int]) -> "MovingScene":
        """The same scene for the frames of all trajectories of a batch of shape (..., T), one after
        the
        other: every object has as many poses as there are frames in all."""
        self.check_length(batch[-1])
        for name, poses in zip(self.names, self.T_world_object, strict=True):
            own = poses.shape[:-3]
            if len(own) >= len(batch) or any(
                n not in (1, m) for n, m in zip(reversed(own), reversed(batch[:-1]), strict=False)
            ):
                raise ShapeError(
                    f"moving scene: object '{name}' has poses for a batch {tuple(own)} of trajectories, the "
                    f"camera for {tuple(batch[:-1])}; give one trajectory for all, or one for each."
                )
        return self._with(
            poses.expand(*batch, 4, 4).reshape(-1, 4, 4) for poses in self.T_world_object
        )


def parts(scene: Any) -> tuple[Any, ...]:
    """The scenes a scene is made of: itself, or the static one and then the objects in order."""
    return scene.scenes if isinstance(scene, MovingScene) else (scene,)


def scenes_and_poses(scene: Any, T_world_cam: Poses) -> list[tuple[Any, Tensor]] | None:
    """Pairs of a scene and the poses it is seen from, along the first axis of T_world_cam
    [W, ..., T, 4, 4], where ``scene`` is a list or tuple of W scenes; None for a single scene."""
    if not isinstance(scene, list | tuple):
        return None
    T_world_cam = as_poses(T_world_cam)
    if T_world_cam.ndim < 4 or len(scene) != T_world_cam.shape[0]:
        raise ShapeError(
            f"{len(scene)} scenes for poses {tuple(T_world_cam.shape)}: give one scene for all trajectories, "
            "or one for each entry of the first axis of poses [scenes, ..., T, 4, 4]."
        )
    return list(zip(scene, T_world_cam, strict=True))


@dataclass(frozen=True)
class Views:
    """A scene as all frames of all trajectories see it, N frames one after the other.

    scene: with the poses of its objects in these frames. T_world_part: [parts, N, 4, 4], the
    identity for the static part. cameras: [parts, N, 4, 4], poses of the camera in the axes of
    every part. batch: (..., T).
    float64.
    """

    scene: Any
    T_world_part: Tensor
    cameras: Tensor
    batch: tuple[int, ...]

    @property
    def T_world_cam(self) -> Tensor:
        """Poses of the camera in the world, [N, 4, 4]."""
        return self.cameras[0]

    def detach(self) -> "Views":
        """The same views without a gradient to the camera."""
        return replace(self, cameras=self.cameras.detach())


def views_of(scene: Any, T_world_cam: Poses, rays: Rays | None = None) -> Views:
    """Views of a scene from trajectories [..., T, 4, 4]: the one place where poses are checked and
    brought into the axes of every part. rays: of the camera, which must be on one device with them.

    Raises: DomainError for what is no scene or no poses; ShapeError unless every object has a pose
      for every frame.
    """
    for part in parts(scene):
        check_kind(part)
    T_world_cam = as_poses(T_world_cam)
    if rays is not None and rays.weight.device != T_world_cam.device:
        raise DomainError(
            f"poses are on {T_world_cam.device}, the rays of the camera on {rays.weight.device}; move one to the "
            "other with .to(device)."
        )
    check_poses(T_world_cam)
    batch = tuple(T_world_cam.shape[:-2])
    cameras = T_world_cam.reshape(-1, 4, 4).double()
    still = torch.eye(4, dtype=torch.float64, device=cameras.device).expand(len(cameras), 4, 4)
    if not isinstance(scene, MovingScene):
        return Views(scene, still[None], cameras[None], batch)
    scene = scene.in_one_row(batch)
    objects = [poses.to(cameras) for poses in scene.T_world_object]
    seen = [_product(inverse(poses), cameras) for poses in objects]
    return Views(scene, torch.stack([still, *objects]), torch.stack([cameras, *seen]), batch)


def _product(a, b):
    """a b [..., 4, 4] written out by element: a matrix product may round differently in another
    batch."""
    x, y, z, w = (a[..., :, k : k + 1] * b[..., k : k + 1, :] for k in range(4))
    return x + y + z + w


def at_frames(scene: Any, frames: slice | Sequence[int]) -> Any:
    """A scene for some frames of a sequence: moving ones are cut, still ones are what they are."""
    return scene.during(frames) if isinstance(scene, MovingScene) else scene


def says_distance(kind):
    """Whether a class has a ``radiance_and_distance`` beside its ``radiance``: one inherited from
    further up would tell of other light."""
    owner = next((base for base in kind.__mro__ if "radiance" in vars(base)), None)
    return owner is not None and "radiance_and_distance" in vars(owner)


def _checked(name, poses):
    try:
        return check_poses(poses)
    except (DomainError, ShapeError) as error:
        raise type(error)(f"moving scene: object '{name}': {error}") from error
