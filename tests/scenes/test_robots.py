"""Robots from URDF: joint by joint against closed forms, bodies by volume, and what a mounted
camera sees."""

import math

import numpy as np
import pytest
import torch

from codesign import lens, render
from codesign.errors import DomainError
from codesign.pose import inverse, look_at
from scenes import robots, worlds
from tests import refusals
from tests.numbers import close
from tests.scenes.solids import volume_m3

CAMERA = render.Camera(lens.Pinhole(4.0), 32, 24, 0.2, samples_per_pixel=4)
ARM = """<robot name="arm">
<material name="grey"><color rgba="0.5 0.5 0.5 1"/></material>
<link name="base"/><link name="upper"/><link name="lower"/><link name="finger"/>
<link name="tip"><visual><geometry>{geometry}</geometry><material name="grey"/></visual></link>
<joint name="shoulder" type="revolute"><parent link="base"/><child link="upper"/><origin xyz="0 0 0.5"/>
<axis xyz="0 0 1"/><limit lower="-2" upper="2" effort="1" velocity="1"/></joint>
<joint name="elbow" type="revolute"><parent link="upper"/><child link="lower"/><origin xyz="0.7 0 0"/>
<axis xyz="0 0 1"/><limit lower="0.1" upper="2" effort="1" velocity="1"/></joint>
<joint name="slide" type="prismatic"><parent link="lower"/><child link="finger"/><origin xyz="0.4 0 0"/>
<axis xyz="1 0 0"/><limit lower="0" upper="0.2" effort="1" velocity="1"/></joint>
<joint name="wrist" type="fixed"><parent link="finger"/><child link="tip"/><origin rpy="0.3 -0.4 0.5"/></joint>
{more}</robot>"""


def arm(folder, geometry='<box size="0.1 0.2 0.3"/>', more=""):
    path = folder / "arm.urdf"
    path.write_text(ARM.format(geometry=geometry, more=more))
    return path


def turn(axis, angle):
    c, s = math.cos(angle), math.sin(angle)
    return np.array(
        {
            "x": [[1, 0, 0], [0, c, -s], [0, s, c]],
            "y": [[c, 0, s], [0, 1, 0], [-s, 0, c]],
            "z": [[c, -s, 0], [s, c, 0], [0, 0, 1]],
        }[axis]
    )


def test_a_planar_arm_reaches_where_its_closed_form_says(tmp_path):
    a, b, d = 0.6, 1.1, 0.15
    robot = robots.from_urdf(arm(tmp_path), {"shoulder": a, "elbow": b, "slide": d})
    tip = robot.frame("tip").numpy()
    reach = 0.4 + d
    expected = [
        0.7 * math.cos(a) + reach * math.cos(a + b),
        0.7 * math.sin(a) + reach * math.sin(a + b),
        0.5,
    ]
    np.testing.assert_allclose(tip[:3, 3], expected, atol=1e-15)
    # URDF: roll, pitch, yaw about fixed axes
    fixed = turn("z", 0.5) @ turn("y", -0.4) @ turn("x", 0.3)
    np.testing.assert_allclose(tip[:3, :3], turn("z", a + b) @ fixed, atol=1e-15)
    assert robot.frame("tip").dtype == torch.float64
    # in the axes of another link
    seen = robots.from_urdf(arm(tmp_path), {"shoulder": a, "elbow": b, "slide": d}, base="lower")
    expected = inverse(robot.frame("lower")) @ robot.frame("tip")
    close(seen.frame("tip"), expected, atol=1e-15)


def test_joints_left_out_stand_at_zero_or_the_limit_next_to_it(tmp_path):
    robot = robots.from_urdf(arm(tmp_path))
    np.testing.assert_allclose(robot.frame("lower").numpy()[:3, :3], turn("z", 0.1), atol=1e-15)


