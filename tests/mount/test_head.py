"""The learnt head: fresh it is least squares, its input against closed forms, gradients against
differences, symmetry by a world in a mirror, and the delivered weights in a world that they have
not seen."""

import math
from dataclasses import replace
from functools import partial

import pytest
import torch

from codesign import lens, pose, render
from codesign.errors import FileFormatError
from codesign.flow.checkpoint import DELIVERED
from codesign.mount import FREE, PLANAR, EgoVelocity, Mount, VelocityHead
from codesign.mount.head import evidence
from codesign.types import FlowField
from scenes.robots import pair as robot_pair
from scenes.robots.pairs import PAIRS
from tests.numbers import D, close, f64, rand64, randn64, seeded

INTERVAL_S = 0.01
PITCH_MM = 0.3
WINDOWS = ((0, 0), (40, 20), (80, 60))
MIRROR = f64([1.0, -1, 1, -1, 1, -1])


def camera_of(windows=WINDOWS, optics=None):
    optics = lens.ThinLens(20.0, 10.0, 20.5) if optics is None else optics
    film = render.Film(112, 92, 32, 32, PITCH_MM, windows)
    return render.Camera(optics, 32, 32, PITCH_MM, 1, 0, film)


def plain_of(axes=FREE, **how):
    return EgoVelocity(axes, (1.5, 0.4, 0.3, 0.8, 0.8, 0.8)[: len(axes)], **how)


def noisy(count, windows=3, seed=3):
    """Fields of flow that is a ramp with noise, a claimed covariance and a confidence."""
    generator = seeded(seed)

    def draw(*shape):
        return rand64(generator, count * windows, *shape)

    ramp = torch.linspace(-1, 1, 32, dtype=D)
    flow = (2 * draw(2, 1, 1) - 1) * (1 + 0.3 * ramp) + 0.2 * (draw(2, 32, 32) - 0.5)
    xx, yy = (0.01 + 0.1 * draw(2, 1, 1)).expand(-1, 2, 32, 32).unbind(1)
    covariance = torch.stack([xx, 0.3 * (xx * yy).sqrt(), yy], 1)
    confidence = 0.4 + 0.6 * draw(1, 1).expand(-1, 32, 32)
    return FlowField(flow, confidence > 0, INTERVAL_S, confidence, covariance)


def of_windows(field, pick, flow=None):
    """The field with each of its tensors [N windows, ...] picked from; ``flow`` instead of its
    flow."""
    given = {**vars(field), "flow_px": field.flow_px if flow is None else flow}
    picked = {name: pick(part) for name, part in given.items() if torch.is_tensor(part)}
    return replace(field, **picked)


def moved(count, mount, seed=4):
    """Poses [N, 3, 4, 4] of the camera on bodies over flat ground."""
    twists = 0.3 * randn64(seeded(seed), count, 6)
    half = INTERVAL_S / 2 * f64([-1.0, 0.0, 1.0])
    return pose.se3_exp(half[:, None] * twists[:, None]) @ mount


def stirred(head, seed=5):
    """The head in float64 with last layers that say something."""
    generator = seeded(seed)
    for last in (head.say[-1], head.claim[-1]):
        for parameter in last.parameters():
            parameter.data = 0.3 * torch.randn(parameter.shape, generator=generator)
    return head.double().requires_grad_(False)


@pytest.fixture(scope="module")
def mount():
    return Mount(
        (0.2, 0.05, 0.5), (0.1, 0.1, 0.1), pitch_rad=1.0, yaw_rad=0.3, roll_rad=0.1
    )().detach()


@pytest.mark.parametrize("axes", [FREE, PLANAR])
@pytest.mark.parametrize("windows", [WINDOWS, ((10, 20),), (*WINDOWS, (60, 0), (0, 60))])
def test_fresh_it_is_least_squares_on_any_film(mount, axes, windows):
    camera = camera_of(windows)
    field = noisy(4, len(windows))
    poses = moved(4, mount)
    plain = plain_of(axes)
    expected = plain(field, camera, None, mount, poses)
    found = VelocityHead(plain)(field, camera, None, mount, poses)
    # the normal matrix is inverted instead of solved with: rounding times its condition
    close(found.velocity, expected.velocity, rtol=1e-9, atol=1e-11)
    close(found.covariance, expected.covariance, rtol=1e-9, atol=1e-12)
    torch.testing.assert_close(found.kept, expected.kept)


