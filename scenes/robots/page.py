"""A page of plain YAML that describes a user's robot: its body, where its camera may sit, what it
moves through and how.

    robot: rover.urdf          # or .obj, .stl, .ply, .dae, .gltf, .glb: metres, or unit_m; x
      forward, y left, z up
    without: [camera_link]     # links that move with the camera
    camera:
      low_m: [0.1, -0.1, 0.4]
      high_m: [0.3, 0.1, 0.6]

What else may stand there is what the classes below have; units are in the names. Paths count from
the page's folder.
"""

import difflib
import math
from collections.abc import Mapping
from dataclasses import MISSING, dataclass, field, fields, is_dataclass, replace
from pathlib import Path
from typing import TypeAlias, get_args, get_origin, get_type_hints

from codesign import plain_yaml
from codesign.checks import check_number
from codesign.errors import CodesignError, DomainError, shown
from codesign.reading import read_text, reading
from scenes.robots import pair as robot_pair
from scenes.robots.pairs import PAIRS

Two: TypeAlias = tuple[float, float]
Three: TypeAlias = tuple[float, float, float]
VELOCITIES = ("planar", "free")
DEPTHS = ("ground", "scene")
MOST_BYTES = 1_000_000
LEAST_FNO = 0.5  # 1 / (2 sin u) of a lens without spherical aberration and coma, at u = 90 degrees
WIDEST_DEG = 160  # that a flat picture spans from corner to corner
HALF_DIAGONAL_MM = robot_pair.PITCH_MM * math.hypot(*robot_pair.SENSOR_PX) / 2


@dataclass(frozen=True)
class CameraBox:
    """Where the camera may sit, in body axes, and how far it may turn: yaw to the left, pitch
    downwards."""

    low_m: Three
    high_m: Three
    yaw_deg: Two = (-35.0, 35.0)
    pitch_deg: Two = (0.0, 80.0)
    roll_deg: Two = (-20.0, 20.0)

    def __post_init__(self):
        for axis, (low, high) in self.bounds().items():
            if not low <= high:
                raise DomainError(
                    f"camera: {axis} goes from {low:g} to {high:g}; give the lower bound first."
                )
        if not -90 < self.pitch_deg[0] <= self.pitch_deg[1] < 90:
            raise DomainError(
                f"camera: pitch_deg is {list(self.pitch_deg)}; stay strictly between -90 and 90 (straight up, down)."
            )
        for name in ("yaw_deg", "roll_deg"):
            low, high = getattr(self, name)
            if high - low > 360:
                raise DomainError(
                    f"camera: {name} goes from {low:g} to {high:g}; a turn, 360, is the most."
                )

    def bounds(self) -> dict[str, Two]:
        """Lowest and highest of the six numbers of a mount, by the names that Start has."""
        box = zip(("x_m", "y_m", "z_m"), self.low_m, self.high_m, strict=True)
        return {name: (low, high) for name, low, high in box} | {
            name: getattr(self, name) for name in ("yaw_deg", "pitch_deg", "roll_deg")
        }


@dataclass(frozen=True)
class Start:
    """The mount to start from; None is the middle of its bounds."""

    x_m: float | None = None
    y_m: float | None = None
    z_m: float | None = None
    yaw_deg: float | None = None
    pitch_deg: float | None = None
    roll_deg: float | None = None


@dataclass(frozen=True)
class OwnLens:
    """A thin lens, focused at a distance."""

    focal_length_mm: float = 6.5
    fno: float = 1.2
    focus_m: float = 1.8

    def __post_init__(self):
        if not self.focal_length_mm > 0:
            raise DomainError(
                f"lens: focal_length_mm is {self.focal_length_mm:g}; a number > 0 is needed."
            )
        spans_deg = 2 * math.degrees(math.atan(HALF_DIAGONAL_MM / self.focal_length_mm))
        if spans_deg > WIDEST_DEG:
            raise DomainError(
                f"lens: at focal_length_mm {self.focal_length_mm:g} a flat picture spans {spans_deg:.0f} degrees, "
                f"{WIDEST_DEG} are the most; take a longer one."
            )
        if not self.fno >= LEAST_FNO:
            raise DomainError(
                f"lens: fno is {self.fno:g}; no lens in air has less than {LEAST_FNO:g} (its light would come from more than "
                "half of all directions)."
            )
        if not 1e3 * self.focus_m > self.focal_length_mm:
            raise DomainError(
                f"lens: focus_m is {self.focus_m:g}; it must lie beyond the focal length, {self.focal_length_mm:g} mm."
            )


@dataclass(frozen=True)
class Clear:
    """The camera's housing, a ball, and how far it stays from the robot."""

    radius_m: float = 0.02
    margin_m: float = 0.005


@dataclass(frozen=True)
class Ahead:
    """A share of the picture that sees beyond a distance."""

    distance_m: float
    share: float


@dataclass(frozen=True)
class Cable:
    """A cone, in body axes, into which the back of the camera must not point."""

    forbidden: Three
    half_angle_deg: float


@dataclass(frozen=True)
class Require:
    """What the mount has to keep."""

    clearance: Clear = field(default_factory=Clear)
    look_ahead: Ahead | None = None
    cable: Cable | None = None
    own_body_share: float = 0.3


