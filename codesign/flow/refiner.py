"""A small network that corrects the closed form: the volume is warped along the flow so far, and
what still moves says what to add."""

import math
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.functional import avg_pool2d, pad, pixel_shuffle, silu

from codesign.checks import check_whole
from codesign.errors import DomainError
from codesign.flow.checks import MOST_STEPS
from codesign.flow.entry import Layer, check_bins, pad_to, presence, takes_volume
from codesign.flow.lk import estimate_lk
from codesign.flow.refiner_evidence import AROUND, CELL, FEW, SOLVED, TOLD, TRIED, Evidence, larger
from codesign.types import EventVolume, FlowField

NEVER = 1e-3  # weight that a cell has at least in a mean of cells, before training
LEAST_NET = 0.5  # flows along the way are not taken longer than the displacement over this
TURNS = 4  # power of the displacement over the way by which corrections fade
COARSEST = 4  # cells a side of the coarsest grid
PRIOR_PX = 3.0  # deviation of each component where nothing is known, as in the closed form
FAR_PX = 8.0  # flows and changes of flow come into the network in these units
NEAR_PX = 2.0
READ = 48  # channels made of the bins
OWN = 7  # what is told beside bins and evidence
WIDEST = 10.0  # logarithm of the largest factor on a claim
SMALLEST_PX2 = 1e-4
SPARE_PX2 = 0.01  # unit of the variance that is added to the start's claim
# what one quadratic field leaves of the start, over its length, at which the correction counts by
# half,
BENT = 0.01
BENT_PX = 0.03  # and in px
POWERS = (0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2)  # of x and y in a quadratic field


