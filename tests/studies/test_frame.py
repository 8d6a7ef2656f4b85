"""What studies share: sweeps that go on where they ended, intervals against closed forms, times,
charts."""

import math
import os
import sys
import time
from statistics import stdev

import matplotlib.pyplot as plt
import numpy as np
import pytest
import torch
from matplotlib.patches import Rectangle

from codesign.errors import CodesignError, DomainError, FileFormatError, MissingPackageError
from studies.frame import bench, compare, show
from studies.frame.bench import Timing, apart, measure, turns
from studies.frame.compare import Interval, bootstrap, student
from studies.frame.config import StudyConfig
from studies.frame.run import open_run
from studies.frame.show import Asked, Panel
from studies.frame.sweep import column, metrics, select, sweep
from tests import refusals
from tests.processes import ROOT, python
from tests.studies.called_apart import killed, killed_once, power, slow, told
from tests.studies.runs import numbers, page


@pytest.fixture
def run(tmp_path):
    return open_run("test_frame", StudyConfig(out=tmp_path / "out"))


# sweep


def test_a_sweep_is_the_product_of_its_axes_in_order(run):
    def cell(a, f):
        return [{"k": k, "value": f(a)} for k in (0, 1)]

    rows = sweep(run, cell, a=(2, 3), f={"square": lambda x: x * x})
    assert rows == [{"a": a, "f": "square", "k": k, "value": a * a} for a in (2, 3) for k in (0, 1)]
    assert column(rows, "value", a=3, k=1) == [9]
    assert select(rows, a=4) == []


def test_numbers_of_numpy_are_numbers_of_a_table(run):
    rows = sweep(run, lambda k: {"twice": 2 * k}, "numpy", k=np.arange(2))
    assert rows == [{"k": 0, "twice": 0}, {"k": 1, "twice": 2}]


@pytest.mark.parametrize("cut", [0, 5], ids=["whole", "a line cut off"])
def test_an_interrupted_sweep_goes_on_where_it_ended(run, cut):
    asked = []

    def cell(seed, stop):
        asked.append(seed)
        if len(asked) == stop:
            raise KeyboardInterrupt
        return {"value": 0.1 * seed}

    with pytest.raises(KeyboardInterrupt):
        sweep(run, lambda seed: cell(seed, 3), seed=range(4))
    path = run.folder / "table.jsonl"
    path.write_bytes(path.read_bytes()[: -cut or None])
    rows = sweep(run, lambda seed: cell(seed, -1), seed=range(5))
    assert column(rows, "value") == [0.1 * seed for seed in range(5)]
    assert asked == [0, 1, 2, *([1] if cut else []), 2, 3, 4]
    assert len(path.read_text().splitlines()) == 5


def test_a_run_of_an_earlier_version_is_refused_and_not_begun_anew(run):
    run.save_state({}, {"searches": [1, 2]})
    again = open_run("test_frame", StudyConfig(resume=run.folder))
    with pytest.raises(FileFormatError, match=r"begun by an earlier version .*start a new run"):
        sweep(again, power, base=(2,), exponent=(1,))
    # a study that reads its state may sweep as well
    again.load_state()
    assert column(sweep(again, power, base=(2,), exponent=(1,)), "power") == [2]


def test_cells_in_processes_give_the_same_table(run):
    found = sweep(run, power, processes=2, given={"base": 3}, exponent=(0, 5))
    assert column(found, "power") == [1, 243]
    assert len({os.getpid(), *column(found, "process")}) == 3
    with pytest.raises(CodesignError, match=r"power\(-1, 2\) ended with code 1.*not below 0"):
        sweep(run, power, "refused", processes=2, given={"base": 2}, exponent=(-1,))
    assert not bench.RUNNING


@pytest.mark.parametrize("way", [{"processes": 2}, {"cluster": "here"}])
def test_cells_whose_worker_is_killed_are_asked_again(run, way, tmp_path):
    if "cluster" in way:
        pytest.importorskip("ray")
    found = sweep(run, killed_once, given={"folder": str(tmp_path)}, exponent=(1, 5, 6), **way)
    assert column(found, "power") == [2, 32, 64]
    assert len((run.folder / "table.jsonl").read_text().splitlines()) == 3


