"""Is the pose gradient of one frame right? Central differences with common random numbers are the
judge, with their own noise known.

The loss is a smooth weighting of the frame. A difference over a step is the mean of the derivative
along it, whatever kinks lie on the way (an edge that passes from one row of pixels to the next, a
thing that comes into view): the gradient that is judged is averaged over poses along the same step.
What is left is noise of sampling, and both sides tell their standard error over seeds. More samples
and seeds are taken until that is small enough, or the last round is done.
"""

import time
from dataclasses import asdict, dataclass, field
from typing import Any, Literal

import torch
from torch import Tensor

from codesign import lens, pose, render
from codesign.errors import DomainError
from codesign.render.hits import first_hits
from codesign.render.moving import views_of
from codesign.render.sequence import Way

LENSES = ("pinhole", "thin", "traced")
RIGHT, WRONG = 0.05, 0.10  # relative errors, beside the noise
ENOUGH = 0.03  # noise at which no more samples are taken
HIGHEST = 0.10  # noise above which nothing passes
STEP_PX = 0.3  # motion of the nearest thing on the film, to either side
COARSE = 7  # random numbers across the weighting of the pixels
Verdict = Literal["right", "near", "wrong", "noisy", "doubtful", "refused", "empty"]


@dataclass(frozen=True)
class Effort:
    """samples: per pixel of the differences; the gradient takes a quarter of them at each of so
    many poses along every step. per_px: samples per pixel length of curve. seeds: of either side,
    more in every round for the side that needs them. directions: random ones that stand for the six
    components, 0 for the six themselves; enough: noise at which no more samples are taken of what
    is right."""

    samples: int = 256
    poses: int = 4
    per_px: float = 8.0
    seeds: tuple[int, ...] = (4, 12, 24)
    directions: int = 0
    enough: float = ENOUGH


USUAL = Effort()


@dataclass(frozen=True)
class Case:
    """A scene before a camera at T_world_cam [4, 4] or on its way [T, 4, 4]; nearest_m: how near
    the nearest thing in view is."""

    scene: Any
    optics: Any
    T_world_cam: Tensor
    pitch_mm: float
    width_px: int
    nearest_m: float
    seed: int = 0

    def camera(self, samples: int, seed: int) -> render.Camera:
        """The camera with so many samples per pixel."""
        return render.Camera(
            self.optics, self.width_px, self.width_px, self.pitch_mm, samples, seed
        )

    @property
    def weight(self) -> Tensor:
        """What the pixels of every frame count in the loss: [T, H, W], smooth and random."""
        generator = torch.Generator().manual_seed(self.seed)
        coarse = torch.randn(len(self.path), 1, COARSE, COARSE, generator=generator)
        size = (self.width_px,) * 2
        return torch.nn.functional.interpolate(coarse, size=size, mode="bicubic")[:, 0]

    @property
    def path(self) -> Tensor:
        """Poses of the frames [T, 4, 4]."""
        return self.T_world_cam.double().reshape(-1, 4, 4)

    def steps(self, directions: int = 0) -> Tensor:
        """Twists [k, 6], metres and radians: STEP_PX of motion on the film each, to either side; of
        the six components, or in so many random directions."""
        turn = STEP_PX * self.camera(1, 0).slope_per_px()
        size = torch.tensor([turn * self.nearest_m] * 3 + [turn] * 3, dtype=torch.float64)
        if not directions:
            return torch.diag(size)
        generator = torch.Generator().manual_seed(self.seed)
        ways = torch.randn(directions, 6, generator=generator, dtype=torch.float64)
        return size * torch.nn.functional.normalize(ways, dim=1)


@dataclass(frozen=True)
class Judged:
    """What was found about one case. error: relative L2 over the k steps, each component in units
    of its own;
    noise: of both sides together, noise_of_gradient: of what is judged; interior: error where
    silhouettes are left out; truth, found: [k]; seeds: of differences and of the gradient."""

    verdict: Verdict
    error: float | None = None
    noise: float | None = None
    noise_of_gradient: float | None = None
    interior: float | None = None
    sentence: str = ""
    truth: list[float] = field(default_factory=list)
    found: list[float] = field(default_factory=list)
    seeds: tuple[int, int] = (0, 0)
    cpu_s: float = 0.0

    def row(self) -> dict[str, Any]:
        """Plain values for a raw table."""
        return asdict(self)


def optics_of(kind: str, scale: float = 1.0, focus_m: float = 2.0) -> Any:
    """One of LENSES of 11 mm times ``scale``, at f/5 where it has an aperture, focused at a
    distance."""
    if kind == "pinhole":
        return lens.Pinhole(11.0 * scale)
    if kind == "thin":
        return lens.ThinLens(11.0 * scale, 2.2 * scale).focus_at(focus_m)
    return lens.load("cooke-triplet").scaled(0.22 * scale).focus_at(focus_m).freeze()


