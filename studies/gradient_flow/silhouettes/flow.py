"""A room with two boxes before a lens: frames, events, flow and loss as a function of nine numbers
of the camera, the ways to its gradient, and its differences with common random numbers."""

import math
from collections.abc import Callable

import torch
from torch import Tensor

from codesign import events, flow, lens, pose, render
from codesign.render.sequence import Way
from scenes.silhouettes import room
from studies.gradient_flow.topic import Asked, Row, Topic

WIDTH_MM = 8.0  # of the film
FRAMES = 12
DURATION_S = 0.05
BINS = 4
THETA = 0.15
MISMATCH = 0.03  # of thresholds, from pixel to pixel
# metres and radians, then two curvatures per mm and the focus in mm: each moves the image by 0.1 to
# 0.3 px of 48, or changes its blur by about as much
STEPS = torch.tensor([*(4e-3,) * 3, *(2e-3,) * 3, 2e-4, 2e-4, 2e-2], dtype=torch.float64)
GROUPS = {"pose": slice(0, 6), "lens": slice(6, 9)}
CURVATURES = (0, 2)
FOCUS = 5
Losses = dict[str, Callable[[Tensor], Tensor]]


class Case:
    """One draw of textures, path, thresholds and weights before the traced triplet, for films of
    size_px pixels a side."""

    def __init__(self, seed: int, size_px: int):
        self.size_px = size_px
        self.scene = room(seed)
        self.lens = lens.load("cooke-triplet").scaled(0.22).freeze()
        draw = torch.Generator().manual_seed(seed)
        angle = 2 * math.pi * float(torch.rand((), generator=draw))
        shift = torch.tensor(
            [0.15 * math.cos(angle), 0.15 * math.sin(angle), 0.1, 0.02, -0.03, 0.04],
            dtype=torch.float64,
        )
        # rolled, so that no edge of the room follows a row of pixels
        start = pose.look_at((0.05, -1.2, 1.0), (0.1, 1.0, 0.75), down=(0.08, 0.0, -1.0))
        along = torch.linspace(-0.5, 0.5, FRAMES, dtype=torch.float64)
        self.path = start @ pose.se3_exp(along[:, None] * shift)
        self.t_s = torch.linspace(0, DURATION_S, FRAMES, dtype=torch.float64)
        shape = (size_px, size_px)
        self.theta = THETA * (1 + MISMATCH * torch.randn(shape, generator=draw))
        coarse = torch.randn(1, 2 * BINS, 5, 5, generator=draw)
        smooth = torch.nn.functional.interpolate(
            coarse, size=shape, mode="bicubic", align_corners=True
        )
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
            thickness_mm=self.lens.thickness_mm
            + change.index_put((torch.tensor([FOCUS]),), numbers[8:]),
        )
        return render.Camera(
            optics, self.size_px, self.size_px, WIDTH_MM / self.size_px, samples, seed
        )

    def frames(
        self, numbers: Tensor, samples: int, seed: int, way: Way = "interior", per_px: float = 2.5
    ) -> Tensor:
        """Frames [T, H, W] from a path moved, in the camera's own axes, by the twist
        numbers[:6]."""
        moved = self.path @ pose.se3_exp(numbers[None, :6])
        camera = self.camera(numbers, samples, seed)
        return render.frames(camera, self.scene, moved, gradient=way, per_px=per_px)

    def places(self, count: int, seed: int) -> Tensor:
        """Where pixels stand inside their threshold, [K, H, W] in -1/2..1/2: each goes through K
        even places, in an order of its own."""
        draw = torch.Generator().manual_seed(seed)
        shape = self.theta.shape
        order = torch.rand(count, *shape, generator=draw).argsort(0)
        return (order + torch.rand(shape, generator=draw)) / count - 0.5

    def losses(self, places: Tensor) -> Losses:
        """Name -> function of frames: a weighted event volume, and the flow's error, of smooth and
        of hard counts; "hard flow, one place" is that of the first place alone."""
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
        """Mean square error of the flow, px2, against what is true where the camera stands
        unmoved."""
        found = flow.estimate_lk(events.from_counts(counts, self.t_s, BINS), "affine").flow_px
        return ((found - self.target) * self.known[:, None]).double().square().mean()

    def gradients(
        self, losses: Losses, samples: int, seed: int, way: Way, per_px: float
    ) -> dict[str, Tensor]:
        """Gradient [9] per step of every number, of every loss: one trace of the frames serves
        all."""
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