def test_a_cell_that_fails_ends_those_that_wait_for_their_turn(run):
    with pytest.raises(CodesignError, match=r"power\(-1, 2\).*not below 0"):
        sweep(run, power, processes=1, given={"base": 2}, exponent=(-1, 1, 2, 3))
    assert not bench.RUNNING


def test_a_worker_that_is_killed_again_and_again_ends_the_sweep(run):
    with pytest.raises(CodesignError, match=r"killed\(1\) ended with code -9"):
        sweep(run, killed, processes=1, exponent=(1,))


def test_a_cluster_refuses_in_a_sentence(run, monkeypatch):
    pytest.importorskip("ray")
    with pytest.raises(CodesignError, match=r"power failed on the cluster: .*not below 0"):
        sweep(run, power, cluster="here", given={"base": 2}, exponent=(-1,))
    with pytest.raises(CodesignError, match=r"no Ray cluster at '127\.0\.0\.1:1'"):
        sweep(run, power, cluster="127.0.0.1:1", given={"base": 2}, exponent=(1,))
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(MissingPackageError, match=r"codesign\[cluster\]"):
        sweep(run, power, cluster="here", given={"base": 2}, exponent=(1,))


def test_an_interruption_ends_the_processes_and_keeps_what_is_done(run):
    run._interruption.requested = True  # as Ctrl-C does; the loop answers after a whole cell
    start = time.monotonic()
    with pytest.raises(KeyboardInterrupt):
        sweep(run, slow, processes=2, seconds=(0, 300, 301))
    assert time.monotonic() - start < 100
    assert not bench.RUNNING
    assert (run.folder / "table.jsonl").read_text() == '[{"seconds": 0}, [{"slept": 0}]]\n'


@refusals.table(__file__, "rows of tables")
def test_rows_that_no_table_can_keep_are_refused(run, row):
    row.holds({**globals(), "run": run})
    assert not (run.folder / "table.jsonl").exists()


@pytest.mark.parametrize("text", ["{}\n", "what\n", '[{"other": 1}, [{"value": 1}]]\n'])
def test_a_damaged_table_and_one_of_other_axes_are_refused(run, text):
    (run.folder / "table.jsonl").write_text(text)
    with pytest.raises(FileFormatError, match="damaged, or a table of other axes"):
        sweep(run, power, base=(1,), exponent=(1,))


def test_metrics_of_a_table_are_its_numbers_in_plain_names():
    rows = [{"lens": "cooke-triplet", "px": 64, "error": 0.5, "note": "text", "none": None}]
    assert metrics(rows, "lens", "px", prefix="flow, 2 levels") == {
        "flow_2_levels_cooke_triplet_64_error": 0.5
    }
    assert metrics(rows, "lens") == {"cooke_triplet_px": 64, "cooke_triplet_error": 0.5}
    signed = [{"at": -1.0, "error": 1.0}, {"at": 1.0, "error": 2.0}]
    assert metrics(signed, "at") == {"minus_1_0_error": 1.0, "1_0_error": 2.0}
    with pytest.raises(DomainError, match="two rows would both be 'a_b_error'"):
        metrics([{"on": "a > b", "error": 1.0}, {"on": "a < b", "error": 2.0}], "on")


def test_turns_meet_all_cells_and_rows_have_their_medians(run):
    asked = []

    def cell(letter, scale):
        asked.append(letter)
        return {"value": scale * len(asked), "text": letter}

    rows = sweep(run, cell, turns=3, given={"scale": 10}, letter="ab")
    assert "".join(asked) == "ababab"
    medians = (("a", 30), ("b", 40))
    assert rows == [{"letter": each, "value": value, "text": each} for each, value in medians]
    assert sweep(run, cell, turns=3, given={"scale": 10}, letter="ab") == rows


# compare


def test_student_against_the_published_table():
    """t(0.975, 4) = 2.776, t(0.95, 4) = 2.132."""
    found = student([1.0, 2.0, 3.0, 4.0, 5.0])
    half = 2.776 * math.sqrt(2.5 / 5)
    assert (found.value, found.count) == (3, 5)
    assert (found.high - 3, 3 - found.low) == pytest.approx((half, half), rel=2e-4)
    assert student([1.0, 2.0, 3.0, 4.0, 5.0], 0.9).high == pytest.approx(
        3 + 2.132 * math.sqrt(0.5), rel=2e-4
    )
    assert student([2.0]) == Interval(2, -math.inf, math.inf, 1)


