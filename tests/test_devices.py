"""No stage decides its device by itself: on a GPU values and slopes are the processor's; without one,
nothing is computed that a GPU would refuse."""

import copy
from dataclasses import replace

import pytest
import torch

from codesign import backend, events, flow, lens, mount, pose, render
from codesign.errors import DomainError
from codesign.events import from_counts, from_stream
from codesign.events.kernels import Lanes
from codesign.system import Batch, System
from codesign.train.batches import to_device
from codesign.train.learner import Learner
from codesign.types import FlowField, FlowWindows
from scenes import textures, trajectories, worlds
from tests.numbers import seeded
from tests.second_device import Host, MixedDevices, second_device

T_S = torch.linspace(0, 0.02, 9, dtype=torch.float64)
NOISY = events.SensorModel(0.15, 0.2, 0.03, 60.0, leak_rate_hz=3.0, shot_rate_hz=20.0)


def times():
    """As callers give them, on the host."""
    return T_S.cpu()


def triplet(device, dtype=torch.float32):
    return lens.load("cooke-triplet", dtype).scaled(0.22).to(device)


def camera(geo):
    return render.Camera(geo, 16, 16, pixel_pitch_mm=0.04, samples_per_pixel=4)


def wall(device):
    return worlds.wall(textures.speckle(3, 64), texel_m=0.01, device=device)


def poses(device):
    start = pose.look_at((0.0, -1.0, 0.0), (0.0, 0.0, 0.0))
    return trajectories.translation(start, (1.5, 0.6, 0.0), T_S).to(device)


def pictures(device):
    """Frames 9 x 16 x 16 of a wave that moves, 0 to 255."""
    at = torch.linspace(0, 6, 16, dtype=torch.float64, device=device)
    phase = T_S.to(device)[:, None, None] * 400
    return 128 + 90 * torch.sin(at + phase) * torch.cos(at[:, None] + 0.5 * phase)


def volume():
    """Event volume of 8 bins of what the memory layer sees."""
    sensor = events.SensorModel(0.1, 0.1)
    counts = events.layer("memory", sensor)(pictures("cpu"), T_S).detach().float()
    return from_counts(counts, T_S, 8)


def slopes(value, *leaves):
    leaves = [leaf for leaf in leaves if leaf.requires_grad]
    found = torch.autograd.grad(value, leaves, allow_unused=True)
    return [value, *[slope for slope in found if slope is not None]]


# each is made on a device, and hands back what is to be computed there


def tracing(device):
    geo, middle = triplet(device, torch.float64), torch.zeros(1, 2, device=device)

    def run():
        rays = lens.aimed_rays(geo, 0.1, middle)
        spots = lens.rms_spot_mm(geo, (0.0, 0.1))
        return [*rays, *slopes(spots.sum(), *geo.parameters())]

    return run


def frames(make, shown=render.frames, **how):
    """Frames of a lens, with slopes to it and to the poses."""

    def of(device):
        geo, scene, at = make(device), wall(device), poses(device).requires_grad_()

        def run():
            seen = shown(camera(geo), scene, at, **how)
            return [seen, *slopes(seen.square().mean(), *geo.parameters(), at)]

        return run

    return of


def thin(device):
    return lens.ThinLens(11.0, 4.0).focus_at(1.0).to(device).requires_grad_()


def moving(device):
    """A board that moves before a wall, true flow and occlusion, and a view of one frame."""
    geo, at = triplet(device), poses(device).requires_grad_()
    board = worlds.checkerboard(0.05, device=device)
    back = wall(device)
    turn = torch.eye(4, dtype=torch.float64, device=device).repeat(len(T_S), 1, 1)
    turn[:, 1, 3] = 0.2

    def run():
        scene = render.MovingScene(back, {"board": (board, turn)})
        seen = render.frames(camera(geo), scene, at)
        truth = render.flow_and_occlusion(camera(geo), scene, at)
        depth = render.view(camera(geo), scene, at, 2).depth_m
        table = render.ProjectionTable(camera(geo).with_lens(geo.double().freeze()))
        told = render.truth_of_frames(table, scene, at.detach(), 3)
        loss = seen.square().mean() + truth.flow_px.square().sum() + depth.sum()
        return [*vars(truth).values(), *vars(told).values(), *slopes(loss, at)]

    return run


