"""Light of single surfaces together with its slopes to the ray: one visit of the surface for both."""

from collections.abc import Callable
from typing import Any

ROOM = 1e-3  # of the diagonal


def with_slopes(shown: Callable[..., Any]) -> Callable[..., Any]:
    """A function (origin, direction, *others) -> (light, normal) of drjit arrays as one that returns light, normal,
    and the slopes of light to origin and direction, all without a graph.

    Automatic differentiation through a call visits the surface again for the adjoint; here it ends inside the call.
    """

    def sloped(origin, direction, *others):
        import drjit as dr

        origin = type(origin)(origin)
        direction = type(direction)(direction)
        with dr.resume_grad():
            dr.enable_grad(origin, direction)
            light, normal = shown(origin, direction, *others)
            if dr.grad_enabled(light):
                dr.backward(light)
            return dr.detach(light), dr.detach(normal), dr.grad(origin), dr.grad(direction)

    return sloped


def shape_numbers(mi: Any, scene: Any) -> Any:
    """Numbers of the shapes of a Mitsuba scene in its own list, behind what their pointers hold (drjit array)."""
    import drjit as dr

    held = [int(dr.reinterpret_array(mi.UInt32, mi.ShapePtr(shape))[0]) for shape in scene.shapes()]
    table = [0] * (1 + max(held, default=0))
    for number, place in enumerate(held):
        table[place] = number
    return mi.UInt32(table)


def box_around(mi: Any, scene: Any) -> Any:
    """Box (drjit arrays) with room for rounding around all shapes of a Mitsuba scene; None under a sky, where rays
    start inside."""
    import drjit as dr

    box = scene.bbox()
    if scene.environment() is not None or not box.valid():
        return None
    room = ROOM * float(dr.norm(box.extents()))
    found = mi.BoundingBox3f(mi.Point3f(box.min - room), mi.Point3f(box.max + room))
    dr.make_opaque(found)  # another scene needs no new kernel
    return found
