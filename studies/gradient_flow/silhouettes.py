"""Frames of occluders over a wall, to the camera's pose and to the lens: one scene before one lens,
and the ways to its gradient beside differences with common random numbers."""

import math

import torch

from codesign import lens, pose, render
from codesign.render.sequence import Way
from scenes import silhouettes as silhouette_scenes
from studies.gradient_flow.topic import Asked, Row, Topic

SIZE_PX = 32
PITCH_MM = 0.25
SAMPLES = 16  # per pixel of one estimate as an optimiser takes it
PER_PX = 64.0  # of the precise ones
# metres and radians; curvatures per mm, thicknesses mm
STEPS = {
    "pose": (2e-3,) * 6,
    "lens": (2e-4,) * 3 + (2e-2,) * 3,
}
ROWS = (0, 2, 4), (1, 3, 5)  # curvatures, and thicknesses of which the last is the focus


class Task:
    """One scene before one lens; a weighted frame as a function of six numbers of the pose or of
    the lens."""

    def __init__(self, scene, kind):
        self.scene = scene
        self.lens = {
            "pinhole": lambda: lens.Pinhole(11.0),
            "thin": lambda: lens.ThinLens(11.0, 2.2, 11.06),
            "traced": lambda: lens.load("cooke-triplet").scaled(0.22).freeze(),
        }[kind]()
        self.pose = pose.look_at((0.05, -1.2, 1.0), (0.0, 1.0, 0.7))[None]
        coarse = torch.randn(1, 1, 6, 6, generator=torch.Generator().manual_seed(3))
        self.weight = torch.nn.functional.interpolate(
            coarse, size=(SIZE_PX, SIZE_PX), mode="bicubic"
        )[0, 0]

    def loss(self, numbers, group, samples, seed, way: Way = "interior", per_px=2.5):
        optics, turn = self.lens, numbers
        if group == "lens":
            turn = torch.zeros(6, dtype=torch.float64)
            curved, thick = (
                turn.index_put((torch.tensor(rows),), mine)
                for rows, mine in zip(ROWS, numbers.split(3), strict=True)
            )
            optics = self.lens.replace(
                curvature_per_mm=self.lens.curvature_per_mm + curved,
                thickness_mm=self.lens.thickness_mm + thick,
            )
        camera = render.Camera(optics, SIZE_PX, SIZE_PX, PITCH_MM, samples, seed)
        frames = render.frames(
            camera, self.scene, self.pose @ pose.se3_exp(turn[None]), gradient=way, per_px=per_px
        )
        return (self.weight * frames[0]).double().mean()

    def gradient(self, group, samples, seed, way: Way, per_px=2.5):
        start = torch.zeros(6, dtype=torch.float64, requires_grad=True)
        return torch.autograd.grad(self.loss(start, group, samples, seed, way, per_px), start)[0]

    @torch.no_grad()
    def differences(self, group, samples, seed):
        found = []
        for step in torch.diag(torch.tensor(STEPS[group], dtype=torch.float64)):
            ahead, behind = (self.loss(way, group, samples, seed) for way in (step, -step))
            found.append((ahead - behind) / (2 * step.sum()))
        return torch.stack(found)


def judged(values):
    """Relative L2 errors against differences, noises and cosines out of values [seeds, 4, n]: of
    differences, interior gradients, those with the boundary term and single estimates of it."""
    truth, interior, boundary, _ = values.mean(0)
    size = float(truth.norm())
    noise = values.std(0).norm(dim=1) / (math.sqrt(len(values)) * size)
    single = (values[:, 3] - truth).norm(dim=1) / size
    return {
        "interior_only": float((interior - truth).norm()) / size,
        "with_boundary": float((boundary - truth).norm()) / size,
        "one_estimate": float(single.median()),
        "noise": float(noise[0]),
        "noise_with_boundary": float(noise[2]),
        "cosine_interior": float(interior @ truth / interior.norm()) / size,
        "cosine": float(boundary @ truth / boundary.norm()) / size,
    }


def measure(config, scene, kind, group):
    """Relative L2 errors of the ways against differences, scaled so that every number counts by its
    own step."""
    task = Task(silhouette_scenes.build(scene), kind)

    def estimates(seed):
        ways = [
            task.differences(group, config.samples, 100 + seed),
            task.gradient(group, config.samples, 200 + seed, "interior", PER_PX),
            task.gradient(group, config.samples, 200 + seed, "boundary", PER_PX),
            task.gradient(group, SAMPLES, 300 + seed, "boundary"),
        ]
        return torch.stack(ways) * torch.tensor(STEPS[group], dtype=torch.float64)

    values = torch.stack([estimates(config.seed + number) for number in range(config.seeds)])
    yield Row((scene, kind, group), judged(values))


def jobs(quick):
    if quick:
        return [
            ("cubes", "pinhole", "pose"),
            ("cubes", "traced", "lens"),
            ("poles", "traced", "lens"),
        ]
    return [
        (scene, kind, group)
        for scene in silhouette_scenes.NAMES
        for kind in ("pinhole", "thin", "traced")
        if kind != "thin" or scene == "cubes"
        for group in ("pose", "lens")
        if group == "pose" or kind == "traced"
    ]


def asked(row):
    """3 % of many samples, 10 % of one estimate; half a per cent where there is a wall alone."""
    alone = row.names == ("wall", "pinhole", "pose")
    return Asked({}, {"with_boundary": 0.005 if alone else 0.03, "one_estimate": 0.10})


TOPIC = Topic(
    "Where objects hide one another",
    "Frames of occluders over a wall, to the camera's pose and to three curvatures and thicknesses of its "
    "lens; the loss is a fixed smooth weighting of one frame. Relative L2 errors of the interior gradient "
    "(plain automatic differentiation), of the one with the boundary term, and of single estimates of "
    f"{SAMPLES} samples (median); noise of the differences.",
    ("scene", "lens", "to"),
    jobs,
    measure,
    asked,
)
