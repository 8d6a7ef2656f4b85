"""Emissive textured geometry in Mitsuba: one ray cast and one texture lookup per ray."""

import torch

from codesign import backend
from codesign.errors import CodesignError, DomainError


class MitsubaScene:
    """A Mitsuba scene whose radiance is read directly from its emitters.

    Args: description: a Mitsuba scene dictionary; every shape carries an area emitter. device: "cpu" or "cuda".
    Computes in float32. Raises: DomainError when Mitsuba refuses the description.
    """

    dtype = torch.float32

    def __init__(self, description, device="cpu"):
        self.mi = backend.mitsuba(device)
        try:
            self.scene = self.mi.load_dict({"type": "scene", **description})
        except CodesignError:
            raise
        except Exception as error:  # Mitsuba raises plain RuntimeErrors of many lines
            raise DomainError(f"Mitsuba cannot build the scene: {str(error).splitlines()[0][:200]}") from error

    def radiance(self, arr, origin, direction):
        """Radiance along world rays (drjit arrays), 0 where nothing is hit. Gradient: to the rays, inside surfaces."""
        mi = self.mi
        ray = mi.Ray3f(mi.Point3f(origin), mi.Vector3f(direction))
        found = self.scene.ray_intersect_preliminary(ray, coherent=True)
        si = found.compute_surface_interaction(ray, mi.RayFlags.UV | mi.RayFlags.ShadingFrame | mi.RayFlags.Minimal)
        return si.emitter(self.scene).eval(si)[0]

    def hit(self, origin_m, direction):
        """First surface met by world rays [N, 3]: point [N, 3], normal [N, 3], valid [N]; no gradient, float64 out of float32 geometry."""
        mi = self.mi
        o, d = (part.detach().float().cpu().unbind(1) for part in (origin_m, direction))
        ray = mi.Ray3f(mi.Point3f(*[mi.Float(v.contiguous()) for v in o]), mi.Vector3f(*[mi.Float(v.contiguous()) for v in d]))
        si = self.scene.ray_intersect(ray)
        valid = torch.as_tensor(si.is_valid().numpy()).reshape(-1)
        t, normal = torch.as_tensor(si.t.numpy()).double(), torch.as_tensor(si.n.numpy()).double()
        t = torch.where(valid, t, torch.ones_like(t))
        return origin_m.detach() + direction.detach() * t[:, None], normal.T, valid
