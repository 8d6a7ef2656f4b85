"""The system on plain algebra, where every junction's gradient is known: probes, recordings, names,
refusals."""

import copy
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from torch import nn

from codesign.errors import DomainError, GradientError, NonFiniteError, ShapeError
from codesign.system import Batch, System, check
from codesign.types import EventVolume, FlowField, Rays
from tests import refusals
from tests.hostile.stages import Stage, held
from tests.numbers import D, f64, seeded

ONE = torch.ones(1)
T_S = f64([0.0, 1.0])
BATCH = Batch(torch.eye(4, dtype=D).expand(2, 4, 4), T_S, scene="wall")


class Glass(nn.Module):
    """A lens with one number."""

    def __init__(self, a=0.5):
        super().__init__()
        self.efl_mm = nn.Parameter(torch.tensor(a))


class ToyCamera:
    """Rays in the direction of the lens's number."""

    seed = 7
    film = SimpleNamespace(shape=(1, 1))

    def __init__(self, lens):
        self.lens = lens

    def with_seed(self, seed):
        twin = ToyCamera(self.lens)
        twin.seed = seed
        return twin

    def with_lens(self, lens):
        return ToyCamera(lens)

    def rays(self):
        a = self.lens.efl_mm
        return Rays(torch.zeros(1, 3), torch.stack([a, 0 * a, 0 * a]).reshape(1, 3), ONE)


def volume_of(frames):
    """The first frame as ON events in one bin; no OFF."""
    on = frames.reshape(-1, 2, 1, 1)[:, :1, None]
    return EventVolume(torch.cat([on, torch.zeros_like(on)], 1), torch.zeros(1), ONE)


def field_of(flow):
    """Flow along x."""
    return FlowField(
        torch.cat([flow, torch.zeros_like(flow)], 1), torch.ones(1, 1, 1, dtype=torch.bool), 1.0
    )


def both(value):
    """Two equal frames of one pixel, [2, 1, 1]."""
    return value.reshape(1, 1, 1).expand(2, 1, 1)


def render_sum(rays):
    return both(rays.direction.sum())


def doubled(frames):
    return volume_of(2 * frames)


def tripled(volume):
    return field_of(3 * volume.counts[:, :1, 0])


def square(field):
    return field.flow_px.square().sum()


def toy(**parts):
    """loss = (3 * 2 * a)^2 with a = 0.5."""
    usual = {"camera": ToyCamera(Glass()), "render": render_sum, "events": doubled, "flow": tripled}
    return System(**{**usual, "objectives": {"square": square}, **parts})


def missed(interval_s):
    """A pass judged by a truth of that interval; the flow's is 1 s."""
    truth = replace(field_of(ONE.reshape(1, 1, 1, 1)), interval_s=interval_s)
    judged = toy(objectives={"missed": lambda field, truth: (field.flow_px - truth.flow_px).sum()})
    return judged(replace(BATCH, truth=truth)).objectives["missed"].item()


def test_gradient_at_every_junction_is_that_of_the_algebra():
    result = toy()(BATCH, probe=True)
    result.backward()
    assert result.loss.item() == pytest.approx(9.0)  # (6 * 0.5)^2
    grad = {row["junction"]: row["gradient_norm"] for row in result.table()}
    assert list(grad) == ["lens", "pose", "rays", "frames", "events", "flow"]
    assert grad["flow"] == pytest.approx(6.0)  # 2 * 3
    assert grad["events"] == pytest.approx(18.0)
    assert grad["frames"] == pytest.approx(36.0)
    assert grad["lens"] == pytest.approx(36.0)


def test_table_counts_zero_gradients():
    result = toy(render=lambda rays: both(rays.direction[:, 0]))(BATCH, probe=True)
    result.backward()
    row = next(r for r in result.table() if r["junction"] == "rays")
    assert row["gradient_norm"] == pytest.approx(36.0)
    # of three direction components only x reaches the loss
    assert row["zero_share"] == pytest.approx(2 / 3)


