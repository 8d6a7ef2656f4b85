"""A small network that corrects the closed form: the volume is warped along the flow so far, and what still
moves says what to add."""

from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.functional import avg_pool2d, interpolate, pad, silu, unfold

from codesign.errors import DomainError
from codesign.flow.checks import check_count
from codesign.flow.entry import check_bins, pad_to, presence, takes_volume
from codesign.flow.layers import GROUPS, Layer
from codesign.flow.lk import estimate_lk
from codesign.flow.warp import along_flow
from codesign.types import EventVolume, FlowField

STRIDE = 16  # sizes are padded to multiples of this
# pixels a side over which the volume is averaged before anything else: no coarser than the closed form's
# finest blur
POOL = 2
CELL = 2  # averaged pixels a side of the cells on which flow is corrected
SCALES = (1, 2, 4)  # averaged pixels over which slopes are taken
SEEN = 6 * len(SCALES) + 2  # what ``_evidence`` tells of a cell
JUDGED = 12  # averaged pixels a side of the windows in which start and corrected flow are compared
PRIOR_PX = 8.0
LARGEST = 8.0  # event rates that many times the usual one are compressed
FLOOR_PX2 = 1e-3  # variance claimed at least


class Refiner(nn.Module):
    """Event flow by a few corrections of the closed form (quadratic field).

    Args: bins: time bins of the volumes. width: channels on the finest grid, a multiple of 4. steps:
      corrections, by the same weights.
    A correction warps the volume along the flow so far. A small U-Net on cells of 4 to 16 px reads the bins
    as they are and as they are warped, the flow so
    far, and the local least-squares solutions of V_t + u V_x + v V_y = 0 for what still moves, at three
    scales; it adds to the flow on cells of 8 and of 4 px.
    Warping looks bins up at q + t flow(q), so the flow belongs to the pixels of the window's start, as the
    truth does.

    >>> from codesign.flow.export import evenly_timed
    >>> network = Refiner(bins=4, width=8, steps=1)
    >>> network(evenly_timed(torch.ones(1, 2, 4, 32, 48))).flow_px.shape
    torch.Size([1, 2, 32, 48])
    """

    def __init__(self, bins: int = 8, width: int = 28, steps: int = 2) -> None:
        super().__init__()
        check_bins(bins)
        check_count(steps, "steps", 1)
        width = check_count(width, "width", 1)
        if width < GROUPS or width % GROUPS:
            raise DomainError(
                f"width = {width}, steps = {steps}; a width that is a multiple of {GROUPS} and at least 1 "
                "step are needed."
            )
        self.config: dict[str, Any] = {"bins": bins, "width": width, "steps": steps}
        c = width
        self.texture = Layer(4 * bins + 2, c)
        self.fine = Layer(c, 2 * c, stride=2)
        self.middle = Layer(2 * c + SEEN, 3 * c, stride=2)
        self.coarse = Layer(3 * c, 3 * c, stride=2)
        self.residual = nn.Sequential(Layer(3 * c, 3 * c), Layer(3 * c, 3 * c, active=False))
        self.join_middle = Layer(6 * c, 2 * c)
        self.join_fine = Layer(4 * c + SEEN + 2, 2 * c)
        self.change_middle = nn.Conv2d(2 * c, 2, 1)
        self.change_fine = nn.Conv2d(2 * c, 2, 1)
        self.blend = nn.Conv2d(2 * c, 9 * (POOL * CELL) ** 2, 1)
        self.doubt = nn.Conv2d(2 * c, 1, 1)
        for last in (self.blend, self.doubt):
            for parameter in last.parameters():
                nn.init.zeros_(parameter)

    @takes_volume
    def forward(self, volume: EventVolume) -> FlowField:
        """Flow of an EventVolume [B, 2, bins, H, W] of any H, W.

        The corrected flow counts where it leaves less that moves than the start does, over windows of 26 px;
        the start where it does not. So the answer stays near the closed form where that is right already.
        Returns: FlowField with confidence and covariance (the same along x and y). An empty sample has flow
          0, confidence 0 and no gradient.
        Gradient: counts and weights.
        Raises: ShapeError for other shapes or numbers of bins; DomainError for counts that are not finite.
        """
        bins = _Bins(volume, self.config["bins"])
        start_px = bins.padded(_closed_form(volume))
        flow_px, doubt = self._corrected(bins, start_px)[-1]
        misfits = [bins.misfit(flow) for flow in (start_px, flow_px)]
        share = misfits[0].square() / (misfits[0].square() + misfits[1].square())
        return _field(start_px + _larger(share[:, None], POOL) * (flow_px - start_px), doubt, volume)

    @takes_volume
    def predictions(self, volume: EventVolume, start_px: Tensor | None = None) -> list[FlowField]:
        """FlowFields after each correction, by themselves: what training looks at. start_px: [B, 2, H, W]
        flow to begin with instead of the closed form's."""
        bins = _Bins(volume, self.config["bins"])
        start_px = bins.padded(_closed_form(volume) if start_px is None else start_px)
        return [_field(flow_px, doubt, volume) for flow_px, doubt in self._corrected(bins, start_px)]

    def _corrected(self, bins, start_px):
        """(flow px, log variance px^2) of the padded volume after each correction."""
        flow = avg_pool2d(start_px, POOL * CELL) / POOL  # in averaged pixels
        found = []
        for step in range(self.config["steps"]):
            dense = _larger(flow, CELL)
            warped = bins.warped(dense)
            with torch.autocast(flow.device.type, enabled=False):
                seen = _evidence(*bins.mean_and_slope(warped), warped)
            change, core = self._correction(
                torch.cat([warped, bins.rates], 1).flatten(1, 2), dense * (POOL / PRIOR_PX), seen
            )
            flow = flow + change
            last = step + 1 == self.config["steps"]
            flow_px = POOL * (
                _blended(flow, self.blend(core), POOL * CELL) if last else _larger(flow, POOL * CELL)
            )
            found.append((flow_px, _larger(self.doubt(core), POOL * CELL)[:, 0]))
        return found

    def _correction(self, rates, dense, seen):
        """Change of the flow on cells [B, 2, h, w], and the features it came from."""
        fine = self.fine(self.texture(torch.cat([rates, dense], 1)))
        middle = self.middle(torch.cat([fine, seen], 1))
        coarse = self.coarse(middle)
        coarse = silu(coarse + self.residual(coarse))
        core = self.join_middle(torch.cat([_larger(coarse, 2), middle], 1))
        change = _larger(self.change_middle(core), 2)
        core = self.join_fine(torch.cat([_larger(core, 2), fine, seen, change], 1))
        return change + self.change_fine(core), core


