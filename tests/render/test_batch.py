"""Several trajectories in one batch: the numbers of separate calls, gradients of separate calls and of
differences, and batches that do not fit."""

import pytest
import torch

from codesign import lens, render
from codesign.pose import apply, inverse, look_at
from codesign.render import Camera, Film, MovingScene, TexturedPlane
from codesign.render.time import adaptive_times
from scenes import silhouettes, textures, trajectories, worlds

D = torch.float64
BATCH = (2, 3)


def start():
    return look_at((0.2, 0.1, 2.0), (0.0, 0.0, 0.0), down=(0, 1, 0))


def paths(count=4, batch=BATCH, origin=None):
    """Trajectories [*batch, count, 4, 4], each with its own motion in all six components."""
    generator = torch.Generator().manual_seed(7)
    twist = 0.05 * torch.randn(*batch, 6, generator=generator, dtype=D)
    return trajectories.body_twist(
        start() if origin is None else origin, twist, torch.linspace(0, 1, count, dtype=D)
    )


def plane(seed=1, height_m=0.0):
    T = torch.eye(4, dtype=D)
    T[2, 3] = height_m
    return TexturedPlane(*textures.waves(seed, finest_period_m=0.2), T_world_plane=T)


def one_by_one(function, poses):
    """What a function of one trajectory gives for each of a batch, stacked to the shape of the batch."""
    found = [function(each) for each in poses.reshape(-1, *poses.shape[-3:])]
    return torch.stack(found).unflatten(0, poses.shape[:-3])


def camera(samples=4, film=None, optics=None):
    return Camera(optics or lens.Pinhole(8.0), 12, 8, 0.1, samples, seed=3, film=film)


@pytest.mark.bits
@pytest.mark.parametrize("film", [None, Film(20, 16, 6, 5, 0.1, ((0, 0), (13, 8)))])
@pytest.mark.parametrize("world", ["plane", "room"])
def test_frames_of_a_batch_are_those_of_each_trajectory(world, film):
    # every frame samples the film at the same points and is a sum of its own: equal in every bit
    scene = plane() if world == "plane" else worlds.room()
    poses = paths() if world == "plane" else paths(origin=look_at(*worlds.VIEWS["room"]))
    cam = camera(film=film)
    found = render.frames(cam, scene, poses)
    assert found.shape == (*BATCH, 4, *cam.film.shape)
    assert torch.equal(found, one_by_one(lambda each: render.frames(cam, scene, each), poses))
    assert not torch.equal(found[0, 0], found[0, 1])
    assert torch.equal(render.frames(cam, scene, poses[0, 0, :1].expand(2, 3, 4, 4))[1, 2], found[0, 0, 0])


def gradients(cam, scene, poses, way, weights):
    """Gradients to poses [..., T, 4, 4] and to curvatures, of the batch and of the trajectories one by one."""
    results = []
    for separate in (False, True):
        leaf = poses.clone().requires_grad_()
        optics = cam.lens.replace(curvature_per_mm=cam.lens.curvature_per_mm.detach().requires_grad_())
        seen = cam.with_lens(optics)
        if separate:
            frames = one_by_one(lambda each, c=seen: render.frames(c, scene, each, gradient=way), leaf)
        else:
            frames = render.frames(seen, scene, leaf, gradient=way)
        results.append(torch.autograd.grad((frames * weights).sum(), [leaf, optics.curvature_per_mm]))
    return results


@pytest.mark.parametrize("way", ["interior", "boundary", "auto", "difference"])
def test_gradients_of_a_batch_are_those_of_each_trajectory(way, generator):
    # float32 frames, whose adjoints are sums over 8 x 8 pixels x 4 samples in any order; "auto" finds edges in all
    scene = silhouettes.build("cubes")
    cam = Camera(lens.load("cooke-triplet").scaled(0.11).freeze(), 8, 8, 1.0, 4)
    poses = paths(2, (2, 2), look_at((0.05, -1.2, 1.0), (0.0, 1.0, 0.7)))
    weights = torch.rand(8, 8, generator=generator)
    whole, parts = gradients(cam, scene, poses, way, weights)
    for found, truth in zip(whole, parts, strict=True):
        assert float(truth.norm()) > 0
        assert float((found - truth).norm() / truth.norm()) <= 256 * 2**-24


