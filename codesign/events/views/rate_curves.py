"""Rate curves: events per second of the whole picture over time, one line per polarity."""

from matplotlib.figure import Figure

from codesign.errors import ShapeError

ON_COLOUR, OFF_COLOUR = (
    "#d55e00",
    "#0072b2",
)  # vermilion and blue of Okabe and Ito, told apart by every kind of colour vision
PREFIXES = ((1e9, "G"), (1e6, "M"), (1e3, "k"))


def rate_figure(middle_s, rate_hz, title="Event rate"):
    """Figure of event rates.

    Args:
      middle_s: [K] middle of each interval, seconds. rate_hz: [K, 2] events per second, ON first (both as
        ``rates`` gives them).
      title: heading.
    Returns: matplotlib Figure; time in milliseconds below ten seconds of recording, else in seconds.
    Raises: ShapeError when the two do not fit.
    """
    if middle_s.ndim != 1 or rate_hz.shape != (len(middle_s), 2) or not len(middle_s):
        raise ShapeError(
            f"middle_s has shape {list(middle_s.shape)}, rate_hz {list(rate_hz.shape)}; [K] and [K, 2] are "
            "needed, K >= 1."
        )
    scale, unit = (1e3, "ms") if float(middle_s[-1] - middle_s[0]) < 10 else (1.0, "s")
    factor, prefix = next(
        ((size, name) for size, name in PREFIXES if float(rate_hz.max()) >= size), (1.0, "")
    )
    figure = Figure(figsize=(8, 3.2), layout="constrained")
    axis = figure.subplots()
    start_s, shift = (
        (float(middle_s[0]), f" since {float(middle_s[0]):.6f} s")
        if abs(float(middle_s[0])) > 1e6
        else (0.0, "")
    )
    for column, colour, name, style in (
        (0, ON_COLOUR, "ON (brighter)", "-"),
        (1, OFF_COLOUR, "OFF (darker)", "--"),
    ):
        axis.plot(
            (middle_s.numpy() - start_s) * scale,
            rate_hz[:, column].numpy() / factor,
            style,
            color=colour,
            lw=1.4,
            label=name,
        )
    axis.set(xlabel=f"time ({unit}){shift}", ylabel=f"{prefix}events per second")
    axis.set_title(title, loc="left", fontsize=11)
    axis.set_ylim(bottom=0)
    axis.margins(x=0)
    axis.grid(alpha=0.3)
    axis.spines[["top", "right"]].set_visible(False)
    axis.legend(
        frameon=False, fontsize=9, ncols=2, loc="lower right", bbox_to_anchor=(1.0, 1.0), borderaxespad=0.2
    )
    return figure
