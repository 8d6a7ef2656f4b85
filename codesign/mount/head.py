"""A learnt head: least squares whose weights know the lens and the mount.

Least squares counts every window by what its flow claims. A head learns what claims are worth: flow
of a window that is blurred, or faster than the estimator reaches, or on something that is not where
the map says, is read short or not at all, and which windows these are can be told from the design,
the residuals and the other windows. It says, window by window, how much to count it and by how much
its flow was read short, and solves again.
"""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.functional import silu

from codesign.checks import check_kind, check_whole
from codesign.errors import DomainError, FileFormatError
from codesign.flow import checkpoint
from codesign.mount.ego_velocity import EgoVelocity, Motion, Readings
from codesign.mount.observability import FREE, chief_lines
from codesign.mount.unknown_depth import UnknownDepth
from codesign.types import ChiefRayCamera, EventVolume, FlowField

LEAST_CONFIDENCE = 1e-6
FOCAL_PX = 300.0  # focal lengths are told as the logarithm of their share of this
# points of the pupil by which blur is measured: exact for spreads of up to the sixth power of the
# radius (coma, spherical aberration), where a single ring knows defocus and astigmatism alone
RINGS, SPOKES = 3, 8
# what becomes of the numbers told of windows, lens and mount in a mirror before which left is right
TOLD = (1, 1, 1, 1, -1, 1, 1, 1, 1, 1, 1)
LENS = (1, -1, 1, 1, 1, 1)
MOUNT = (1, -1, 1, 1, -1, 1, 1, -1, 1)


@dataclass(frozen=True)
class Evidence:
    """Windows W of N bodies, K velocities.

    information: [N, W, K, K] of the velocities without prior, outliers weighted down. pull:
    [N, W, K], so that a window alone says inverse(information) pull. energy: [N, W], the squared
    flow in units of its deviation. rows: [N, W, 2, K] and flow_px: [N, W, 2], means over the window
    of what velocities make and of what was read, px.
    told: [N, W, 11], the window's surface, depth, confidence, claim, flow and residuals. lens:
    [N, W, 6], its direction in body axes, focal length and blur. mount: [N, 9], position in metres,
    camera z and y in body axes. prior: [N, K].
    """

    information: Tensor
    pull: Tensor
    energy: Tensor
    rows: Tensor
    flow_px: Tensor
    told: Tensor
    lens: Tensor
    mount: Tensor
    prior: Tensor

    def __getitem__(self, bodies: Tensor | slice) -> "Evidence":
        """The evidence of some bodies."""
        return Evidence(*(getattr(self, field.name)[bodies] for field in fields(self)))

    @staticmethod
    def joined(parts: "list[Evidence]") -> "Evidence":
        """All bodies of several, for films with as many windows."""
        return Evidence(
            *(torch.cat([getattr(each, f.name) for each in parts]) for f in fields(Evidence))
        )


