"""The chain: junction probes, recorded junctions, and errors that name where a value went bad."""

from types import SimpleNamespace

import pytest
import torch

from codesign.errors import DomainError, NonFiniteError
from codesign.graph import Chain
from codesign.types import EventVolume, FlowField, Rays


def toy(render=lambda rays, design: rays.direction.sum(1)):
    """A chain of plain algebra: loss = (3 * 2 * a)^2 with a the design, so every junction gradient is
    known."""

    def lens(a):
        optics = SimpleNamespace(efl_mm=a)

        def rays():
            return Rays(torch.zeros(1, 3), torch.stack([a, 0 * a, 0 * a]).reshape(1, 3), torch.ones(1))

        return SimpleNamespace(lens=optics, rays=rays)

    return Chain(
        lens=lens,
        render=render,
        events=lambda frames, design: EventVolume(
            2 * frames.reshape(1, 1, 1, 1, 1), torch.zeros(1), torch.ones(1)
        ),
        flow=lambda volume, design: FlowField(
            3 * volume.counts[:, 0], torch.ones(1, 1, 1, dtype=torch.bool), 1.0
        ),
        objective=lambda field, camera, design: field.flow_px.square().sum(),
    )


def test_gradient_at_every_junction_is_that_of_the_algebra():
    a = torch.tensor(0.5, requires_grad=True)
    result = toy()(a)
    result.backward()
    assert result.loss.item() == pytest.approx(9.0)  # (6 * 0.5)^2
    grad = {row["junction"]: row["gradient_norm"] for row in result.table()}
    assert grad["flow"] == pytest.approx(6.0)  # 2 * 3
    assert grad["events"] == pytest.approx(18.0)
    assert grad["frames"] == pytest.approx(36.0)
    assert grad["lens"] == pytest.approx(36.0)


def test_table_counts_zero_gradients():
    a = torch.tensor(0.5, requires_grad=True)
    result = toy(render=lambda rays, design: rays.direction[:, 0])(a)
    result.backward()
    row = next(r for r in result.table() if r["junction"] == "rays")
    assert row["gradient_norm"] == pytest.approx(36.0)
    assert row["zero_share"] == pytest.approx(2 / 3)  # of three direction components only x reaches the loss


@pytest.mark.parametrize(
    ("name", "value", "loss"),
    [
        ("frames", torch.tensor([1.0]), 36.0),
        ("events", EventVolume(torch.ones(1, 1, 1, 1, 1), torch.zeros(1), torch.ones(1)), 9.0),
        ("flow", FlowField(torch.full((1, 1, 1, 1), 2.0), torch.ones(1, 1, 1, dtype=torch.bool), 1.0), 4.0),
    ],
)
def test_recorded_junctions_replace_what_is_before_them(name, value, loss):
    def never(rays, design):
        raise AssertionError("the render stage ran although a later junction was recorded")

    result = toy(render=never)(torch.tensor(0.5, requires_grad=True), recorded={name: value})
    assert result.loss.item() == pytest.approx(loss)


def test_unknown_recorded_junction_is_refused():
    with pytest.raises(DomainError, match=r"\['lenses'\] cannot be replaced; rays, frames, events, flow can"):
        toy()(torch.tensor(0.5), recorded={"lenses": None})


def test_a_bad_value_is_named_by_its_junction():
    with pytest.raises(NonFiniteError, match="junction 'frames'"):
        toy(render=lambda rays, design: rays.direction.sum(1) / 0)(torch.tensor(0.5, requires_grad=True))


def test_a_bad_gradient_is_named_by_its_junction():
    # sqrt(|x|) at 0 has a finite value and an infinite slope: the frames are the first junction from the loss
    # back to see it
    chain = toy(render=lambda rays, design: rays.direction[:, 1])
    chain.events = lambda frames, design: EventVolume(
        (frames.abs() + 0.0).sqrt().reshape(1, 1, 1, 1, 1), torch.zeros(1), torch.ones(1)
    )
    chain.objective = lambda field, camera, design: field.flow_px.sum()
    with pytest.raises(NonFiniteError, match="junction 'frames'"):
        chain(torch.tensor(0.5, requires_grad=True)).backward()
