"""A user's own robot, world and trajectory: twists by closed forms, faults by their sentences."""

import math
from dataclasses import replace

import numpy as np
import PIL.Image
import pytest
import torch
from scipy.spatial.transform import Rotation

from codesign import backend, lens, pose, render
from codesign.errors import DomainError, FileFormatError
from codesign.mount import FREE, CableSide, Clearance, EgoVelocity, Housing, LookAhead, OwnBody
from scenes import bodies, build, robots, textures, worlds
from scenes.robots import pair as robot_pair
from scenes.robots.check import check_pair
from scenes.robots.own import own_pair
from scenes.robots.page import CameraBox, OwnRobot, Start, read_own
from scenes.robots.pairs import PAIRS
from tests import refusals
from tests.numbers import D, close, f64

TWIST = f64([0.4, 0.1, 0.0, 0.0, 0.0, 0.3])
UNSEEN = robot_pair.UNSEEN_FROM
PAGE = """
robot: box.obj
camera:
  low_m: [0.24, -0.1, 0.25]
  high_m: [0.34, 0.1, 0.4]
start:
  pitch_deg: 30
"""
URDF = PAGE.replace("box.obj", "robot.urdf")


def obj(body, uv=""):
    """Text of a Wavefront file."""
    vertices = "".join(f"v {x} {y} {z}\n" for x, y, z in body.vertices_m)
    return vertices + uv + "".join(f"f {a} {b} {c}\n" for a, b, c in body.faces + 1)


def csv(t_s, poses):
    """Text of a table of poses."""
    turns = Rotation.from_matrix(poses[:, :3, :3].numpy()).as_quat()
    rows = np.concatenate([t_s[:, None], poses[:, :3, 3].numpy(), turns], 1).tolist()
    return "t_s,x,y,z,qx,qy,qz,qw\n" + "\n".join(",".join(map(repr, row)) for row in rows) + "\n"


def screw(t_s):
    """Poses of a body that goes with TWIST, 0.3 m above the origin of a room at first."""
    first = torch.eye(4, dtype=D)
    first[2, 3] = 0.3
    return first @ pose.se3_exp(torch.as_tensor(t_s)[:, None] * TWIST)


def tipped(pitch_rad):
    """A pose [4, 4] that looks down."""
    turn = torch.zeros(6, dtype=D)
    turn[4] = pitch_rad
    return pose.se3_exp(turn)


# of seconds since the first pose
MOTIONS = {
    "screw": screw,
    "still": lambda s: screw(0 * s),
    "parks": lambda s: screw(np.minimum(s, 0.9)),
    "slow": lambda s: screw(8e-3 * s),
    "late": lambda s: screw(np.where(s < 1, s, 1 + 8e-3 * s)),
    "tips": lambda s: screw(s) @ tipped(1.2),
    "fast": lambda s: screw(300 * s),
}
# size and middle
BOXES = {
    "box": ((0.4, 0.3, 0.2), (0.0, 0.0, 0.05)),
    "blank": ((6.0, 6.0, 3.0), (0.0, 0.0, 1.4)),
    "pole": ((0.1, 0.1, 0.6), (0.0, 0.0, -0.25)),
    "in_mm": ((400.0, 300.0, 200.0), (0.0, 0.0, 50.0)),
}


@pytest.fixture
def page(tmp_path):
    """Writes a page beside a robot, a blank room and trajectories, and gives its path."""
    t_s = np.linspace(1.7e9, 1.7e9 + 1.5, 31)
    for name, box in BOXES.items():
        (tmp_path / f"{name}.obj").write_text(obj(bodies.box(*box)))
    for name, motion in MOTIONS.items():
        (tmp_path / f"{name}.csv").write_text(csv(t_s, motion(t_s - t_s[0])))
    (tmp_path / "short.csv").write_text(csv(t_s[:2], screw([0.0, 0.05])))
    (tmp_path / "notes.txt").write_text("a robot")
    (tmp_path / "parts").mkdir()
    (tmp_path / "robot.urdf").write_text(
        '<robot name="r"><link name="base"><visual><geometry>'
        '<mesh filename="package://mine/box.obj"/></geometry></visual></link></robot>'
    )
    textured_room(tmp_path)

    def write(text, name="page.yaml"):
        path = tmp_path / name
        path.write_text(text)
        return path

    return write