def evidence(
    read: Readings,
    plain: Motion,
    camera: ChiefRayCamera,
    T_body_cam: Tensor,
    prior: tuple[float, ...],
    volume: EventVolume | None = None,
) -> Evidence:
    """Evidence of what was read, and of the plain solution of it (``EgoVelocity.read`` and
    ``solve``).

    Args:
      camera: one with ``rays_through`` says how it blurs, another counts as sharp.
      T_body_cam: [4, 4] or [N, 4, 4].
      prior: [K] standard deviations.
      volume: whose events are counted, None: they are not told.
    Gradient: readings, solution, lens, mount, counts.
    """

    def by_window(values):
        return values.unflatten(1, (read.windows, -1))

    def mean(values):
        return by_window(values).mean(2)

    surface = (read.share.detach() > 0).double()
    count = (plain.kept * read.share)[..., None, None]
    weighed = count * (read.rows.mT @ read.precision)  # [N, P, K, 2]
    flow = read.flow_px[..., None]
    drawn = read.confidence[..., None, None]
    energy = count / drawn.clamp_min(LEAST_CONFIDENCE) * (flow.mT @ read.precision @ flow)
    miss = by_window(read.missed_px(plain.velocity))
    squared = mean(read.squared(plain.velocity))
    nearness = mean(torch.where(read.share.detach() > 0, 1 / read.depth_m, 0.0))
    flow_px = mean(read.flow_px)
    events = torch.zeros_like(squared)
    if volume is not None:
        events = volume.counts.double().mean((-2, -1)).sum((1, 2)).reshape(squared.shape)
    told = [
        mean(surface),
        torch.asinh(nearness),
        mean(read.confidence),
        -mean(torch.logdet(read.precision)) / 4,
        torch.asinh(flow_px[..., 0]),
        torch.asinh(flow_px[..., 1]),
        torch.log1p(_length(mean(_length(read.flow_px)[..., None]))),
        mean(plain.kept),
        torch.log(squared + 1e-2),
        torch.log1p(_length((miss - miss.mean(2, keepdim=True)).flatten(2) / miss.shape[2] ** 0.5)),
        torch.log1p(events),
    ]
    mounts = T_body_cam.double().reshape(-1, 4, 4).expand(len(flow_px), 4, 4)
    mount = torch.cat([mounts[:, :3, 3], mounts[:, :3, 2], mounts[:, :3, 1]], 1)
    return Evidence(
        by_window(drawn * (weighed @ read.rows)).sum(2),
        by_window(weighed @ flow).sum(2)[..., 0],
        by_window(energy).sum(2)[..., 0, 0],
        mean(drawn * read.rows),
        flow_px,
        torch.stack(told, -1),
        _lens(camera, read.windows, nearness, mounts),
        mount,
        flow_px.new_tensor(prior).expand(len(flow_px), -1),
    )


def _length(vectors):
    """Lengths [...] of vectors [..., D], with a gradient at 0."""
    return (vectors.square().sum(-1) + 1e-12).sqrt()


def window_optics(camera: ChiefRayCamera, read: Readings) -> Tensor:
    """[N, W, 2] of the windows of readings: logarithm of the focal length there, in units of
    FOCAL_PX, and log1p of the blur of what is seen in them, px. Gradient: lens and depth."""
    seen = read.share.detach() > 0
    near = torch.where(seen, 1 / read.depth_m, 0.0).unflatten(1, (read.windows, -1))
    count = seen.unflatten(1, (read.windows, -1)).sum(2).clamp_min(1)
    mounts = torch.eye(4).to(near).expand(len(near), 4, 4)
    return _lens(camera, read.windows, near.sum(2) / count, mounts)[..., 3:5]


def _lens(camera, windows, nearness, mounts):
    """[N, W, 6]: direction of the windows in body axes, logarithm of the focal length there, blur
    in pixels (root mean square radius) of what is as near as 1 / nearness [N, W] m, and of what is
    infinitely far."""
    pixels = camera.film.pixels().double().reshape(windows, -1, 2).mean(1)
    base, slope, base_step, slope_step = chief_lines(camera, pixels)
    ahead = torch.cat([slope, torch.ones_like(slope[:, :1])], 1)
    ahead = ahead / _length(ahead)[:, None]
    focal = -torch.linalg.det(slope_step).abs().log() / 2 - torch.tensor(FOCAL_PX).log()
    lines = (base, slope, base_step, slope_step)
    depths = torch.stack([nearness, torch.zeros_like(nearness)])
    blur = _blur_px(camera, pixels, *lines, depths).log1p()
    direction = (mounts[:, None, :3, :3] @ ahead[:, :, None])[..., 0]
    return torch.cat([direction, torch.stack([focal.expand_as(nearness), *blur], -1)], -1)


