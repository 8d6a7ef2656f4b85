"""Robots and their worlds: bodies by volume, drives by closed forms, flow by two roads, variants by
number."""

import math
from dataclasses import fields, replace

import drjit as dr
import numpy as np
import pytest
import torch

from codesign import lens, pose, render
from codesign.errors import DomainError
from codesign.mount import FREE, Body, EgoVelocity, ground_depth, judge
from codesign.mount.depth import ground_and_scene_depth, scene_depth
from scenes import bodies, worlds
from scenes.robots import pair as robot_pair
from scenes.robots.pairs import PAIRS
from tests.numbers import D, close, f64, randn64, seeded
from tests.render.differences import assert_gradients
from tests.scenes.solids import volume_m3

NAMES = tuple(PAIRS)
LARGE = 200  # operations of a kernel that casts rays


@pytest.fixture(scope="module", params=NAMES)
def pair(request):
    return PAIRS[request.param]()


@pytest.fixture(scope="module")
def drives(pair):
    """One world with three drives."""
    return pair.batch((3,), 3)


def test_boxes_and_cylinders_have_their_volumes_and_stand_where_they_are_asked_to():
    around = bodies.AROUND
    # of the regular polygon in a circle of radius 1
    area = around / 2 * math.sin(2 * math.pi / around)
    assert volume_m3(bodies.box((2.0, 1.0, 0.5), (3.0, 2.0, 1.0), 30.0)) == pytest.approx(
        1.0, rel=1e-12
    )
    for axis, name in enumerate("xyz"):
        body = bodies.cylinder(0.1, 0.04, (1.0, 2.0, 3.0), name)
        assert volume_m3(body) == pytest.approx(area * 0.01 * 0.04, rel=1e-9)
        half = np.ptp(body.vertices_m, axis=0)[axis] / 2
        assert half == pytest.approx(0.02, rel=1e-12)
        np.testing.assert_allclose(body.vertices_m.mean(0), [1, 2, 3], atol=1e-12)


def test_bodies_are_closed_and_stand_above_the_ground(pair, drives):
    for body in pair.bodies.values():
        edges = np.concatenate([body.faces[:, [k, (k + 1) % 3]] for k in range(3)])
        counted = np.unique(edges, axis=0, return_counts=True)
        assert (counted[1] == 1).all()  # every directed edge once,
        # and once back
        assert {tuple(edge) for edge in edges} == {tuple(edge[::-1]) for edge in edges}
        assert volume_m3(body) > 0
        points = torch.from_numpy(body.vertices_m)
        lowest = pose.apply(drives.T_world_body.flatten(0, 1), points)[..., 2].min()
        assert lowest > 0


def test_poses_follow_the_true_velocity(drives):
    twist = torch.stack([drives.twist] * (robot_pair.FRAMES - 1), 1)
    found, _ = render.camera_velocity(drives.T_world_body[0], drives.t_s)
    # rounding of poses of 1e-15 m over 2.5 ms
    close(found, twist, atol=1e-9)