def test_without_a_probe_nothing_is_kept_and_nothing_looked_at():
    result = toy(render=lambda rays: render_sum(rays) / 0)(BATCH)
    assert result.junctions is None
    assert result.loss.item() == float("inf")


def test_several_objectives_share_one_pass_and_add_up_by_weight():
    rendered = []

    def counted(rays):
        rendered.append(1)
        return render_sum(rays)

    lens = Glass()
    system = toy(
        camera=ToyCamera(lens),
        render=counted,
        objectives={"square": square, "sum": lambda volume: volume.counts.sum()},
    )
    result = system(BATCH)
    assert len(rendered) == 1
    result.backward({"square": 0.5, "sum": 10.0})
    assert lens.efl_mm.grad is not None
    # d(36 a^2)/da = 36, d(2 a)/da = 2
    assert lens.efl_mm.grad.item() == pytest.approx(0.5 * 36 + 10 * 2)
    assert set(system(BATCH, objectives=("sum",)).objectives) == {"sum"}
    with pytest.raises(DomainError, match="no objective 'cube'; there are square, sum"):
        system(BATCH, objectives=("cube",))


@pytest.mark.parametrize(
    ("name", "value", "loss"),
    [
        ("frames", torch.ones(1, 2, 1, 1), 36.0),
        ("events", volume_of(torch.ones(2)), 9.0),
        ("flow", field_of(torch.full((1, 1, 1, 1), 2.0)), 4.0),
    ],
)
def test_recorded_junctions_replace_what_is_before_them(name, value, loss):
    def never(rays):
        raise AssertionError("the render stage ran although a later junction was recorded")

    assert toy(render=never)(BATCH, recorded={name: value}).loss.item() == pytest.approx(loss)


def test_a_bad_gradient_is_named_by_its_junction():
    # sqrt(|x|) at 0 has a finite value and an infinite slope: the frames are the first junction
    # from the loss back to see it
    system = toy(
        render=lambda rays: both(rays.direction[:, 1]),
        events=lambda frames: volume_of(frames.abs().sqrt()),
        objectives={"sum": lambda field: field.flow_px.sum()},
    )
    with pytest.raises(NonFiniteError, match="junction 'frames'"):
        system(BATCH, probe=True).backward()


def test_a_stage_gets_what_its_signature_names():
    seen = {}

    def events(frames, t_s, camera, generator, theta=0.2):
        seen.update(t_s=t_s, camera=camera, draw=torch.rand(3, generator=generator), theta=theta)
        return volume_of(2 * frames)

    toy(events=events)(Batch(BATCH.T_world_body, T_S, "wall", seed=5))
    assert seen["t_s"] is T_S
    assert seen["camera"].seed == 5
    assert seen["theta"] == 0.2
    torch.testing.assert_close(seen["draw"], torch.rand(3, generator=seeded(5)))


def test_parameters_of_every_part_are_the_systems():
    layer = Stage(lambda frames, gain: volume_of(gain * frames))
    system = toy(events=layer, mount=held())
    assert {name for name, _ in system.named_parameters()} == {
        "lens.efl_mm",
        "events.gain",
        "mount.twist",
    }
    twin = system.replaced(events=doubled)
    assert {name for name, _ in twin.named_parameters()} == {"lens.efl_mm", "mount.twist"}
    assert twin.lens is system.lens


def test_estimator_and_bins_must_fit():
    network = Stage(lambda volume, gain: tripled(volume))
    network.config = {"bins": 5}
    assert toy(flow=network).bins == 5
    with pytest.raises(
        DomainError,
        match=r"stage 'flow' \(Stage\) was built for 5 time bins and the system makes 9",
    ):
        toy(flow=network, bins=9)


@refusals.table(__file__, "systems")
def test_what_does_not_fit_is_refused(row):
    def run(*given):
        return toy(render=lambda rays, T_world_cam: render_sum(rays))(Batch(*given))

    row.holds(globals() | {"run": run})


