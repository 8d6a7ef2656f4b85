"""Gradients of what the camera sees, and of the flow error behind it, to lens, camera pose and
object pose, beside differences over the same film samples.

Every draw has its own film samples, and its gradient is compared with its own differences. Noise is
what the draws disagree about, and what a doubled step changes.
"""

import functools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import scipy
import torch
from torch import Tensor

from codesign import events, flow, render
from codesign.grad import Difference, Row
from codesign.grad.row import SIGMAS, make_row
from codesign.render.sequence import Way
from studies.gradient_flow.certificates import scenes
from studies.gradient_flow.certificates.scenes import FRAMES, SIZE_PX, T_S, Numbers

TOLERANCE = 0.01
RARE = 1.5e-4  # to a side: one wrong verdict in ten runs of 300 rows
THETA = 0.2
BINS = 4
PER_PX = 32.0  # samples per pixel length of silhouettes
STEADY_PX = 0.03  # between the true flow and its mean around, where no silhouette is near
Line = tuple[str, Tensor]  # a group, and a direction in it, in steps
Losses = Callable[[Numbers, int, Way], Tensor]  # of a draw, its gradient by a way


def certify_seen(
    name: str, samples: int, draws: int, directions: int | None
) -> Iterator[tuple[str, Row]]:
    """(junction, row) of frames and final loss to every group of ``scenes.point``, for a scene by
    its name.

    Args: samples per pixel; draws of film samples; directions as for ``lines``.
    """
    losses = functools.partial(_seen, name, samples)
    way = scenes.scene(name).way
    yield from _rows(("frames", "final loss"), losses, lines(name, directions), draws, way)


def certify_truth(name: str, directions: int | None) -> Iterator[tuple[str, Row]]:
    """As ``certify_seen`` for the true flow, which has no film samples."""
    losses = functools.partial(_truth, name)
    yield from _rows(("true flow",), losses, lines(name, directions), 1, "interior")


def lines(name: str, directions: int | None) -> list[Line]:
    """Steps to take in a scene: along every number (None), or in random directions in groups that
    have more."""
    found = []
    draw = torch.Generator().manual_seed(1)
    for group, unit in scenes.steps(name).items():
        few = directions is not None and directions < unit.numel()
        for k in range(directions if few else unit.numel()):
            way = torch.zeros(unit.numel(), dtype=torch.float64)
            way[k] = 1
            if few:
                way = torch.nn.functional.normalize(way.normal_(generator=draw), dim=0)
            line = way.reshape(unit.shape) * unit
            # air has no index to change
            if line.any():
                found.append((group, line))
    return found


def frames(name: str, numbers: Numbers, samples: int, draw: int, way: Way) -> Tensor:
    """Frames [FRAMES, SIZE_PX, SIZE_PX], rounded no further than the scene's own precision."""
    world, path = scenes.scene(name).at(numbers)
    camera = scenes.camera(numbers, samples, draw)
    return render.frames(camera, world, path, way, PER_PX).double()


def smooth_weight(*shape: int) -> Tensor:
    """[*shape, SIZE_PX, SIZE_PX]: a stage downstream never sees single pixels."""
    coarse = torch.randn(1, math.prod(shape), 5, 5, generator=torch.Generator().manual_seed(3))
    size = (SIZE_PX, SIZE_PX)
    fine = torch.nn.functional.interpolate(coarse, size=size, mode="bicubic", align_corners=True)
    return fine.double().reshape(*shape, *size)


@functools.cache
def target(name: str) -> tuple[Tensor, Tensor]:
    """True flow [1, 2, H, W] of a scene as it stands, and [1, 1, H, W] where it is known and no
    silhouette is near."""
    with torch.no_grad():
        found, valid = true_flow(name, scenes.point())
    around = torch.nn.functional.avg_pool2d(found, 3, 1, 1, count_include_pad=False)
    jumps = ((found - around).abs().amax(1) > STEADY_PX) | ~valid
    near = torch.nn.functional.max_pool2d(jumps[:, None].double(), 3, 1, 1)
    return found, near == 0


