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
        import drjit as dr

        super().__init__(description, device, merge=False)
        mi = self.mi
        self.placement = placement
        self.backs = dict(backs)  # alive as long as the table that points to them
        shapes = {
            shape.id(): int(dr.reinterpret_array(mi.UInt32, mi.ShapePtr(shape))[0])
            for shape in self.scene.shapes()
        }
        table = [0] * (1 + max(shapes.values(), default=0))
        for name, back in self.backs.items():
            table[shapes[name]] = int(dr.reinterpret_array(mi.UInt32, mi.EmitterPtr(back))[0])
        self.table = mi.UInt32(table)

    def emitted(self, arr: Any, si: Any, ray: Any) -> Any:
        """Radiance of what is met towards the ray: of the side that it comes from."""
        import drjit as dr

        mi = self.mi
        met = si.is_valid()
        facing = -dr.dot(si.n, ray.d)
        number = dr.gather(mi.UInt32, self.table, dr.reinterpret_array(mi.UInt32, si.shape), met)
        behind = met & (facing < 0) & (number != 0)
        emitter = dr.select(behind, dr.reinterpret_array(mi.EmitterPtr, number), si.emitter(self.scene))
        si.wi = dr.select(
            met,
            mi.Vector3f(0, 0, dr.select(behind, -facing, facing)),
            mi.Vector3f(self.placement.in_scene(arr, -ray.d)),
        )
        return self.placement.gain * emitter.eval(si)[0]
