"""What a Mitsuba scene's shapes are told apart by, and the box around them."""

from typing import Any

ROOM = 1e-3  # of the diagonal


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
