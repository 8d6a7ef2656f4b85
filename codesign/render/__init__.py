"""Cameras, scenes and frames: one wavefront for all frames, ground truth through the current
lens."""

from codesign.doors import explain
from codesign.render import sequence, truth
from codesign.render.camera import Camera, angular_miss_rad, project
from codesign.render.film import Film
from codesign.render.moving import MovingScene
from codesign.render.planes import TexturedPlane
from codesign.render.projection import ProjectionTable
from codesign.render.psf_frames import psf_frames
from codesign.render.psf_map import PsfMap, psf_map
from codesign.render.sequence import frames
from codesign.render.time import adaptive_times, exposed_frames, frame_chunks
from codesign.render.truth import (
    FlowTruth,
    FramesTruth,
    View,
    camera_velocity,
    flow_and_occlusion,
    true_flow,
    truth_of_frames,
    view,
)
from codesign.render.wavefront import shade
from codesign.render.world import MitsubaScene

__all__ = [
    "Camera",
    "Film",
    "FlowTruth",
    "FramesTruth",
    "MitsubaScene",
    "MovingScene",
    "ProjectionTable",
    "PsfMap",
    "TexturedPlane",
    "View",
    "adaptive_times",
    "angular_miss_rad",
    "camera_velocity",
    "exposed_frames",
    "flow_and_occlusion",
    "frame_chunks",
    "frames",
    "project",
    "psf_frames",
    "psf_map",
    "sequence",
    "shade",
    "true_flow",
    "truth",
    "truth_of_frames",
    "view",
]

explain(globals())
