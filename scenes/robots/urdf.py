"""Robots from URDF files: their bodies at given joint angles as scenes, and named frames to mount a
camera on. Metres, radians; the robot's own axes are those of one of its links.

    robot = robots.from_urdf("rover.urdf", {"mast": 0.3})
    world = render.MovingScene(static, {"robot": (robot.scene(), T_world_robot)})
    T_world_cam = T_world_robot @ robot.frame("camera_link") @ robots.T_LINK_OPTICAL

Forward kinematics carries no gradient; a mount is moved by a further transform on the right.
"""

import io
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from codesign.errors import DomainError, FileFormatError
from codesign.optional import optional
from codesign.reading import building, read_bytes
from codesign.render import MitsubaScene
from scenes import mesh_files, textures, units
from scenes.build import World, emissive
from scenes.from_mesh import shapes_of
from scenes.trees import unreached

yourdfpy = optional("yourdfpy", "worlds", "reading URDF")
trimesh = optional("trimesh", "worlds", "reading URDF")
etree = optional("lxml.etree", "worlds", "reading URDF")

# from the axes of a camera (z forward, x right, y down) to those of a link (x forward, y left, z
# up): ROS REP 103
T_LINK_OPTICAL = torch.tensor(
    [[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]], dtype=torch.float64
)
ROVER = Path(__file__).with_name("rover.urdf")  # four wheels, a mast, a camera that nods
ROUND = 48  # faces around a cylinder
FINE = 3  # subdivisions of a ball's icosahedron: 1,280 faces
MOVES = ("revolute", "continuous", "prismatic")
HELD = ("floating", "planar")
KINDS = (*MOVES, "fixed", *HELD)
MOST_BYTES = 100_000_000


@dataclass(frozen=True)
class Robot:
    """Links at joint angles. path: of the URDF. frames: name of each link -> T_robot_link [4, 4].
    parts: what is seen, in the robot's axes, named by link. base: the link whose axes are the
    robot's."""

    path: Path
    frames: Mapping[str, np.ndarray]
    parts: Sequence[mesh_files.Part]
    base: str

    def frame(self, name: str) -> Tensor:
        """T_robot_frame [4, 4] float64 of a link. Raises: DomainError for one that is not there."""
        if name not in self.frames:
            raise DomainError(
                f"robot '{self.path}' has no frame '{name}'; it has {', '.join(self.frames)}."
            )
        return torch.from_numpy(self.frames[name].copy())

    def scene(self, device: str = "cpu") -> MitsubaScene:
        """The robot in its own axes, as an emissive scene before nothing: its colours in the light
        of a plain sky that turns with it. Raises: DomainError for a robot without a body."""
        return emissive(World(self.shapes(), two_sided=True), device)

    def shapes(self) -> dict[str, Any]:
        """Painted bodies for a ``scenes.build.World`` of one's own, in the robot's axes."""
        if not self.parts:
            raise DomainError(
                f"robot '{self.path}' has no links with a shape, so there is nothing to see; add <visual> or "
                "<collision>."
            )
        return shapes_of(list(self.parts))


def from_urdf(
    path: str | Path,
    joint_angles: Mapping[str, float] | None = None,
    *,
    base: str | None = None,
    packages: Mapping[str, str | Path] | None = None,
    collision: bool = False,
) -> Robot:
    """A robot at joint angles.

    Args:
      path: a .urdf file (a .xacro has to be expanded before).
      joint_angles: joint -> radians (metres of a prismatic one), within its limits; the others are
        at 0, or at the limit next to it. Joints that mimic others follow them. Floating and planar
        joints are held at 0.
      base: the link whose axes are the robot's; None is the root of the tree.
      packages: package -> folder, for package:// paths; one that is not named is searched from the
        URDF's folder upwards.
      collision: whether collision shapes are shown even where there are visual ones; a link without
        visual shapes shows its collision shapes always.
    Returns: Robot. Meshes keep their own colours, or take those of the URDF's material (as sRGB);
      the pictures of URDF materials are left. A .dae counts in the unit that it says, with its axes
      as they are, as ROS's own viewer has it.
    Raises: FileFormatError for a file that is missing or damaged, or for meshes that are (all of
      them in one sentence); DomainError for joints and frames that are not there and for angles
      outside their limits.
    """
    path = Path(path)
    model = _model(path)
    model.update_cfg(_checked_angles(path, model, dict(joint_angles or {})))
    root = model.base_link if base is None else base
    names = [link.name for link in model.robot.links]
    if root not in names:
        raise DomainError(f"robot '{path}' has no frame '{base}'; it has {', '.join(names)}.")
    frames = {name: np.array(model.get_transform(name, root), dtype=np.float64) for name in names}
    colours = _colours(path, model.robot)
    finder = _Finder(path, dict(packages or {}))
    parts = []
    _check_places(path, frames.values())
    for link in model.robot.links:
        shapes = (
            link.collisions if collision and link.collisions else link.visuals or link.collisions
        )
        for shape in shapes:
            placed = frames[link.name] @ (np.eye(4) if shape.origin is None else shape.origin)
            _check_places(path, [placed])
            colour = _colour(path, getattr(shape, "material", None), colours)
            parts += [
                _moved(part, placed, link.name, colour)
                for part in _parts(shape.geometry, finder, link.name)
            ]
    finder.check()
    robot = Robot(path, frames, tuple(parts), root)
    if parts:
        corners = np.concatenate([part.vertices_m for part in parts])
        _check_places(path, [corners])
        units.hint(corners.min(0), corners.max(0), f"robot '{path}'")
    return robot