def test_a_joint_that_mimics_another_follows_it(tmp_path):
    more = """<link name="second"/><joint name="follower" type="revolute"><parent link="base"/><child link="second"/>
    <axis xyz="0 1 0"/><limit lower="-9" upper="9" effort="1" velocity="1"/>
    <mimic joint="shoulder" multiplier="-2" offset="0.3"/></joint>"""
    robot = robots.from_urdf(arm(tmp_path, more=more), {"shoulder": 0.4})
    np.testing.assert_allclose(robot.frame("second").numpy()[:3, :3], turn("y", -0.5), atol=1e-15)
    with pytest.raises(
        DomainError, match="no joint 'follower' that can be set; it has shoulder, elbow, slide"
    ):
        robots.from_urdf(arm(tmp_path, more=more), {"follower": 0.1})


@pytest.mark.parametrize("kind", ["floating", "planar"])
def test_followers_and_axes_behind_a_held_joint(tmp_path, kind):
    box = '<visual><geometry><box size="1 1 1"/></geometry><material name="red">{}</material></visual>'
    red = '<color rgba="1 0 0 1"/>'
    path = tmp_path / "r.urdf"
    path.write_text(
        f'<robot name="r"><link name="a">{box.format("")}</link><link name="b"/><link name="c"/>'
        f'<link name="d">{box.format(red)}</link>'
        f'<joint name="f" type="{kind}"><parent link="a"/><child link="b"/></joint>'
        '<joint name="s" type="prismatic"><parent link="b"/><child link="c"/><axis xyz="2 0 0"/>'
        '<limit lower="0" upper="9" effort="1" velocity="1"/></joint><joint name="m" type="continuous">'
        '<parent link="c"/><child link="d"/><axis xyz="0 0 3"/><mimic joint="s" multiplier="2"/></joint></robot>'
    )
    robot = robots.from_urdf(path, {"s": 0.5})
    at = robot.frame("d").numpy()
    np.testing.assert_allclose(at[:3, 3], [0.5, 0, 0], atol=1e-15)
    np.testing.assert_allclose(at[:3, :3], turn("z", 1.0), atol=1e-15)
    # pure red of sRGB, named in one link and said in another
    assert [part.colour[0] for part in robot.parts] == pytest.approx([0.2126] * 2, abs=1e-4)


@pytest.mark.parametrize(
    ("geometry", "expected", "share"),
    [
        ('<box size="0.1 0.2 0.3"/>', 0.006, 1e-12),
        # inscribed prism of 48 sides: n/2 sin(2 pi/n) / pi of the circle
        ('<cylinder radius="0.1" length="0.3"/>', 0.01 * 0.3 * 24 * math.sin(math.pi / 24), 1e-9),
        # 1,280 chords lie below the sphere
        ('<sphere radius="0.1"/>', 4 / 3 * math.pi * 0.001, 0.02),
    ],
)
def test_bodies_have_their_volume(tmp_path, geometry, expected, share):
    [part] = robots.from_urdf(arm(tmp_path, geometry), {"shoulder": 1.0}).parts
    assert volume_m3(part) == pytest.approx(expected, rel=share)
    assert part.colour[0] == pytest.approx(((0.5 + 0.055) / 1.055) ** 2.4)  # sRGB grey of one half


def mesh_of(folder, name="t.stl", size=1.0):
    import trimesh

    folder.mkdir(parents=True, exist_ok=True)
    trimesh.creation.box(extents=[size] * 3).export(folder / name)


def test_meshes_are_found_by_package_and_path_at_their_scale(tmp_path):
    mesh_of(tmp_path / "my_robot" / "meshes")
    (tmp_path / "my_robot" / "urdf").mkdir()
    for name in (
        "package://my_robot/meshes/t.stl",
        "../meshes/t.stl",
        f"file://{tmp_path}/my_robot/meshes/t.stl",
    ):
        path = arm(
            tmp_path / "my_robot" / "urdf", f'<mesh filename="{name}" scale="0.1 -0.2 0.3"/>'
        )
        [part] = robots.from_urdf(path).parts
        assert volume_m3(part) == pytest.approx(0.006, rel=1e-6)  # mirrored, and still outwards
    mesh_of(tmp_path / "elsewhere" / "meshes", size=2.0)
    path = arm(tmp_path / "my_robot" / "urdf", '<mesh filename="package://my_robot/meshes/t.stl"/>')
    [part] = robots.from_urdf(path, packages={"my_robot": tmp_path / "elsewhere"}).parts
    assert volume_m3(part) == pytest.approx(8, rel=1e-6)