def test_a_bootstrapped_mean_has_the_standard_error_of_the_sample(generator):
    values = torch.randn(400, generator=generator, dtype=torch.float64)
    found = bootstrap(lambda x: x.mean(-1), values, draws=20_000)
    half = 1.96 * float(values.std(correction=0)) / 20
    assert found.value == float(values.mean())
    # the draws' own noise is 1 % of an end
    assert (found.high - found.low) / 2 == pytest.approx(half, rel=0.03)
    assert found == bootstrap(lambda x: x.mean(-1), values, draws=20_000)
    assert found != bootstrap(lambda x: x.mean(-1), values, draws=20_000, seed=1)


def test_paired_units_are_drawn_together():
    hard = torch.tensor([1.0, 10.0, 100.0, 1000.0])
    for kind in (compare.ratio_of_means, compare.median_ratio):
        found = kind(0.5 * hard, hard)
        assert (found.value, found.low, found.high) == pytest.approx((0.5, 0.5, 0.5), rel=1e-12)
    found = bootstrap(lambda x: x[0].sum(-1) / x[1].sum(-1), torch.stack([hard, 4 * hard]))
    assert (found.low, found.high) == pytest.approx((0.25, 0.25), rel=1e-12)


def test_log_ratios_say_who_wins():
    logs = [-0.2, -0.1, 0.0, 0.1]
    theirs = [0.5, 3.0, 0.7, 1.1]
    found = compare.log_ratio([r * math.exp(x) for r, x in zip(theirs, logs, strict=True)], theirs)
    half = 3.182446 * stdev(logs) / 2  # Student's t, three degrees of freedom, two-sided 95 %
    assert (found.value, found.low, found.high) == pytest.approx(
        (-0.05, -0.05 - half, -0.05 + half), rel=1e-6
    )
    assert (found.count, found.outcome) == (4, "is undecided")
    assert compare.log_ratio([1.0, 1.1], [2.0, 2.2]).outcome == "wins"
    assert compare.log_ratio([2.0, 2.2], [1.0, 1.1]).outcome == "loses"
    # one case says nothing
    assert compare.log_ratio([1.0], [2.0]).percent() == "-50.0 % (-100.0 to inf %)"


