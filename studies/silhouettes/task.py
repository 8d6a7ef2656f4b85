"""Frames of occluders over a wall, to the camera's pose and to the lens: one scene before one lens, the ways to its
gradient beside differences, and what the boundary term costs."""

import math

import torch

from codesign import lens, pose, render
from codesign.render.sequence import Way
from scenes import silhouettes as silhouette_scenes
from studies.frame.timing import measure

SIZE_PX = 32
PITCH_MM = 0.25
SAMPLES = 16
STEPS = {
    "pose": (2e-3,) * 6,
    "lens": (2e-4,) * 3 + (2e-2,) * 3,
}  # metres and radians; curvatures per mm, thicknesses mm
ROWS = (0, 2, 4), (1, 3, 5)  # curvatures, and thicknesses of which the last is the focus


class Task:
    """One scene before one lens; a weighted frame as a function of six numbers of the pose or of the lens."""

    def __init__(self, scene, kind):
        self.scene = scene
        self.lens = {
            "pinhole": lambda: lens.Pinhole(11.0),
            "thin": lambda: lens.ThinLens(11.0, 2.2, 11.06),
            "traced": lambda: lens.load("cooke-triplet").scaled(0.22).freeze(),
        }[kind]()
        self.pose = pose.look_at((0.05, -1.2, 1.0), (0.0, 1.0, 0.7))[None]
        coarse = torch.randn(1, 1, 6, 6, generator=torch.Generator().manual_seed(3))
        self.weight = torch.nn.functional.interpolate(coarse, size=(SIZE_PX, SIZE_PX), mode="bicubic")[0, 0]

    def loss(self, numbers, group, samples, seed, way: Way = "interior", per_px=2.5):
        optics = self.lens
        turn = torch.zeros(6, dtype=torch.float64)
        if group == "pose":
            turn = numbers
        else:
            base = torch.zeros(2, 6, dtype=torch.float64)
            change = base.index_put(
                (torch.tensor([0, 0, 0, 1, 1, 1]), torch.tensor([*ROWS[0], *ROWS[1]])), numbers
            )
            optics = self.lens.replace(
                curvature_per_mm=self.lens.curvature_per_mm + change[0],
                thickness_mm=self.lens.thickness_mm + change[1],
            )
        camera = render.Camera(optics, SIZE_PX, SIZE_PX, PITCH_MM, samples, seed)
        frames = render.frames(
            camera, self.scene, self.pose @ pose.se3_exp(turn[None]), gradient=way, per_px=per_px
        )
        return (self.weight * frames[0]).double().mean()

    def gradient(self, group, samples, seed, way: Way, per_px=2.5):
        start = torch.zeros(6, dtype=torch.float64, requires_grad=True)
        return torch.autograd.grad(self.loss(start, group, samples, seed, way, per_px), start)[0]

    def differences(self, group, samples, seed):
        found = []
        for step in torch.diag(torch.tensor(STEPS[group], dtype=torch.float64)):
            with torch.no_grad():
                found.append(
                    (self.loss(step, group, samples, seed) - self.loss(-step, group, samples, seed))
                    / (2 * step.sum())
                )
        return torch.stack(found)


def compare(run, task, scene, kind, group, many, seeds, seed):
    """One row: relative L2 errors of the ways against differences, scaled so that every number counts by its
    own step."""
    scale = torch.tensor(STEPS[group], dtype=torch.float64)
    truths = torch.stack([task.differences(group, many, seed + 100 + k) for k in range(seeds)]) * scale
    truth = truths.mean(0)
    error = truths.std(0) / math.sqrt(seeds)

    def away(g):
        return float((g * scale - truth).norm() / truth.norm())

    def mean(way):
        return torch.stack([task.gradient(group, many, seed + 200 + k, way, 64.0) for k in range(seeds)])

    interior = mean("interior")
    whole = mean("boundary")
    single = [away(task.gradient(group, SAMPLES, seed + 300 + k, "boundary")) for k in range(2 * seeds)]
    spread = (whole * scale).std(0) / math.sqrt(seeds)
    bias = (
        (whole.mean(0) * scale - truth) / (error.square() + spread.square()).sqrt().clamp_min(1e-30)
    ).tolist()
    found = {
        "interior": away(interior.mean(0)),
        "whole": away(whole.mean(0)),
        "single": sorted(single)[len(single) // 2],
        "noise": float(error.norm() / truth.norm()),
        "worst_bias": max(map(abs, bias)),
    }
    run.record(**{f"{scene}_{kind}_{group}_{name}": value for name, value in found.items()})
    return scene, kind, group, found


def cost():
    """Processor seconds of one step, forward and backward to pose and lens, without the boundary term and with it: 16
    frames of 96 x 96 pixels, 8 samples, triplet, room with two boxes; medians of one run, taken in turn."""
    scene = silhouette_scenes.room()
    optics = lens.load("cooke-triplet", torch.float32).scaled(0.22).freeze("conic", "asphere", "index_offset")
    camera = render.Camera(optics, 96, 96, PITCH_MM * SIZE_PX / 96, 8)
    shifts = torch.linspace(0, 0.1, 16, dtype=torch.float64)[:, None] * torch.tensor(
        [[1.0, 0, 0, 0, 0, 0]], dtype=torch.float64
    )
    path = pose.look_at((0.05, -1.2, 1.0), (0.0, 1.0, 0.7)) @ pose.se3_exp(shifts)

    def work(way):
        twist = torch.zeros(6, dtype=torch.float64, requires_grad=True)
        frames = render.frames(camera, scene, path @ pose.se3_exp(twist), gradient=way)
        torch.autograd.grad(
            frames.diff(dim=0).square().mean(), [twist, optics.curvature_per_mm, optics.thickness_mm]
        )

    turns = [
        [measure(lambda way=way: work(way), 3).cpu for way in ("interior", "boundary")] for _ in range(3)
    ]
    return [sorted(column)[1] for column in zip(*turns, strict=True)]