class Refiner(nn.Module):
    """Event flow by a few corrections of the closed form ("local").

    Args:
      bins: time bins of the volumes.
      width: channels on cells of 4 px, a multiple of 16.
      steps: corrections, by the same weights.
    A correction reads the volume along the flow so far and solves V_t + u V_x + v V_y = 0 by least
    squares for what still moves, on cells of 4 px, at three blurs and in windows of 12, 28 and 36
    px, and tries the flows of cells around (refiner_evidence). A U-Net on cells of 4, 8 and 16 px
    reads these solutions and how sure they are, the bins as they are and along the flow so far, all
    in units of the noise of scattered events, the density of events, the flow so far and the
    deviation that the closed form claims. It says cell by cell how much of each solution and
    neighbour to add, adds something of its own in units of the claimed deviation, and says how
    pixels mix cells and how wide the claim is to be. Fresh weights give the closed form as it is.
    Bins are read at q + t flow(q), so the flow belongs to the pixels of the window's start. The
    correction counts as far as the closed form bends away from one quadratic field: it does so
    where the events have evidence for it, and
      without any (noise, thin packets, cameras that turn) the closed form stands as it is.

    >>> from codesign.flow.export import evenly_timed
    >>> network = Refiner(bins=4, width=16, steps=1)
    >>> network(evenly_timed(torch.ones(1, 2, 4, 32, 48))).flow_px.shape
    torch.Size([1, 2, 32, 48])
    """

    def __init__(self, bins: int = 8, width: int = 48, steps: int = 2) -> None:
        super().__init__()
        check_bins(bins)
        check_whole(steps, "steps", 1, MOST_STEPS)
        width = check_whole(width, "width", 1, MOST_STEPS)
        if width % 16:
            raise DomainError(f"width is {width}; a multiple of 16 is needed.")
        self.config: dict[str, Any] = {"bins": bins, "width": width, "steps": steps}
        wide = 4 * width // 3 // 16 * 16
        self.reading = nn.Conv2d(2 * bins, READ, 3, 2, 1)
        self.fine = Layer(READ + TOLD + TRIED + OWN, width)
        self.middle = Layer(width, wide, 2)
        self.coarse = Layer(wide, 2 * width, 2)
        self.residual = Layer(2 * width, 2 * width)
        self.join_middle = Layer(2 * width + wide, wide)
        self.narrow = nn.Conv2d(wide, 2 * width // 3, 1)
        self.join_fine = Layer(width + 2 * width // 3, width)
        self.change = nn.Conv2d(width, 2 + SOLVED + len(AROUND), 1)
        self.claim = nn.Conv2d(width, 2, 1)
        self.edges = nn.Conv2d(width, 9 * CELL**2, 1)
        for last in (self.change, self.claim, self.edges):
            for parameter in last.parameters():
                nn.init.zeros_(parameter)

    def forward(
        self,
        volume: EventVolume,
        start_px: Tensor | None = None,
        clock: str = "time",
    ) -> FlowField:
        """Flow of an EventVolume [B, 2, bins, H, W] of any H, W.

        Args:
          start_px: [B, 2] or [B, 2, H, W] flow that is expected, px per interval, such as that of
            the window before: the closed form begins from it too (``estimate_lk``).
          clock: "time" or "events", as of ``estimate_lk``; corrections fade where motion turns
            back.
        Returns: FlowField with confidence and covariance. An empty sample has flow 0, confidence 0
          and no gradient.
        Gradient: counts and weights.
        Raises: ShapeError for other shapes or numbers of bins; DomainError for counts that are no
          events.
        """
        return self.predictions(volume, start_px, clock, every=False)[-1]

    @takes_volume
    def predictions(
        self,
        volume: EventVolume,
        start_px: Tensor | None = None,
        clock: str = "time",
        every: bool = True,
    ) -> list[FlowField]:
        """FlowFields after each correction, or the last alone. Arguments, gradient and errors as
        ``forward``."""
        start = self.start(volume, start_px, clock)
        with torch.autocast(volume.counts.device.type, enabled=False):
            share = _bends(start.flow_px)
        return [
            _mixed(volume, start, field, share)
            for field in self.refined(volume, start, clock=clock, every=every)
        ]

    def start(
        self,
        volume: EventVolume,
        start_px: Tensor | None = None,
        clock: str = "time",
    ) -> FlowField:
        """The closed form that is corrected."""
        # its solves need full precision
        with torch.autocast(volume.counts.device.type, enabled=False):
            return estimate_lk(volume, model="local", start_px=start_px, clock=clock)

    def refined(
        self,
        volume: EventVolume,
        start: FlowField,
        through: bool = True,
        clock: str = "time",
        every: bool = True,
    ) -> list[FlowField]:
        """FlowFields after each whole correction, as it is trained, or after the last alone, of an
        estimate with covariance, such as ``start(volume)``, whose covariance says how far it may be
        off. Gradient: counts, start and weights.

        through: False leaves out the gradient through the places at which bins are read, as in the
          training of RAFT (Teed and Deng, ECCV 2020): it takes a third off a step.
        """
        with torch.autocast(volume.counts.device.type, enabled=False):
            evidence = Evidence(replace(volume, counts=pad_to(volume.counts, CELL)), clock)
        net = evidence.net.clamp_min(LEAST_NET)
        claimed = start.covariance_px2
        deviation = _on_cells((claimed[:, :1] + claimed[:, 2:]) / 2) / net.square()
        first = flow = _on_cells(start.flow_px) / net
        near = avg_pool2d(evidence.density, 3, 1, 1, count_include_pad=False) + FEW
        far = evidence.mean_density.expand_as(near)
        told = torch.cat([near.log(), far.log(), (deviation + SPARE_PX2).log()], 1) / 4
        unit = (deviation + SMALLEST_PX2).sqrt()
        found = []
        for left in reversed(range(self.config["steps"])):
            with torch.autocast(flow.device.type, enabled=False):
                where = flow if through else flow.detach()
                known, solved = evidence.at(where, unit.square())
                bins = evidence.bins(where)
                tried, offered = evidence.others(where)
            read = silu(self.reading(bins))
            parts = [read, known, tried, told, flow / FAR_PX, (flow - first) / NEAR_PX]
            core = self._core(torch.cat(parts, 1))
            own, shares = self.change(core).split([2, SOLVED + len(AROUND)], 1)
            moves = torch.cat([solved, offered], 1)
            flow = flow + unit * own + (shares[:, :, None] * moves).sum(1)
            if every or not left:
                change = _on_pixels(net * (flow - first), self.edges(core))
                found.append((change, self.claim(core)))
        present = presence(volume.counts)
        shown = present * evidence.net.clamp_min(0) ** TURNS
        return [_field(volume, start, present, shown, *parts) for parts in found]

    def _core(self, known):
        """Features [B, width, h, w] of the cells, from what is known of them; beyond the image
        nothing is."""
        rows, columns = known.shape[-2:]
        fine = self.fine(pad_to(known, COARSEST))
        middle = self.middle(fine)
        coarse = self.coarse(middle)
        coarse = coarse + self.residual(coarse)
        middle = self.join_middle(torch.cat([larger(coarse, 2), middle], 1))
        core = self.join_fine(torch.cat([larger(self.narrow(middle), 2), fine], 1))
        return core[..., :rows, :columns]


def _on_cells(image):
    """Means of an image [B, C, H, W] over cells, continued beyond its border."""
    extra = (0, -image.shape[-1] % CELL, 0, -image.shape[-2] % CELL)
    return avg_pool2d(pad(image, extra, mode="replicate") if any(extra) else image, CELL)


def mixed(image: Tensor, logits: Tensor) -> Tensor:
    """Pixels [B, C, side h, side w] of an image [B, C, h, w] on cells: each a mean of the nine
    cells around, by weights of these logits [B, 9 side^2, h, w]. Source: Teed and Deng, RAFT, ECCV
    2020, sec. 3.3."""
    rows, columns = image.shape[2:]
    side = math.isqrt(logits.shape[1] // 9)
    weights = logits.unflatten(1, (9, side, side)).softmax(1)
    around = pad(image, (1, 1, 1, 1), mode="replicate")[:, :, None, None]
    found = sum(
        weights[:, None, 3 * down + right]
        * around[..., down : down + rows, right : right + columns]
        for down in range(3)
        for right in range(3)
    )
    return pixel_shuffle(found.flatten(1, 3), side)


def _on_pixels(image, edges):
    """``mixed`` by weights that begin as those of linear interpolation (edges [B, 9 CELL^2, h, w]
    are 0)."""
    return mixed(image, edges + _linear().to(edges).log().flatten()[:, None, None])


def _linear():
    """[9, CELL, CELL] weights of the nine cells around in linear interpolation to the pixels of the
    middle one."""
    place = (torch.arange(CELL) + 0.5) / CELL - 0.5
    along = torch.stack([-place, 1 - place.abs(), place]).clamp_min(NEVER)
    return (along[:, None, :, None] * along[None, :, None, :]).flatten(0, 1)


def _field(volume, start, present, shown, change, claim):
    """FlowField from the change of the flow [B, 2, >= H, >= W] px and the claim [B, 2, h, w] on
    cells:
    logarithms of the factor on the start's covariance and of the variance that is added; ``shown``
    [B, 1, 1, 1] is how much of both counts."""
    height, width = start.flow_px.shape[-2:]
    change, claim = (part[..., :height, :width] for part in (change, larger(claim, CELL)))
    factor, added = (WIDEST * torch.tanh(claim / WIDEST)).exp().split(1, 1)
    covariance = start.covariance_px2 * (1 + shown * (factor - 1))
    added = shown * SPARE_PX2 * added
    covariance = covariance + torch.cat([added, torch.zeros_like(added), added], 1)
    return _claiming(volume, start.flow_px + shown * change, covariance, present)


def _claiming(volume, flow, covariance, present):
    """FlowField whose confidence follows from its covariance."""
    spread = (covariance[:, 0] + covariance[:, 2]) / 2
    confidence = present[:, 0] / (1 + spread / PRIOR_PX**2)
    valid = (present.detach() > 0)[:, 0].expand_as(spread)
    return FlowField(flow, valid, float(volume.collected_s.sum()), confidence, covariance)


def _bends(flow):
    """[B, 1, 1, 1] in 0..1 by the root mean square of what a quadratic field leaves of a flow
    [B, 2, H, W]."""
    y, x = (torch.linspace(-1, 1, size).to(flow) for size in flow.shape[2:])
    y, x = torch.meshgrid(y, x, indexing="ij")
    height, width = flow.shape[2:]  # a film of a row or two has fewer directions
    powers = [(i, j) for i, j in POWERS if i < width and j < height]
    basis = torch.stack([x**i * y**j for i, j in powers], -1).flatten(0, 1)
    basis = torch.linalg.qr(basis).Q
    whole = flow.flatten(2)
    left = whole - whole @ basis @ basis.T
    left, whole = (part.square().sum(1).mean(1) for part in (left, whole))
    return (left / (left + BENT**2 * whole + BENT_PX**2))[:, None, None, None]


def _mixed(volume, start, corrected, share):
    """Mean and covariance of the belief that the correction is right by ``share``, and else the
    start."""
    change = corrected.flow_px - start.flow_px
    x, y = change.unbind(1)
    apart = share * (1 - share) * torch.stack([x * x, x * y, y * y], 1)
    covariance = torch.lerp(start.covariance_px2, corrected.covariance_px2, share.expand_as(apart))
    return _claiming(
        volume, start.flow_px + share * change, covariance + apart, presence(volume.counts)
    )
