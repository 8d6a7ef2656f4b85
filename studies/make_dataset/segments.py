"""Which shape of a scene lies under a pixel."""

import torch

from codesign.render.hits import turned
from codesign.render.moving import parts, views_of


class Segments:
    """Which shape of a scene lies under a pixel. names: "part/shape" in order of their numbers; a
    part that is one surface has one segment."""

    def __init__(self, scene):
        self.names = []
        self._parts = []
        for label, part in zip(("static", *getattr(scene, "names", ())), parts(scene), strict=True):
            shapes = (
                sorted(part.scene.shapes(), key=lambda shape: shape.id())
                if hasattr(part, "scene") and hasattr(part, "mi")
                else []
            )
            self._parts.append((part, shapes, len(self.names)))
            self.names += [f"{label}/{shape.id()}" for shape in shapes] or [label]

    def at(self, rays, scene, T_world_cam, object_id):
        """Numbers [F, H, W] of the segments that rays of all pixels meet in F frames; object_id [F,
        H, W] is the number of the part that is met first. scene: as it is in these frames.
        T_world_cam: [F, 4, 4]."""
        owner = object_id.flatten(1)
        found = torch.full_like(owner, -1, dtype=torch.int64)
        cameras = views_of(scene, T_world_cam).cameras[:, :, None]
        for number, ((part, shapes, first), pose) in enumerate(
            zip(self._parts, cameras, strict=True)
        ):
            met = owner == number
            if not shapes or not met.any():
                found = torch.where(met, first, found)
                continue
            origin = turned(pose, rays.origin_m.double()) + pose[..., :3, 3]
            direction = turned(pose, rays.direction.double())
            found = torch.where(
                met,
                first
                + _shape_of(part, shapes, origin.reshape(-1, 3), direction.reshape(-1, 3)).reshape(
                    owner.shape
                ),
                found,
            )
        return found.reshape(object_id.shape)


def _shape_of(part, shapes, origin_m, direction):
    """Index into ``shapes`` of what rays [N, 3] meet first, [N]."""
    import drjit as dr

    mi = part.mi
    o, d = (
        [mi.Float(v.float().contiguous()) for v in values.unbind(1)]
        for values in (origin_m, direction)
    )
    met = part.scene.ray_intersect_preliminary(
        mi.Ray3f(mi.Point3f(*o), mi.Vector3f(*d)), coherent=True
    ).shape
    index = mi.Int32(0)
    for number, shape in enumerate(shapes):
        index = dr.select(met == mi.ShapePtr(shape), number, index)
    return torch.as_tensor(index.numpy()).long().to(origin_m.device)
