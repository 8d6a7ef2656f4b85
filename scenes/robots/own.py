"""A pair out of a user's own files: a robot from URDF or a mesh, a world, a trajectory
(scenes.robots.page)."""

import contextlib
import math
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from codesign import render
from codesign.doors import explain
from codesign.errors import CodesignError, DomainError, FileFormatError
from codesign.mount import FREE, PLANAR
from codesign.pose import se3_exp
from codesign.reading import noting
from scenes import mesh_files, robots, worlds
from scenes.bodies import Body
from scenes.robots import pair as robot_pair
from scenes.robots.page import OwnRobot, read_own
from scenes.robots.pair import Design, RobotPair
from scenes.robots.pairs import PAIRS
from scenes.tum import Recorded, read_tum

ROOM_M = 0.75  # from a robot's origin to its outermost point, in the worlds of the pairs
LIFT_M = 0.008  # of what rolls: roll and pitch take it away over half a window
WHITE = 255.0  # radiance that the 1 of a Mitsuba scene becomes
DULL = 80.0  # of what lies behind a mesh
TRAINING = 2 / 3  # of a trajectory; the rest is for judging
STILL = 1e-3  # metres and radians within which a trajectory stands still
MOST_TILT_RAD = math.radians(60)  # of a robot that drives
LEAST_PRIOR = 0.05  # m/s and rad/s
Drive = Callable[[int, int], tuple[Tensor, Tensor]]


def own_pair(settings: OwnRobot | str | Path) -> RobotPair:
    """The pair that a page of settings describes; to be looked at by ``check.check_pair`` before
    the first frame.

    A robot that drives through the world of a pair stands with its lowest point 8 mm over the
    ground, wherever its origin is. Windows of a trajectory begin at random places, for training in
    its first two thirds, for judging in the rest. A world from a file is the same for all numbers.

    Args:
      settings: or the path of their page (``page.read_own``).
    Raises: FileFormatError for files that are missing or damaged; DomainError, naming the entry,
      for what is unknown, missing, out of range, or does not go together: a robot without room in
      the world, a trajectory that stands still or is shorter than three windows.
    """
    own = settings if isinstance(settings, OwnRobot) else read_own(settings)
    with noting() as opened:
        return _pair(own, opened)