def true_flow(name: str, numbers: Numbers) -> tuple[Tensor, Tensor]:
    """Flow from the first frame to the last, and where it is known."""
    world, path = scenes.scene(name).at(numbers)
    ends = [0, FRAMES - 1]
    return render.true_flow(scenes.camera(numbers, 1, 0), world.during(ends), path[ends])


def closed_form(counts: Tensor) -> Tensor:
    """Estimated flow [1, 2, H, W] of counts [FRAMES - 1, 2, H, W]."""
    volume = events.from_counts(counts, T_S, BINS)
    return flow.estimate_lk(volume, "affine", levels_px=(2.0, 1.0), steps=2).flow_px


def _seen(name, samples, numbers, draw, way):
    """A weighted mean of the frames, and the squared error of the closed-form flow of their smooth
    counts, px2."""
    image = frames(name, numbers, samples, draw, way)
    fixed, known = target(name)
    found = closed_form(events.soft_counts(image, THETA, THETA))
    error = ((found - fixed) * known).square().mean()
    return torch.stack([(smooth_weight(FRAMES) * image).mean() / 100, error])


def _truth(name, numbers, draw, way):
    found, _ = true_flow(name, numbers)
    return (smooth_weight(1, 2) * target(name)[1] * found).mean()[None]


def _rows(junctions, losses: Losses, chosen: Sequence[Line], draws: int, way: Way):
    slopes = torch.stack([_slopes(losses, chosen, draw, way) for draw in range(draws)])
    differences = _differences(losses, chosen, draws, 1)
    some = max(1, draws // 4)
    bending = _differences(losses, chosen, some, 2) - differences[:some]
    for k, junction in enumerate(junctions):
        bent = bending[..., k].mean(0).abs()
        for row in judged(chosen, slopes[..., k], differences[..., k], bent):
            yield junction, row


def _slopes(losses, chosen, draw, way):
    leaves = {name: value.requires_grad_() for name, value in scenes.point().items()}
    found = []
    for value in losses(leaves, draw, way):
        grads = torch.autograd.grad(
            value, list(leaves.values()), retain_graph=True, materialize_grads=True
        )
        of = dict(zip(leaves, grads, strict=True))
        found.append(torch.stack([(of[group] * line).sum() for group, line in chosen]))
    return torch.stack(found, 1)


@torch.no_grad()
def _differences(losses, chosen, draws, step):
    """[draws, lines, losses] central differences over a number of steps, per step."""
    start = scenes.point()

    def at(draw, group, way):
        return losses({**start, group: start[group] + way}, draw, "interior")

    found = [
        torch.stack(
            [(at(k, group, step * way) - at(k, group, -step * way)) for group, way in chosen]
        )
        for k in range(draws)
    ]
    return torch.stack(found) / (2 * step)


def judged(chosen: Sequence[Line], slopes: Tensor, differences: Tensor, bent: Tensor) -> list[Row]:
    """Rows of the groups of some lines.

    Args:
      slopes, differences: [draws, lines], alike drawn. bent: [lines] what is left of bending.
    Noise is the standard error of their mean distance, with Student's factor for so few draws. What
    is wrong by it has to be so by ``RARE`` too, since there are hundreds of rows.
    """
    groups = dict.fromkeys(group for group, _ in chosen)
    rows = []
    for group in groups:
        own = [k for k, (other, _) in enumerate(chosen) if other == group]
        one = group, slopes[:, own], differences[:, own], bent[own]
        row = _judged(*one, scipy.stats.norm.sf(SIGMAS))
        if row.verdict == "fail" and _judged(*one, RARE).verdict != "fail":
            row = replace(row, verdict="noise")
        rows.append(row)
    return rows


def _judged(group, slopes, differences, bent, chance):
    """Row of a group; by chance alone, a distance exceeds three of its noises so often to a side."""
    noise = bent
    draws = len(slopes)
    if draws > 1:
        student = scipy.stats.t.isf(chance, len(bent) * (draws - 1)) / SIGMAS
        noise = torch.hypot(bent, student * (slopes - differences).std(0) / math.sqrt(draws))
    pairs = zip(differences.mean(0).tolist(), noise.tolist(), strict=True)
    found = [Difference(value, 1.0, deviation, ()) for value, deviation in pairs]
    return make_row(group, slopes.mean(0).tolist(), found, TOLERANCE)
