"""Scenes in axes and a unit of their own, placed in the world: the rays go to the scene; and
emissive scenes that are placed already, whose surfaces may show one radiance from their front and
another from behind."""

import copy
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from codesign.checks import check_finite, check_positive
from codesign.errors import DomainError, GradientError
from codesign.render.world import MitsubaScene


@dataclass(frozen=True)
class Placement:
    """How a scene of its own axes and unit stands in the world. R_world_scene: [3, 3] rotation from
    its axes to the world's; unit_m: metres per unit of its lengths; gain: factor on its radiance.

    Raises: DomainError for a matrix that is no rotation, or a unit or gain that is not positive.
    """

    R_world_scene: Tensor
    unit_m: float = 1.0
    gain: float = 1.0

    def __post_init__(self):
        R = check_finite(self.R_world_scene, "placement: R_world_scene").double()
        if (
            R.shape != (3, 3)
            or float((R @ R.mT - torch.eye(3)).abs().max()) > 1e-6
            or torch.linalg.det(R) < 0
        ):
            raise DomainError(
                f"placement: R_world_scene must be a rotation [3, 3], got {R.tolist()}."
            )
        for name in ("unit_m", "gain"):
            check_positive(getattr(self, name), f"placement: {name}")

    def in_scene(self, direction: Any) -> Any:
        """World directions (drjit arrays) in the scene's axes."""
        rows = self.R_world_scene.mT.tolist()
        return type(direction)(
            *[r[0] * direction.x + r[1] * direction.y + r[2] * direction.z for r in rows]
        )


class PlacedScene:
    """A scene in axes and units of its own, seen by cameras in the world's metres.

    Args:
      scene: with ``radiance``, ``radiance_and_distance`` and ``hit``, such as a PathScene.
      placement: of it. Nothing of the scene is changed, so what depends on its size (media, bumps,
        point
    lamps) looks as in itself.
    Gradient: that of the scene.
    """

    def __init__(self, scene: Any, placement: Placement):
        self.scene = scene
        self.placement = placement
        self.dtype = scene.dtype

    @property
    def seed(self) -> int:
        """Of the scene's random numbers."""
        return self.scene.seed

    def with_seed(self, seed: int) -> "PlacedScene":
        """The same scene with other random numbers."""
        twin = copy.copy(self)
        twin.scene = self.scene.with_seed(seed)
        return twin

    def radiance(self, arr: Any, origin: Any, direction: Any) -> Any:
        """Radiance along world rays (drjit arrays)."""
        return self.placement.gain * self.scene.radiance(arr, *self._in_scene(origin, direction))

    def radiance_and_distance(self, arr: Any, origin: Any, direction: Any) -> Any:
        """Radiance as above, and the distance in metres to what is hit."""
        light, distance = self.scene.radiance_and_distance(arr, *self._in_scene(origin, direction))
        return self.placement.gain * light, self.placement.unit_m * distance

    def _in_scene(self, origin, direction):
        place = self.placement
        return place.in_scene(origin) / place.unit_m, place.in_scene(direction)

    def hit(self, origin_m: Tensor, direction: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """First surface met by world rays [N, 3]: point [N, 3], normal [N, 3], valid [N], as
        MitsubaScene has it."""
        R = self.placement.R_world_scene.to(origin_m)
        unit_m = self.placement.unit_m
        point, normal, valid = self.scene.hit((origin_m @ R) / unit_m, direction @ R.to(direction))
        return unit_m * (point @ R.mT.to(point)), normal @ R.mT.to(normal), valid

    def outline(self) -> Any:
        """Raises GradientError: curves are known of scenes in the world's own axes."""
        raise GradientError(
            "a placed scene has no outline and no gradient of silhouettes; choose a baked or emissive level, "
            "or gradient 'difference'."
        )


class SidedScene(MitsubaScene):
    """A MitsubaScene of which some shapes show light from behind too.

    Args:
      description: as for MitsubaScene.
      backs: area emitter of the back of each shape that has one, by its name.
      placement: turn of the scene's sky and factor on all its radiance; its shapes stand in the
        world already.
    """

    both_sides = True

    def __init__(
        self,
        description: Mapping[str, Any],
        backs: Mapping[str, Any],
        placement: Placement,
        device: str = "cpu",
    ):
        super().__init__(description, device, merge=False)
        self.placement = placement
        self.backs = dict(backs)

    def leaving(self, shape: Any, si: Any, ray: Any) -> Any:
        """Radiance of a shape towards the ray: of the side that it comes from."""
        import drjit as dr

        facing = -dr.dot(si.n, ray.d)
        back = self.backs.get(shape.id())
        light = self.emitted(shape, shape.emitter(), si, facing)
        if back is not None:
            light = dr.select(facing < 0, self.emitted(shape, back, si, -facing), light)
        return self.placement.gain * light

    def sky(self, direction: Any) -> Any:
        """Radiance of the sky that turns with the scene."""
        return self.placement.gain * super().sky(self.placement.in_scene(direction))