def _blur_px(camera, pixels, base, slope, base_step, slope_step, nearness):
    """[..., W] of what is as near as 1 / nearness [..., W] m in each window."""
    if not hasattr(camera, "rays_through"):
        return torch.zeros_like(nearness)
    points, weight = _pupil()
    count = len(points)
    rays = camera.rays_through(
        pixels.repeat_interleave(count, 0), points.to(pixels).repeat(len(pixels), 1)
    )
    passes = rays.weight.detach() > 0
    lit = passes.double().reshape(-1, count) * weight.to(pixels)
    along = torch.where(passes[:, None], rays.direction, 1.0).double()
    off_slope = (along[:, :2] / along[:, 2:]).reshape(-1, count, 2) - slope[:, None]
    start = rays.origin_m.double().reshape(-1, count, 3)
    off_base = start[..., :2] - (off_slope + slope[:, None]) * start[..., 2:] - base[:, None]
    near = nearness[..., None, None]
    share = lit / lit.sum(-1, keepdim=True).clamp_min(1e-12)
    # [..., W, 2, points]
    shift = torch.linalg.solve(near * base_step + slope_step, (near * off_base + off_slope).mT)
    shift = shift - (shift * share[:, None]).sum(-1, keepdim=True)
    return ((shift.square().sum(-2) * share).sum(-1) + 1e-12).sqrt()


@cache
def _pupil():
    """Points [24, 2] of the unit disc and their shares [24] of it."""
    node, weight = np.polynomial.legendre.leggauss(RINGS)  # in the square of the radius
    radius = torch.from_numpy(((node + 1) / 2) ** 0.5)
    angle = 2 * torch.pi * (torch.arange(SPOKES, dtype=torch.float64) + 0.5) / SPOKES
    points = torch.stack(
        [radius[:, None] * angle.cos(), radius[:, None] * angle.sin()], -1
    ).flatten(0, 1)
    return points, torch.from_numpy(weight / 2).repeat_interleave(SPOKES) / SPOKES


# of what the solution so far makes of a window; -1 is mirrored, as in TOLD
SOLVED = (
    -1,
    1,
    1,
    1,
    1,
    1,
)
VELOCITY = (1, -1, 1, -1, 1, -1)  # forward, left, up, roll, pitch, yaw
WIDEST = 6.0  # logarithm of the largest factor on a window's weight
WIDER = 4.0  # of those on deviations
SIX = len(FREE)
KIND = "velocity head"
DELIVERED = Path(__file__).with_name("head.safetensors")