def test_scenes_each_see_their_own_poses():
    poses = torch.eye(4, dtype=D).expand(2, 1, 2, 4, 4)

    def render(scene, T_world_cam):
        return float(scene) * T_world_cam[..., 0, 0, None, None]

    counts = toy(render=render, events=lambda frames: frames[:, 1:, None].expand(-1, -1, 2, -1, -1))
    volume = counts.replaced(bins=1).begin(Batch(poses, T_S, ("3", "4")))["volume"]
    assert volume.counts[:, 0, 0, 0, 0].tolist() == [3.0, 4.0]


def test_windows_of_a_film_become_samples():
    camera = ToyCamera(Glass())
    camera.film = SimpleNamespace(shape=(3, 1, 1))
    poses = torch.eye(4, dtype=D).expand(2, 2, 4, 4)

    # [trajectory 2, T 2, window 3, 1, 1]: 100 trajectory + 10 time + window
    def render(T_world_cam):
        shape = (
            torch.arange(2.0)[:, None, None] * 100
            + torch.arange(2.0)[:, None] * 10
            + torch.arange(3.0)
        )
        return shape[..., None, None]

    seen = []

    def events(frames):
        seen.append(frames[..., 0, 0])
        return frames[:, 1:, None].expand(-1, -1, 2, -1, -1)

    toy(camera=camera, render=render, events=events, bins=1).begin(Batch(poses, T_S, "wall"))[
        "volume"
    ]
    assert seen[0].tolist() == [[0, 10], [1, 11], [2, 12], [100, 110], [101, 111], [102, 112]]


def test_check_finds_a_frozen_variable_and_one_that_no_objective_sees():
    system = toy()
    lens = system.lens
    assert check(
        system, BATCH, torch.optim.SGD([lens.efl_mm], lr=0.1)
    ).loss.item() == pytest.approx(9.0)
    # as a lens without aspheres has them
    check(system, BATCH, torch.optim.SGD([lens.efl_mm, nn.Parameter(torch.zeros(3, 0))], lr=0.1))
    stray = nn.Parameter(torch.zeros(2))
    with pytest.raises(
        GradientError,
        match=r"no objective \(square\) depends on variable 1 \(no parameter of the system",
    ):
        check(system, BATCH, [lens.efl_mm, stray])
    lens.efl_mm.requires_grad_(False)
    with pytest.raises(
        GradientError, match=r"variable 'lens.efl_mm' is frozen but was handed to the optimiser"
    ):
        check(system, BATCH, [lens.efl_mm])


def test_a_copy_is_independent_and_whole():
    system = toy()
    twin = copy.deepcopy(system)
    with torch.no_grad():
        twin.lens.efl_mm.mul_(2)
    assert system(BATCH).loss.item() == pytest.approx(9.0)
    assert twin(BATCH).loss.item() == pytest.approx(36.0)
    twin(BATCH).backward()
    assert system.lens.efl_mm.grad is None


def test_parts_can_be_exchanged_in_place_and_are_looked_at():
    system = toy()
    system.events = volume_of
    assert system(BATCH).loss.item() == pytest.approx(2.25)  # (3 * 0.5)^2
    system.lens = Glass(1.0)
    for each in (system, system.replaced(bins=1), copy.deepcopy(system)):
        assert each(BATCH).loss.item() == pytest.approx(9.0)
    with pytest.raises(ShapeError, match="was given bins=5, stage 'events' made 1"):
        system.replaced(bins=5)(BATCH)
    system.camera = ToyCamera(Glass(2.0))
    assert system(BATCH).loss.item() == pytest.approx(36.0)
    system.camera = lambda: ToyCamera(Glass(1.0))
    assert not list(system.parameters()), "the lens left with its camera"


def test_check_finds_a_lens_computed_once():
    once = toy()
    once.lens.register_buffer("made", 2 * once.lens.efl_mm)
    with pytest.raises(GradientError, match="computed once from other tensors"):
        check(once, BATCH)