@dataclass(frozen=True)
class OwnRobot:
    """A user's robot, and how its camera is judged.

    robot: URDF or mesh file. camera: bounds of the mount. without: links left out, those that move
      with the camera.
    start: of the mount, where the first search begins. lens: held. packages: package -> folder, for
    package:// paths of a URDF. unit_m: metres per unit of the robot's mesh file, world_unit_m of
    the world's; None is as the file says it, or metres.
    world: "outdoors", "corridor" or "flight", or a file: a mesh (metres, z up; glTF y up) or a
      Mitsuba scene (.xml).
    motion: the drives of a pair by the same names, or a file of poses T_world_body (scenes.tum);
      None is the world's.
    velocities: which count, "planar" or "free"; None is as the pair has it that the motion names,
      "free" for a file.
    depth: how it is known, "ground" (the plane z = 0 of the world) or "scene" (a map); None is as
      the world's pair has it, "scene" for a file.
    require: what the mount has to keep.
    Raises: DomainError for what does not go together.
    """

    robot: str
    camera: CameraBox
    without: tuple[str, ...] = ()
    start: Start = field(default_factory=Start)
    lens: OwnLens = field(default_factory=OwnLens)
    packages: dict[str, str] = field(default_factory=dict)
    unit_m: float | None = None
    world_unit_m: float | None = None
    world: str = "outdoors"
    motion: str | None = None
    velocities: str | None = None
    depth: str | None = None
    require: Require = field(default_factory=Require)

    def __post_init__(self):
        for name, (low, high) in self.camera.bounds().items():
            value = getattr(self.start, name)
            if value is not None and not low <= value <= high:
                raise DomainError(
                    f"start: {name} is {value:g}, outside the camera's bounds, {low:g} to {high:g}; move it inside or "
                    "widen them."
                )
        for name, known in (("velocities", VELOCITIES), ("depth", DEPTHS)):
            if getattr(self, name) not in (None, *known):
                raise DomainError(
                    f"{name} is {shown(getattr(self, name))}; give {' or '.join(known)}."
                )
        for name, of in (("unit_m", self.robot), ("world_unit_m", self.world)):
            value = getattr(self, name)
            if value is not None and not 0 < value < math.inf:
                raise DomainError(
                    f"{name} is {value:g}; metres > 0 are needed, such as 0.001 for millimetres."
                )
            if value is not None and of in PAIRS:
                raise DomainError(
                    f"{name} is of mesh files, and '{of}' is in metres; leave it out."
                )
            if value is not None and Path(of).suffix.lower() == ".urdf":
                raise DomainError(
                    f"{name} is of mesh files, and '{of}' is in metres; give its meshes a scale there, such as "
                    'scale="0.001 0.001 0.001" for millimetres.'
                )
        if self.packages and Path(self.robot).suffix.lower() != ".urdf":
            raise DomainError(f"packages are of URDFs, and '{self.robot}' is none; leave them out.")
        if self.motion in PAIRS and self.world in PAIRS and self.motion != self.world:
            raise DomainError(
                f"motion '{self.motion}' goes through its own world, not through '{self.world}'; leave one of them out."
            )


def read_own(path: str | Path) -> OwnRobot:
    """The settings on a page of plain YAML (codesign.plain_yaml).

    Raises: FileFormatError where the file is missing or no such page; DomainError, naming file and
      entry, for an entry that is unknown (with the nearest name), missing, of another kind, or out
      of range.
    """
    path = Path(path)
    text = read_text(path, MOST_BYTES)
    try:
        with reading("it", "give a page of plain YAML"):
            page = plain_yaml.load(text)
        own = _filled(OwnRobot, page, "")
    except CodesignError as error:
        raise type(error)(f"robot page '{path}': {error}") from error
    here = path.parent
    files = {name: getattr(own, name) for name in ("robot", "world", "motion")}
    packages = {name: str(here / folder) for name, folder in own.packages.items()}
    given = {name: str(here / file) for name, file in files.items() if file and file not in PAIRS}
    return replace(own, packages=packages, **given)


def _filled(kind, page, entry):
    """A dataclass from the mapping that stands at an entry."""
    kinds = get_type_hints(kind)
    where = f"{entry}." if entry else ""
    if not isinstance(page, Mapping):
        raise DomainError(
            f"{entry} is {shown(page)}; write {', '.join(kinds)} below it, indented by two spaces."
        )
    for name in page:
        if name not in kinds:
            near = difflib.get_close_matches(name, kinds, n=1)
            meant = f"did you mean '{where}{near[0]}'? " if near else ""
            raise DomainError(
                f"there is no entry '{where}{name}'; {meant}There are {', '.join(kinds)}."
            )
    for each in fields(kind):
        required = each.default is MISSING and each.default_factory is MISSING
        if required and each.name not in page:
            raise DomainError(f"the entry '{where}{each.name}' is missing; add it.")
    return kind(
        **{name: _value(kinds[name], given, f"{where}{name}") for name, given in page.items()}
    )


def _value(kind, given, entry):
    """What stands at an entry, checked to be of a kind: text, a number, so many of them, or a
    mapping."""
    parts = get_args(kind)
    if get_origin(kind) is dict:
        if not isinstance(given, Mapping):
            raise DomainError(
                f"{entry} is {shown(given)}; write name: value below it, indented by two spaces."
            )
        return {name: _value(parts[1], each, f"{entry}.{name}") for name, each in given.items()}
    if type(None) in parts:
        return None if given is None else _value(parts[0], given, entry)
    if is_dataclass(kind):
        return _filled(kind, given, entry)
    if kind is str:
        if not isinstance(given, str) or not given:
            raise DomainError(f"{entry} is {shown(given)}; give text.")
        return given
    if kind is float:
        return check_number(given, entry)
    if not isinstance(given, list) or (parts[-1] is not ... and len(given) != len(parts)):
        raise DomainError(
            f"{entry} is {shown(given)}; give a list of {'texts' if ... in parts else len(parts)}, in [ ]."
        )
    return tuple(_value(parts[0], each, entry) for each in given)