def robot(device):
    """From lens, mount and thresholds to the velocity of a body over the ground, read and to be
    expected."""
    plain = mount.EgoVelocity(every_px=4)
    head = mount.VelocityHead(plain).to(device)
    geo, level = triplet(device), events.layer("memory", events.SensorModel(0.1, 0.1)).to(device)
    place = mount.Mount((0.0, 0.0, 0.4), (0.1, 0.1, 0.1), pitch_rad=0.9).to(device)
    ground = worlds.ground(textures.speckle(3, 64), texel_m=0.005, device=device)
    body = torch.eye(4, dtype=torch.float64, device=device).repeat(1, len(T_S), 1, 1)
    body[0, :, 0, 3] = T_S.to(device) * 0.8

    def run():
        told = System(
            camera=camera(geo),
            mount=place,
            events=level,
            flow=flow.estimate_lk,
            estimate=head,
            scene=ground,
            objectives={"speed": lambda estimate: estimate.velocity.square().sum()},
        )
        passed = told.begin(Batch(body, times()))
        speed = passed["estimate"].velocity.square().sum()
        read = plain.read(
            *[passed[name] for name in ("field", "camera", "scene", "T_body_cam", "T_world_cam")]
        )
        twist = read.flow_px.new_tensor([[0.8, 0.0, 0.0, 0.0, 0.0, 0.0]])
        flow_px = (read.rows @ twist[:, None, :3, None])[..., 0]
        trend = mount.PrecisionTrend().add(read, flow_px)
        wrong = mount.expected_errors(plain, trend.followed(read, flow_px), twist).squared.sum()
        asked = *geo.parameters(), *level.parameters(), *place.parameters()
        return slopes(speed + wrong, *asked)

    return run


def layer(name):
    def of(device):
        dead_s = 3e-3 if name == "physical" else 0.0
        sensor = events.SensorModel(0.18, 0.2, cutoff_hz=60.0, refractory_s=dead_s)
        made = events.layer(name, sensor, learn=("theta_on", "theta_off")).to(device)
        given = pictures(device).requires_grad_()

        def run():
            counts = made(given, times())
            return [counts, *slopes(counts.square().sum(), given, *made.parameters())]

        return run

    return of


def hard(device):
    given, draw = pictures(device), seeded(1)

    def run():
        state = events.SensorState()
        parts = given[:5], given[5:]
        first = events.simulate(parts[0], times()[:5], NOISY, draw, state)
        finer = replace(NOISY, theta_on=0.05)  # what stands beyond fires at once
        stream = events.concatenate(
            [first, events.simulate(parts[1], times()[5:], finer, draw, state)]
        )
        slotted = replace(NOISY, leak_jitter=0.1, refractory_s=1e-3, timing="v2e")
        slots = events.simulate(given, times(), slotted, draw)
        counts = [events.to_counts(each, times()) for each in (stream, slots)]
        return [*counts, from_stream(stream, 0, 16_000, 5).counts]

    return run


def streams(device):
    """What is made of single events."""
    stream = to_device(events.naive(pictures("cpu"), T_S, 0.05), torch.device(device))

    def run():
        tracker = flow.Tracker(flow.estimate_lk, window_s=0.01, bins=4)
        tracked = [window.field.flow_px for window in tracker.track([stream])]
        return [
            events.decay_from_stream(stream, [5_000, 15_000], 0.01),
            events.surface_from_stream(stream, [5_000, 15_000], 0.01),
            events.spikes_from_stream(stream, 0, 1_000, 20),
            *tracked,
        ]

    return run


def estimator(estimate):
    def of(device):
        given = to_device(volume(), torch.device(device))
        counts = given.counts.requires_grad_()
        made = estimate.to(device) if isinstance(estimate, torch.nn.Module) else estimate

        def run():
            flow_px = made(given).flow_px
            return [flow_px, *slopes(flow_px.square().sum(), counts)]

        return run

    return of


def analyses(device):
    """Everything that is asked of a lens, and its slopes."""
    geo = triplet(device, torch.float64)

    def run():
        told = {
            "mtf": lens.analysis.diffraction_mtf(geo, 0.1, (20.0, 40.0), grid=32),
            "rays": lens.analysis.geometric_mtf(geo, 0.1, (20.0,), grid=16),
            "psf": lens.analysis.diffraction_psf(geo, 0.1, grid=16).energy,
            "light": lens.relative_illumination(geo, (0.0, 0.2)),
            "focus": lens.analysis.through_focus_spot_mm(geo, (0.0, 0.2), (-0.1, 0.1), grid=8),
            **vars(lens.seidel_sums(geo, 0.2)),
            "near": lens.rms_spot_mm(geo.focus_at(0.5), (0.1,), at_m=(0.4, 0.6)),
        }
        waves = lens.analysis.rms_waves(lens.analysis.wavefront(geo, 0.1, grid=16))
        return [*told.values(), *slopes(waves, *geo.parameters())]

    return run


def design(device):
    """Three steps of an optimiser in scaled variables of a lens."""
    geo = triplet(device, torch.float64)

    def run():
        driven = copy.deepcopy(geo)
        variables = driven.variables("curvature", "focus", keep_efl=True)
        optimiser = torch.optim.Adam(variables, lr=0.1)
        for _ in range(3):
            optimiser.zero_grad()
            spots = lens.rms_spot_mm(driven, (0.0, 0.1))
            spots.square().sum().backward()
            optimiser.step()
        return [spots, *(v.detach() for v in variables)]

    return run


def upsampled(device):
    given = pictures(device).float()

    def run():
        finer, times_s = events.upsample(given, times(), max_displacement_px=0.5)
        return [finer, times_s.to(finer.device)]

    return run