def _check_places(path, places):
    if not all(np.isfinite(each).all() for each in places):
        raise FileFormatError(
            f"robot '{path}' has places that are not finite; look for an origin, an axis or a size that is too large."
        )


def _model(path):
    if not path.is_file():
        raise FileFormatError(f"robot '{path}' is not a file; give the path of a .urdf file.")
    if path.suffix.lower() == ".xacro":
        raise FileFormatError(
            f"robot '{path}' is a xacro; expand it first: xacro {path.name} > robot.urdf"
        )
    data = read_bytes(path, MOST_BYTES)
    with building(f"robot '{path}'", "it is no whole URDF; correct or export it anew"):
        # whole or not at all: yourdfpy would go on with what it can read
        tree = etree.fromstring(data)
        if tree.tag != "robot":
            raise ValueError(f"its first element is <{tree.tag}> instead of <robot>")
        for joint in tree.findall("joint"):
            # yourdfpy finds the leader of a joint that mimics by counting a floating one before it as one number
            if joint.get("type") in HELD:
                joint.set("type", "fixed")
        with np.errstate(all="ignore"):  # what is not finite, or has no axis, is refused below
            model = yourdfpy.URDF.load(io.BytesIO(etree.tostring(tree)), load_meshes=False)
        wrong = _no_tree(model) or _wrong_joint(model.robot.joints)
    if wrong:
        raise FileFormatError(f"robot '{path}' cannot be built: {wrong[:300]}; correct it.")
    for joint in model.robot.joints:
        if joint.type in MOVES:  # a direction, whatever its length
            joint.axis = joint.axis / np.linalg.norm(joint.axis)
    return model


def _no_tree(model):
    """What keeps links and joints from being a tree, or an empty text."""
    links = [link.name for link in model.robot.links]
    joints = model.robot.joints
    for kind, names in (("links", links), ("joints", [joint.name for joint in joints])):
        twice = sorted(name for name, count in Counter(names).items() if count > 1)
        if twice:
            return f"several {kind} are called {', '.join(twice)}"
    pairs = [(joint.parent, joint.child) for joint in joints]
    lost = sorted({str(end) for pair in pairs for end in pair} - set(links))
    if lost:
        return f"joints name links that are not there: {', '.join(lost)}"
    looped = unreached(links, pairs)
    if looped:
        return f"joints lead in a loop through {', '.join(looped)}"
    roots = sorted(set(links) - {child for _, child in pairs})
    return (
        ""
        if len(roots) == 1
        else f"it has {len(roots)} root links instead of 1: {', '.join(roots)}"
    )


def _wrong_joint(joints):
    """What is wrong with a joint of the file, or an empty text."""
    leaders = {joint.name for joint in joints if joint.type in MOVES and joint.mimic is None}
    for joint in joints:
        if joint.type not in KINDS:
            return f"joint '{joint.name}' is of the type '{joint.type}', which is none of {', '.join(KINDS)}"
        if joint.mimic is not None and joint.mimic.joint not in leaders:
            return f"joint '{joint.name}' mimics '{joint.mimic.joint}', which is no joint that moves by itself"
        if joint.type in MOVES and not 1e-9 < np.linalg.norm(joint.axis) < 1e9:
            return f"joint '{joint.name}' has the axis {' '.join(f'{v:g}' for v in joint.axis)}, which has no direction"
    return ""


def _checked_angles(path, model, angles):
    """Every joint that can be set, at its given value or at what is nearest to 0."""
    free = {joint.name: joint for joint in model.actuated_joints if joint.type in MOVES}
    unknown = [name for name in angles if name not in free]
    if unknown:
        raise DomainError(
            f"robot '{path}' has no joint '{unknown[0]}' that can be set; it has {', '.join(free) or 'none'}."
        )
    values = {}
    for name, joint in free.items():
        low, high = -math.inf, math.inf
        if joint.type != "continuous" and joint.limit is not None:
            low, high = (float(said or 0.0) for said in (joint.limit.lower, joint.limit.upper))
        value = float(angles.get(name, min(max(0.0, low), high)))
        if not low <= value <= high or not math.isfinite(value):
            raise DomainError(
                f"robot '{path}': joint '{name}' at {value:g} lies outside its limits, {low:g} to {high:g}."
            )
        values[name] = value
    return values


