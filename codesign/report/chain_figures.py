"""Pictures, curves and matrices drawn into axes: what pages of runs are made of."""

from collections.abc import Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def draw_image(axis: Any, image: Any, of_scale: Sequence[Any], signed: bool = False) -> None:
    """Draw an image [H, W] into an axis: grey with a display's gamma, or ``signed`` in red
    (above 0) and blue.

    Args:
      of_scale: the images that share its scale, itself among them.
      signed: whether zero is in the middle of the scale. An image [H, W, 3] is shown in its own
        colours, 0 to 1.
    """
    image = np.asarray(image)
    top = max(float(np.quantile(np.abs(np.asarray(other)), 0.99)) for other in of_scale) or 1.0
    if image.ndim == 3:
        axis.imshow(image)
    elif signed:
        axis.imshow(image, cmap="RdBu_r", vmin=-top, vmax=top)
    else:
        axis.imshow(np.clip(image / top, 0, 1) ** (1 / 2.2), cmap="gray", vmin=0, vmax=1)
    axis.set_xticks([])
    axis.set_yticks([])


def draw_curves(
    axis: Any,
    series: Mapping[str, tuple[Any, Any]],
    xlabel: str,
    ylabel: str,
    log: str = "",
    levels: Sequence[float] = (),
) -> None:
    """Draw named curves, label -> (x, y), into an axis.

    Args:
      log: the axes that are logarithmic, of "xy".
      levels: heights of dashed lines: what is asked, what is allowed.
    """
    for number, (label, (x, y)) in enumerate(series.items()):
        dashes = ("-", "--", ":")[number // 10 % 3]  # there are ten colours
        marker = "o" if len(x) < 20 else None
        axis.plot(x, y, dashes, label=label, marker=marker, ms=3, lw=1.4)
    for level in levels:
        axis.axhline(level, color="firebrick", ls="--", lw=1)
    axis.set(xlabel=xlabel, ylabel=ylabel)
    axis.set_xscale("log" if "x" in log else "linear")
    axis.set_yscale("log" if "y" in log else "linear")
    for side in (axis.xaxis, axis.yaxis):
        if side.axis_name in log:
            side.set_major_formatter(lambda value, _: f"{value:g}")
            side.set_minor_formatter(partial(_between_powers, side))
    axis.grid(alpha=0.3)


def _between_powers(side, value, _):
    """The number at a tick between powers of ten: 2 and 5 alone, and all where the axis is short."""
    low, high = side.get_view_interval()
    return f"{value:g}" if high < 4 * low or f"{value:.0e}"[0] in "25" else ""


def heat_map(values: Any, rows: Sequence[str], columns: Sequence[str], label: str) -> "Figure":
    """Figure of a labelled matrix on a logarithmic colour scale; NaN cells stay empty."""
    import matplotlib.pyplot as plt
    from matplotlib.colors import LogNorm

    values = np.asarray(values, dtype=float)
    figure, axis = plt.subplots(figsize=(1.5 + 1.3 * len(columns), 1.2 + 0.5 * len(rows)))
    shown = np.where(np.isfinite(values), np.maximum(values, 1e-9), np.nan)
    picture = axis.imshow(
        shown,
        cmap="viridis_r",
        norm=LogNorm(vmin=max(np.nanmin(shown), 1e-9), vmax=max(np.nanmax(shown), 1e-8)),
        aspect="auto",
    )
    for i in range(len(rows)):
        for j in range(len(columns)):
            if np.isfinite(values[i, j]):
                axis.text(
                    j,
                    i,
                    f"{values[i, j]:.1e}",
                    ha="center",
                    va="center",
                    fontsize=8,
                    color="w" if picture.norm(shown[i, j]) > 0.5 else "k",
                )
    axis.set_xticks(range(len(columns)), columns, rotation=20, ha="right")
    axis.set_yticks(range(len(rows)), rows)
    figure.colorbar(picture, label=label)
    figure.tight_layout()
    return figure