def learnt(device):
    """A step of a network of 8 bins on windows whose flow is known, by its own losses."""
    network = copy.deepcopy(flow.load("refiner")).to(device)
    given = to_device(volume(), torch.device(device))
    px = torch.ones(1, 2, 16, 16, device=device)
    truth = FlowField(px, torch.ones(1, 16, 16, dtype=torch.bool, device=device), 0.02)
    windows = FlowWindows(given, truth, None)

    def run():
        learner = Learner(network, lambda told, batch: flow.losses.laplace_loss(told, batch.truth))
        done = learner.step(windows)
        found = network(given).flow_px
        losses = flow.losses.contrast_loss(given, found), flow.losses.smoothness_loss(found)
        scores = [flow.metrics.aee(found, px)]
        return [found, *losses, *scores, torch.as_tensor(done.loss, device=found.device)]

    return run


def spikes(device):
    """Learnt generators of events, and surfaces of what they make."""
    made = events.SpikeEsim(seed=0).to(device)
    given = pictures(device).requires_grad_()

    def run():
        counts, _ = made(given, times())
        surface = events.surface_from_counts(counts, times(), 0.01)
        lost = events.van_rossum(counts, counts.detach() * 0, tau_s=0.01)
        return [surface, *slopes(lost, given, *made.parameters())]

    return run


def expected(device):
    """What a mount is judged by before anything is rendered, and what its robot keeps in view."""
    geo, place = triplet(device), mount.Mount((0.0, 0.0, 0.4), (0.1, 0.1, 0.1), pitch_rad=0.9)
    place = place.to(device)
    ahead = mount.LookAhead(1.0, 0.1)

    def run():
        at = place()
        slack = ahead.slack(at, camera(geo))
        rows, _ = mount.body_flow(camera(geo), at.new_ones(256), at)
        return [rows.detach(), *slopes(slack + rows.sum(), *place.parameters())]

    return run


STAGES = {
    "lens analyses": analyses,
    "lens design": design,
    "upsampling": upsampled,
    "training": learnt,
    "learnt spikes": spikes,
    "mount": expected,
    "tracing": tracing,
    "traced frames": frames(triplet),
    "thin frames": frames(thin),
    "frames by differences": frames(thin, gradient="difference"),
    "frames by point spread": frames(thin, render.psf_frames),
    "moving parts": moving,
    "robot": robot,
    "hard": hard,
    "streams": streams,
    **{f"layer {name}": layer(name) for name in events.LAYERS},
    "closed form": estimator(flow.estimate),
    "least squares": estimator(flow.estimate_lk),
    "refiner": estimator(flow.load("refiner")),
}


@pytest.mark.parametrize("name", STAGES)
def test_it_computes_where_its_input_is(name):
    run = STAGES[name]("cpu")
    with second_device():
        found = run()
    assert not any(isinstance(one, Host) for one in found)


@pytest.mark.cuda
@pytest.mark.parametrize("name", STAGES)
def test_a_gpu_gives_what_the_processor_gives(name):
    """Rays in float32 are rounded by 1e-7 of a metre or so, which textures turn into 1e-4 of a
    frame's contrast, and thresholds into an event more or less in a thousand."""
    expected = STAGES[name]("cpu")()
    for one, other in zip(STAGES[name]("cuda")(), expected, strict=True):
        assert one.device.type == "cuda"
        one, other = one.cpu().double(), other.double()
        assert one.isfinite().equal(other.isfinite())
        one, other = (v[other.isfinite()] for v in (one, other))
        assert float((one - other).norm()) <= 2e-3 * float(other.norm())


def test_what_a_gpu_refuses_is_refused():
    there = torch.ones(3)
    with second_device():
        here = torch.ones(3)
        assert isinstance(here, Host)
        assert not isinstance(here.to(there.device), Host)
        assert not isinstance(torch.zeros(2, device=there.device), Host)
        assert torch.equal(there[torch.tensor([0, 2])] * torch.tensor(2.0), 2 * there[:2])
        for wrong in (
            lambda: there + here,
            lambda: torch.stack([there, here]),
            lambda: there.numpy(),
            lambda: backend.run_kernel(lambda arr, x: (x,), (here,), [(3,)]),
            lambda: there @ torch.eye(3, device="cpu"),
            lambda: here[there.long()],
            lambda: Lanes(there, 3).load(here),
        ):
            with pytest.raises(MixedDevices):
                wrong()
        assert there.cpu().numpy().sum() == 3


def test_silhouettes_on_a_gpu_are_refused_in_a_sentence(monkeypatch):
    monkeypatch.setattr(render.sequence, "device_of", lambda lens: torch.device("cuda"))
    for gradient in ("boundary", "auto"):
        with pytest.raises(DomainError, match="found on the processor only"):
            render.frames(camera(triplet("cpu")), wall("cpu"), poses("cpu"), gradient)