def judge(case: Case, way: Way = "boundary", effort: Effort = USUAL) -> Judged:
    """The verdict on one way to the pose gradient: right within RIGHT + 2 x noise, wrong beyond
    WRONG + noise, near between the two, noisy where that of the gradient stays above HIGHEST,
    doubtful where that of the differences does, refused with the sentence, empty where nothing in
    view changes."""
    began = time.process_time()
    plain = gradient(case, effort, 0, "interior")
    truth = torch.zeros(0, len(plain), dtype=torch.float64)
    got = truth
    found = Judged("empty")
    for seeds in effort.seeds:
        doubted = found.verdict in ("near", "wrong")
        if doubted or _share(got, truth) > effort.enough / 2**0.5:
            try:
                more = [gradient(case, effort, k, way) for k in range(len(got), seeds)]
            except DomainError as error:
                return Judged("refused", sentence=str(error), cpu_s=time.process_time() - began)
            got = torch.cat([got, torch.stack(more)])
        if doubted or _share(truth, truth) > effort.enough / 2**0.5:
            more = [differences(case, effort, 1000 + k) for k in range(len(truth), seeds)]
            truth = torch.cat([truth, torch.stack(more)])
        found = compared(truth, got, plain, time.process_time() - began)
        if found.noise is None or (found.verdict == "right" and found.noise < effort.enough):
            break
    return found


def compared(truth: Tensor, got: Tensor, plain: Tensor, cpu_s: float = 0.0) -> Judged:
    """Judged out of differences [seeds, k], the gradient [seeds, k] and the interior one [k], all
    in units of the steps."""
    if float(truth.abs().max()) < 1e-9 and float(got.abs().max()) < 1e-9:
        return Judged("empty", cpu_s=cpu_s)
    mean = truth.mean(0)
    size = max(float(mean.norm()), 1e-30)
    error = float((got.mean(0) - mean).norm()) / size
    noise = float((_spread(truth).square() + _spread(got).square()).sum().sqrt()) / size
    share = _share(got, truth)
    interior = float((plain - mean).norm()) / size
    means, seeds = (mean.tolist(), got.mean(0).tolist()), (len(truth), len(got))
    return Judged(
        verdict(error, noise, share), error, noise, share, interior, "", *means, seeds, cpu_s
    )


def _spread(estimates):
    return estimates.std(0) / estimates.shape[0] ** 0.5


def _share(estimates, truth):
    """Standard error of the mean of estimates [seeds, k] over the size of the truth's; infinite
    without any."""
    if not len(estimates) or not len(truth):
        return float("inf")
    return float(_spread(estimates).norm() / truth.mean(0).norm().clamp_min(1e-30))


def verdict(error: float, noise: float, noise_of_gradient: float) -> Verdict:
    """What an error means beside its noise."""
    if noise > HIGHEST:
        if error > WRONG + 3 * noise:
            return "wrong"
        return "noisy" if noise_of_gradient > HIGHEST else "doubtful"
    if error <= RIGHT + 2 * noise:
        return "right"
    return "wrong" if error > WRONG + noise else "near"


def differences(case: Case, effort: Effort, seed: int) -> Tensor:
    """Central differences [k] of the loss, in units of the steps; one launch for all of them."""
    steps = case.steps(effort.directions)
    poses = case.path @ pose.se3_exp(torch.cat([steps, -steps]))[:, None]
    with torch.no_grad():
        frames = render.frames(case.camera(effort.samples, seed), case.scene, poses)
    ahead, behind = (frames.double() * case.weight).mean((1, 2, 3)).reshape(2, -1)
    return (ahead - behind) / 2


def gradient(case: Case, effort: Effort, seed: int, way: Way) -> Tensor:
    """The gradient [k] of the loss by one way, in units of the steps: every component is the mean
    over poses along its own step, one in each of ``effort.poses`` equal parts."""
    generator = torch.Generator().manual_seed(seed)
    steps = case.steps(effort.directions)
    at = torch.rand(len(steps), effort.poses, generator=generator, dtype=torch.float64)
    at = 2 * (at + torch.arange(effort.poses)) / effort.poses - 1
    offsets = (at[..., None] * steps[:, None]).reshape(-1, 6)
    twist = torch.zeros_like(offsets, requires_grad=True)
    frames = render.frames(
        case.camera(effort.samples // 4, seed),
        case.scene,
        case.path @ (pose.se3_exp(offsets) @ pose.se3_exp(twist))[:, None],
        gradient=way,
        per_px=effort.per_px,
    )
    loss = (frames.double() * case.weight).sum() / case.weight.numel()
    (found,) = torch.autograd.grad(loss, twist)
    return (found.reshape(-1, effort.poses, 6).mean(1) * steps).sum(1)


def nearest_m(scene: Any, optics: Any, path: Tensor, pitch_mm: float, width_px: int) -> float:
    """Distance of the nearest thing that the chief rays of the film meet on the way [T, 4, 4], 1
    where they meet none."""
    camera = render.Camera(optics, 4 * width_px, 4 * width_px, pitch_mm / 4, 1)
    rays = camera.rays()
    poses = views_of(scene, path).cameras
    found = first_hits(rays.origin_m, rays.direction, rays.weight > 0, scene, poses).distance_m
    away = found[found.isfinite()]
    return float(away.min()) if away.numel() else 1.0