def test_blur_and_focal_length_are_those_of_the_thin_lens(mount):
    camera = camera_of()
    # looks straight down
    level = f64([[1.0, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 0.8], [0, 0, 0, 1]])
    plain = plain_of()
    read = plain.read(noisy(2), camera, None, level, level.expand(2, 3, 4, 4))
    found = evidence(read, plain.solve(read), camera, level, plain.prior).lens
    up = 10 * PITCH_MM / 20.5  # the middle of the second window is 10 px above that of the film
    ahead = f64([0.0, up, -1.0]) / math.hypot(1.0, up)
    close(found[:, 1, :3], ahead.expand(2, 3), atol=1e-9)
    close(found[..., 3].exp() * 300, torch.full((2, 3), 20.5 / PITCH_MM, dtype=D), rtol=1e-6)
    for column, near in ((4, 1 / 0.8), (5, 0.0)):
        disc_px = 10.0 * abs(1 - 20.5 * (1 / 20.0 - 1e-3 * near)) / PITCH_MM
        # root mean square radius of a uniform disc
        expected = torch.full((2, 3), disc_px / 8**0.5, dtype=D)
        close(found[..., column].expm1(), expected, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("fno", [1.6, 2.2, 4.0])
def test_blur_of_a_wide_lens_is_the_spot_of_its_whole_pupil(mount, fno):
    """Whose corners are blurred by powers of the pupil that a single ring of it does not know."""
    geo = lens.family("retrofocus-4").lens(2.5, fno, 1.0, 0.2)
    windows = tuple((x, 30) for x in (0, 20, 40))
    camera = render.Camera(geo, 32, 32, 0.0185, 1, 0, render.Film(112, 92, 32, 32, 0.0185, windows))
    plain = plain_of()
    read = plain.read(noisy(1), camera, None, mount, mount.expand(1, 3, 4, 4))
    found = evidence(read, plain.solve(read), camera, mount, plain.prior).lens[0, :, 5].expm1()
    middle = camera.film.pixels().reshape(3, -1, 2).double().mean(1)

    def slope(pixels, pupil):
        rays = camera.rays_through(pixels, pupil)
        return (rays.direction[:, :2] / rays.direction[:, 2:]).double()

    turn, count = torch.arange(2000) * math.pi * (3 - 5**0.5), 2000
    radius = ((torch.arange(count) + 0.5) / count).sqrt()
    pupil = torch.stack([radius * turn.cos(), radius * turn.sin()], 1).double()
    for number, pixel in enumerate(middle):
        steps = pixel + torch.eye(2, dtype=D)
        chief = slope(torch.stack([pixel, *steps]), torch.zeros(3, 2, dtype=D))
        off = slope(pixel.expand(count, 2), pupil)
        shift = torch.linalg.solve((chief[1:] - chief[:1]).mT, (off - off.mean(0)).mT)
        assert float(found[number]) == pytest.approx(
            float(shift.square().sum(0).mean().sqrt()), rel=0.02
        )
    # the other way through the lens, from a point far away to the film: alike, not the same
    sine = camera.chief_rays(middle).direction[:, :2].norm(dim=1)
    spot = lens.rms_spot_mm(geo, sine.asin().tolist(), vignetting=True) / 0.0185
    torch.testing.assert_close(found, spot.double(), rtol=0.15, atol=0.02)


def test_the_order_of_windows_does_not_matter(mount):
    order = [2, 0, 1]
    field = noisy(3)
    poses = moved(3, mount)
    head = stirred(VelocityHead(plain_of()))
    turned = of_windows(field, lambda part: part.unflatten(0, (3, 3))[:, order].flatten(0, 1))
    expected = head(field, camera_of(), None, mount, poses)
    found = head(turned, camera_of(tuple(WINDOWS[k] for k in order)), None, mount, poses)
    close(found.velocity, expected.velocity, rtol=1e-9, atol=1e-11)
    close(found.covariance, expected.covariance, rtol=1e-9, atol=1e-12)


def test_a_world_in_a_mirror_gives_the_velocity_in_a_mirror(mount):
    """Left and right of body and world, and of the image, are exchanged."""
    field = noisy(3)
    poses = moved(3, mount)
    left = torch.diag(f64([1.0, -1, 1, 1]))
    image = torch.diag(f64([-1.0, 1, 1, 1]))
    sign = f64([-1.0, 1])[:, None, None]
    mirrored = replace(
        field, covariance_px2=field.covariance_px2 * torch.tensor([1.0, -1, 1])[:, None, None]
    )
    flipped = of_windows(mirrored, lambda part: part.flip(-1), sign * field.flow_px)
    other = camera_of(tuple((112 - 32 - x, y) for x, y in WINDOWS))
    head = stirred(VelocityHead(plain_of(every_px=1)))
    expected = head(field, camera_of(), None, mount, poses)
    found = head(flipped, other, None, left @ mount @ image, left @ poses @ image)
    close(found.velocity, expected.velocity * MIRROR, rtol=1e-7, atol=1e-9)
    unmirrored = head(flipped, other, None, mount, poses)
    assert (unmirrored.velocity - expected.velocity * MIRROR).abs().max() > 1e-3


@pytest.fixture(scope="module")
def designs(mount):
    """Velocities as a function of one number that changes what is read, the mount or the lens."""
    camera = camera_of()
    plain = plain_of(steps=2)
    head = stirred(VelocityHead(plain))
    field, poses = noisy(2), moved(2, mount)
    body = poses @ torch.linalg.inv(mount)
    read = plain.read(field, camera, None, mount, poses)
    generator = seeded(8)
    ways = {}
    for name in ("flow_px", "precision", "confidence"):
        value = getattr(read, name)
        share = randn64(generator, value.shape[:2])
        ways[name] = value * share.reshape(*value.shape[:2], *[1] * (value.ndim - 2))

    def of_reading(shift, name):
        changed = replace(read, **{name: getattr(read, name) + shift * ways[name]})
        return head.judged(evidence(changed, plain.solve(changed), camera, mount, plain.prior))[0]

    def of_mount(shift):
        turned = mount @ pose.se3_exp(shift * f64([0.1, -0.2, 0.3, 0.2, 0.1, -0.3]))
        return head(field, camera, None, turned, body @ turned).velocity

    def of_lens(shift, share_focus):
        optics = lens.ThinLens(20.0 + (1 - share_focus) * shift, 10.0, 20.5 + share_focus * shift)
        return head(field, camera_of(optics=optics), None, mount, poses).velocity

    return {
        "mount": of_mount,
        "focus": partial(of_lens, share_focus=1),
        "focal length": partial(of_lens, share_focus=0),
        **{name: partial(of_reading, name=name) for name in ways},
    }


@pytest.mark.parametrize(
    "what", ["flow_px", "precision", "confidence", "mount", "focus", "focal length"]
)
def test_gradient_is_that_of_differences(designs, what):
    at = torch.zeros((), dtype=D, requires_grad=True)
    # truncation step^2 times third derivatives, rounding of 1e-12 over the step
    assert torch.autograd.gradcheck(designs[what], at, eps=1e-5, rtol=1e-5, atol=1e-6)
    assert torch.autograd.functional.jacobian(designs[what], at).abs().max() > 1e-4


def test_weights_are_kept_and_read_again(tmp_path, mount):
    head = stirred(VelocityHead(plain_of(), width=16, rounds=1)).float()
    head.save(tmp_path / "head.safetensors", {"note": "a"})
    again = VelocityHead.load(plain_of(), tmp_path / "head.safetensors")
    assert again.config == head.config
    field = noisy(2)
    poses = moved(2, mount)
    found, expected = (
        each(field, camera_of(), None, mount, poses).velocity for each in (again, head)
    )
    assert torch.equal(found, expected)
    with pytest.raises(FileFormatError, match="no velocity head"):
        VelocityHead.load(plain_of(), DELIVERED["refiner"])


def test_every_body_may_have_a_mount_of_its_own(mount):
    """Two mounts with two drives each are as four bodies."""
    other = mount @ pose.se3_exp(f64([0.1, 0.0, 0.0, 0.0, 0.2, 0.0]))
    mounts = torch.stack([mount, other])[:, None]
    poses = torch.stack([moved(2, mount), moved(2, other)])
    head = stirred(VelocityHead(plain_of()))
    field = noisy(4)
    found = head(field, camera_of(), None, mounts, poses).velocity
    each = mounts.expand(2, 2, 4, 4).reshape(4, 4, 4)
    torch.testing.assert_close(
        found, head(field, camera_of(), None, each, poses.flatten(0, 1)).velocity
    )
    alone = of_windows(field, lambda part: part[6:])
    torch.testing.assert_close(found[2:], head(alone, camera_of(), None, other, poses[1]).velocity)


def test_the_delivered_head_is_ahead_of_least_squares_in_an_unseen_world():
    pair = PAIRS["corridor"]()
    batch = pair.batch(robot_pair.unseen(1), 12)
    system = pair.system(pair.design, "sensor")
    head = VelocityHead.pretrained(system.estimate)
    with torch.no_grad():
        run = system.begin(batch)
        plain = pair.errors(run["estimate"], batch).bounded().mean()
        learnt = system.replaced(estimate=head).begin(batch)["estimate"]
    assert sum(weight.numel() for weight in head.parameters()) <= 50_000
    # the study found 0.80 of the typical error over four designs; 12 samples of one world scatter
    # by a third of that
    assert pair.errors(learnt, batch).bounded().mean() < plain
