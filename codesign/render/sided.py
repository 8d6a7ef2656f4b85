"""Emissive geometry whose surfaces may show one radiance from their front and another from behind."""

from collections.abc import Mapping
from typing import Any

from codesign.render.placed import Placement
from codesign.render.world import MitsubaScene


class SidedScene(MitsubaScene):
    """A MitsubaScene of which some shapes show light from behind too.

    Args: description: as for MitsubaScene. backs: area emitter of the back of each shape that has one, by its name.
      placement: turn of the scene's sky and factor on all its radiance; its shapes stand in the world already.
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