def test_units_that_share_groups_count_as_their_groups():
    values = torch.randn(80, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    # a group each: the interval of a mean
    alone, mean = compare.grouped(values, range(80)), student(values)
    assert alone.value == mean.value
    assert alone.high - alone.low == pytest.approx(mean.high - mean.low, rel=0.1)
    # all alike within a group: as many units as groups
    groups = [k % 20 for k in range(400)]
    shared = compare.grouped(values[:20].repeat(20), groups)
    few = bootstrap(lambda x: x.mean(-1), values[:20])
    assert shared.count == 20
    assert (shared.low, shared.high) == pytest.approx((few.low, few.high), abs=0.06)


def test_drawn_signs_have_those_that_were_found_among_them():
    assert compare.sign_flip([1.0] * 60) == pytest.approx(1 / 20_000)
    assert compare.sign_flip([1.0] * 3) == pytest.approx(2 / 8)
    assert compare.sign_flip([1.0, math.nan]) == 1, "NaN decides nothing"


def test_intervals_print_and_record():
    assert f"{Interval(0.5, 0.25, 1, 3):.2f}" == "0.50 (0.25 to 1.00)"
    assert str(Interval(0.5, 0.25, 1, 3)) == "0.5 (0.25 to 1)"
    assert Interval(0.5, 0.25, 1, 3).metrics("x") == {"x": 0.5, "x_low": 0.25, "x_high": 1}
    assert student([2.0]).metrics("x") == {"x": 2}


@refusals.table(__file__, "comparisons")
def test_comparisons_that_are_none_are_refused(row):
    row.holds(globals())


# bench


def test_times_count_the_repeats_only():
    calls = []
    timing = measure(lambda: calls.append(1), repeats=5, warm=2)
    assert (len(calls), len(timing.wall_s), len(timing.cpu_s)) == (7, 5, 5)
    assert min(timing.wall_s) <= timing.wall <= max(timing.wall_s)
    both = Timing((1.0, 2.0), (1.0, 5.0)) + Timing((9.0,), (2.0,))
    assert (both.wall, both.cpu) == (2, 2)


def test_processor_time_leaves_waiting_out():
    timing = measure(lambda: time.sleep(0.05), repeats=3, warm=0)
    assert timing.wall >= 0.05
    assert timing.cpu < 0.02


def test_functions_take_turns():
    order = []
    calls = {name: lambda name=name: order.append(name) for name in "ab"}
    found = turns(calls, rounds=2, repeats=2, warm=0)
    assert "".join(order) == "aaabbbaabb"
    assert {len(timing.wall_s) for timing in found.values()} == {4}


@pytest.mark.skipif(
    sys.platform != "linux", reason="other systems do not start the count of a peak anew"
)
def test_a_function_in_its_own_process_and_the_memory_that_it_takes():
    variable, peak, nothing = apart(
        told, "CODESIGN_TEST", peak_of=50, environment={"CODESIGN_TEST": "set"}
    )
    assert variable == "set"
    assert peak == pytest.approx(50, abs=5)
    assert nothing < 5
    assert bench.installed({"yes": "torch", "no": "no_such_package"}) == ["yes"]


def test_a_function_of_a_script_is_not_found_elsewhere(tmp_path):
    script = tmp_path / "mine.py"
    script.write_text("from studies.frame.bench import apart\ndef cell(): return 1\napart(cell)\n")
    done = python(str(script), PYTHONPATH=str(ROOT))
    assert "move it into a module and import it" in done.stderr


# show


ROWS = [
    {"lens": "a", "method": "flow", "error": 1.0},
    {"lens": "b", "method": "flow", "error": Interval(2, 1, 3, 4)},
    {"lens": "a", "method": "spots", "error": 3.0},
]


def test_tables_out_of_long_rows():
    assert show.table(ROWS, method="method", error="error, px") == (
        ("method", "error, px"),
        [("flow", 1.0), ("flow", "2 (1 to 3)"), ("spots", 3.0)],
    )
    assert show.table(ROWS)[0] == ("lens", "method", "error")


def test_what_was_asked_and_missed(run):
    bounded = [Asked("speed", 12.0, least=10), Asked("memory, MB", 6.0, most=5)]
    figures = [*bounded, Asked("error", 0.5)]
    assert show.asked(run, figures) == "**Missed in this run:** memory, MB 6 (≤ 5)."
    assert show.asked(run, figures[:1]) == "All figures are met."
    assert not Asked("number", math.nan, most=1).met
    show.tabulate(run, "T", ROWS[::2], "lens", "method", prefix="x", error="px")
    run.finish("T", "L")
    assert "<td>≤ 5</td>" in page(run.folder).replace(' class="number"', "")
    recorded = numbers(run.folder)
    names = ("speed", "memory_mb", "x_a_flow_error", "x_a_spots_error")
    assert [recorded[name] for name in names] == [12, 6, 1, 3]


def test_figures_hold_what_they_are_given():
    chart = show.panels(
        Panel({"a": ([1, 2], [3, 4])}, "x", "y", "xy", [2.0]), Panel({"b": ([1], [1])}, "x", "y")
    )
    left, right = chart.axes
    assert (left.get_xscale(), left.get_yscale(), right.get_yscale()) == ("log", "log", "linear")
    assert [np.asarray(line.get_ydata()).tolist() for line in left.lines] == [[3, 4], [2, 2]]
    image = np.linspace(0, 1, 12).reshape(3, 4)
    assert left.get_legend() is None is right.get_legend()
    ticks = [label.get_text() for label in left.get_yticklabels(minor=True)]
    assert any(ticks), "a short axis has numbers"
    grid = show.pictures(
        {"r": {"i": image, "s": image - 0.5}, "q": {"i": np.ones((3, 4, 3))}}, signed=["s"]
    )
    assert [axis.axison for axis in grid.axes] == [True, True, True, False]
    assert [axis.get_title() for axis in grid.axes] == ["i", "s", "", ""]
    low, high = grid.axes[1].images[0].get_clim()
    assert low == -high == pytest.approx(-0.5, abs=0.01)
    drawn = show.bars({"a": 2.0, "b": Interval(1, 0.5, 2, 9)}, "s", log=True, level=1.5)
    widths = [bar.get_width() for bar in drawn.axes[0].patches if isinstance(bar, Rectangle)]
    assert widths == [2, 1]
    for figure in (chart, grid, drawn):
        plt.close(figure)
