"""What a run keeps and shows: exact state, metrics, a page that loads nothing."""

import re
from dataclasses import dataclass
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pytest
import torch

from codesign.errors import DomainError, FileFormatError, ShapeError
from codesign.state import write_state
from studies.frame.run import StudyConfig, open_run
from tests import refusals
from tests.numbers import f64
from tests.studies.runs import module_of, numbers, ran
from tests.studies.smallest_study import Config


def test_state_returns_every_bit(run, generator):
    tensors = {
        "float32": torch.randn(3, 4, generator=generator).T,
        "float64/odd name": f64([0.1, torch.nan, -0.0, torch.inf, 5e-324]),
        "int64": torch.tensor([2**62 + 1, -1]),
        "bool": torch.tensor([True, False]),
        "scalar": torch.tensor(1 / 3),
        "empty": torch.zeros(0, 2),
        "file": torch.randn(2, generator=generator).requires_grad_(),
    }
    given = {"step": 7, "best": 0.1 + 0.2, "history": [1e-300, float("inf")], "name": "π"}
    run.save_state(tensors, given)
    back = run.load_state()
    assert back.numbers == given
    assert list(back.tensors) == list(tensors)
    for name, tensor in tensors.items():
        found = back.tensors[name]
        assert (found.dtype, found.shape) == (tensor.dtype, tensor.shape)
        assert found.numpy().tobytes() == tensor.detach().numpy().tobytes()


def test_state_is_data_and_damage_is_named(run):
    assert run.load_state() is None
    run.save_state({"x": torch.ones(2)}, {})
    path = run.folder / "state.npz"
    with np.load(path, allow_pickle=False) as arrays:
        assert all(arrays[name].dtype != object for name in arrays.files)
    with pytest.raises(ShapeError, match="bfloat16"):
        run.save_state({"x": torch.ones(2, dtype=torch.bfloat16)}, {})
    # a refused state does not touch the last one
    assert torch.equal(run.load_state().tensors["x"], torch.ones(2))
    for damage in (b"", b"not a state", path.read_bytes()[:-30]):
        path.write_bytes(damage)
        with pytest.raises(FileFormatError, match="not a state file"):
            run.load_state()


def test_the_state_of_another_run_is_refused(tmp_path):
    def folder(name, study="smallest_study", **options):
        made = open_run(study, Config(out=tmp_path / name, **options))
        made.save_state({}, {"step": 1})
        return made.folder

    def resumed():
        return open_run("smallest_study", Config(resume=mine)).load_state()

    mine = folder("mine")
    assert resumed().numbers == {"step": 1}
    for other, reason in (
        (folder("a", "other"), "study"),
        (folder("b", limit=2.0), "configuration"),
    ):
        (mine / "state.npz").write_bytes((other / "state.npz").read_bytes())
        with pytest.raises(FileFormatError, match=f"another {reason}"):
            resumed()
    write_state(mine / "state.npz", {}, {"numbers": {}, "times": {"seconds": 0.0, "loops": {}}})
    with pytest.raises(FileFormatError, match=r"another version .*start a new run"):
        resumed()


def test_a_file_that_an_option_names_is_the_same_when_a_run_goes_on(tmp_path):
    given, other = tmp_path / "lens.json", tmp_path / "other.json"
    given.write_text("one")
    begun = Reading(out=tmp_path / "run", files=(given, other), lens="triplet")
    open_run("reading", begun)
    resumed = Reading(resume=tmp_path / "run")
    assert open_run("reading", resumed).config.files == (given, other)
    for change in (lambda: given.write_text("two"), given.unlink):
        change()
        with pytest.raises(DomainError, match=r"lens\.json' changed since this run was begun"):
            open_run("reading", resumed)
    given.write_text("one")
    open_run("reading", resumed)
    (inside := tmp_path / "frames").mkdir()
    (inside / "0.png").write_text("one")
    begun = Reading(out=tmp_path / "second", files=(inside,))
    open_run("reading", begun)
    (inside / "0.png").write_text("two")
    with pytest.raises(DomainError, match=r"what lies in '.*frames' changed since"):
        open_run("reading", Reading(resume=tmp_path / "second"))
    other.write_text("was not there")
    with pytest.raises(DomainError, match=r"other\.json' changed since"):
        open_run("reading", resumed)


@dataclass(frozen=True)
class Reading(StudyConfig):
    files: tuple[Path, ...] = ()
    lens: str = ""


@refusals.table(__file__, "empty paths")
def test_an_empty_path_is_not_the_present_folder(row, capsys):
    name, words = row.call.split(" ", 1)
    assert ran(module_of(name), words) == 2
    assert row.sentence in capsys.readouterr().err


def test_metrics_are_finite_numbers(run):
    run.record(good_mm=np.float64(2.5), count=torch.tensor(3), flag=True)
    assert numbers(run.folder) == {"good_mm": 2.5, "count": 3, "flag": 1}


@refusals.table(__file__, "metrics")
def test_what_is_no_metric_is_refused_and_nothing_recorded(run, row):
    row.holds({**globals(), "run": run})
    run.finish("A page", "That holds none.")
    assert numbers(run.folder) == {}


def test_page_holds_everything_and_loads_nothing(run):
    run.card("RMS spot", "12.3 µm", "detuned: 41 µm")
    run.section(
        "Result",
        "The **lens** is `sharp` <script>alert(1)</script> https://example.org\n\n- one\n- two",
    )
    figure, axes = plt.subplots()
    axes.plot([0, 1], [1, 0])
    path = run.figure(figure, "loss", "The loss *falls*.")
    assert not plt.fignum_exists(figure.number)
    rows = [["axis", 1234.56, 8], ["edge", -0.000125, None], ["corner", 1.5e-7, 0]]
    run.table("Spots", ["field", "rms_um", "rays"], rows)
    (run.folder / "events.gif").write_bytes(b"GIF89a")
    run.video("events.gif", "Events.")
    run.record(loss_last=0.5)
    html = run.finish("A sharper lens", "It is *better*.").read_text()
    loaded = re.findall(
        r"""(?:src|href|srcset|data|action|poster)\s*=\s*["']([^"']*)|url\(([^)]*)\)|@import\s*([^;]*)""",
        html,
    )
    assert all(any(each) and next(filter(None, each)).startswith("data:") for each in loaded)
    assert html.count("data:image/png;base64,") == 1
    assert html.count("data:image/gif;base64,R0lGODlh") == 1
    assert "<script" not in html
    for piece in (
        "The <strong>lens</strong> is <code>sharp</code> &lt;script&gt;",
        "<li>two</li>",
        '<td>axis</td><td class="number">1235</td><td class="number">8</td>',
        '<td class="number">−0.000125</td><td class="number">–</td>',
        '<td class="number">1.5·10⁻⁷</td>',
        'alt="The loss falls."',
        "12.3 µm",
        "loss_last",
    ):
        assert piece in html
    assert plt.imread(path).shape[1] > 600, "figures are sharp enough to print"


@refusals.table(__file__, "pages")
def test_page_refuses_what_it_cannot_show(run, row):
    row.holds({"run": run})