def _colours(path, robot):
    """Linear luminance of materials by name: a colour said in one link is that of the name in all."""
    said = [shape.material for link in robot.links for shape in link.visuals]
    named = [each for each in (*robot.materials, *said) if each and each.name and each.color]
    return {each.name: _colour(path, each, {}) for each in reversed(named)}


def _colour(path, material, known):
    """Linear luminance of an URDF material, or None."""
    if material is None:
        return None
    if material.color is None:
        return known.get(material.name)
    rgb = np.asarray(material.color.rgba, dtype=float)[:3]
    if len(rgb) < 3 or not ((rgb >= 0) & (rgb <= 1)).all():
        raise FileFormatError(
            f"robot '{path}' has the colour {' '.join(f'{v:g}' for v in rgb)}; red, green and blue go from 0 to 1."
        )
    return textures.linear(rgb[None, None]).item()


def _parts(geometry, finder, link):
    """Parts of a shape in its own axes."""
    if geometry.mesh is not None:
        return finder.parts(geometry.mesh, link)
    if geometry.box is not None:
        mesh = trimesh.creation.box(extents=finder.sizes(geometry.box.size, 3, "box", link))
    elif geometry.cylinder is not None:
        radius, length = finder.sizes(
            (geometry.cylinder.radius, geometry.cylinder.length), 2, "cylinder", link
        )
        mesh = trimesh.creation.cylinder(radius, length, sections=ROUND)
    else:
        (radius,) = finder.sizes((geometry.sphere.radius,), 1, "sphere", link)
        mesh = trimesh.creation.icosphere(FINE, radius)
    grey = np.full(len(mesh.faces), mesh_files.UNCOLOURED)
    return [
        mesh_files.Part("", np.array(mesh.vertices), np.array(mesh.faces), grey, coloured=False)
    ]


def _moved(part, T_robot_shape, link, colour):
    """A part in the robot's axes, named by its link."""
    if colour is not None and not part.coloured:
        part = replace(part, colour=np.full(len(part.faces), colour))
    vertices = part.vertices_m @ T_robot_shape[:3, :3].T + T_robot_shape[:3, 3]
    faces = part.faces[:, ::-1] if np.linalg.det(T_robot_shape[:3, :3]) < 0 else part.faces
    return replace(part, name=link, vertices_m=vertices, faces=faces)


class _Finder:
    """Meshes by the names that a URDF has for them; those that cannot be read are told together."""

    def __init__(self, urdf, packages):
        self.urdf = urdf
        self.packages = {name: Path(folder) for name, folder in packages.items()}
        self.read: dict[str, Any] = {}
        self.lost: dict[str, str] = {}

    def sizes(self, values, count, shape, link):
        """Sizes of a shape, metres. Raises: DomainError for others than ``count`` positive ones."""
        values = [float(value) for value in np.atleast_1d(values)]
        if len(values) != count or not all(0 < value < math.inf for value in values):
            raise DomainError(
                f"robot '{self.urdf}': the {shape} of link '{link}' has the size {values}; positive metres are needed, "
                f"{count} of them."
            )
        return values

    def parts(self, mesh, link):
        """Parts of a mesh at its scale; none where it is lost."""
        name = mesh.filename or ""
        if name not in self.read:
            try:
                found, root = self.find(name)
                up = "z" if found.suffix.lower() == ".dae" else None
                self.read[name] = mesh_files.read(found, up=up, root=root)
            except FileFormatError as error:
                self.lost[name] = str(error).rstrip(".")
                self.read[name] = []
        scale = np.ones(3) * (1.0 if mesh.scale is None else mesh.scale)
        if not np.isfinite(scale).all() or not scale.all():
            raise DomainError(
                f"robot '{self.urdf}': a mesh of link '{link}' has the scale {scale.tolist()}, which leaves nothing of it; "
                "give three numbers other than 0."
            )
        stretched = np.eye(4)
        stretched[:3, :3] = np.diag(scale)
        return [_moved(part, stretched, part.name, None) for part in self.read[name]]

    def find(self, name):
        """Path of a mesh, and the folder that what it names must lie in."""
        here = self.urdf.resolve().parent
        if name.startswith(("package://", "model://")):
            package, _, rest = name.partition("://")[2].partition("/")
            if package in self.packages:
                folders = [self.packages[package]]
            else:
                above = [here, *here.parents]
                folders = [f for f in above if f.name == package] + [f / package for f in above]
            for folder in folders:
                if (folder / rest).is_file():
                    return folder / rest, folder
            raise FileFormatError(f"'{name}' is missing")
        plain = name.removeprefix("file://")
        if not plain or "://" in plain:
            raise FileFormatError(f"'{name}' is no path of this machine")
        found = here / plain
        if not found.is_file():
            raise FileFormatError(f"'{name}' is missing")
        return found, here if found.resolve().is_relative_to(here) else None

    def check(self):
        """Raise FileFormatError when meshes were lost."""
        if self.lost:
            raise FileFormatError(
                f"robot '{self.urdf}': {len(self.lost)} of its meshes cannot be read: {'; '.join(self.lost.values())}. "
                "Put them there, or say with packages= where a package lies."
            )
