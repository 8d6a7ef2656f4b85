"""Closed-form event flow: coarse-to-fine Bayesian least squares on event volumes.

The signed event rate of a moving texture moves with it, so the volume obeys V_t + u V_x + v V_y = 0
(Lucas and Kanade, 1981, with event rate in place of intensity); time is the way that the scene has
gone (path). The volume is warped back along the current flow; per pixel, the regression of the bins
over the way gives V_t and their mean gives V_x, V_y; all pixels together pull at the parameters of
a polynomial field (level), those of cells at what it leaves (cells). Gaussian priors on the field
(polynomials, quadtree) hold against the pull, which is weighed by the noise that scattered events
put into it, so that few events mean small steps, and the spread of what is left is returned with
the flow.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from codesign.checks import check, check_choice, check_finite, check_number, check_whole
from codesign.errors import DomainError, ShapeError, shown
from codesign.flow.checks import MOST_STEPS, check_flow, check_volume
from codesign.flow.lk.cells import Cells
from codesign.flow.lk.level import Level, along_path
from codesign.flow.lk.path import Path
from codesign.flow.lk.polynomials import Polynomials
from codesign.flow.lk.start import at_start
from codesign.types import EventVolume, FlowField

# field -> the polynomial in it
MODELS = {
    "constant": "constant",
    "affine": "affine",
    "quadratic": "quadratic",
    "local": "quadratic",
}
CLOCKS = ("time", "events")
TURNED = 0.1  # share of the variance of the whole way that remains where it leads back to its start
LEAST_BLUR_PX, MOST_BLUR_PX = 0.2, 1000  # below, a Gaussian is one sample
LONGEST_PX = 1e4  # of a prior or a start
FIRST = 1.0  # by what the first of two answers leads in the logarithm of their odds


def estimate_lk(
    volume: EventVolume,
    model: str = "affine",
    prior_px: float = 3.0,
    levels_px: Sequence[float] = (4.0, 2.0, 1.0),
    steps: int = 3,
    noise_floor: float = 0.02,
    clock: str = "time",
    start_px: Tensor | None = None,
) -> FlowField:
    """Flow over the volume's interval, with its uncertainty.

    Args:
      volume: EventVolume, counts [B, 2, bins >= 2, H >= 2, W >= 2]. Hot pixels are weighed down
        (level.weighed_down).
      model: "constant", "affine" or "quadratic" field over the image, or "local": a quadratic one
        and values on cells of 8 px, as smooth as the data ask, for layers and depth.
      prior_px: standard deviation expected of each component of the flow at the image centre, px
        per interval; weak evidence leaves the flow near zero.
      levels_px: Gaussian blur of the volume, coarse to fine.
      steps: Gauss-Newton steps at each.
      noise_floor: least noise assumed, relative to that of a Poisson volume with these counts;
        matters for counts without quantisation or noise.
      clock: "time": motion is even over the interval. "events": it goes as the events come, and may
        turn back (``path``); for sensors that saw the scene before the window began, in steady
        light.
      start_px: flow [B, 2] or [B, 2, H, W] on the pixels of the start, px per interval, expected of
        these windows (in a video, that of the window before): its least-squares fit by the
        polynomial is one more field to descend from, with the prior about it at the first of
        several levels. The descents from zero stay, and are averaged with it by the contrast of the
        events along each.
    Returns: FlowField on the pixels of the start of the interval: flow_px [B, 2, H, W] px per
      interval; covariance_px2 [B, 3, H, W] of its error by the posterior; confidence [B, H, W] in
      0..1, 1 - trace(covariance) / trace(prior covariance), both of the flow along the whole way
      (``path``); valid is False for samples without events, whose flow and confidence are 0 and
      whose covariance is the prior's.
    Gradient: counts, of flow, covariance and confidence; none to start_px.
    Raises: ShapeError, DomainError.
    Cost: linear in pixels and bins; a level of blur s works on a grid of spacing 2^floor(log2 s)
      px. start_px adds a descent on the first two levels.

    >>> import torch
    >>> from codesign.flow.export import evenly_timed
    >>> y, x = torch.meshgrid(torch.arange(48.0), torch.arange(64.0), indexing="ij")
    >>> times = (0.0, 0.25, 0.5, 0.75, 1.0)
    >>> rate = torch.stack([torch.sin((x - 2 * t) / 4) + torch.sin((y - t) / 5) for t in times])
    >>> counts = torch.stack([rate.clamp(min=0), (-rate).clamp(min=0)])[None]
    >>> estimate_lk(evenly_timed(counts)).flow_px[0, :, 24, 32].round(decimals=0).tolist()
    [2.0, 1.0]
    """
    check_slopes(volume)
    check_choice(model, "model", MODELS)
    check_choice(clock, "clock", CLOCKS)
    check_number(prior_px, "prior_px", above=0.0, most=LONGEST_PX)
    check_number(noise_floor, "noise_floor", 0.0)
    steps = check_whole(steps, "steps", 1, MOST_STEPS)
    if not isinstance(levels_px, Sequence) or not levels_px or isinstance(levels_px, str):
        raise DomainError(
            f"levels_px is {shown(levels_px)}; a list of blurs in pixels, coarse to fine, is needed."
        )
    for blur_px in levels_px:
        check_number(blur_px, "a blur of levels_px", LEAST_BLUR_PX, MOST_BLUR_PX)
    found = along_path(volume, clock)
    return field(
        volume,
        found[0],
        *descended(volume, found, model, prior_px, levels_px, steps, noise_floor, start_px),
    )


def descended(
    volume: EventVolume,
    found: tuple[Path, Tensor, Tensor],
    model: str = "local",
    prior_px: float = 3.0,
    levels_px: Sequence[float] = (4.0, 2.0, 1.0),
    steps: int = 3,
    noise_floor: float = 0.02,
    start_px: Tensor | None = None,
) -> tuple[Tensor, Tensor, Tensor]:
    """Flow [B, 2, H, W] px per way on the pixels of the start, its covariance [B, 3, H, W] and
    confidence [B, H, W].

    Args:
      found: as of ``level.along_path``. Others, gradient: as of ``estimate_lk``.
    """
    way, bins, density = found
    counts = volume.counts
    shape = Polynomials(MODELS[model], *counts.shape[-2:], prior_px, counts.device)
    descents = [Descent(shape, prior_px, model == "local", counts)]
    if start_px is not None:
        warm = Descent(shape, prior_px, model == "local", counts)
        net, share = _net(way, counts)
        begun = torch.where(_seen(counts)[:, None], check_start(start_px, counts) * net / share, 0)
        warm.begin(begun.detach(), way.start.detach())
        descents.insert(0, warm)
    for number, blur_px in enumerate(levels_px):
        level = Level(way, bins, density, shape, blur_px, noise_floor)
        last = number == len(levels_px) - 1
        bend = number > 0 or last
        if number == 1:  # a coarse blur may take one stripe for the next: another start
            descents.append(Descent(shape, prior_px, model == "local", counts))
        for descent in descents:
            descent.descend(level, steps, bend, last, expected=number == 0 and not last)
        while len(descents) > 1 and (number == 1 or last):
            other = descents.pop()
            descents[-1].join(other, level)
    return descents[0].at_start(way.start)


def field(
    volume: EventVolume,
    way: Path,
    flow: Tensor,
    covariance: Tensor,
    confidence: Tensor,
) -> FlowField:
    """FlowField over the interval of what was found along the way."""
    net, share = _net(way, volume.counts)
    interval_s = float(volume.collected_s.sum())
    covariance = share * covariance
    seen = _seen(volume.counts)
    confidence = torch.where(seen, confidence, 0)  # 1 - 1 rounds to 2e-16
    return FlowField(net * flow, seen, interval_s, confidence, covariance, way.net.detach())


def _net(way, counts):
    """[B, 1, 1, 1] displacement over the way, and the factor on variances."""
    net = way.net.to(counts)[:, None, None, None]
    return net, net.square() + TURNED * (1 - net.square())


def _seen(counts):
    """[B, H, W] whether a sample has events."""
    batch, *_, height, width = counts.shape
    return (counts.detach().sum((1, 2, 3, 4)) > 0)[:, None, None].expand(batch, height, width)


def check_slopes(volume: EventVolume) -> Tensor:
    """Counts [B, 2, bins, H, W] of a volume of 2 bins, rows and columns at least."""
    counts = check_volume(volume, least_bins=2)
    height, width = counts.shape[-2:]
    if min(height, width) < 2:
        raise ShapeError(
            f"an event volume of {height} x {width} pixels has no slopes both ways; give at least 2 x 2."
        )
    return counts


def check_start(start_px: Tensor, counts: Tensor) -> Tensor:
    """``start_px`` of ``estimate_lk`` as [B, 2, H, W], of the type of ``counts``."""
    batch, _, _, height, width = counts.shape
    if check(start_px, "...>=0", "start_px").ndim != 2:
        start_px = check_flow(start_px, (batch, 2, height, width), "start_px")
    elif tuple(start_px.shape) != (batch, 2):
        raise ShapeError(
            f"start_px is {list(start_px.shape)}; [{batch}, 2] or [{batch}, 2, {height}, {width}] is needed."
        )
    else:
        start_px = check_finite(start_px, "start_px")[:, :, None, None].expand(
            -1, -1, height, width
        )
    if (longest := float(start_px.detach().abs().max())) > LONGEST_PX:
        raise DomainError(
            f"start_px reaches {longest:g} px; at most {LONGEST_PX:g} px are possible."
        )
    return start_px.to(counts)


class Descent:
    """A field, and how surely it is known: a polynomial, and values on cells.

    Where not ``local``, the cells are no part of the flow. They are found once, at the end: what
    one polynomial does not explain is error of the field.
    """

    def __init__(self, shape: Polynomials, prior_px: float, local: bool, like: Tensor) -> None:
        """Args: like: [B, ...], tells batch, device and precision."""
        batch = len(like)
        self.shape = shape
        self.like = like
        # in units of the prior: parameters = unit @ found
        self.found = torch.zeros(batch, 2 * shape.terms, dtype=torch.float64, device=like.device)
        self.expected: Tensor | None = None
        self.precision = shape.one.expand(batch, -1, -1)
        self.local = local
        self.cells = Cells(batch, shape.height, shape.width, prior_px, like.device)

    def begin(self, flow_px: Tensor, start: Tensor) -> None:
        """Moves to the least-squares fit of a flow [B, 2, H, W], px per way, on the pixels of the
        start, which lies at ``start`` [B] on the way."""
        self.found = self.expected = self.shape.fitted(flow_px, start)

    def parameters(self) -> Tensor:
        """[B, 2K] of the polynomial, px per way."""
        return (self.found @ self.shape.unit.T).to(self.like)

    def flow(self, level: Level) -> Tensor:
        """[B, 2, h, w] px per way on the level's samples."""
        flow = level.moments.flow(self.parameters())
        return flow + self.cells.on(level).to(flow) if self.local else flow

    def descend(
        self,
        level: Level,
        steps: int,
        bend: bool,
        last: bool,
        expected: bool = False,
    ) -> None:
        """Moves to the best field, by steps no longer than the linearisation reaches.

        Args:
          bend: whether cells of a local field move too; they do from the second step on, or the
            only one, since what the polynomial has not yet reached looks like a local part.
          last: whether nothing follows.
          expected: whether the prior is about the field of ``begin``, which a blur that sees
            nothing then leaves as it is.
        """
        centre = (
            self.expected
            if expected and self.expected is not None
            else torch.zeros_like(self.found)
        )
        for step in range(steps):
            products = level.products(self.flow(level))
            evidence, pull = level.evidence(products)
            self.precision = self.shape.one + evidence
            change = torch.linalg.solve(self.precision, pull + centre - self.found)
            moved = self.shape.mean_square(change @ self.shape.unit.T)
            change = change * (1 + moved / (2 * level.sigma) ** 2).rsqrt()[:, None]
            self.found = self.found + change
            moves = bend and step >= min(1, steps - 1) if self.local else last and step == steps - 1
            if moves:
                by_polynomial = level.moments.flow((change @ self.shape.unit.T).to(self.like))
                self.cells.step(level, products, by_polynomial)

    def join(self, other: "Descent", level: Level) -> None:
        """The mean of this field and another, by how much contrast the events along each have;
        where this one began somewhere, also by the prior, which it has had few steps to meet."""
        more = level.contrast_along(self.flow(level)) - level.contrast_along(other.flow(level))
        if self.expected is not None:
            more = more + other.found.square().sum(1) - self.found.square().sum(1)
        share = torch.sigmoid(more / 2 + FIRST)[:, None]
        self.found = other.found + share * (self.found - other.found)
        if self.local:
            share = share[..., None, None]
            self.cells.value = other.cells.value + share * (self.cells.value - other.cells.value)

    def at_start(self, start: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Flow [B, 2, H, W], its covariance [B, 3, H, W] and confidence [B, H, W] on the pixels of
        the start, which lies at ``start`` [B] on the way."""
        unit = self.shape.unit
        spread = unit @ torch.linalg.inv(self.precision) @ unit.T
        return at_start(self.shape, self.parameters(), spread, self.cells, self.local, start)