def textured_room(folder):
    """A room of 6 x 6 x 3 m as a mesh, each side with the same picture."""
    import skimage.data

    PIL.Image.fromarray(skimage.data.brick()).save(folder / "brick.png")
    (folder / "room.mtl").write_text("newmtl wall\nmap_Kd brick.png\n")
    corners = [(x, y, z) for x in (-3, 3) for y in (-3, 3) for z in (-0.1, 2.9)]
    sides = ((1, 3, 4, 2), (5, 6, 8, 7), (1, 2, 6, 5), (3, 7, 8, 4), (1, 5, 7, 3), (2, 4, 8, 6))
    (folder / "room.obj").write_text(
        "mtllib room.mtl\nvt 0 0\nvt 6 0\nvt 6 6\nvt 0 6\nusemtl wall\n"
        + "".join(f"v {x} {y} {z}\n" for x, y, z in corners)
        + "".join(f"f {a}/1 {b}/2 {c}/3 {d}/4\n" for a, b, c, d in sides)
    )


def textured_floor(folder):
    """A floor of 6 x 6 m at z = -0.1 as a Mitsuba scene that glows, y up, white at 1."""
    import skimage.data

    tiled = np.tile(skimage.data.gravel(), (2, 2))
    PIL.Image.fromarray(tiled).save(folder / "gravel.png")
    (folder / "floor.xml").write_text("""<scene version="3.0.0"><shape type="rectangle">
      <transform name="to_world">
        <rotate x="1" angle="-90"/><scale value="3"/><translate y="-0.1"/>
      </transform>
      <emitter type="area"><texture type="bitmap" name="radiance">
        <string name="filename" value="gravel.png"/>
      </texture></emitter></shape></scene>""")


def test_the_built_in_pairs_pass():
    for make in PAIRS.values():
        check_pair(make())


def test_a_page_becomes_a_pair(page):
    found = own_pair(
        page(
            PAGE.replace("box.obj", f'"{robots.ROVER}"')
            + """  yaw_deg: 5
without: [camera_link]
lens:
  focal_length_mm: 5
  focus_m: 2.5
velocities: free
require:
  clearance:
    radius_m: 0.03
    margin_m: 0.01
  look_ahead:
    distance_m: 2.0
    share: 0.2
  cable:
    forbidden: [0, 0, -1]
    half_angle_deg: 30
  own_body_share: 0.1
"""
        )
    )
    start = robot_pair.Design(
        5.0, 1.2, 0.4, 0.29, 0.0, 0.325, math.radians(5), math.radians(30), 0.0
    )
    assert found.design.mount().allclose(start.mount(), rtol=0, atol=1e-12)
    assert replace(found.design, x_m=0.29, z_m=0.325) == start
    assert found.low.z_m == 0.25
    assert found.high.pitch_rad == math.radians(80)
    assert found.axes == FREE
    assert found.depth == "ground"
    assert found.frame == robots.from_urdf(robots.ROVER).base == "base_link"
    assert [path.name for path in found.files] == ["rover.urdf"]
    cable, ahead, clearance, own_body = found.requirements()
    assert cable == CableSide((0.0, 0.0, -1.0), math.radians(30))
    assert ahead == LookAhead(2.0, 0.2, ground_z_m=found.ground_z_m)
    assert isinstance(clearance, Clearance)
    assert (clearance.housing, clearance.margin_m) == (Housing(0.03), 0.01)
    assert isinstance(own_body, OwnBody)
    assert own_body.largest_share == 0.1
    # seven of the rover's eight shapes, from the ends of its wheels at 1 mm up to the top of its
    # mast
    corners = np.concatenate([mesh.vertices_m for mesh in found.bodies.values()])
    assert len(found.bodies) == 7
    assert corners[:, 2].min() == pytest.approx(0.001, abs=1e-9)
    assert corners[:, 2].max() == pytest.approx(0.17 + 0.062 + 0.3, abs=1e-9)


def test_a_start_may_stand_on_a_wall_of_its_box(page):
    path = page(PAGE.replace("  pitch_deg: 30", "  pitch_deg: 30\n  x_m: 0.34"))
    check_pair(own_pair(path))


