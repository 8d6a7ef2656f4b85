"""Words and pictures of a lens_motion page."""

import math

import torch

from studies.lens_motion.rivals import rays_at
from studies.lens_opt.task import PITCH_MM

LABELS = {
    "refocused": "refocusing alone",
    "spots": "the spot designer",
    "mtf": "mean MTF",
    "mtf_along": "MTF along the motion",
    "edge": "the edge objective",
    "flow": "the flow design",
}
EXPLAINED = (
    "Hard events from the physical sensor, textures and motions that nothing was designed or chosen on, the same "
    "cases for every lens. A change below 0 says that the design errs less than the lens of the row; where the "
    "interval holds 0, it is undecided. Smallest detectable: the change that so many cases would have shown four times in "
    "five. Turned: the same lenses, every flow vector turned by 90 degrees."
)
IMAGES = (
    "Point images of the wall at the windows' centres, upright as on the sensor; red: directions of the flow there; "
    "grey: a pixel."
)
REACH_PX = 8.0


def point_images(lenses, motion):
    """A row of windows per lens: rays in pixels, radius turned to where it points on the sensor,
    and the flow.

    lenses: by the name of their designer.
    """
    import matplotlib.pyplot as plt

    windows = motion.windows_px
    figure, axes = plt.subplots(
        len(windows),
        len(lenses),
        figsize=(2 * len(lenses), 2.1 * len(windows)),
        squeeze=False,
        layout="constrained",
    )
    at_px = torch.tensor(windows, dtype=torch.float64)
    directions = motion.directions_rad(12, at_px)
    for column, (name, optics) in zip(axes.T, lenses.items(), strict=True):
        found = rays_at(optics, at_px, 48)
        points = found.spread()[0].detach() / PITCH_MM
        for axis, at, spots, share, angles in zip(
            column, windows, points, found.share, directions, strict=True
        ):
            radius = math.atan2(at[1], at[0])
            across, along = spots.unbind(1)
            x = along * math.cos(radius) - across * math.sin(radius)
            y = along * math.sin(radius) + across * math.cos(radius)
            axis.scatter(x, y, s=0.4 * share / share.mean(), color="0.1", linewidths=0)
            for angle in (angles + radius).tolist():
                dx, dy = (0.9 * REACH_PX * f(angle) for f in (math.cos, math.sin))
                axis.plot([0.7 * dx, dx], [0.7 * dy, dy], color="firebrick", linewidth=1)
            axis.add_patch(plt.Rectangle((-0.5, -0.5), 1, 1, fill=False, color="0.6"))
            axis.set(
                xlim=(-REACH_PX, REACH_PX),
                ylim=(REACH_PX, -REACH_PX),
                aspect="equal",
                xticks=[],
                yticks=[],
            )
        column[0].set_title(LABELS[name].removeprefix("the "), fontsize=9)
    for axis, at in zip(axes[:, 0], windows, strict=True):
        axis.set_ylabel(f"window at ({at[0]}, {at[1]}) px", fontsize=8)
    return figure