def test_the_ground_is_where_the_estimator_takes_it(pair, drives):
    """Where a robot on flat ground is said to know depth by the ground, most of what it sees lies
    there."""
    if pair.depth != "ground":
        pytest.skip("depth comes from the scene")
    camera = pair.design.camera()
    pixels = camera.film.pixels()[::37].expand(3, -1, 2)
    poses = drives.T_world_body[0, :, robot_pair.FRAMES // 2] @ pair.design.mount()
    ground = ground_depth(camera, pixels, poses, drives.scene)
    seen = scene_depth(camera, pixels, poses, drives.scene)
    near = ground < 1.5
    alike = (ground - seen).abs() < 1e-4
    assert alike[near].double().mean() > 0.7


def test_one_cast_gives_the_depth_that_is_believed_and_the_true_one(pair, drives):
    camera = pair.design.camera()
    pixels = camera.film.pixels()[::37].expand(3, -1, 2)
    poses = drives.T_world_body[0, :, robot_pair.FRAMES // 2] @ pair.design.mount()
    believed, true = ground_and_scene_depth(camera, pixels, poses, drives.scene)
    close(believed, ground_depth(camera, pixels, poses, drives.scene))
    close(true, scene_depth(camera, pixels, poses, drives.scene))


def test_another_world_of_a_pair_needs_no_kernel_of_its_own(pair):
    """Repeats of pictures, boxes and places are data; what is compiled depends on the kinds of
    shapes alone."""
    camera = pair.design.camera()
    mount = pair.design.mount()

    def compiled(number):
        world, (driven, _) = pair.world(number), pair.drive(number, 1)
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            dr.kernel_history_clear()
            render.frames(camera, world, driven[0] @ mount)
            return {
                kernel["hash"]
                for kernel in dr.kernel_history()
                if kernel.get("operation_count", 0) > LARGE
            }

    assert compiled(21) == compiled(22) != set()


def test_a_known_body_has_no_depth(pair, drives):
    """Straight down on the robot: where its mesh is hit, and only there, depth is infinite."""
    camera = render.Camera(lens.Pinhole(5.0), 16, 16, 0.3, 1)
    above = pose.look_at((0.02, 0.01, 1.2), (0.0, 0.0, 0.0), (-1.0, 0.0, 0.0))
    T_world_body = drives.T_world_body[:, :, robot_pair.FRAMES // 2]
    poses = (T_world_body @ above).flatten(0, 1)
    pixels = camera.film.pixels().expand(3, -1, 2)
    depth = scene_depth(camera, pixels, poses, drives.scene)
    hit = render.view(camera, pair.body(), above[None], 0).valid.flatten()
    assert 0.05 < hit.double().mean() < 0.9
    assert depth[:, hit].isinf().all()
    assert depth[:, ~hit].isfinite().all()


def test_variants_differ_and_come_again(pair):
    kept = pair.drive(5, 4)
    for again, other in zip(pair.drive(5, 4), pair.drive(6, 4), strict=True):
        assert any(torch.equal(again, each) for each in kept)
        assert not any(each.shape == other.shape and torch.equal(other, each) for each in kept)
    camera = render.Camera(pair.design.camera().lens, 12, 9, 0.4, 4)
    poses = kept[0][0, :1] @ pair.design.mount()
    first, second, third = (render.frames(camera, pair.world(n), poses) for n in (5, 5, 6))
    assert torch.equal(first, second)
    assert (first / third).log().abs().mean() > 0.1


def test_unseen_variants_share_nothing_with_training():
    assert not set(robot_pair.training(500)) & set(robot_pair.unseen(500))
    assert not set(robot_pair.PHOTOS[True]) & set(robot_pair.PHOTOS[False])
    with pytest.raises(DomainError, match="give 1 to"):
        robot_pair.training(robot_pair.UNSEEN_FROM + 1)
    drawn = [robot_pair.picture(np.random.default_rng([n, 2]), n > 9, 100.0) for n in range(20)]
    sums = {round(float(each.std()), 4) for each in drawn}
    assert len(sums) >= 12  # photographs come again, patterns do not


def test_pictures_have_their_mean_and_six_tenths_of_the_contrast():
    from scenes import textures

    found = robot_pair.picture(np.random.default_rng([1, 2]), False, 120.0)
    assert float(found.mean()) == pytest.approx(120.0, rel=1e-4)
    log = np.log(found)
    whole = [np.log(textures.photo(name)).std() for name in robot_pair.PHOTOS[False]]
    whole.append(0.5)  # of random patterns
    assert min(abs(log.std() / 0.6 - each) for each in whole) < 1e-3


def test_speeds_and_rates_are_those_of_the_hard_regime():
    speed, deviates = robot_pair.speeds_and_deviates(4, 400, 3)
    # one in every four-hundredth of the distribution
    share = (speed / 0.05).log() / math.log(60)
    even = (torch.arange(400, dtype=D) + 0.5) / 400
    close(share.sort().values, even, atol=0.5 / 400)
    normal = 0.5 * (1 + torch.erf(deviates / math.sqrt(2)))
    close(normal.sort(0).values, even[:, None].expand(-1, 3), atol=0.5 / 400)


def test_the_design_starts_inside_its_bounds_and_others_are_refused(pair):
    assert pair.check(pair.design) is pair.design
    for field in fields(robot_pair.Design):
        low, start, high = (getattr(d, field.name) for d in (pair.low, pair.design, pair.high))
        assert low < start < high or low == start == high
    with pytest.raises(DomainError, match=r"efl_mm = 99 lies outside its bounds"):
        pair.check(replace(pair.design, efl_mm=99.0))


def test_the_default_design_keeps_what_a_mount_has_to_keep(pair):
    wanted = pair.requirements()
    assert ("look-ahead" in [each.name for each in wanted]) == (pair.look_ahead is not None)
    assert all(verdict.kept for verdict in judge(wanted, pair.design.mount(), pair.design.camera()))
    # the clearance is that of the nearest mesh, less the housing and its margin
    at = pair.design.mount()[:3, 3]
    nearest = min(
        float(Body([(mesh.vertices_m, mesh.faces)]).distance_m(at)) for mesh in pair.bodies.values()
    )
    found = next(each for each in wanted if each.name == "clearance").exact(
        pair.design.mount(), None
    )
    assert float(found.min()) == pytest.approx(nearest - 0.02 - 0.005, abs=1e-12)


def test_an_estimate_of_exact_flow_is_the_true_velocity(pair, drives):
    """Rendered truth through the design's own windows, where the scene's depth is known, gives back
    the twist."""
    mount = pair.design.mount()
    exact = EgoVelocity(FREE, (1e3,) * 6, "scene", outlier=1.0, steps=20)
    slow = replace(drives, T_world_body=slowed(drives, 0.05))
    system = pair.system(pair.design).replaced(flow=lambda volume, truth: truth, estimate=exact)
    with torch.no_grad():
        found = system.begin(slow)["estimate"].velocity
    assert mount.shape == (4, 4)
    # things' edges and the body's own are left to the outlier rule
    close(found, 0.05 * drives.twist, rtol=0.05, atol=2e-3)


def slowed(drives, share):
    """Poses of the same drives at a share of their velocity, about the middle of the window."""
    middle = drives.T_world_body[:, :, robot_pair.FRAMES // 2]
    twist = share * drives.twist.unflatten(0, middle.shape[:2])
    return robot_pair.moved(middle.flatten(0, 1), twist.flatten(0, 1)).unflatten(
        0, middle.shape[:2]
    )


def test_a_pair_sees_through_a_family_of_traced_lenses():
    """What the lens of a family costs reaches the frames: the corner windows are darker than behind
    a thin lens, and its variables carry gradients, as differences say."""
    family_pair = replace(PAIRS["corridor"](), family="retrofocus-4")
    assert family_pair.system(family_pair.design).camera.lens.name == "retrofocus-4"
    start, scene = family_pair.design, worlds.smooth_plane(5)
    pose_at = pose.look_at((0.2, 0.1, 1.0), (0, 0, 0), down=(0, 1, 0))[None]

    def frames(efl_mm, fno):
        return render.frames(
            family_pair.camera(replace(start, efl_mm=efl_mm, fno=fno)), scene, pose_at
        )

    at = [f64(v) for v in (start.efl_mm, 1.6)]
    weights = randn64(seeded(0), frames(*at).shape)
    assert_gradients(lambda *v: (frames(*v) * weights).sum(), at, (1e-5, 1e-5), 1e-5)
    whole = render.Film(*robot_pair.SENSOR_PX, *robot_pair.SENSOR_PX, robot_pair.PITCH_MM)
    for efl_mm in (family_pair.low.efl_mm, family_pair.high.efl_mm):
        family_pair.camera(replace(start, efl_mm=efl_mm)).with_film(whole).check()
    traced = family_pair.camera(start).rays().weight.reshape(9, -1).mean(1)
    thin = start.camera().rays().weight.reshape(9, -1).mean(1)
    assert thin.min() == 1.0
    assert 0.3 < traced[0] / traced[4] < 0.85
