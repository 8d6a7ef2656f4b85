"""Are flows too short? Textures that shift evenly: analytic rates, hard events of a sensor whose memory has seen the
motion for a whole window before, and for a quarter of one."""

import numpy as np
import torch
from scipy.ndimage import map_coordinates, spline_filter

from codesign import flow
from codesign.events import from_counts, memory
from scenes import flow_textures

SIDE = 64
MARGIN = 20  # px that textures reach beyond the image
INTERVALS = 64
BINS = 8
SIZES_PX = (0.5, 1.0, 2.0, 4.0, 6.0)
CASES = {
    "rates": (None, 0),
    "events_theta_0.1_settled": (0.1, INTERVALS),
    "events_theta_0.2_settled": (0.2, INTERVALS),
    "events_theta_0.2_begun_a_quarter_before": (0.2, INTERVALS // 4),
}  # name -> threshold, None for the rate itself; intervals of the motion before the window


def gains(run, windows):
    """Records the median gain (found along the truth, over the truth) of a constant field, per texture and size."""
    rows = []
    for kind in ("fine", "mixed"):
        for size in SIZES_PX:
            found = [_gain(kind, size, *case, windows, run.config.seed) for case in CASES.values()]
            for case, gain in zip(CASES, found, strict=True):
                run.record(**{f"gain_{kind}_{size:g}px_{case}": gain})
            rows.append([kind, size, *(round(gain, 3) for gain in found)])
    run.table(
        "Length of the flow found over the true one",
        ["textures", "flow (px)", *(case.replace("_", " ") for case in CASES)],
        rows,
        "Medians over windows that shift evenly, without noise.",
    )


def _gain(kind, size_px, theta, lead, windows, seed):
    draw = np.random.default_rng(seed)
    pool = flow_textures.pool(kind)
    counts = []
    truth = []
    for _ in range(windows):
        texture = pool[draw.integers(len(pool))]
        top, left = (draw.integers(MARGIN, extent - SIDE - MARGIN) for extent in texture.shape)
        angle = draw.uniform(0, 2 * np.pi)
        shift = size_px * np.array([np.cos(angle), np.sin(angle)])
        reach = SIDE + MARGIN
        splines = spline_filter(texture[top - MARGIN : top + reach, left - MARGIN : left + reach], order=3)
        y, x = np.mgrid[:SIDE, :SIDE] + float(MARGIN)
        times = np.arange(-lead, INTERVALS + 1) / INTERVALS
        frames = [
            map_coordinates(splines, [y - t * shift[1], x - t * shift[0]], order=3, prefilter=False)
            for t in times
        ]
        levels = torch.from_numpy(np.log(np.maximum(np.stack(frames), 1.0))).float()
        if theta is None:
            change = levels.diff(dim=0) / 0.1
            counts.append(torch.stack([change.clamp_min(0), (-change).clamp_min(0)], 1)[:, :, None])
        else:
            even = torch.full((1, SIDE, SIDE), theta)
            counts.append(memory(levels[:, None], even, even, log_input=True)[0][lead:])
        truth.append(shift)
    t_s = torch.linspace(0, 1, INTERVALS + 1, dtype=torch.float64)
    with torch.no_grad():
        field = flow.estimate_lk(from_counts(torch.cat(counts, 2), t_s, BINS), "constant")
    found = field.flow_px.mean((2, 3)).double().numpy()
    truth = np.stack(truth)
    return float(np.median((found * truth).sum(1) / (truth * truth).sum(1)))