@pytest.mark.bits
@pytest.mark.parametrize("own", [False, True])
def test_objects_move_the_same_for_all_trajectories_or_each_its_own_way(own):
    # float64 throughout; products of 4 x 4 matrices may round differently in another batch
    cam = camera()
    poses = paths()
    cards = paths(4, BATCH if own else (), torch.eye(4, dtype=D)) + 0
    cards[..., 2, 3] += 0.4

    def scene(objects):
        return MovingScene(plane(2), {"card": (plane(1), objects)})

    found = render.frames(cam, scene(cards), poses)
    flow = render.flow_and_occlusion(cam, scene(cards), poses)
    for index in ((0, 0), (1, 2)):
        alone = scene(cards[index] if own else cards)
        torch.testing.assert_close(
            found[index], render.frames(cam, alone, poses[index]), rtol=1e-12, atol=1e-12
        )
        truth = render.flow_and_occlusion(cam, alone, poses[index])
        torch.testing.assert_close(flow.flow_px[index], truth.flow_px, rtol=0, atol=1e-10)
        assert torch.equal(flow.valid[index], truth.valid)
        assert torch.equal(flow.occluded[index], truth.occluded)
    cut = scene(cards).during([1, 3])
    torch.testing.assert_close(
        render.frames(cam, cut, poses[..., [1, 3], :, :]), found[..., [1, 3], :, :], rtol=1e-12, atol=1e-12
    )


@pytest.mark.bits
@pytest.mark.parametrize("stride", [1, 2])
def test_truth_of_a_batch_is_that_of_each_trajectory(stride):
    cam = camera(
        film=Film(20, 16, 6, 5, 0.1, ((0, 0), (13, 8))), optics=lens.load("cooke-triplet").scaled(0.2)
    )
    poses = paths()
    flow, valid = render.true_flow(cam, plane(), poses, stride)
    assert flow.shape == (*BATCH, 4 - stride, 2, *cam.film.shape)
    assert valid.shape == (*BATCH, 4 - stride, *cam.film.shape)
    truth = one_by_one(lambda each: render.true_flow(cam, plane(), each, stride)[0], poses)
    torch.testing.assert_close(flow, truth, rtol=0, atol=1e-10)
    both = render.flow_and_occlusion(cam, plane(), poses, stride)
    assert torch.equal(both.valid, valid)
    torch.testing.assert_close(both.flow_px, flow, rtol=0, atol=1e-10)
    assert not both.occluded.any()


@pytest.mark.bits
def test_exposures_chunks_and_times_take_several_trajectories():
    cam = camera()
    twist = torch.tensor([[0.2, 0.1, 0, 0, 0, 0], [0.4, 0.2, 0, 0, 0, 0.5]], dtype=D)

    def both(t_s):
        return trajectories.body_twist(start(), twist, t_s)

    t_s = torch.linspace(0, 0.1, 5, dtype=D)
    blurred = render.exposed_frames(cam, plane(), both, t_s, 0.02, 2)
    truth = [render.exposed_frames(cam, plane(), lambda t, k=k: both(t)[k], t_s, 0.02, 2) for k in range(2)]
    assert torch.equal(blurred, torch.stack(truth))
    chunks = list(render.frame_chunks(cam, plane(), both(t_s), 2))
    assert [tuple(chunk.shape[:2]) for chunk in chunks] == [(2, 2), (2, 2), (2, 1)]
    assert torch.equal(torch.cat(chunks, 1), render.frames(cam, plane(), both(t_s)))
    # the second moves twice as far and more: it decides the times of both
    times = adaptive_times(cam, plane(), both, 0.0, 0.1, 0.5)
    torch.testing.assert_close(
        times, adaptive_times(cam, plane(), lambda t: both(t)[1], 0.0, 0.1, 0.5), rtol=1e-9, atol=0
    )


def card_over_plane(objects):
    return MovingScene(plane(2), {"card": (plane(1), objects)})


def points_of_a_view(poses):
    cards = inverse(start()) @ poses
    cards[..., 2, 3] += 0.4
    return render.view(camera(), card_over_plane(cards), poses, -1).points_world_m


def projected(poses):
    world = 0.2 * torch.rand(7, 3, generator=torch.Generator().manual_seed(0), dtype=D)
    return render.project(camera(optics=lens.load("cooke-triplet").scaled(0.2)), apply(inverse(poses), world))


def velocity(poses):
    return torch.cat(render.camera_velocity(poses, torch.linspace(0, 0.3, 4, dtype=D)), -1)


@pytest.mark.bits
@pytest.mark.parametrize("of_poses", [points_of_a_view, projected, velocity])
def test_what_a_batch_gives_is_what_each_trajectory_gives(of_poses):
    found = of_poses(paths())
    torch.testing.assert_close(found, one_by_one(of_poses, paths()), rtol=0, atol=1e-10)
    assert not torch.equal(found[0, 0], found[0, 1])
