"""What each window of a film says of a body's velocity, and through what lens and from where it was seen: the input of
a learnt head, small enough to keep."""

from dataclasses import dataclass, fields

import torch
from torch import Tensor

from codesign.place.observability import chief_lines
from codesign.task.ego_velocity import Motion, Readings
from codesign.types import ChiefRayCamera, EventVolume

LEAST_CONFIDENCE = 1e-6
FOCAL_PX = 300.0  # focal lengths are told as the logarithm of their share of this
RIM = 0.5**0.5  # four points of the pupil there spread light as all of a uniform pupil does
# what becomes of the numbers told of windows, lens and mount in a mirror before which left is right
TOLD = (1, 1, 1, 1, -1, 1, 1, 1, 1, 1, 1)
LENS = (1, -1, 1, 1, 1, 1)
MOUNT = (1, -1, 1, 1, -1, 1, 1, -1, 1)


@dataclass(frozen=True)
class Evidence:
    """Windows W of N bodies, K velocities.

    information: [N, W, K, K] of the velocities without prior, outliers weighted down. pull: [N, W, K], so that a window
    alone says inverse(information) pull. energy: [N, W], the squared flow in units of its deviation. rows: [N, W, 2, K]
    and flow_px: [N, W, 2], means over the window of what velocities make and of what was read, px.
    told: [N, W, 11], the window's surface, depth, confidence, claim, flow and residuals. lens: [N, W, 6], its direction
    in body axes, focal length and blur. mount: [N, 9], position in metres, camera z and y in body axes. prior: [N, K].
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
        return Evidence(*(torch.cat([getattr(each, f.name) for each in parts]) for f in fields(Evidence)))


def evidence(
    read: Readings,
    plain: Motion,
    camera: ChiefRayCamera,
    T_body_cam: Tensor,
    prior: tuple[float, ...],
    volume: EventVolume | None = None,
) -> Evidence:
    """Evidence of what was read, and of the plain solution of it (``EgoVelocity.read`` and ``solve``).

    Args: camera: one with ``rays_through`` says how it blurs, another counts as sharp. T_body_cam: [4, 4] or [N, 4, 4].
      prior: [K] standard deviations. volume: whose events are counted, None: they are not told.
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


def _lens(camera, windows, nearness, mounts):
    """[N, W, 6]: direction of the windows in body axes, logarithm of the focal length there, blur in pixels (root mean
    square radius) of what is as near as 1 / nearness [N, W] m, and of what is infinitely far."""
    pixels = camera.film.pixels().double().reshape(windows, -1, 2).mean(1)
    base, slope, base_step, slope_step = chief_lines(camera, pixels)
    ahead = torch.cat([slope, torch.ones_like(slope[:, :1])], 1)
    ahead = ahead / _length(ahead)[:, None]
    focal = -torch.linalg.det(slope_step).abs().log() / 2 - torch.tensor(FOCAL_PX).log()
    lines = (base, slope, base_step, slope_step)
    blur = [_blur_px(camera, pixels, *lines, near).log1p() for near in (nearness, torch.zeros_like(nearness))]
    direction = (mounts[:, None, :3, :3] @ ahead[:, :, None])[..., 0]
    return torch.cat([direction, torch.stack([focal.expand_as(nearness), *blur], -1)], -1)


def _blur_px(camera, pixels, base, slope, base_step, slope_step, nearness):
    if not hasattr(camera, "rays_through"):
        return torch.zeros_like(nearness)
    rim = RIM * torch.tensor([[1.0, 0.0], [-1, 0], [0, 1], [0, -1]], dtype=torch.float64)
    rays = camera.rays_through(pixels.repeat_interleave(4, 0), rim.repeat(len(pixels), 1))
    lit = (rays.weight.detach() > 0).double().reshape(-1, 4)
    along = torch.where(rays.weight.detach()[:, None] > 0, rays.direction, 1.0).double()
    off_slope = (along[:, :2] / along[:, 2:]).reshape(-1, 4, 2) - slope[:, None]
    start = rays.origin_m.double().reshape(-1, 4, 3)
    off_base = start[..., :2] - (off_slope + slope[:, None]) * start[..., 2:] - base[:, None]
    near = nearness[..., None, None]
    shift = torch.linalg.solve(
        near * base_step + slope_step, (near * off_base + off_slope).mT
    )  # [N, W, 2, 4]
    share = lit / lit.sum(-1, keepdim=True).clamp_min(1)
    return ((shift.square().sum(-2) * share).sum(-1) + 1e-12).sqrt()
