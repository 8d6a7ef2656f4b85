"""By what should sensor and estimator be settled on few recorded drives: by the hard errors of
these, or by those to be expected? Read-outs of one design, ranked by both, beside single events in
many drives of other worlds."""

from collections.abc import Sequence
from functools import cache
from typing import Any

import torch
from torch import Tensor
from torch.quasirandom import SobolEngine

from studies.codesign.arms import RECORDED
from studies.codesign.design import Space
from studies.codesign.landscape import ranked
from studies.codesign.problem import Drawn
from studies.frame.run import Run
from studies.frame.show import tabulate
from studies.frame.sweep import Row, column, sweep

FIRST = 6_000_000  # number of the first draw, beyond those of any race
FIRST_WORLD = 700  # of those that no arm is trained in, nor a calibration fitted to
WORLDS, DRIVES = 24, 4
WIDE = 0.25  # of the cube, to either side
LOST = 0.5  # hard error, from which on a read-out is none of the good ones


def looked(run: Run[Any], space: Space, drawn: Drawn, at: Tensor, count: int) -> list[Row]:
    """Rows of read-outs around that of shares [V]: errors on as many recorded drives as an arm has,
    hard and expected, and the hard ones of single events in other worlds."""
    free = space.part("read-out")
    if not free:
        return []
    spread = SobolEngine(len(free), scramble=True, seed=9).draw(count, dtype=torch.float64)
    judge = Drawn(space, range(FIRST_WORLD, FIRST_WORLD + WORLDS), WORLDS, DRIVES)
    whole = space.made(at)

    @cache
    def frames():
        begun = [drawn.looked(whole, drawn.draw(FIRST + number)) for number in range(RECORDED)]
        return begun, judge.looked(whole, judge.draw(FIRST))

    def cell(number):
        begun, truth = frames()
        share = at.clone()
        share[free] = (at[free] + WIDE * (2 * spread[number] - 1)).clamp(0, 1)
        numbers = space.numbers(share)
        chosen = {space.free[k]: numbers[space.free[k]] for k in free}

        other = whole.with_numbers(**chosen)
        on_few = [one.again(other) for one in begun]
        return {
            **chosen,
            "hard": float(torch.cat([each.hard() for each in on_few]).mean()),
            "expected": float(torch.cat([each.expected for each in on_few]).mean()),
            "elsewhere": float(truth.again(other, "sensor").hard().mean()),
        }

    return sweep(run, cell, "read_outs", number=range(count))


def show(run: Run[Any], rows: Sequence[Row]) -> None:
    """Rank correlations, and where the pick of either ends."""
    run.section(
        "By what to settle a read-out",
        f"{len(rows)} read-outs around that of the joint answer of which least error is expected: errors on the drives that an arm has "
        f"recorded ({RECORDED} rounds), beside single events in {WORLDS * DRIVES} drives of {WORLDS} other worlds. Good ones have "
        f"less than {LOST} there.",
    )
    if not rows:
        run.text("Nothing of sensor and estimator is free.")
        return
    good = [row for row in rows if row["elsewhere"] < LOST]
    lines = []
    for name in ("hard", "expected"):
        pick = min(rows, key=lambda row: row[name])
        line = {"judge": name, "pick_elsewhere": pick["elsewhere"]}
        for kind, some in (("all", rows), ("good", good)):
            line[f"rank_{kind}"] = ranked(column(some, name), column(some, "elsewhere"))
        lines.append(line)
    run.record(read_outs=len(rows), read_outs_good=len(good))
    tabulate(
        run,
        "Ranks beside other worlds, and the error of the pick there",
        lines,
        "judge",
        prefix="read_out",
    )
