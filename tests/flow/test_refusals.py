"""Wrong calls of the flow package, as somebody makes who meets it for the first time: the calls and
sentences of refusals.txt. None leaves a file behind."""
# pyright: reportArgumentType=false
# ruff: noqa: F401 (names of the calls)

import math
from dataclasses import replace

import torch

from codesign import flow
from codesign.flow import contrast, losses, metrics
from codesign.flow.export import evenly_timed, export
from codesign.flow.files import write_flow
from studies.train_flow.peers import ECN, IDNet
from tests import refusals
from tests.event_streams import stream_of
from tests.flow import test_tracker
from tests.flow.test_contrast import moving_dots, uniform, window
from tests.flow.test_export import Small
from tests.flow.test_losses import FIRST, TRUTH, D
from tests.flow.test_tracker import SIZE
from tests.numbers import f64

FLOW = torch.zeros(2, 3, 3)
CORNER = FLOW[:, :2, :2]
EVERYWHERE = stream_of(
    (0, 0, 0, 1), (1, 1, 0, 1), (2, 0, 1, 1), (3, 1, 1, 1), height_px=2, width_px=2
)
AT_ONCE = stream_of((0, 0, 0, 1), height_px=2, width_px=2)
DOTS = moving_dots()
STREAM = stream_of((10, 1, 1, 1), height_px=8, width_px=16)
STILL = torch.zeros(2, 8, 16)
UNKNOWN = torch.zeros(1, 2, 8, 16, dtype=D).index_fill(3, torch.tensor([2]), math.nan)
TILTED = f64([1.0, 2.0, 1.0])[None, :, None, None].expand(2, 3, 1, 2)


def tracker(estimator=test_tracker.summed, **options):
    return flow.Tracker(estimator, **options)


def at_times(*t_us):
    return test_tracker.stream_of(t_us)


@refusals.table(
    __file__, "networks", "images of warped events", "losses", "measures", "files", "tracker"
)
def test_one_wrong_value(row, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    row.holds(globals())
    assert not list(tmp_path.iterdir())
