"""The matrix of hard cases by stages, three columns a stage."""

from collections.abc import Iterable, Mapping
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure

from studies.stability.case import KINDS, Case

COLOURS = ListedColormap(["#eeeeee", "#b2182b", "#5aae61"])
LETTERS = ("v", "g", "s")


def matrix(rows: Iterable[Mapping[str, Any]], cases: Mapping[str, Case]) -> Figure:
    """A square for each cell of the rows, red where it was missed.

    Args: rows: of a case's label, kind and whether it passed. cases: by label.
    """
    names = list(dict.fromkeys(case.name for case in cases.values()))
    stages = list(dict.fromkeys(case.stage for case in cases.values()))
    found = np.zeros((len(names), len(KINDS) * len(stages)))
    for row in rows:
        case = cases[row["case"]]
        column = len(KINDS) * stages.index(case.stage) + KINDS.index(row["kind"])
        found[names.index(case.name), column] = 2 if row["passed"] else 1
    figure, axis = plt.subplots(figsize=(0.26 * found.shape[1] + 2.5, 0.26 * len(names) + 1))
    axis.pcolormesh(found, cmap=COLOURS, vmin=0, vmax=2, edgecolors="white", linewidth=1.5)
    for edge in range(0, found.shape[1], len(KINDS)):
        axis.axvline(edge, color="0.4", linewidth=1)
    axis.set_yticks(np.arange(len(names)) + 0.5, names)
    axis.set_xticks(np.arange(found.shape[1]) + 0.5, LETTERS * len(stages), fontsize=7)
    above = axis.secondary_xaxis("top")
    above.set_xticks(len(KINDS) * (np.arange(len(stages)) + 0.5), stages, fontsize=8)
    for ticks in (axis, above):
        ticks.tick_params(length=0)
    axis.invert_yaxis()
    axis.set_frame_on(False)
    return figure
