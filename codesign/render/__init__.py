"""Cameras, scenes and frames: one wavefront for all frames, ground truth through the current lens."""

from codesign.render import truth
from codesign.render.camera import Camera, Film, angular_miss_rad, project
from codesign.render.planes import TexturedPlane
from codesign.render.wavefront import frames, shade
from codesign.render.world import MitsubaScene


def true_flow(camera, scene, T_world_cam, stride=1):
    """Flow [T - stride, 2, *film.shape] px and valid mask through the camera's lens; see codesign.render.truth."""
    return truth.true_flow(camera, scene, T_world_cam, project, stride)


__all__ = ["Camera", "Film", "MitsubaScene", "TexturedPlane", "angular_miss_rad", "frames", "project", "shade", "true_flow", "truth"]
