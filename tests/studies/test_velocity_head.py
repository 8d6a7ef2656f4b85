"""The study of the velocity head: its designs, and a little training on evidence in closed form."""

from dataclasses import fields

import pytest
import torch

from codesign.mount import EgoVelocity, Evidence, VelocityHead
from scenes.robots.pairs import PAIRS
from studies import velocity_head
from studies.velocity_head import designs
from tests.studies.browser import check_page
from tests.studies.runs import numbers, page, ran

D = torch.float64
WINDOWS = 4
NOISE_PX = 0.1
SHORT = 0.5  # of its flow, that one window of each body reads


def made(count, seed):
    """Samples of bodies one of whose windows, told by a number, reads short."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape):
        return torch.randn(count, *shape, generator=generator, dtype=D)

    twist = normal(6)
    rows = normal(WINDOWS, 2, 6)
    marked = torch.zeros(count, WINDOWS, dtype=D)
    marked[:, 0] = 1
    flow = (rows @ twist[:, None, :, None])[..., 0] + NOISE_PX * normal(WINDOWS, 2)
    flow = flow * (1 - (1 - SHORT) * marked[..., None])
    told = torch.zeros(count, WINDOWS, 11, dtype=D)
    told[..., 9] = marked
    seen = Evidence(
        rows.mT @ rows / NOISE_PX**2,
        (rows.mT @ flow[..., None])[..., 0] / NOISE_PX**2,
        flow.square().sum(-1) / NOISE_PX**2,
        rows,
        flow,
        told,
        torch.zeros(count, WINDOWS, 6, dtype=D),
        torch.zeros(count, 9, dtype=D),
        torch.ones(count, 6, dtype=D),
    )
    return {f.name: getattr(seen, f.name) for f in fields(seen)} | {"twist": twist}


def test_designs_keep_off_the_bounds_and_more_of_them_begin_alike():
    pair = PAIRS["flight"]()
    few = designs(pair, 4, 7)
    assert few == designs(pair, 9, 7)[:4]
    for design in designs(pair, 32, 0):
        for field in fields(design):
            low, value, high = (getattr(each, field.name) for each in (pair.low, design, pair.high))
            assert low == value == high or low < value < high


def test_a_little_training_lowers_the_error_on_worlds_kept_from_it_and_what_it_saves_loads(
    tmp_path, monkeypatch
):
    """Training is of three worlds of four. In closed form: one window of four that reads half of
    its flow pulls least squares; a head that hears which one it is leaves it out."""

    def rendered(pair, design, index, config):
        return made(config.worlds * config.motions, index)

    monkeypatch.setattr(velocity_head, "rendered", rendered)
    sizes = "--designs 60 --worlds 4 --motions 6 --steps 120 --width 16 --batch 96"
    out = tmp_path / "run"
    assert ran(velocity_head, f"{sizes} --pair corridor --out", out) == 0
    check_page("velocity_head", out)
    metrics = numbers(out)
    assert metrics["corridor_head_error"] < 0.6 * metrics["corridor_plain_error"]
    assert metrics["corridor_log_ratio_high"] < 0
    assert "wins in &#39;corridor&#39; (360 samples of 60 designs" in page(out)
    head = VelocityHead.load(EgoVelocity(tuple(range(6)), (1.0,) * 6), out / "head.safetensors")
    again = {name: tensor.double() for name, tensor in made(600, 1000).items()}
    samples = velocity_head.Samples(
        Evidence(*(again[f.name] for f in fields(Evidence))),
        again["twist"],
        PAIRS["corridor"]().axes,
    )
    error = velocity_head.typical(velocity_head.errors(head, samples))
    assert error == pytest.approx(metrics["corridor_head_error"], rel=0.3)