def test_a_robot_stands_on_the_ground_wherever_its_origin_is(page):
    """The box reaches 5 cm below its origin; its velocity is that of the origin."""
    found = own_pair(page(PAGE))
    poses, twist = found.drive(2, 4)
    assert torch.equal(twist, PAIRS["outdoors"]().drive(2, 4)[1])
    seen, _ = render.camera_velocity(poses, robot_pair.times())
    # 1e-15 m over 2.9 ms
    close(seen, twist[:, None].expand_as(seen), atol=1e-9)
    middle = poses[:, 0] @ pose.se3_exp(robot_pair.MIDDLE_S * twist)
    close(middle[:, 2, 3], torch.full((4,), 0.058, dtype=D), atol=1e-12)
    corners = torch.from_numpy(next(iter(found.bodies.values())).vertices_m)
    assert pose.apply(poses.flatten(0, 1), corners)[..., 2].min() > 0
    assert found.ground_z_m == pytest.approx(-0.058, abs=1e-4)  # it heaves by 0.03 m/s for 1.4 ms


def test_windows_of_a_screw_have_its_twist(page):
    """Poses 50 ms apart; between them the constant twist, so exact in and across them."""
    found = own_pair(page(PAGE + "motion: screw.csv\n"))
    for number in (0, 7, UNSEEN):
        poses, twist = found.drive(number, 5)
        # clocks of 1.7e9 s have 2e-7 s
        close(twist, TWIST.expand(5, 6), atol=1e-5)
        seen, _ = render.camera_velocity(poses, robot_pair.times())
        close(seen, twist[:, None].expand_as(seen), atol=1e-5)
        angle = torch.atan2(poses[:, 0, 1, 0], poses[:, 0, 0, 0])
        begin = angle / TWIST[5]
        close(poses[:, 0], screw(begin), atol=1e-5)
        last = begin + robot_pair.times()[-1]
        assert (last <= 1.0 + 1e-5).all() if number < UNSEEN else (begin >= 1.0 - 1e-5).all()
    assert found.prior == pytest.approx((0.4, 0.1, 0.05, 0.05, 0.05, 0.3), abs=1e-5)
    assert found.ground_z_m == pytest.approx(-0.3, abs=1e-9)


def test_windows_of_uneven_motion_have_their_mean_velocity(page, tmp_path):
    """x = t^2 / 2 sampled every millisecond: from t to u the mean velocity is (t + u) / 2; chords
    of 1 ms lie within 1.25e-7 m of the parabola, so velocities over 20 ms within 1.25e-5."""
    t_s = np.linspace(0, 1.5, 1501)
    poses = torch.eye(4, dtype=D).repeat(len(t_s), 1, 1)
    poses[:, 0, 3] = torch.from_numpy(t_s**2 / 2)
    (tmp_path / "gains.csv").write_text(csv(t_s, poses))
    poses, twist = own_pair(page(PAGE + "motion: gains.csv\n")).drive(3, 6)
    at = (2 * poses[:, 1:, 0, 3]).sqrt()
    close(twist[:, 0], (at[:, 0] + at[:, -1]) / 2, atol=1.3e-5)
    close(at[:, -1] - at[:, 0], torch.full((6,), 0.02, dtype=D), atol=1e-4)


@pytest.mark.parametrize(
    ("write", "files"),
    [
        (textured_room, ("room.obj", "room.mtl", "brick.png")),
        (textured_floor, ("floor.xml", "gravel.png")),
    ],
)
def test_rendered_flow_of_a_world_of_ones_own_gives_the_twist_back(write, files, page, tmp_path):
    write(tmp_path)
    low = PAGE.replace("pitch_deg: 30", "pitch_deg: 70")
    found = own_pair(page(low + f"world: {files[0]}\nmotion: screw.csv\n"))
    check_pair(found)
    assert found.depth == "scene"
    assert {path.name for path in found.files} == {"box.obj", "screw.csv", *files}
    assert own_pair(tmp_path / "page.yaml").files == found.files  # what was loaded before too
    drives = found.batch((0, UNSEEN), 2)
    system = found.system(found.design).replaced(
        flow=lambda volume, truth: truth, estimate=EgoVelocity(FREE, (1e3,) * 6, "scene")
    )
    with torch.no_grad():
        velocity = system.begin(drives)["estimate"].velocity
    # depth is read up to 1.5 ms from the middle of the flow: 0.6 mm of 0.6 m and more, a thousandth
    # of 0.4 m/s
    close(velocity, drives.twist, atol=4e-4)


