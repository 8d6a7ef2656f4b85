"""Distances to meshes against closed forms and brute force, inside and outside against shapes that
are known."""

import math
from functools import partial

import numpy as np
import pytest
import torch

from codesign.errors import GradientError
from codesign.mount import Body, Housing
from codesign.mount.pose import attitude
from codesign.mount.triangles import closest_points, first_crossings
from scenes import bodies, robots
from tests.numbers import D, close, f64, rand64, randn64

BOX = ((-0.2, -0.1, 0.0), (0.3, 0.15, 0.4))


def box_mesh(low, high):
    low, high = np.array(low), np.array(high)
    box = bodies.box(high - low, (low + high) / 2)
    return box.vertices_m, box.faces


def box_distance(points, low, high):
    """Closed form: outside the norm of what sticks out, inside the nearest face."""
    low, high = f64([low, high])
    over = (points - (low + high) / 2).abs() - (high - low) / 2
    return over.clamp_min(0).norm(dim=-1) + over.amax(-1).clamp_max(0)


def ball_mesh(radius):
    import trimesh

    mesh = trimesh.creation.icosphere(2, radius)
    return mesh.vertices, mesh.faces


def some_poses(generator, count, spread):
    angles = (rand64(generator, count, 3) - 0.5) * 6
    poses = torch.eye(4, dtype=D).repeat(count, 1, 1)
    poses[:, :3, :3] = torch.stack([attitude(*each) for each in angles.tolist()])
    poses[:, :3, 3] = (rand64(generator, count, 3) - 0.5) * spread
    return poses


def test_distance_to_a_box_is_the_closed_form(generator):
    points = 1.5 * (rand64(generator, 2000, 3) - 0.4)
    found = Body([box_mesh(*BOX)]).distance_m(points)
    expected = box_distance(points, *BOX)
    assert 20 < (expected < 0).sum() < 1980
    # the sum and root of three squares below 4 in float64
    close(found, expected, atol=1e-14)


def test_nearest_points_beat_every_sampled_point(generator):
    """No point of the triangles is nearer than the one found, and the one found is a point of
    them."""
    triangles = randn64(generator, 7, 3, 3)
    triangles[6, 2] = 0.5 * (triangles[6, 0] + triangles[6, 1])  # one without area
    points = 2 * randn64(generator, 50, 3)
    closest, face = closest_points(points, triangles)
    grid = torch.linspace(0, 1, 101, dtype=D)
    u, v = torch.meshgrid(grid, grid, indexing="ij")
    u, v = u[u + v <= 1 + 1e-12], v[u + v <= 1 + 1e-12]
    weight = torch.stack([1 - u - v, u, v], 1)  # [S, 3]
    sampled = (weight @ triangles).reshape(-1, 3)
    brute = torch.cdist(points, sampled).amin(1)
    far = (points - closest).norm(dim=1)
    spacing = 0.01 * float((triangles - triangles.roll(1, 1)).norm(dim=-1).max())
    assert (far <= brute + 1e-12).all()
    assert (brute - far <= spacing).all()
    own = torch.cdist(closest[:, None], weight @ triangles[face]).amin((1, 2))
    assert own.max() <= spacing


def test_overlapping_solids_have_no_walls_inside():
    """Deep inside one of two boxes that overlap, a face of the other is near; the depth is that to
    the outside."""
    both = Body([box_mesh((0, 0, 0), (2, 1, 1)), box_mesh((0.99, 0.3, 0.3), (3, 0.7, 0.7))])
    found = both.distance_m(f64([[1.0, 0.5, 0.5], [2.5, 0.5, 0.5]]))
    close(found, f64([-0.5, -0.2]), atol=1e-14)


@pytest.mark.parametrize("turned", ["outward", "inward", "split at seams"])
def test_winding_of_the_file_and_seams_do_not_matter(turned):
    vertices, faces = box_mesh(*BOX)
    if turned == "inward":
        faces = faces[:, ::-1]
    if turned == "split at seams":
        vertices, faces = vertices[faces].reshape(-1, 3), np.arange(3 * len(faces)).reshape(-1, 3)
    body = Body([(vertices, faces)])
    assert len(body.solids) == 1
    points = f64([[0.0, 0.0, 0.1], [0.0, 0.0, 0.5]])
    close(body.distance_m(points), f64([-0.1, 0.1]), atol=1e-14)


SHEET = [(-5, -5, 0), (5, -5, 0), (5, 5, 0), (-5, 5, 0)], [(0, 1, 2), (0, 2, 3)]


def test_a_sheet_has_two_sides_and_a_capsule_that_pierces_it_no_room():
    sheet = Body([SHEET])
    points = f64([[0.3, 0.2, 2.0], [0.3, 0.2, -2.0]])
    torch.testing.assert_close(sheet.distance_m(points), f64([2.0, 2.0]))
    pose = torch.eye(4, dtype=D)
    pose[2, 3] = 0.0713  # looks up, its back goes down through the sheet
    for behind_m, room in ((0.1, -0.02), (0.05, 0.0013)):
        housing = Housing(0.02, behind_m=behind_m)
        assert float(sheet.clearances_m(pose, housing)) == pytest.approx(room, abs=1e-12)


