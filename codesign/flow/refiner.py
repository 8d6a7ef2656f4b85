"""A small network that corrects the closed form: the volume is warped along the flow so far, and what still moves says what to add."""

import torch
from torch import nn
from torch.nn.functional import avg_pool2d, interpolate, pad, unfold

from codesign.errors import DomainError, ShapeError, check_finite
from codesign.flow.lk import estimate_lk
from codesign.flow.warp import along_flow
from codesign.types import FlowField

STRIDE = 16  # sizes are padded to multiples of this
POOL = 2  # the volume is averaged over so many pixels a side before anything else; the closed form's finest blur is as wide
CELL = 2  # and the network works on cells of so many averaged pixels a side
SCALES = (1, 2, 4)  # averaged pixels over which slopes are taken
GATE_EVENTS = 2.0
PRIOR_PX = 8.0
LARGEST = 8.0  # event rates that many times the usual one count as one or two
FLOOR_PX2 = 1e-3  # variance of a flow known as well as can be


class Refiner(nn.Module):
    """Event flow by a few corrections of the closed form.

    Args: bins: time bins of the volumes. width: channels on the finest grid, a multiple of 8. steps: corrections.
    Every correction warps the volume along the flow so far and reads, on cells of 4 x 4 px, the warped bins and the local least-squares solutions of
    V_t + u V_x + v V_y = 0 at three scales; a small U-Net with memory between steps turns them into a change of the flow. Warping looks bins up at
    q + t flow(q), so the flow belongs to the pixels of the window's start, as the truth does.
    """

    def __init__(self, bins=8, width=32, steps=3):
        super().__init__()
        if bins < 2 or steps < 1 or width < 8 or width % 8:
            raise DomainError(f"bins = {bins}, width = {width}, steps = {steps}; at least 2 bins, 1 step, and a width that is a multiple of 8 are needed.")
        self.config = {"bins": bins, "width": width, "steps": steps}
        self.bins, self.steps = bins, steps
        self.texture = nn.Conv2d(bins, width, 2 * CELL, stride=CELL, padding=CELL // 2)
        self.enter = _Block(2 * width + 6 * len(SCALES) + 2 + 2, width)
        self.coarser = _Block(width, 2 * width, stride=2)
        self.coarsest = _Block(2 * width, 3 * width, stride=2)
        self.whole = _Block(3 * width, 3 * width, whole=True)
        self.up_coarser = _Up(3 * width, 2 * width)
        self.up = _Up(2 * width, width)
        self.change = nn.Conv2d(width, 2, 3, padding=1)
        self.memory = nn.Conv2d(width, width, 1)
        self.blend = nn.Conv2d(width, 9 * (POOL * CELL) ** 2, 1)
        self.doubt = nn.Conv2d(width, 1, 3, padding=1)
        for last in (self.change, self.blend, self.doubt):
            nn.init.zeros_(last.weight)
            nn.init.zeros_(last.bias)

    def forward(self, volume):
        """FlowField of a volume [B, 2, bins, H, W], with confidence and covariance. Gradient: counts and weights."""
        return self.predictions(volume)[-1]

    def predictions(self, volume, start_px=None):
        """FlowFields after each correction, the last one the answer. start_px: [B, 2, H, W] flow to begin with instead of the closed form's.

        Raises: ShapeError for other shapes or numbers of bins; DomainError for counts that are not finite.
        """
        counts = volume.counts
        if counts.ndim != 5 or counts.shape[1] != 2 or counts.shape[2] != self.bins or min(counts.shape) < 1:
            raise ShapeError(f"this network takes event volumes [B, 2, {self.bins}, H, W], got {tuple(counts.shape)}; make the volume with {self.bins} bins.")
        check_finite(counts, "event volume")
        height, width = counts.shape[-2:]
        if start_px is None:
            start_px = estimate_lk(volume).flow_px
        span = volume.collected_s.sum()
        share, time = ((values / span).to(counts) for values in (volume.collected_s, volume.centroid_s))
        extra = (0, -width % STRIDE, 0, -height % STRIDE)
        signed = _rates(avg_pool2d(pad(counts.flatten(1, 2), extra), POOL), share)
        flow = avg_pool2d(pad(start_px, extra, mode="replicate"), POOL * CELL) / POOL  # in averaged pixels
        state = flow.new_zeros(flow.shape[0], self.memory.out_channels, *flow.shape[-2:])
        gate, fields = _gate(counts), []
        for step in range(self.steps):
            dense = interpolate(flow, scale_factor=CELL, mode="bilinear", align_corners=False)
            warped = along_flow(signed, dense, time)
            core = self._core(torch.cat([self.texture(warped), _evidence(warped, share, time), flow * (POOL / PRIOR_PX), state], 1))
            flow = flow + self.change(core) / POOL
            state = torch.tanh(self.memory(core))
            if step + 1 == self.steps:
                flow_px = _blended(POOL * flow, self.blend(core), POOL * CELL)
            else:
                flow_px = POOL * interpolate(flow, scale_factor=POOL * CELL, mode="bilinear", align_corners=False)
            fields.append(self._field(flow_px, core, gate, volume))
        return fields

    def _core(self, features):
        fine = self.enter(features)
        coarser = self.coarser(fine)
        return self.up(self.up_coarser(self.whole(self.coarsest(coarser)), coarser), fine)

    def _field(self, flow_px, core, gate, volume):
        counts = volume.counts
        height, width = counts.shape[-2:]
        doubt = interpolate(self.doubt(core), scale_factor=POOL * CELL, mode="bilinear", align_corners=False)[:, 0, :height, :width]
        trust = gate * torch.sigmoid(-doubt)
        variance = PRIOR_PX**2 * (1 - gate) + gate * torch.exp(doubt) + FLOOR_PX2
        valid = (counts.detach().sum((1, 2, 3, 4)) > 0)[:, None, None].expand(-1, height, width)
        flow_px = gate[:, None] * flow_px[..., :height, :width]
        return FlowField(flow_px, valid, float(volume.collected_s.sum()), trust, torch.stack([variance, torch.zeros_like(variance), variance], 1))


class _Block(nn.Module):
    """A 3 x 3 convolution and a residual one, with group normalisation and SiLU; ``whole`` adds what the mean over the image says."""

    def __init__(self, entering, leaving, stride=1, whole=False):
        super().__init__()
        self.first = nn.Conv2d(entering, leaving, 3, stride=stride, padding=1)
        self.second = nn.Conv2d(leaving, leaving, 3, padding=1)
        self.norms = nn.ModuleList([nn.GroupNorm(leaving // 8, leaving) for _ in range(2)])
        self.whole = nn.Linear(leaving, leaving) if whole else None
        self.bend = nn.SiLU()

    def forward(self, x):
        x = self.bend(self.norms[0](self.first(x)))
        if self.whole is not None:
            x = x + self.whole(x.mean((2, 3)))[:, :, None, None]
        return x + self.bend(self.norms[1](self.second(x)))


class _Up(nn.Module):
    """Twice the size, joined with what the finer grid knew."""

    def __init__(self, entering, leaving):
        super().__init__()
        self.bring = nn.Conv2d(entering, leaving, 1)
        self.join = nn.Conv2d(leaving, leaving, 3, padding=1)
        self.norm = nn.GroupNorm(leaving // 8, leaving)
        self.bend = nn.SiLU()

    def forward(self, coarse, fine):
        x = fine + interpolate(self.bring(coarse), scale_factor=2, mode="bilinear", align_corners=False)
        return x + self.bend(self.norm(self.join(x)))


def _rates(counts, share):
    """Signed event rates [B, bins, H, W] from counts [B, 2 bins, H, W], in units of the sample's root mean square, large ones compressed smoothly."""
    on, off = counts.chunk(2, 1)
    scale = 1 / (share[:, None, None] * len(share))
    rate = (on - off) * scale
    size = (((on + off) * scale).square().mean((1, 2, 3), keepdim=True) + 1e-4).rsqrt()
    rate = rate * size
    return rate * (1 + (rate / LARGEST).square()).rsqrt()


def _gate(counts):
    """[B, 1, 1]: 0 for an empty sample, 1 for one with events; flat at 0, so that an empty sample has zero gradient."""
    square = counts.sum((1, 2, 3, 4)).square()
    return (square / (square + GATE_EVENTS**2))[:, None, None]


def _evidence(warped, share, time):
    """What the warped bins say about the flow that is still missing, on cells [B, 2 + 6 scales, h, w].

    Mean and mean square of the rate; per scale the local least-squares flow (2), orientation (2) and strength (1) of the texture, strength of what moves (1).
    """
    weight = share[:, None, None]
    middle = (share * time).sum()
    lean = weight * (time - middle)[:, None, None] / (share * (time - middle).square()).sum()
    mean, slope = (warped * weight).sum(1, keepdim=True), (warped * lean).sum(1, keepdim=True)
    both = torch.cat([mean, slope], 1)
    found = [avg_pool2d(torch.cat([mean, warped.square().mean(1, keepdim=True)], 1), CELL)]
    for scale in SCALES:
        level = avg_pool2d(both, scale) if scale > 1 else both
        edge = pad(level[:, :1], (1, 1, 1, 1), mode="replicate")[:, 0]
        dx = (edge[:, 1:-1, 2:] - edge[:, 1:-1, :-2]) / (2 * scale)
        dy = (edge[:, 2:, 1:-1] - edge[:, :-2, 1:-1]) / (2 * scale)
        moving = level[:, 1]
        products = torch.stack([dx * dx, dx * dy, dy * dy, dx * moving, dy * moving, moving * moving], 1)
        if scale < CELL:
            products = avg_pool2d(products, CELL // scale)
        products = avg_pool2d(products, 3, stride=1, padding=1, count_include_pad=False)
        xx, xy, yy, xs, ys, ss = products.unbind(1)
        damping = 0.02 * (xx + yy).mean((1, 2), keepdim=True) + 0.02 * ss * (POOL / PRIOR_PX) ** 2 + 1e-6
        a, b = xx + damping, yy + damping
        det = a * b - xy * xy  # at least damping squared
        u, v = (xy * ys - b * xs) / det, (xy * xs - a * ys) / det
        limit = (1 + (u * u + v * v) / (4.0 * scale) ** 2).rsqrt()
        seen = torch.stack([u * limit, v * limit, (xx - yy) / (a + b), 2 * xy / (a + b), (xx + yy + 1e-6).log() / 4, (ss + 1e-6).log() / 4], 1)
        found.append(interpolate(seen, scale_factor=scale // CELL, mode="nearest") if scale > CELL else seen)
    return torch.cat(found, 1)


def _blended(flow, weights, factor):
    """Every fine pixel as a learnt mean of the nine cells around its own (Teed and Deng, RAFT, ECCV 2020, section 3.3)."""
    batch, _, height, width = flow.shape
    mix = weights.reshape(batch, 1, 9, factor, factor, height, width).softmax(2)
    near = unfold(pad(flow, (1, 1, 1, 1), mode="replicate"), 3).reshape(batch, 2, 9, 1, 1, height, width)
    return (mix * near).sum(2).permute(0, 1, 4, 2, 5, 3).reshape(batch, 2, factor * height, factor * width)
