"""The study of velocity heads: order of samples, ratios by hand, and the whole of it on evidence in closed form."""

import json
from dataclasses import fields

import pytest
import torch

from codesign import task
from scenes import robot_pair
from scenes.robot_pairs import PAIRS
from studies.frame.run import main
from studies.velocity_head import __main__ as heads
from studies.velocity_head import samples as kept
from studies.velocity_head.compare import ARMS, Errors
from studies.velocity_head.samples import Drawn, Samples, designs
from studies.velocity_head.training import distance

D = torch.float64
WINDOWS = 4
NOISE_PX = 0.1
SHORT = 0.5  # of its flow, that one window of each body reads


def made(count, seed, pair):
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
    seen = task.Evidence(
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
    head = task.VelocityHead(task.EgoVelocity(tuple(range(6)), (1.0,) * 6))
    velocity, covariance, _ = (part.detach() for part in head.judged(seen))
    return Samples(seen, twist, velocity, covariance, pair.axes)


def test_designs_keep_off_the_bounds_and_more_of_them_begin_alike():
    pair = PAIRS["flight"]()
    few = designs(pair, 4, 7)
    assert few == designs(pair, 9, 7)[:4]
    for design in designs(pair, 32, 0):
        for field in fields(design):
            low, value, high = (getattr(each, field.name) for each in (pair.low, design, pair.high))
            assert low == value == high or low < value < high


def test_samples_of_one_world_are_neighbours_and_are_read_again(tmp_path, monkeypatch):
    pair = PAIRS["outdoors"]()
    asked = []

    def part(self, design, first, motions):
        asked.append((first, motions))
        found = made(len(self.numbers) * motions, 1, pair)
        world = torch.arange(len(self.numbers)).repeat_interleave(motions)
        found.twist[:, 0] = world
        found.twist[:, 1] = first + torch.arange(motions).repeat(len(self.numbers))
        return found

    monkeypatch.setattr(Drawn, "_part", part)
    drawn = Drawn(pair, robot_pair.training(3), tmp_path, 0)
    found = drawn.samples("own", 2, pair.design, 8)
    assert asked == [(16, kept.AT_ONCE), (16 + kept.AT_ONCE, 8 - kept.AT_ONCE)]
    assert found.twist[:, 0].tolist() == [world for world in range(3) for _ in range(8)]
    assert found.twist[:, 1].tolist() == [*range(16, 24)] * 3
    again = drawn.samples("own", 2, pair.design, 8)
    assert len(asked) == 2
    assert torch.equal(again.seen.flow_px, found.seen.flow_px)


def test_distance_by_hand():
    pair = PAIRS["outdoors"]()
    samples = made(2, 1, pair)
    covariance = torch.diag(torch.tensor([4.0, 1.0, 9.0, 9.0, 9.0, 0.25], dtype=D)).expand(2, 6, 6)
    off = torch.tensor([2.0, 3.0, 100.0, 100.0, 100.0, 0.5], dtype=D)
    found = distance(samples.twist + off, covariance, samples)
    torch.testing.assert_close(found, torch.full((2,), 1.0 + 9 + 1, dtype=D))  # forward, left, yaw


def test_ratios_by_hand():
    """A bounded error of b is a typical one of sqrt(b / (1 - b)): 1/2 gives 1, 1/5 gives 1/2, 4/5 gives 2."""
    design = PAIRS["outdoors"]().design
    errors = Errors([])
    shared = {"plain": 0.8, "hidden": 0.5, "shared": 0.2, "alone": 0.5, "trained on": 0.2}
    poorer = shared | {"shared": 0.5}
    for found in (shared, poorer, shared):
        errors.add("outdoors", design, {arm: torch.full((4,), found[arm]) for arm in ARMS}, worlds=2)
    assert errors.ratios("own").tolist() == pytest.approx([1.0, 2.0, 1.0])
    assert errors.ratios("alone").tolist() == pytest.approx([0.5, 1.0, 0.5])
    figures = errors.figures(seed=0)
    assert figures["shared_over_own_median"] == pytest.approx(1.0)
    assert figures["shared_over_own_worst"] == pytest.approx(2.0)
    assert figures["shared_over_own_within_1_1"] == 2
    assert figures["shared_over_plain_median"] == pytest.approx(0.25)
    assert figures["outdoors_plain_error"] == pytest.approx(2.0)
    # of three designs drawn again the median is 2 in 7 of 27 draws, and never another
    assert (figures["shared_over_own_low90"], figures["shared_over_own_high90"]) == pytest.approx((1.0, 2.0))


def test_the_shared_head_is_as_good_as_own_ones_where_designs_do_not_matter(tmp_path, monkeypatch):
    numbers = {"training": 0, "own": 1000, "unseen": 2000}

    def samples(self, kind, index, design, motions):
        return made(len(self.numbers) * motions, numbers[kind] + index, self.pair)

    monkeypatch.setattr(Drawn, "samples", samples)
    sizes = {"designs": 10, "held-out": 2, "worlds": 4, "unseen": 2, "motions": 30, "own-motions": 90}
    sizes |= {"judged-motions": 90, "steps": 120, "own-steps": 40, "width": 16, "batch": 96}
    arguments = [word for name, value in sizes.items() for word in (f"--{name}", str(value))]
    out = tmp_path / "run"
    assert main(heads.study, heads.Config, [*arguments, "--pair", "corridor", "--out", str(out)]) == 0
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["shared_over_plain_median"] < 0.6
    assert metrics["shared_over_trained_on_worst"] == pytest.approx(1.0, abs=0.3)
    # a window that reads half of its flow is far out of a covariance that does not know it
    assert metrics["plain_within_90_share"] < 0.3
    assert metrics["shared_within_90_share"] == pytest.approx(0.9, abs=0.1)
    head = task.VelocityHead.load(task.EgoVelocity(), out / "head.safetensors")
    assert head.config["width"] == 16


def test_sizes_and_names_are_checked(tmp_path, capsys):
    for arguments, sentence in (
        (["--pair", "attic"], "choose from outdoors, corridor, flight"),
        (["--worlds", "1"], "--worlds is 1; at least 2"),
        (["--own-motions", "97"], "a world has 96 drives"),
    ):
        assert main(heads.study, heads.Config, [*arguments, "--out", str(tmp_path / arguments[0])]) == 2
        assert sentence in capsys.readouterr().err
