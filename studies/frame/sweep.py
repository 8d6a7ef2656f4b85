"""Every case by every method, as one long table that an interrupted run goes on with.

    def cell(lens, seed):
        return {"error_px": ..., "cpu_s": ...}

    rows = sweep(run, cell, lens=("cooke-triplet", "double-gauss"), seed=range(5))
    rows[0]      # {"lens": "cooke-triplet", "seed": 0, "error_px": 0.31, "cpu_s": 2.0}
    column(rows, "error_px", lens="double-gauss")      # [0.28, 0.33, ...] by seed

The table stands in the run's folder, a line of JSON a cell, written as soon as its figures are
there.
"""

import itertools
import json
import re
import statistics
from collections.abc import Callable, Generator, Iterable, Mapping, Sequence
from contextlib import closing
from pathlib import Path
from types import MappingProxyType
from typing import Any

from codesign.errors import DomainError, FileFormatError
from studies.frame import workers
from studies.frame.run import Run

Row = dict[str, Any]


def sweep(
    run: Run,
    cell: Callable[..., Row | Iterable[Row]],
    name: str = "table",
    processes: int = 0,
    turns: int = 1,
    given: Mapping[str, Any] = MappingProxyType({}),
    cluster: str = "",
    **axes: Iterable[Any] | Mapping[str, Any],
) -> list[Row]:
    """Rows of every combination of the axes; those that an earlier session wrote are read back.

    Args:
      cell: called with one value of every axis, by the axis's name; returns figures by name, or
        several such rows.
      name: of the table, <name>.jsonl, and of the progress bar.
      processes: 0 calls ``cell`` here; otherwise each call gets a fresh process, so many at a time,
        and ``cell`` stands at the top level of a module. A process that is killed is asked again.
      turns: how often every cell is asked, all cells in turns, so that what else the machine does
        meets all; of figures that are numbers the rows have the medians.
      given: further arguments of every call, which are no axes.
      cluster: address of a Ray cluster instead ("auto": that of this machine; "here": one of its
        own).
      axes: name -> values as JSON keeps them (numbers, text), or label -> value of any kind, where
        the row has the label. The last axis changes fastest.
    Returns: the long table, in the order of the axes: a row has the axes' values, then the figures.
    Raises: DomainError when a figure is not plain and finite, or named as an axis; FileFormatError
      when the table in the folder is of other axes or damaged, or an earlier version kept another
      kind of progress there.
    """
    if processes < 0:
        raise DomainError(
            f"processes is {processes}; give 0 for none beside this one, or a number."
        )
    path = run.path(f"{name}.jsonl")
    if run.state_unread and not path.exists():
        raise FileFormatError(
            f"the run in '{run.folder}' was begun by an earlier version of this study, which kept its progress in "
            "state.npz instead of a table; start a new run."
        )
    known = _read(path, {*axes, "turn"} if turns > 1 else set(axes))
    cells = [
        dict(zip(axes, map(_plain, point), strict=True))
        for point in itertools.product(*map(list, axes.values()))
    ]
    asked = (
        cells
        if turns == 1
        else [{**point, "turn": turn} for turn in range(turns) for point in cells]
    )
    missing = [point for point in asked if _key(point) not in known]
    measured = _measured(cell, missing, axes, given, processes, cluster)
    with (
        run.progress(len(asked), name, done=len(asked) - len(missing)) as progress,
        closing(measured),  # an interruption ends the processes
    ):
        for point, found in measured:
            rows = [found] if isinstance(found, Mapping) else found
            if rows is None:
                raise DomainError(f"the cell {point} returned nothing; return a row of figures.")
            known[_key(point)] = _append(path, point, [dict(row) for row in rows])
            progress.advance()
    # those of one cell are as many cells apart as there are
    of_turns = [[known[_key(point)] for point in asked[k :: len(cells)]] for k in range(len(cells))]
    return [
        point | _median(rows)
        for point, found in zip(cells, of_turns, strict=True)
        for rows in zip(*found, strict=True)
    ]


def _plain(value: Any) -> Any:
    """A number of numpy or torch as Python's own, which a table keeps."""
    return value.item() if hasattr(value, "item") else value


