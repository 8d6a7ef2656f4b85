"""What the core alone must do, run where no extra is installed: every room is imported, a frame
goes through events and flow to a gradient of the lens, the delivered network is there, and a
missing package is named."""

from importlib.util import find_spec
from pathlib import Path

import torch

import codesign
from codesign import events, flow, lens, pose, render
from codesign.errors import MissingPackageError

codesign.shipped.on_path()
from scenes import textures, trajectories, worlds  # noqa: E402

for package in (
    "h5py",
    "hdf5plugin",
    "lz4",
    "zstandard",
    "imageio_ffmpeg",
    "tensorboard",
    "onnx",
    "pytest",
):
    assert find_spec(package) is None, f"{package} is no part of the core, but was installed"
for name in codesign.__all__:
    getattr(codesign, name)
assert Path(codesign.__file__).with_name("py.typed").is_file()

camera = render.Camera(lens.load("cooke-triplet").scaled(0.22), 32, 32, 0.037, 4)
wall = worlds.wall(textures.shrunk(textures.photo("gravel"), 2), texel_m=0.003)
t_s = torch.linspace(0, 0.05, 5, dtype=torch.float64)
poses = trajectories.translation(pose.look_at((0, -2, 0), (0, 0, 0)), (0.3, 0.1, 0.0), t_s)
frames = render.frames(camera, wall, poses)
counts, _ = events.memory(frames, 0.2, 0.2)
field = flow.estimate_lk(events.from_counts(counts, t_s, bins=4))
field.flow_px.square().mean().backward()
slope = camera.lens.curvature_per_mm.grad
assert slope is not None
assert 0 < float(slope.norm()) < float("inf"), (
    "the flow has a gradient with respect to the curvatures"
)

assert sum(weight.numel() for weight in flow.load("refiner").parameters()) > 1000
zero = torch.zeros(1, dtype=torch.int64)
said = ""
try:
    events.write("events.aedat4", codesign.types.EventStream(zero, zero, zero, zero + 1, 2, 2))
except MissingPackageError as error:
    said = str(error)
assert (
    said
    == "reading and writing .aedat4 needs lz4; install it with: pip install 'codesign[event-files]'"
)