def test_settings_need_no_file():
    box = CameraBox((0.05, 0.0, 0.4), (0.25, 0.0, 0.6), pitch_deg=(20.0, 20.0))
    found = own_pair(
        OwnRobot(str(robots.ROVER), box, ("camera_link",), Start(z_m=0.5), world="flight")
    )
    assert found.axes == FREE
    assert found.ranges.held.tolist() == [False, True, False, False, True, False]
    assert found.design.pitch_rad == math.radians(20)
    poses, _ = found.drive(0, 8)
    assert poses[..., 2, 3].min() > 0.3  # it flies as it is


@refusals.table(__file__, "pages")
def test_a_fault_gets_one_sentence_before_the_first_frame(row, page):
    def made(text):
        check_pair(own_pair(page(text)), numbers=(0, UNSEEN))

    row.holds({"made": made, "PAGE": PAGE, "URDF": URDF})


def test_a_mesh_counts_in_the_unit_that_the_page_says(page):
    units = "unit_m: 0.001\nworld: room.obj\nworld_unit_m: 0.5\nmotion: screw.csv\n"
    said = own_pair(page(PAGE.replace("box.obj", "in_mm.obj") + units))
    [body] = said.bodies.values()
    assert body.vertices_m.max(0).tolist() == pytest.approx([0.2, 0.15, 0.15])
    assert said.world(0).scene.bbox().max.x == pytest.approx(1.5)


def test_a_package_of_a_urdf_lies_where_the_page_says(page, tmp_path):
    (tmp_path / "box.obj").rename(tmp_path / "parts" / "box.obj")
    [body] = own_pair(page(URDF + "packages:\n  mine: parts\n")).bodies.values()
    assert body.vertices_m.max(0).tolist() == pytest.approx([0.2, 0.15, 0.15])


def test_a_page_that_is_no_text_is_refused(tmp_path):
    with pytest.raises(FileFormatError, match=r"no file lies at .*none.yaml"):
        read_own(tmp_path / "none.yaml")
    (tmp_path / "a.yaml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(FileFormatError, match=r"a.yaml cannot be read"):
        read_own(tmp_path / "a.yaml")


def test_a_pair_made_by_hand_is_looked_at_too():
    pair = PAIRS["flight"]()
    with pytest.raises(DomainError, match="efl_mm = 99 lies outside its bounds"):
        check_pair(replace(pair, design=replace(pair.design, efl_mm=99.0)))

    def rests(number, motions):
        poses, twist = pair.drive(number, motions)
        return robot_pair.moved(poses[:, 0], 0 * twist), 0 * twist

    with pytest.raises(DomainError, match="drives 0 never move"):
        check_pair(replace(pair, drive=rests))
    triplet = render.Camera(lens.load("cooke-triplet"), 60, 60, 2.0, 1)
    with pytest.raises(DomainError, match="image circle"):
        check_pair(pair, triplet)


@pytest.mark.parametrize(("scale", "textured"), [(1.0, True), (1 / 255, False)])
def test_a_world_too_dark_for_the_sensor_has_no_texture(scale, textured):
    """Below 20 of 255 the sensor's level is linear in radiance: between 0 and 1 it spans a seventh,
    log(20) / 20."""
    picture = scale * textures.speckle(3, finest_px=3.0, coarsest_px=128.0)

    def ground(number):
        return worlds.ground(picture)

    pair = replace(PAIRS["flight"](), world=ground)
    if textured:
        check_pair(pair)
    else:
        with pytest.raises(
            DomainError, match="world 0 has no texture where the camera looks: 0% of blocks"
        ):
            check_pair(pair)


def test_a_horizon_alone_is_no_texture():
    def ground_and_sky(number):
        mi = backend.mitsuba("cpu")
        ground = build.rectangle(mi, (0, 0, 0), (0, 0, 1), 200, 200, (0, 1, 0))
        paint = build.Paint(np.full((2, 2), 60.0))
        above = build.sky(mi, np.full((4, 8), 150.0))
        return build.emissive(build.World({"ground": (ground, paint)}, {"sky": above}))

    with pytest.raises(
        DomainError, match=r"world 0 has no texture where the camera looks: \d% of blocks"
    ):
        check_pair(replace(PAIRS["outdoors"](), world=ground_and_sky))