def _median(rows: Sequence[Row]) -> Row:
    """One row for those of several turns."""
    return {
        name: statistics.median(row[name] for row in rows)
        if isinstance(value, int | float)
        else value
        for name, value in rows[0].items()
    }


def select(rows: Iterable[Row], **where: Any) -> list[Row]:
    """The rows that have these values."""
    return [row for row in rows if all(row.get(name) == value for name, value in where.items())]


def column(rows: Iterable[Row], name: str, **where: Any) -> list[Any]:
    """One figure of the rows that have these values."""
    return [row[name] for row in select(rows, **where)]


def typical(rows: Iterable[Row], name: str = "errors", **where: Any) -> float:
    """Median over the rows that have these values of the mean of a figure that is a list."""
    return statistics.median(map(statistics.fmean, column(rows, name, **where)))


def metrics(rows: Iterable[Mapping[str, Any]], *axes: str, prefix: str = "") -> dict[str, float]:
    """What ``Run.record`` takes of a table: every number by the values of the axes and its own
    name, in plain letters.

    Args:
      axes: names of the columns that tell rows apart.
      prefix: first word of every name.
    """
    found = {}
    for row in rows:
        name = plain(prefix, *(row[axis] for axis in axes))
        numbers = {
            key: value
            for key, value in row.items()
            if isinstance(value, int | float) and key not in axes
        }
        named = {f"{name}_{key}": value for key, value in numbers.items()}
        if twice := sorted(named.keys() & found.keys()):
            raise DomainError(
                f"two rows would both be '{twice[0]}' in metrics.json; give their axes other names."
            )
        found |= named
    return found


def plain(*words: object) -> str:
    """A name for metrics.json: letters, digits and underscores; numbers below zero say "minus"."""
    text = re.sub(r"(?<!\S)-(?=[\d.])", "minus ", " ".join(map(str, words)))
    return "_".join(re.findall(r"\w+", text)).lower()


def _measured(cell, points, axes, given, processes, cluster) -> Generator[tuple[Row, Any]]:
    """Each point with what ``cell`` returns for it, in the order in which they are done."""

    def values(point):
        return {
            axis: values[point[axis]] if isinstance(values, Mapping) else point[axis]
            for axis, values in axes.items()
        } | given

    if not processes and not cluster:
        for point in points:
            yield point, cell(**values(point))
        return
    calls = {number: values(point) for number, point in enumerate(points)}
    answers = (
        workers.on_cluster(cell, calls, cluster)
        if cluster
        else workers.in_processes(cell, calls, processes)
    )
    with closing(answers):
        for number, found in answers:
            yield points[number], found


def _key(point):
    return json.dumps(point)


def _read(path: Path, axes: set[str]) -> dict[str, list[Row]]:
    """Figures of an earlier session by cell. A line that was cut off when it was killed is cut
    away."""
    known: dict[str, list[Row]] = {}
    text = path.read_bytes() if path.exists() else b""
    whole = text[: text.rfind(b"\n") + 1]
    if whole != text:
        with path.open("r+b") as file:
            file.truncate(len(whole))
    try:
        for line in whole.splitlines():
            point, rows = json.loads(line)
            if set(point) != axes:
                raise ValueError
            known[_key(point)] = [dict(row) for row in rows]
    except (ValueError, TypeError) as error:
        raise FileFormatError(
            f"'{path}' is damaged, or a table of other axes; remove it to begin it anew."
        ) from error
    return known


def _append(path, point, rows):
    """Write the rows of one cell as one line; returns them."""
    if any(point.keys() & row.keys() for row in rows):
        raise DomainError(
            f"the cell {point} returns a figure named as an axis ({rows}); choose another name."
        )
    try:
        line = json.dumps([point, rows], allow_nan=False)
    except (TypeError, ValueError) as error:
        raise DomainError(
            f"the cell {point} returns what is no finite number, text or None ({error}): {str(rows)[:200]}"
        ) from error
    with path.open("a", encoding="utf-8") as file:
        file.write(line + "\n")
    return rows
