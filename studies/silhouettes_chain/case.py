"""A room with two boxes before a lens: frames, events, flow and loss as a function of nine numbers of the camera, the
ways to its gradient, and its differences with common random numbers."""

import math
from collections.abc import Callable

import torch
from torch import Tensor

from codesign import events, flow, lens, pose, render
from codesign.render.sequence import Way
from scenes.silhouettes import room

WIDTH_MM = 8.0  # of the film
FRAMES = 12
DURATION_S = 0.05
BINS = 4
THETA = 0.15
MISMATCH = 0.03  # of thresholds, from pixel to pixel
# metres and radians, then two curvatures per mm and the focus in mm: each moves the image by 0.1 to 0.3 px of 48, or
# changes its blur by about as much
STEPS = torch.tensor([*(4e-3,) * 3, *(2e-3,) * 3, 2e-4, 2e-4, 2e-2], dtype=torch.float64)
GROUPS = {"pose": slice(0, 6), "lens": slice(6, 9)}
CURVATURES = (0, 2)
FOCUS = 5
Losses = dict[str, Callable[[Tensor], Tensor]]


class Case:
    """One draw of textures, path, thresholds and weights before the traced triplet, for films of size_px pixels a
    side."""

    def __init__(self, seed: int, size_px: int):
        self.size_px = size_px
        self.scene = room(seed)
        self.lens = lens.load("cooke-triplet").scaled(0.22).freeze()
        draw = torch.Generator().manual_seed(seed)
        angle = 2 * math.pi * float(torch.rand((), generator=draw))
        shift = torch.tensor(
            [0.15 * math.cos(angle), 0.15 * math.sin(angle), 0.1, 0.02, -0.03, 0.04], dtype=torch.float64
        )
        # rolled, so that no edge of the room follows a row of pixels
        start = pose.look_at((0.05, -1.2, 1.0), (0.1, 1.0, 0.75), down=(0.08, 0.0, -1.0))
        along = torch.linspace(-0.5, 0.5, FRAMES, dtype=torch.float64)
        self.path = start @ pose.se3_exp(along[:, None] * shift)
        self.t_s = torch.linspace(0, DURATION_S, FRAMES, dtype=torch.float64)
        shape = (size_px, size_px)
        self.theta = THETA * (1 + MISMATCH * torch.randn(shape, generator=draw))
        coarse = torch.randn(1, 2 * BINS, 5, 5, generator=draw)
        smooth = torch.nn.functional.interpolate(coarse, size=shape, mode="bicubic", align_corners=True)
        self.weight = smooth.reshape(2, BINS, *shape)
        with torch.no_grad():
            camera = self.camera(torch.zeros(9, dtype=torch.float64), 1, 0)
            self.target, self.known = render.true_flow(camera, self.scene, self.path[[0, -1]])

    def camera(self, numbers: Tensor, samples: int, seed: int) -> render.Camera:
        """The camera with curvatures and focus changed by numbers[6:]."""
        change = torch.zeros(6, dtype=torch.float64)
        optics = self.lens.replace(
            curvature_per_mm=self.lens.curvature_per_mm
            + change.index_put((torch.tensor(CURVATURES),), numbers[6:8]),
            thickness_mm=self.lens.thickness_mm + change.index_put((torch.tensor([FOCUS]),), numbers[8:]),
        )
        return render.Camera(optics, self.size_px, self.size_px, WIDTH_MM / self.size_px, samples, seed)

    def frames(
        self, numbers: Tensor, samples: int, seed: int, way: Way = "interior", per_px: float = 2.5
    ) -> Tensor:
        """Frames [T, H, W] from a path moved, in the camera's own axes, by the twist numbers[:6]."""
        moved = self.path @ pose.se3_exp(numbers[None, :6])
        camera = self.camera(numbers, samples, seed)
        return render.frames(camera, self.scene, moved, gradient=way, per_px=per_px)

    def places(self, count: int, seed: int) -> Tensor:
        """Where pixels stand inside their threshold, [K, H, W] in -1/2..1/2: each goes through K even places, in an
        order of its own."""
        draw = torch.Generator().manual_seed(seed)
        shape = self.theta.shape
        order = torch.rand(count, *shape, generator=draw).argsort(0)
        return (order + torch.rand(shape, generator=draw)) / count - 0.5

    def losses(self, places: Tensor) -> Losses:
        """Name -> function of frames: a weighted event volume, and the flow's error, of smooth and of hard counts;
        "hard flow, one place" is that of the first place alone."""
        return {
            "smooth counts": lambda frames: self.weighted(self.smooth(frames)),
            "smooth flow": lambda frames: self.flow_error(self.smooth(frames)),
            "hard counts": lambda frames: self.weighted(self.hard(frames, places)),
            "hard flow": lambda frames: self.flow_error(self.hard(frames, places)),
            "hard flow, one place": lambda frames: self.flow_error(self.hard(frames, places[:1])),
        }

    def smooth(self, frames: Tensor) -> Tensor:
        """Counts [T - 1, 2, H, W] without quantisation."""
        return events.soft_counts(frames, self.theta, self.theta)

    def hard(self, frames: Tensor, places: Tensor) -> Tensor:
        """Whole counts [T - 1, 2, K, H, W]; the gradient is that of their mean over all places."""
        first = events.lin_log(frames[:1])[0]
        begun = torch.stack((first + places * self.theta, first.expand_as(places)))
        later = frames[1:, None].expand(-1, *places.shape)
        theta = self.theta.expand_as(places)
        return events.memory(later, theta, theta, state=begun)[0]

    def weighted(self, counts: Tensor) -> Tensor:
        """Event volume under a smooth random weight, mean over places."""
        volume = events.from_counts(counts, self.t_s, BINS).counts.double()
        return (volume * self.weight).sum((1, 2)).mean()

    def flow_error(self, counts: Tensor) -> Tensor:
        """Mean square error of the flow, px2, against what is true where the camera stands unmoved."""
        found = flow.estimate_lk(events.from_counts(counts, self.t_s, BINS), "affine").flow_px
        return ((found - self.target) * self.known[:, None]).double().square().mean()

    def gradients(
        self, losses: Losses, samples: int, seed: int, way: Way, per_px: float
    ) -> dict[str, Tensor]:
        """Gradient [9] per step of every number, of every loss: one trace of the frames serves all."""
        numbers = torch.zeros(9, dtype=torch.float64, requires_grad=True)
        frames = self.frames(numbers, samples, seed, way, per_px)
        found = {}
        for name, loss in losses.items():
            leaf = frames.detach().requires_grad_()
            (pull,) = torch.autograd.grad(loss(leaf), leaf)
            found[name] = torch.autograd.grad(frames, numbers, pull, retain_graph=True)[0] * STEPS
        return found

    @torch.no_grad()
    def differences(self, losses: Losses, samples: int, seed: int) -> dict[str, Tensor]:
        """Central differences [9] over a step of every number either way, per step."""
        found: dict[str, list[Tensor]] = {name: [] for name in losses}
        for step in torch.diag(STEPS):
            ahead, behind = (self.frames(sign * step, samples, seed) for sign in (1, -1))
            for name, loss in losses.items():
                found[name].append((loss(ahead) - loss(behind)) / 2)
        return {name: torch.stack(values) for name, values in found.items()}