def _larger(image, factor):
    return interpolate(image, scale_factor=factor, mode="bilinear", align_corners=False)


def _field(flow_px, doubt, volume):
    """FlowField cropped to the volume's size, faded in with the sample's events. doubt: [B, H, W] log
    variance, px^2."""
    counts = volume.counts
    height, width = counts.shape[-2:]
    shown = presence(counts)
    variance = (
        FLOOR_PX2 + PRIOR_PX**2 * (1 - shown[:, 0]) + shown[:, 0] * torch.exp(doubt[:, :height, :width])
    )
    valid = (counts.detach().sum((1, 2, 3, 4)) > 0)[:, None, None].expand(-1, height, width)
    confidence = shown[:, 0] * PRIOR_PX**2 / (PRIOR_PX**2 + variance)
    covariance = torch.stack([variance, torch.zeros_like(variance), variance], 1)
    return FlowField(
        shown * flow_px[..., :height, :width], valid, float(volume.collected_s.sum()), confidence, covariance
    )


def _closed_form(volume):
    with torch.autocast(volume.counts.device.type, enabled=False):  # its solves need full precision
        return estimate_lk(volume, model="quadratic").flow_px


class _Bins:
    """Event rates [B, 2, bins, h, w] of a volume, averaged over POOL x POOL px, and how they are read.

    Rates are in units of the sample's root mean square, large ones compressed smoothly; sides are padded with
    empty pixels to multiples of STRIDE.
    """

    def __init__(self, volume, bins):
        counts = volume.counts
        span = volume.collected_s.sum()
        self.share, self.time = (
            (values / span).to(counts) for values in (volume.collected_s, volume.centroid_s)
        )
        self.extra = (0, -counts.shape[-1] % STRIDE, 0, -counts.shape[-2] % STRIDE)
        rate = avg_pool2d(pad_to(counts.flatten(1, 2), STRIDE), POOL).unflatten(1, (2, -1)) / (
            self.share[:, None, None] * bins
        )
        rate = rate * (rate.sum(1).square().mean((1, 2, 3)) + 1e-4).rsqrt()[:, None, None, None, None]
        self.rates = rate * (1 + (rate / LARGEST).square()).rsqrt()

    def padded(self, flow_px):
        """A flow of the volume continued to the padded size."""
        return pad(flow_px, self.extra, mode="replicate") if any(self.extra) else flow_px

    def warped(self, flow):
        """Rates along a flow in averaged pixels [B, 2, h, w]."""
        with torch.autocast(flow.device.type, enabled=False):
            return along_flow(self.rates, flow.to(self.rates.dtype), self.time)

    def mean_and_slope(self, rates):
        """Mean over the bins of ON less OFF, and its slope over time per window, [B, h, w] each."""
        signed = rates[:, 0] - rates[:, 1]
        centred = self.time - (self.share * self.time).sum()
        slope_weight = self.share * centred / (self.share * centred.square()).sum()
        return (signed * self.share[:, None, None]).sum(1), (signed * slope_weight[:, None, None]).sum(1)

    def misfit(self, flow_px):
        """Mean square of what still moves along a flow [B, 2, H, W] px, over windows, [B, h, w], on a small
        floor, so that two flows that fit alike share."""
        energy = self.mean_and_slope(self.warped(avg_pool2d(flow_px, POOL) / POOL))[1].square()
        reach = min(JUDGED // 2, *(side - 1 for side in energy.shape[-2:]))
        near = avg_pool2d(
            pad(energy[:, None], (reach, reach, reach, reach), mode="reflect"), 2 * reach + 1, stride=1
        )[:, 0]
        return near + 1e-3 * energy.mean((1, 2), keepdim=True) + 1e-4


def _evidence(mean, moving, warped):
    """What the warped bins [B, 2, bins, h, w], their mean and slope, say about the flow that is still
    missing, on cells [B, SEEN, h / CELL, w / CELL].

    Mean and mean square of the rate; per scale the local least-squares flow (2), orientation (2) and strength
    (1) of the texture, strength of what moves (1).
    """
    both = torch.stack([mean, moving], 1)
    square = (warped[:, 0] - warped[:, 1]).square().mean(1)
    found = [avg_pool2d(torch.stack([mean, square], 1), CELL)]
    for scale in SCALES:
        level = avg_pool2d(both, scale) if scale > 1 else both
        edge = pad(level[:, :1], (1, 1, 1, 1), mode="replicate")[:, 0]
        dx = (edge[:, 1:-1, 2:] - edge[:, 1:-1, :-2]) / (2 * scale)
        dy = (edge[:, 2:, 1:-1] - edge[:, :-2, 1:-1]) / (2 * scale)
        slope = level[:, 1]
        products = torch.stack([dx * dx, dx * dy, dy * dy, dx * slope, dy * slope, slope * slope], 1)
        if scale < CELL:
            products = avg_pool2d(products, CELL // scale)
        products = avg_pool2d(products, 3, stride=1, padding=1, count_include_pad=False)
        local = _local_flow(products, 4.0 * scale)
        found.append(
            interpolate(local, scale_factor=scale // CELL, mode="nearest") if scale > CELL else local
        )
    return torch.cat(found, 1)


def _local_flow(products, reach):
    """Damped least-squares flow within ``reach``, and what it rests on, [B, 6, h, w], from the sums xx, xy,
    yy, xs, ys, ss of slopes in space and time."""
    xx, xy, yy, xs, ys, ss = products.unbind(1)
    damping = 0.02 * (xx + yy).mean((1, 2), keepdim=True) + 0.02 * ss * (POOL / PRIOR_PX) ** 2 + 1e-6
    a = xx + damping
    b = yy + damping
    determinant = a * b - xy * xy  # at least damping squared
    u = (xy * ys - b * xs) / determinant
    v = (xy * xs - a * ys) / determinant
    limit = (1 + (u * u + v * v) / reach**2).rsqrt()
    return torch.stack(
        [
            u * limit,
            v * limit,
            (xx - yy) / (a + b),
            2 * xy / (a + b),
            (xx + yy + 1e-6).log() / 4,
            (ss + 1e-6).log() / 4,
        ],
        1,
    )


def _blended(flow, weights, factor):
    """Every fine pixel as a learnt mean of the nine cells around its own (Teed and Deng, RAFT, ECCV 2020,
    section 3.3)."""
    batch, _, height, width = flow.shape
    mix = weights.reshape(batch, 1, 9, factor, factor, height, width).softmax(2)
    near = unfold(pad(flow, (1, 1, 1, 1), mode="replicate"), 3).reshape(batch, 2, 9, 1, 1, height, width)
    return (mix * near).sum(2).permute(0, 1, 4, 2, 5, 3).reshape(batch, 2, factor * height, factor * width)