def _pair(own, opened):
    bodies, frame = _bodies(own)
    world, depth = _world(own)
    if own.motion is None or own.motion in PAIRS:
        named = PAIRS[own.motion or own.world]()
        drive, axes, prior = _standing(named, bodies), named.axes, named.prior
    else:
        drive, prior = recorded_drives(_file("motion", own.motion))
        axes = FREE
    if own.velocities is not None:
        axes = PLANAR if own.velocities == "planar" else FREE
    middle = drive(0, 12)[0][:, robot_pair.FRAMES // 2]
    if axes == PLANAR and middle[:, 2, 2].min() < math.cos(MOST_TILT_RAD):
        raise DomainError(
            f"motion: '{own.motion}' tips the robot by more than {math.degrees(MOST_TILT_RAD):.0f} degrees, and its velocities "
            "are planar; see whether its quaternions are qx qy qz qw, or set velocities: free."
        )
    low, high, start = _designs(own)
    asked = own.require
    named_files = [Path(n) for n in (own.robot, own.world, own.motion) if n and n not in PAIRS]
    ahead, cable = asked.look_ahead, asked.cable
    return RobotPair(
        Path(own.robot).stem,
        bodies,
        low,
        high,
        start,
        axes,
        prior,
        own.depth or depth,
        None if ahead is None else (ahead.distance_m, ahead.share),
        world,
        drive,
        housing_radius_m=asked.clearance.radius_m,
        margin_m=asked.clearance.margin_m,
        own_body_share=asked.own_body_share,
        cable=None if cable is None else (cable.forbidden, math.radians(cable.half_angle_deg)),
        ground_z_m=-float(middle[:, 2, 3].mean()),
        frame=frame,
        one_world=own.world not in PAIRS,
        files=tuple(dict.fromkeys([*named_files, *opened])),
        page=repr(own),
    )


def recorded_drives(path: Path) -> tuple[Drive, tuple[float, ...]]:
    """Windows of a trajectory (``RobotPair.drive``), with the constant twist that leads from the
    first pose whose events are read to the last; and the root mean squares of its six velocities,
    at least 0.05 m/s and rad/s, as a prior.

    Raises: FileFormatError, as ``scenes.tum.read_tum``; DomainError for one that is too short or
      stands still.
    """
    t_s, poses = read_tum(path)
    window_s = float(robot_pair.times()[-1])
    if not (t_s[-1] - t_s[0]) >= 3 * window_s:
        raise DomainError(
            f"motion: '{path}' lasts {(t_s[-1] - t_s[0]):g} s; {3 * window_s:.3g} s are the least: windows of "
            f"{window_s:.3g} s are taken from its first two thirds for training and from the rest for judging."
        )
    trajectory = Recorded(t_s - t_s[0], poses)
    end = float(trajectory.t_s[-1])
    parts = {False: (0.0, TRAINING * end), True: (TRAINING * end, end)}
    for first, last in parts.values():
        inside = trajectory.t_s[(trajectory.t_s > first) & (trajectory.t_s < last)]
        passed = trajectory(torch.cat([torch.tensor([first, last], dtype=torch.float64), inside]))
        if (passed - passed[0]).abs().max() < STILL:
            raise DomainError(
                f"motion: '{path}' stands still from {first:g} to {last:g} s after its begin, so nothing there makes "
                "an event; cut it to where the robot moves."
            )
    length = trajectory.t_s.diff()[:, None]
    squares = (length * trajectory.twist_per_s**2).sum(0) / length.sum()
    prior = tuple(squares.sqrt().clamp_min(LEAST_PRIOR).tolist())

    def drive(number: int, motions: int) -> tuple[Tensor, Tensor]:
        first, last = parts[number >= robot_pair.UNSEEN_FROM]
        begin = np.random.default_rng([number, 4]).uniform(first, last - window_s, motions)
        t_s = torch.from_numpy(begin)[:, None] + robot_pair.times()
        poses = trajectory(t_s.clamp_max(last).flatten()).unflatten(0, t_s.shape)
        twist, _ = render.camera_velocity(poses[:, [1, -1]], [0.0, robot_pair.DURATION_S])
        return poses, twist[:, 0]

    return drive, prior


@contextlib.contextmanager
def _entry(name):
    """What goes wrong inside names an entry of the page."""
    try:
        yield
    except CodesignError as error:
        raise type(error)(f"{name}: {error}") from error


def _file(entry, name, kinds=()):
    """Path of a file that an entry names, of one of some kinds."""
    path = Path(name)
    if kinds and path.suffix.lower() not in kinds:
        raise DomainError(
            f"{entry}: '{path}' is of no kind that is read here; give {', '.join(kinds)}."
        )
    if not path.is_file():
        raise FileFormatError(
            f"{entry}: there is no file '{path}'; paths count from the folder of the page."
        )
    return path


def _bodies(own):
    """Meshes in body axes, less those that move with the camera, and the name of the axes."""
    path = _file("robot", own.robot, (".urdf", *mesh_files.KINDS))
    missing = [
        f"'{name}' in '{folder}'"
        for name, folder in own.packages.items()
        if not Path(folder).is_dir()
    ]
    if missing:
        raise FileFormatError(
            f"packages: there is no folder for {', '.join(missing)}; paths count from the folder of the page."
        )
    if path.suffix.lower() == ".urdf":
        with _entry("robot"):
            robot = robots.from_urdf(path, packages=own.packages)
        parts, frame, links = list(robot.parts), robot.base, set(robot.frames)
    else:
        with _entry("robot"):
            parts = mesh_files.read(path, own.unit_m, materials=False)
        frame, links = "base_link", set()
    names = sorted({part.name for part in parts})
    known = {*names, *links}  # a link may be a frame without a shape
    unknown = [name for name in own.without if name not in known]
    if unknown:
        raise DomainError(
            f"without: no part belongs to '{unknown[0]}'; there are {', '.join(names) or 'none'}."
        )
    left = [part for part in parts if part.name not in own.without]
    if not left:
        raise DomainError(
            f"robot: of '{path}' nothing with a shape is left; name fewer links in 'without'."
        )
    bodies = {
        f"{k}-{re.sub(r'[^A-Za-z0-9_-]', '_', part.name)}": Body(part.vertices_m, part.faces)
        for k, part in enumerate(left)
    }
    return bodies, frame


def _world(own):
    """What makes worlds by number, and how depth is known there unless asked otherwise."""
    if own.world in PAIRS:
        named = PAIRS[own.world]()
        return named.world, named.depth
    path = _file("world", own.world, (*mesh_files.KINDS, ".xml"))
    if own.motion is None:
        raise DomainError(
            f"motion is missing: the world '{own.world}' is a file and has no drives; give a file of poses, or one of "
            f"{', '.join(PAIRS)}."
        )
    with _entry("world"):
        if path.suffix.lower() == ".xml":
            scene = worlds.from_mitsuba(path, gain=WHITE, unit_m=own.world_unit_m or 1.0)
        else:
            scene = worlds.from_mesh(path, background=DULL, unit_m=own.world_unit_m)

    def same(number: int) -> render.MitsubaScene:
        return scene

    return same, "scene"


def _standing(named, bodies):
    """Drives of a pair for other bodies; those that drive stand on the ground."""
    vertices = np.concatenate([mesh.vertices_m for mesh in bodies.values()])
    reach = np.linalg.norm(vertices[:, :2], axis=1).max()
    if reach > ROOM_M:
        raise DomainError(
            f"robot: it reaches {reach:.3g} m from its origin, the drives of '{named.name}' have room for {ROOM_M:g} m; "
            "give a mesh in metres, or its unit_m, or a world and a trajectory of your own."
        )
    if named.axes == FREE:
        lowest = float(vertices[:, 2].min()) + float(named.drive(0, 12)[0][..., 2, 3].min())
        if lowest < 0:
            raise DomainError(
                f"robot: it reaches {-vertices[:, 2].min():.3g} m below its origin, and the drives of '{named.name}' would "
                f"bring that {-lowest:.2g} m under the floor; put its origin lower, or give a world and a trajectory of your own."
            )
        return named.drive
    up = torch.eye(4, dtype=torch.float64)
    up[2, 3] = LIFT_M - float(vertices[:, 2].min())

    def drive(number: int, motions: int) -> tuple[Tensor, Tensor]:
        poses, twist = named.drive(number, motions)
        middle = poses[:, 0] @ se3_exp(robot_pair.MIDDLE_S * twist)
        return robot_pair.moved(middle @ up, twist), twist

    return drive


def _designs(own):
    lens = (own.lens.focal_length_mm, own.lens.fno, 1 / own.lens.focus_m)
    designs: list[dict[str, float]] = [{}, {}, {}]
    for name, ends in own.camera.bounds().items():
        given = getattr(own.start, name)
        first = sum(ends) / 2 if given is None else given
        for design, value in zip(designs, (*ends, first), strict=True):
            turns = name.endswith("_deg")
            design[name.replace("_deg", "_rad")] = math.radians(value) if turns else value
    return [Design(*lens, **each) for each in designs]


explain(globals())