# ---- what is measured

SINGLE = 16  # samples per pixel of one estimate as an optimiser takes it
PER_PX = 64.0  # of the precise ones
LOSSES = ("smooth counts", "smooth flow", "hard counts", "hard flow", "hard flow, one place")


def estimates(case: Case, samples: int, places: int, seed: int) -> Tensor:
    """Differences, the interior gradient, the one with the boundary term and a single estimate of
    it, at one seed of the camera and one draw of places: [4, LOSSES, 9]."""
    losses = case.losses(case.places(places, seed))
    ways = (
        case.differences(losses, samples, seed),
        case.gradients(losses, samples // 2, seed, "interior", PER_PX),
        case.gradients(losses, samples // 2, seed, "boundary", PER_PX),
        case.gradients(losses, SINGLE, seed + 50, "boundary", 2.5),
    )
    return torch.stack([torch.stack([way[key].detach() for key in LOSSES]) for way in ways])


def judged(values: Tensor) -> dict[str, float]:
    """Relative L2 errors against differences, noises and cosines out of values
    [cases, seeds, 4, n]; cases stand side by side, so that no error cancels another's."""
    truth, interior, boundary, _ = values.mean(1).transpose(0, 1).flatten(1)
    size = float(truth.norm())
    deviation = values.std(1).transpose(0, 1).flatten(1) / math.sqrt(values.shape[1])
    single = (values[:, :, 3].transpose(0, 1).flatten(1) - truth).norm(dim=1) / size
    return {
        "interior_only": float((interior - truth).norm()) / size,
        "with_boundary": float((boundary - truth).norm()) / size,
        "one_estimate": float(single.median()),
        "noise": float(deviation[0].norm()) / size,
        "noise_with_boundary": float(deviation[2].norm()) / size,
        "cosine_interior": float(interior @ truth / interior.norm()) / size,
        "cosine": float(boundary @ truth / boundary.norm()) / size,
    }


def measure(config):
    samples, places, size_px = (128, 16, 32) if config.quick else (config.samples // 4, 32, 48)
    cases = [Case(config.seed + number, size_px) for number in range(config.scenes)]
    seeds = [100 * (1 + config.seed) + seed for seed in range(2 * config.seeds)]
    values = torch.stack(
        [torch.stack([estimates(case, samples, places, seed) for seed in seeds]) for case in cases]
    )
    for number, loss in enumerate(LOSSES):
        for group, which in GROUPS.items():
            # a random pattern of counts hardly answers to the lens
            if not (loss.endswith("counts") and group == "lens"):
                yield Row((loss, group), judged(values[:, :, :, number, which]))


def asked(row):
    """5 % and twice the noise of smooth counts; of the mean over places of hard ones a noise below
    10 % and a cosine of 0.9. Nothing is asked of one place."""
    if row.names[0].startswith("smooth"):
        return Asked({}, {"with_boundary": 0.05 + 2 * row.numbers["noise"]})
    return None if row.names[0].endswith("place") else Asked({"cosine": 0.9}, {"noise": 0.10})


TOPIC = Topic(
    "From silhouettes to the flow loss",
    "A room with two boxes, through events and flow, to the camera's pose and to its lens. Relative L2 "
    f"error against differences; one estimate has {SINGLE} samples. The loss of hard counts is a mean over "
    "places of every pixel inside its threshold; that of one place alone is another, rough function, "
    "whose differences nothing can be judged by.",
    ("loss", "to"),
    lambda quick: [()],
    measure,
    asked,
)
