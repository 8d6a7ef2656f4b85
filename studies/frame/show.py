"""What a page shows of figures: tables out of long rows, what was asked beside what was found,
charts, pictures.

    run.table("Errors", *table(rows, method="method", error_px="error, px")) tabulate(run, "Errors",
    rows, "method") lead = asked(run, [Asked("speed over optiland", 22.0, least=10.0),
    Asked("memory, MB", 3.0, most=5.0)]) run.figure(panels(Panel({"ours": (x, y)}, "rays",
    "seconds", log="xy")), "growth", "Time against rays.") run.figure(pictures({"room": {"traced":
    frame, "difference": off}}, signed=["difference"]), "room", "…")

Single charts (``curves``), image strips, heat maps and lens layouts: codesign.report.chain_figures,
lens_layout.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from codesign.report.chain_figures import draw_curves, draw_image
from codesign.report.flow_colours import draw_wheel
from studies.frame.compare import Interval
from studies.frame.run import Run
from studies.frame.sweep import metrics, plain

Rows = Iterable[Mapping[str, Any]]
Shown = tuple[tuple[str, ...], list[tuple[Any, ...]]]


def table(rows: Rows, **titles: str) -> Shown:
    """Columns and rows for ``Run.table``.

    Args:
      rows: figures by name; one that a row lacks shows as a dash.
      titles: name -> title of its column, in their order; all names as they are when none is given.
    """
    rows = list(rows)
    titles = titles or {name: name.replace("_", " ") for row in rows for name in row}
    return tuple(titles.values()), [tuple(_cell(row.get(name)) for name in titles) for row in rows]


def tabulate(
    run: Run, title: str, rows: Rows, *axes: str, prefix: str = "", caption: str = "", **titles: str
) -> None:
    """Show rows as a table, and record their numbers by the values of the axes.

    Args:
      axes, prefix: as of ``sweep.metrics``.
      titles: as of ``table``.
    """
    rows = list(rows)
    run.record(**metrics(rows, *axes, prefix=prefix))
    run.table(title, *table(rows, **titles), caption)


@dataclass(frozen=True)
class Asked:
    """A figure that something was asked of: at least, at most, or between both; ``what`` names
    it."""

    what: str
    value: float
    least: float = -math.inf
    most: float = math.inf

    @property
    def met(self) -> bool:
        return self.least <= self.value <= self.most

    @property
    def wanted(self) -> str:
        ends = (("≥", self.least), ("≤", self.most))
        return ", ".join(f"{sign} {end:.3g}" for sign, end in ends if math.isfinite(end)) or "–"


def asked(run: Run, figures: Iterable[Asked]) -> str:
    """Show figures beside what was asked of them, as a table, and record them by their names.

    Returns: "All figures are met." or the sentence about those that are not, for the head of the
      page.
    """
    figures = list(figures)
    run.record(**{plain(figure.what): figure.value for figure in figures})
    rows = [(f.what, f.value, f.wanted, "yes" if f.met else "NO") for f in figures]
    run.table("Against what was asked", ("what", "found", "asked", "met"), rows)
    missed = [f"{f.what} {f.value:.3g} ({f.wanted})" for f in figures if not f.met]
    return f"**Missed in this run:** {'; '.join(missed)}." if missed else "All figures are met."


@dataclass(frozen=True)
class Panel:
    """One chart. series: label -> (x, y). log: axes that are logarithmic, of "xy". levels: heights
    of dashed lines. bands: label -> (x, low, high), shaded in the colour of the series of that
    label."""

    series: Mapping[str, tuple[Any, Any]]
    xlabel: str
    ylabel: str
    log: str = ""
    levels: Sequence[float] = ()
    bands: Mapping[str, tuple[Any, Any, Any]] = field(default_factory=dict)


def panels(*charts: Panel, width: float = 4.5):
    """Figure of charts beside one another; below stands a legend for all where they have the same
    series, else one of its own below each chart that has several."""
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(
        1, len(charts), figsize=(width * len(charts), 3.4), squeeze=False, layout="constrained"
    )
    for axis, chart in zip(axes[0], charts, strict=True):
        draw_curves(axis, chart.series, chart.xlabel, chart.ylabel, chart.log, chart.levels)
        colours = {line.get_label(): line.get_color() for line in axis.get_lines()}
        for label, (x, low, high) in chart.bands.items():
            axis.fill_between(x, low, high, color=colours[label], alpha=0.12, linewidth=0)
    how = {"frameon": False, "fontsize": 8}
    if all(chart.series.keys() == charts[0].series.keys() for chart in charts):
        if len(charts[0].series) > 1:
            handles = axes[0, 0].get_legend_handles_labels()
            figure.legend(*handles, loc="outside lower center", ncols=4, **how)
        return figure
    for axis, chart in zip(axes[0], charts, strict=True):
        if len(chart.series) > 1:
            axis.legend(loc="upper center", bbox_to_anchor=(0.5, -0.18), ncols=2, **how)
    return figure


def pictures(
    rows: Mapping[str, Mapping[str, Any]],
    signed: Iterable[str] = (),
    side: float = 2.3,
    flow: bool = False,
):
    """Figure of pictures: row label -> column title -> [H, W] or, in colours of 0 to 1, [H, W, 3].

    Grey pictures of a row share their scale, with a display's gamma; columns that are ``signed``
    are red above zero and blue below, on one scale per row. A picture that a row lacks leaves its
    place empty. ``flow``: beside them stands the wheel of the colours of flow.
    """
    import matplotlib.pyplot as plt

    titles = list(dict.fromkeys(title for row in rows.values() for title in row))
    shapes = [np.shape(image)[:2] for row in rows.values() for image in row.values()]
    tallest = max(height / width for height, width in shapes)
    # room for labels, titles and the wheel
    size = (side * len(titles) + 1.2 + 0.8 * flow, side * len(rows) * tallest + 0.3)
    figure, axes = plt.subplots(
        len(rows), len(titles), figsize=size, squeeze=False, layout="constrained"
    )
    signed = set(signed)
    for number, (line, (label, row)) in enumerate(zip(axes, rows.items(), strict=True)):
        for axis, title in zip(line, titles, strict=True):
            axis.set(xticks=[], yticks=[])
            if title not in row:
                axis.axis("off")
                continue
            of_scale = [
                image for other, image in row.items() if (other in signed) == (title in signed)
            ]
            draw_image(axis, row[title], of_scale, title in signed)
            axis.set_title("" if number else title, fontsize=9)
        line[0].set_ylabel(label, fontsize=9, rotation=0, ha="right", va="center")
    if flow:
        draw_wheel(axes[0, -1], (1.05, 0, 0.35, 0.35))
    return figure


def bars(
    values: Mapping[str, float | Interval],
    xlabel: str,
    log: bool = False,
    level: float | None = None,
):
    """Figure of horizontal bars, with whiskers where a value is an Interval; ``level`` is drawn as
    a red line."""
    import matplotlib.pyplot as plt

    figure, axis = plt.subplots(figsize=(7, 0.8 + 0.4 * len(values)), layout="constrained")
    for at, value in enumerate(values.values()):
        of = value if isinstance(value, Interval) else Interval(value, value, value, 1)
        whiskers = [[of.value - of.low], [of.high - of.value]] if of.low < of.high else None
        axis.barh(at, of.value, 0.65, xerr=whiskers, color="#1b6ca8", ecolor="0.3", capsize=3)
    if level is not None:
        axis.axvline(level, color="firebrick", linewidth=1)
    axis.set_yticks(range(len(values)), list(values))
    axis.set(xlabel=xlabel, xscale="log" if log else "linear")
    if log:  # 0.5, not 5 x 10^-1
        low, high = axis.get_xlim()
        axis.xaxis.set_major_formatter("{x:g}")
        axis.xaxis.set_minor_formatter(lambda value, _: f"{value:g}" if high < 10 * low else "")
    axis.invert_yaxis()
    return figure


def _cell(value):
    return str(value) if isinstance(value, Interval) else value