def test_collision_shapes_stand_in_and_are_shown_on_request():
    seen = robots.from_urdf(robots.ROVER)
    solid = robots.from_urdf(robots.ROVER, collision=True)
    assert sum(volume_m3(p) for p in seen.parts if p.name == "chassis") == pytest.approx(
        0.5 * 0.32 * 0.12 + 0.2 * 0.2 * 0.08
    )
    assert sum(volume_m3(p) for p in solid.parts if p.name == "chassis") == pytest.approx(
        0.5 * 0.32 * 0.2
    )
    # wheels have visual shapes alone
    assert {p.name for p in solid.parts} == {p.name for p in seen.parts}


def test_a_camera_on_a_link_looks_along_its_x_axis_with_z_up():
    T_body_cam = robots.T_LINK_OPTICAL
    expected = look_at((0, 0, 0), (1, 0, 0))  # looks along +x, z up
    torch.testing.assert_close(T_body_cam, expected)


def test_a_robot_in_a_world_is_seen_by_its_own_camera():
    robot = robots.from_urdf(robots.ROVER, {"camera_nod": 0.95, "mast_turn": 0.0})
    T_world_robot = look_at((0.3, 0.2, 0.0), (1.3, 0.2, 0.0)) @ inverse(robots.T_LINK_OPTICAL)
    T_world_cam = (T_world_robot @ robot.frame("camera_link") @ robots.T_LINK_OPTICAL)[None]
    ground = worlds.ground(np.zeros((8, 8)))
    body = robot.scene()
    moving = render.MovingScene(ground, {"robot": (body, T_world_robot[None])})
    with torch.no_grad():
        image = render.frames(CAMERA, moving, T_world_cam)
    # the same picture from the robot's own axes
    alone = render.frames(CAMERA, body, inverse(T_world_robot) @ T_world_cam)
    close(image, alone, rtol=1e-4, atol=1e-3)
    assert 0.05 < (alone > 0).double().mean() < 0.6  # the deck below, the ground beyond
    # the deck's front edge, 0.25 m ahead of the middle and 0.23 m up, by the pinhole's formula
    up, forward = 0.17 + 0.062 + 0.35 - 0.23, 0.25 - 0.12
    below = math.atan2(up, forward) - 0.95
    row = 11.5 + math.tan(below) * 4.0 / 0.2
    column = image[0, :, 16]
    edge = float((column[:-1] - column[1:]).abs().argmax()) + 0.5
    assert abs(edge - row) < 1


MANY = '<mesh filename="package://lost/a.stl"/></geometry></visual><visual><geometry><mesh filename="b.dae"/>'


LIMIT = '<limit lower="-1" upper="1" effort="1" velocity="1"/>'
SECOND = '<link name="c"/><joint name="{}" type="continuous"><parent link="{}"/><child link="c"/>{}</joint>'


@refusals.table(__file__, "robots")
def test_what_is_no_robot_is_refused(row, tmp_path):
    def read(text, name="r.urdf"):
        (tmp_path / name).write_text(text)
        return robots.from_urdf(tmp_path / name)

    def of(geometry='<box size="0.1 0.2 0.3"/>', **options):
        return robots.from_urdf(arm(tmp_path, geometry), **options)

    def joined(kind, inside, more=""):
        joint = f'<joint name="j" type="{kind}"><parent link="a"/><child link="b"/>{inside}</joint>'
        return read(f'<robot name="r"><link name="a"/><link name="b"/>{joint}{more}</robot>')

    mesh_of(tmp_path)
    row.holds(globals() | {"read": read, "of": of, "joined": joined})


def test_a_robot_in_millimetres_gets_a_hint(tmp_path):
    with pytest.warns(UserWarning, match="m wide"):
        robots.from_urdf(arm(tmp_path, '<box size="100 200 300"/>'))