class VelocityHead(nn.Module):
    """Stage ``estimate`` of a System, where EgoVelocity can stand, for any film, lens, mount and
    number of windows.

    Windows are read by one network each, whose answers are pooled (mean and maximum; Zaheer et al.,
    Deep Sets, 2017); a second one hears the pool, the mount and the solution so far, a third says
    of each window a factor on its information, up to e^6, and one on its flow, up to e; and of the
    body, factors on prior and covariance and a correction of at most one standard deviation. It
    hears everything also as a mirror shows it, so that left and right are treated alike. Fresh
    weights give the velocity of ``plain`` as it is.

    Args:
      plain: axes, prior, depth and how flow is read.
      width: of the layers.
      rounds: of weighing and solving.

    >>> from codesign.mount import FREE, EgoVelocity, VelocityHead
    >>> plain = EgoVelocity(FREE, prior=(2.0, 2.0, 1.0, 1.0, 1.0, 1.0), depth="scene")
    >>> sum(weight.numel() for weight in VelocityHead(plain).parameters()) <= 50_000
    True
    """

    def __init__(self, plain: EgoVelocity, width: int = 32, rounds: int = 2) -> None:
        super().__init__()
        self.plain = check_kind(plain, EgoVelocity, "plain")
        if isinstance(plain.depth, UnknownDepth):
            raise DomainError("a head weighs windows whose depth is known; give ``plain`` a depth.")
        width = check_whole(width, "width")
        self.config: dict[str, Any] = {
            "width": width,
            "rounds": check_whole(rounds, "rounds"),
        }
        window = (*TOLD, *LENS, *SOLVED)
        around = (*MOUNT, *VELOCITY, *(1,) * SIX)
        for name, signs in (("of_window", window), ("of_body", around), ("of_velocity", VELOCITY)):
            mirror = torch.tensor([[1.0] * len(signs), [float(sign) for sign in signs]])
            self.register_buffer(name, mirror, persistent=False)
        self.window = _layers(len(window), width, width)
        self.body = _layers(2 * width + len(around), width, width)
        self.say = _layers(2 * width + len(around), width, 2)
        self.claim = _layers(width, width, 3 * SIX)
        for last in (self.say[-1], self.claim[-1]):
            for parameter in last.parameters():
                nn.init.zeros_(parameter)

    def forward(
        self,
        field: FlowField,
        camera: ChiefRayCamera,
        scene: Any,
        T_body_cam: Tensor,
        T_world_cam: Tensor,
        t_s: Tensor | None = None,
        volume: EventVolume | None = None,
    ) -> Motion:
        """Motion of N bodies; arguments as of EgoVelocity, and the volume whose events are counted
        where there is one.

        ``kept``: by how much the plain solution believed each point, times its window's weight, at
        most 1.
        Gradient: flow, covariance, mount, poses, lens, counts, weights.
        """
        seen, plain = self._read(field, camera, scene, T_body_cam, T_world_cam, t_s, volume)
        velocity, covariance, weight = self.judged(seen)
        kept = plain.kept.unflatten(1, (weight.shape[1], -1)) * weight[..., None]
        return Motion(velocity, covariance, kept.flatten(1).clamp(max=1.0))

    def evidence(
        self,
        field: FlowField,
        camera: ChiefRayCamera,
        scene: Any,
        T_body_cam: Tensor,
        T_world_cam: Tensor,
        t_s: Tensor | None = None,
        volume: EventVolume | None = None,
    ) -> Evidence:
        """What ``judged`` needs, to be kept: training renders nothing twice."""
        return self._read(field, camera, scene, T_body_cam, T_world_cam, t_s, volume)[0]

    def _read(self, field, camera, scene, T_body_cam, T_world_cam, t_s, volume):
        """Evidence, and the plain solution."""
        read = self.plain.read(field, camera, scene, T_body_cam, T_world_cam, t_s)
        plain = self.plain.solve(read)
        mounts = T_body_cam.expand(*T_world_cam.shape[:-3], 4, 4).reshape(-1, 4, 4)
        return evidence(read, plain, camera, mounts, self.plain.prior, volume), plain

    def judged(self, seen: Evidence) -> tuple[Tensor, Tensor, Tensor]:
        """Velocity [N, K], its covariance [N, K, K] and the weights [N, W] of the windows.
        Gradient: evidence and weights of the network."""
        even = torch.ones_like(seen.energy)
        weight = even
        velocity, covariance = _solved(seen, even, even, seen.prior)
        claim = seen.prior.new_zeros(len(even), 3, SIX)
        for _ in range(self.config["rounds"]):
            said, claim = self._said(seen, velocity, covariance)
            claim = claim[..., list(self.plain.axes)]
            weight = _bounded(said[..., 0], WIDEST)
            prior = seen.prior * _bounded(claim[:, 0], WIDER)
            velocity, covariance = _solved(
                seen, weight, weight * _bounded(said[..., 1], 1.0), prior
            )
        velocity = velocity + _deviation(covariance) * torch.tanh(claim[:, 1])
        factor = _bounded(claim[:, 2], WIDER)
        return velocity, factor[:, :, None] * covariance * factor[:, None, :], weight

    def _said(self, seen, velocity, covariance):
        """What the network says: [N, W, 2] of windows and [N, 3, 6] of bodies."""
        by_flow = (seen.rows @ velocity[:, None, :, None])[..., 0]
        miss = seen.flow_px - by_flow
        expected = torch.einsum("nwck,nkl,nwcl->nw", seen.rows, covariance, seen.rows)
        share = torch.einsum("nwkl,nlk->nw", seen.information, covariance)
        squared = _squared(seen, velocity)
        solved = [
            *torch.asinh(miss).unbind(-1),
            torch.log1p((by_flow.square().sum(-1) + 1e-12).sqrt()),
            torch.log(squared + 0.1),
            torch.log(expected.clamp_min(0) + 1e-4) / 2,
            torch.log(share.clamp_min(0) + 1e-3),
        ]
        windows = torch.cat([seen.told, seen.lens, torch.stack(solved, -1)], -1)
        deviation = (_deviation(covariance) / seen.prior).log()
        body = torch.cat(
            [seen.mount, self._six(torch.asinh(velocity / seen.prior)), self._six(deviation)], -1
        )
        dtype = self.say[0].weight.dtype
        # [2, N, W, ...], as is and in a mirror
        windows = (windows * self.of_window[:, None, None]).to(dtype)
        body = (body * self.of_body[:, None]).to(dtype)
        heard = self.window(windows)
        core = self.body(torch.cat([heard.mean(2), heard.amax(2), body], -1))
        around = torch.cat([core, body], -1)[:, :, None].expand(-1, -1, heard.shape[2], -1)
        said = self.say(torch.cat([heard, around], -1)).mean(0)
        scales, change, claims = self.claim(silu(core)).unflatten(-1, (3, SIX)).unbind(-2)
        change = change * self.of_velocity[:, None]
        claim = torch.stack([scales.mean(0), change.mean(0), claims.mean(0)], 1)
        return said.to(velocity), claim.to(velocity)

    def _six(self, values):
        """[N, 6]: 0 where the body does not have a velocity."""
        found = values.new_zeros(len(values), SIX)
        found[:, list(self.plain.axes)] = values
        return found

    def save(self, path: str | Path, metadata: Mapping[str, Any] | None = None) -> None:
        """Write the weights as .safetensors, with plain JSON values about them. Raises:
        FileFormatError."""
        content = {"kind": KIND, "config": self.config, "metadata": dict(metadata or {})}
        checkpoint.write_tensors(path, self.state_dict(), content)

    @classmethod
    def load(cls, plain: EgoVelocity, path: str | Path) -> "VelocityHead":
        """The head of a file that ``save`` wrote, beside a plain estimator of the user's.

        Raises: FileFormatError when the file is missing, damaged, or of another network.
        """
        weights, content = checkpoint.read_tensors(path)
        if content.get("kind") != KIND:
            raise FileFormatError(
                f"'{path}' holds no velocity head; give a file that VelocityHead.save wrote."
            )
        config = dict(content["config"])
        # of earlier versions: whether it hears lens and mount
        if not config.pop("design", True):
            raise FileFormatError(f"'{path}' holds a head that hears no design; train it anew.")
        head = cls(plain, **config)
        checkpoint.fill(head, weights, path)
        return head.eval()

    @classmethod
    def pretrained(cls, plain: EgoVelocity) -> "VelocityHead":
        """The delivered head, which studies.velocity_head trained on the three pairs of
        scenes.robots.pairs.

        It knows their regime: nine windows of 32 x 32, the closed form of flow with a prior of 4
        px, axes ``mount.FREE``. Elsewhere it is a start for training.
        """
        return cls.load(plain, DELIVERED)


def _layers(inputs, width, outputs):
    return nn.Sequential(nn.Linear(inputs, width), nn.SiLU(), nn.Linear(width, outputs))


def _bounded(logarithm, widest):
    """Factor, 1 where the logarithm is 0, from exp(-widest) to exp(widest)."""
    return (widest * torch.tanh(logarithm / widest)).exp()


def _deviation(covariance):
    return covariance.diagonal(dim1=-2, dim2=-1).sqrt()


def _squared(seen, velocity):
    """[N, W]: squared flow that the velocity leaves unexplained, in units of its deviation."""
    along = velocity[:, None, :, None]
    bent = (along.mT @ seen.information @ along)[..., 0, 0]
    pulled = (seen.pull * velocity[:, None]).sum(-1)
    return (seen.energy + (bent - 2 * pulled)).clamp_min(0)


def _solved(seen, weight, pulled, prior):
    """Velocity [N, K] and covariance [N, K, K] of windows weighted [N, W], their pulls [N, W]."""
    normal = (weight[..., None, None] * seen.information).sum(1) + torch.diag_embed(prior**-2)
    covariance = torch.linalg.inv(normal)
    return (covariance @ (pulled[..., None] * seen.pull).sum(1)[..., None])[..., 0], covariance
