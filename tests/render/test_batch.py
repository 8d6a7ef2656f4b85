"""Several trajectories in one batch: the numbers and gradients of separate calls."""

import pytest
import torch

from codesign import lens, render
from codesign.pose import apply, inverse, look_at
from codesign.render import Camera, Film, MovingScene
from scenes import silhouettes, trajectories, worlds
from tests.numbers import D, close, f64, rand64, randn64, seeded
from tests.render.planes import START, plane

BATCH = (2, 3)
T_S = torch.linspace(0, 1, 4, dtype=D)
WINDOWS = Film(20, 16, 6, 5, 0.1, ((0, 0), (13, 8)))


def paths(count=4, batch=BATCH, origin=START):
    """Trajectories [*batch, count, 4, 4], each with its own motion in all six components."""
    twist = 0.05 * randn64(seeded(7), *batch, 6)
    return trajectories.body_twist(origin, twist, torch.linspace(0, 1, count, dtype=D))


def one_by_one(function, poses):
    """What a function of one trajectory gives for each of a batch, stacked to the shape of the
    batch."""
    found = [function(each) for each in poses.reshape(-1, *poses.shape[-3:])]
    return torch.stack(found).unflatten(0, poses.shape[:-3])


def camera(film=None, optics=None):
    size = (film.width_px, film.height_px) if film else (12, 8)
    return Camera(optics or lens.Pinhole(8.0), *size, 0.1, 4, seed=3, film=film)


def beside(poses, own=True):
    """A card over a plane: with a way of its own beside every camera, or the same for all."""
    cards = inverse(START) @ poses if own else paths(4, (), torch.eye(4, dtype=D))
    cards = cards.clone()
    cards[..., 2, 3] += 0.4
    return MovingScene(plane(2), {"card": (plane(1), cards)})


def occlusion(scene, poses, cam, stride=1):
    """Everything that flow_and_occlusion tells, as one tensor."""
    found = render.flow_and_occlusion(cam, scene, poses, stride)
    flow, valid = render.true_flow(cam, scene, poses, stride)
    assert torch.equal(valid, found.valid)
    close(flow, found.flow_px, atol=1e-10)
    masks = torch.stack([found.valid, found.occluded], -3 - (cam.film.windows_px is not None))
    return torch.cat([flow, masks.double()], -3 - (cam.film.windows_px is not None))


def projected(poses):
    world = 0.2 * rand64(seeded(0), 7, 3)
    return render.project(
        camera(optics=lens.load("cooke-triplet").scaled(0.2)), apply(inverse(poses), world)
    )


def by_time(function):
    """Of poses at four times, as functions of time."""
    return lambda poses: function(lambda t: poses[..., [round(float(v) * 3) for v in t], :, :])


@pytest.mark.bits
@pytest.mark.parametrize(
    "of_poses",
    [
        lambda poses: render.frames(camera(), plane(), poses),
        lambda poses: render.frames(camera(WINDOWS), plane(), poses),
        lambda poses: render.frames(
            camera(), worlds.room(), look_at(*worlds.VIEWS["room"]) @ inverse(START) @ poses
        ),
        lambda poses: torch.cat(list(render.frame_chunks(camera(), plane(), poses, 3)), -3),
        by_time(lambda path: render.exposed_frames(camera(), plane(), path, T_S, 0.02, 2)),
        lambda poses: render.frames(camera(), beside(poses), poses),
        lambda poses: render.frames(camera(), beside(poses, own=False), poses),
        lambda poses: render.frames(
            camera(), beside(poses).during([1, 3]), poses[..., [1, 3], :, :]
        ),
        lambda poses: occlusion(beside(poses), poses, camera()),
        lambda poses: occlusion(beside(poses, own=False), poses, camera(WINDOWS)),
        lambda poses: occlusion(
            plane(), poses, camera(WINDOWS, lens.load("cooke-triplet").scaled(0.2)), 2
        ),
        lambda poses: render.view(camera(), beside(poses), poses, -1).points_world_m,
        projected,
        lambda poses: torch.cat(render.camera_velocity(poses, T_S), -1),
    ],
)
def test_what_a_batch_gives_is_what_each_trajectory_gives(of_poses):
    # products of 4 x 4 matrices may round differently in another batch; float32 scenes have every
    # bit or a phase apart
    found = of_poses(paths())
    close(found, one_by_one(of_poses, paths()), rtol=1e-10, atol=1e-10)
    assert not torch.equal(found[0, 0], found[0, 1])


def gradients(cam, scene, poses, way, weights, separate):
    """Gradients to poses [..., T, 4, 4] and to curvatures, of the batch or of the trajectories one
    by one."""
    leaf = poses.clone().requires_grad_()
    optics = cam.lens.replace(curvature_per_mm=cam.lens.curvature_per_mm.detach().requires_grad_())
    seen = cam.with_lens(optics)

    def frames(each):
        return render.frames(seen, scene, each, gradient=way)

    found = one_by_one(frames, leaf) if separate else frames(leaf)
    return torch.autograd.grad((found * weights).sum(), [leaf, optics.curvature_per_mm])


@pytest.mark.parametrize("way", ["interior", "boundary", "auto", "difference"])
def test_gradients_of_a_batch_are_those_of_each_trajectory(way, generator):
    # float32 frames, whose adjoints are sums over 8 x 8 pixels x 4 samples in any order; "auto"
    # finds edges in all
    scene = silhouettes.build("cubes")
    cam = Camera(lens.load("cooke-triplet").scaled(0.11).freeze(), 8, 8, 1.0, 4)
    poses = paths(2, (2, 2), look_at((0.05, -1.2, 1.0), (0.0, 1.0, 0.7)))
    weights = torch.rand(8, 8, generator=generator)
    whole, parts = (
        gradients(cam, scene, poses, way, weights, separate) for separate in (False, True)
    )
    for found, truth in zip(whole, parts, strict=True):
        assert truth.norm() > 0
        assert (found - truth).norm() / truth.norm() <= 256 * 2**-24


def test_the_trajectory_that_moves_furthest_decides_the_times_of_all():
    twist = f64([[0.2, 0.1, 0, 0, 0, 0], [0.4, 0.2, 0, 0, 0, 0.5]])

    def times(motion):
        return render.adaptive_times(
            camera(), plane(), lambda t: trajectories.body_twist(START, motion, t), 0.0, 0.1, 0.5
        )

    close(times(twist), times(twist[1]), rtol=1e-9)


@pytest.mark.bits
def test_a_list_of_worlds_is_each_with_its_own_poses():
    several = [plane(), plane(5)]
    poses = paths(3, (2, 2))
    frames = render.frames(camera(), several, poses)
    truth = occlusion(several, poses, camera(), 2)
    for k, world in enumerate(several):
        assert torch.equal(frames[k], render.frames(camera(), world, poses[k]))
        alone = occlusion(world, poses[k], camera(), 2)
        close(truth[k], alone, atol=1e-10)