def test_one_file_with_two_things_makes_two_solids():
    low, first = box_mesh((0, 0, 0), (1, 1, 1))
    high, second = box_mesh((3, 0, 0), (4, 1, 1))
    body = Body([(np.concatenate([low, high]), np.concatenate([first, second[:-1] + 8]))])
    assert [len(solid) for solid in body.solids] == [12, 11]  # the other has a hole


def test_gradient_of_the_distance(generator):
    body = Body([box_mesh(*BOX), ball_mesh(0.2)])
    points = (0.8 * (rand64(generator, 40, 3) - 0.4)).requires_grad_()
    assert torch.autograd.gradcheck(body.distances_m, (points,), eps=1e-7, atol=1e-6)
    # on a face the slope is the normal: 1 outward
    on_face = torch.tensor([[0.1, 0.05, 0.4]], dtype=D, requires_grad=True)
    (slope,) = torch.autograd.grad(Body([box_mesh(*BOX)]).distance_m(on_face).sum(), on_face)
    close(slope[0], f64([0.0, 0.0, 1.0]), atol=1e-12)
    # beyond a corner distances bend, which the slope at the nearest point does not know
    with pytest.raises(GradientError, match="has none of its own"):
        torch.autograd.functional.hessian(lambda at: body.distances_m(at).square().sum(), points)


def test_a_capsule_is_its_spheres(generator):
    """The clearance of a capsule is the smallest of those of the balls along its axis: never more
    than that of any sampled ball, and less by no more than half their spacing."""
    body = Body([box_mesh(*BOX), ball_mesh(0.2)])
    poses = some_poses(generator, 60, 1.2)
    housing = Housing(0.03, behind_m=0.12)
    found = body.clearances_m(poses, housing)
    share = torch.linspace(0, 0.12, 401, dtype=D)
    axis = poses[:, None, :3, 3] - share[:, None] * poses[:, None, :3, 2]
    sampled = (body.distances_m(axis) - 0.03).amin(1)
    outside = sampled + 0.03 > 0
    assert (found <= sampled + 1e-12)[outside].all()
    assert (sampled - found <= 0.12 / 400 / 2 + 1e-12)[outside].all()
    assert ((found < 0) == (sampled < 0)).all()
    assert (~outside).sum() > 3
    # inside, by the spacing of the points looked at
    assert ((found - sampled).abs() <= 0.12 / 16 / 2 + 1e-12)[~outside].all()


def test_a_capsule_through_a_cube_reaches_its_middle():
    body = Body([box_mesh((-0.1, -0.1, -0.1), (0.1, 0.1, 0.1))])
    pose = torch.eye(4, dtype=D)
    pose[2, 3] = 0.2
    assert float(body.clearances_m(pose, Housing(0.03, behind_m=0.4))) == pytest.approx(
        -0.13, abs=1e-12
    )


def test_gradient_of_the_clearance_to_the_mount(generator):
    body = Body([box_mesh(*BOX), ball_mesh(0.2)])
    poses = some_poses(generator, 4, 3.0)
    for housing in (Housing(0.05), Housing(0.05, behind_m=0.2)):
        clearances = partial(body.clearances_m, housing=housing)
        assert torch.autograd.gradcheck(
            clearances, (poses.clone().requires_grad_(),), eps=1e-7, atol=1e-6
        )


def test_rays_are_hidden_by_what_stands_before_them():
    body = Body([box_mesh(*BOX)])
    origin = f64([[1.0, 0.0, 0.2]] * 3)
    direction = f64([[-2.0, 0.0, 0.0], [1.0, 0.0, 0.0], [-1.0, 0.5, 0.0]])
    found = first_crossings(origin, direction, body.triangles)
    assert found.tolist() == [pytest.approx(0.35), math.inf, math.inf]  # 0.7 m in lengths of 2 m


@pytest.mark.parametrize("first", [0, 1, 2])
def test_a_line_through_the_edge_between_two_triangles_crosses_them(first):
    """A square at z = 2, cut from corner to corner; its middle lies on that edge."""
    corners = f64([[0.0, 0, 2], [4, 0, 2], [4, 4, 2], [0, 4, 2]])
    square = torch.stack([corners[[0, 1, 2]].roll(first, 0), corners[[2, 3, 0]].roll(first, 0)])
    origin, direction = f64([[[2.0, 2, 0]], [[0, 0, 1]]])
    assert first_crossings(origin, direction, square).tolist() == [2.0]


def test_the_rover_is_a_body_without_its_camera():
    robot = robots.from_urdf(robots.ROVER)
    camera = robot.frame("camera_link")[:3, 3]
    whole = Body.of(robot.parts).distance_m(camera)
    # the box of the camera ends 5 mm behind its origin
    assert float(whole) == pytest.approx(0.005, abs=1e-12)
    # the mast ends 50 mm below it and stands, 15 mm thick, 40 mm behind it
    alone = Body.of(robot.parts, without=["camera_link"]).distance_m(camera)
    rim = 0.04 - 0.015 * math.cos(math.pi / 48)  # of 48 faces: between its apothem and its radius
    assert math.hypot(0.04 - 0.015, 0.05) - 1e-9 <= alone <= math.hypot(rim, 0.05) + 1e-9
