"""The mount that was found, for those who build it: a transform between named frames in YAML, lens,
sensor and camera beside it. It loads back to the same bits."""

import hashlib
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import scipy
import torch
from torch import Tensor

from codesign import lens as lenses
from codesign import plain_yaml, render
from codesign.atomic import write_atomic
from codesign.errors import DomainError, FileFormatError
from codesign.events import SensorModel
from codesign.lens.files.load import text_of
from codesign.mount import Mount, yaw_pitch_roll_rad
from codesign.reading import building, read_bytes, read_text

FORMAT = "codesign mount 1"
MOST_BYTES = 50_000_000  # of a lens file
# metres, and entries of the rotation, between the transform and the mount's own numbers, which may
# be of single precision
AGREES = 1e-6
# what a film says of itself; where its coordinates are computed is not a part of it
FILM = tuple(name for name in render.Film.__dataclass_fields__ if name != "device")
COMMENT = """Pose of a camera on a robot, p_parent = R p_child + t: metres, unit quaternion (x, y, z, w).
Axes of the parent as in REP 103: x forward, y left, z up. The child is an optical frame (suffix _optical_frame): z along
the view, x right, y down in the image; its origin is the centre of the lens's entrance pupil. urdf_origin has the same
pose for a link with x along the view and z up, as <origin xyz= rpy=> of a fixed joint.
The section mount rebuilds the learnable mount to the last bit; leave it out to hold the pose of the transform."""


@dataclass(frozen=True)
class HandOver:
    """What is handed over.

    mount, camera: as found; the camera has its lens. sensor: of the events, or None. parent_frame,
    child_frame: names of the robot's link (REP 105: base_link, base_footprint) and of the camera's
    optical frame. notes: what was measured, name -> number or text.
    """

    mount: Mount
    camera: render.Camera
    sensor: SensorModel | None = None
    parent_frame: str = "base_link"
    child_frame: str = "camera_optical_frame"
    notes: Mapping[str, float | int | str] = field(default_factory=dict)


def save_hand_over(path: str | Path, handed: HandOver) -> None:
    """Write a mount to a .yaml file, and a traced lens to a .lens.json beside it.

    Raises: DomainError for a frame without a name, a lens that no file keeps or a camera whose film
      has other parts; FileFormatError where the place is not writable.
    """
    path = Path(path)
    if path.suffix.lower() not in (".yaml", ".yml"):
        raise FileFormatError(
            f"hand-over {path}: extension '{path.suffix}' is not written; use .yaml."
        )
    for name in (handed.parent_frame, handed.child_frame):
        _check_frame(name)
    pose = handed.mount().detach()
    camera = handed.camera
    page: dict[str, Any] = {"format": FORMAT, "transform": _transform(pose, handed)}
    yaw, pitch, roll = yaw_pitch_roll_rad(pose).tolist()
    page["urdf_origin"] = {"xyz_m": pose[:3, 3].tolist(), "rpy_rad": [roll, pitch, yaw]}
    page["lens"], beside = _lens_page(camera.lens, path)
    page["camera"] = {
        **{name: value for name in FILM if (value := getattr(camera.film, name)) is not None},
        **{name: getattr(camera, name) for name in ("samples_per_pixel", "seed", "falloff", "aim")},
    }
    spectrum = camera.spectrum
    line, _ = camera.colours[0]
    if line and spectrum is None:  # ``in_one_colour``
        spectrum = lenses.Spectrum((line["wavelength_um"],), (1.0,))
    if spectrum is not None:
        for name in ("wavelengths_um", "weights"):
            page["camera"][name] = [float(value) for value in getattr(spectrum, name)]
    if handed.sensor is not None:
        page["sensor"] = asdict(handed.sensor)
    if handed.notes:
        page["notes"] = dict(handed.notes)
    page["mount"] = {
        name: value.detach().tolist() for name, value in handed.mount.state_dict().items()
    }
    files = {path: plain_yaml.dump(page, COMMENT)}  # refused, it replaces no lens
    for file, text in (beside | files).items():
        write_atomic(file, text.encode())


def load_hand_over(path: str | Path) -> HandOver:
    """Read what ``save_hand_over`` wrote: the same mount, camera and sensor to the last bit,
    and the lens; one with variables, or scaled as those of a family are, to rounding.

    A file without the section mount holds the pose of its transform. The file is data: nothing in
    it is run, and it names no file outside its own folder.
    Raises: FileFormatError, in a sentence that names what is missing, unknown or at odds.
    """
    path = Path(path)
    with building(f"hand-over {path}", "give a .yaml file that save_hand_over wrote"):
        page = plain_yaml.load(read_text(path))
        if page.get("format") != FORMAT:
            raise FileFormatError(
                f"it has no line 'format: \"{FORMAT}\"'; write it with save_hand_over."
            )
        missing = [
            name for name in ("transform", "camera", "lens") if not isinstance(page.get(name), dict)
        ]
        if missing:
            raise FileFormatError(f"the entry '{missing[0]}' is missing; write it anew.")
        transform = page["transform"]
        frames = [transform.get(name) for name in ("parent_frame", "child_frame")]
        for name in frames:
            _check_frame(name)
        return HandOver(
            _mount(page, _pose(transform)),
            _camera(page["camera"], _lens(page["lens"], path)),
            SensorModel(**page["sensor"]) if "sensor" in page else None,
            *frames,
            page.get("notes", {}),
        )


def _check_frame(name):
    if not name or not isinstance(name, str):
        raise DomainError(f"hand-over: a frame is named {name!r}; give a name such as 'base_link'.")


def _transform(pose, handed):
    # x, y, z, w >= 0
    turn = scipy.spatial.transform.Rotation.from_matrix(pose[:3, :3].cpu().numpy())
    quaternion = turn.as_quat(canonical=True)
    return {
        "parent_frame": handed.parent_frame,
        "child_frame": handed.child_frame,
        "translation_m": dict(zip("xyz", pose[:3, 3].tolist(), strict=True)),
        "rotation_quaternion": dict(zip("xyzw", quaternion.tolist(), strict=True)),
    }


def _pose(page):
    pose = torch.eye(4, dtype=torch.float64)
    quaternion = torch.tensor(
        [page["rotation_quaternion"][axis] for axis in "xyzw"], dtype=torch.float64
    )
    if not abs(float(quaternion.norm()) - 1) < 1e-6:
        raise DomainError(
            f"the quaternion has length {float(quaternion.norm()):.6g}; give one of length 1."
        )
    turn = scipy.spatial.transform.Rotation.from_quat(quaternion.numpy())
    pose[:3, :3] = torch.from_numpy(turn.as_matrix())
    pose[:3, 3] = torch.tensor([page["translation_m"][axis] for axis in "xyz"], dtype=torch.float64)
    return pose


def _mount(page, pose: Tensor) -> Mount:
    if "mount" not in page:
        held = Mount(pose[:3, 3], (0.0, 0.0, 0.0))
        held.start_attitude.copy_(pose[:3, :3])
        return held
    state = {
        name: torch.tensor(value, dtype=torch.float64) for name, value in page["mount"].items()
    }
    mount = Mount((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    mount.load_state_dict(state)
    off = float((mount().detach() - pose).abs().max())
    if not off < AGREES:
        raise DomainError(
            f"the transform and the numbers of the section mount are {off:.3g} apart; take out that section to hold the "
            "transform, or write the file anew."
        )
    return mount


def _lens_page(lens, path):
    """The lens's part of a hand-over, and the files beside it: path -> text."""
    lens = lens.replace() if hasattr(lens, "replace") else lens  # its values now, of variables too
    dtype = str(getattr(lens, "dtype", torch.float64)).removeprefix("torch.")
    if type(lens) in (lenses.ThinLens, lenses.Pinhole):  # another class may map otherwise
        efl_mm, image_mm = (
            float(value.detach()) for value in (lens.efl_mm, lens.image_distance_mm)
        )
        page = {"kind": "thin", "dtype": dtype, "efl_mm": efl_mm}
        page["entrance_pupil_diameter_mm"] = lens.entrance_pupil_diameter_mm
        return page if image_mm == efl_mm else {**page, "image_distance_mm": image_mm}, {}
    if type(lens) is lenses.GeoLens:
        file = path.with_suffix(".lens.json")
        text = text_of(lens, file)
        page = {
            "kind": "traced",
            "dtype": dtype,
            "file": file.name,
            "sha256": _digest(text.encode()),
        }
        return page, {file: text}
    raise DomainError(
        f"hand-over: a {type(lens).__name__} is kept by no file; give a GeoLens, ThinLens or Pinhole."
    )


def _lens(page, path):
    dtype = {"float32": torch.float32, "float64": torch.float64}[page["dtype"]]
    if page["kind"] == "thin":
        efl = torch.tensor(page["efl_mm"], dtype=dtype)
        diameter = page["entrance_pupil_diameter_mm"]
        image = page.get("image_distance_mm")
        if diameter == 0 and image is None:
            return lenses.Pinhole(efl)
        return lenses.ThinLens(
            efl, diameter, None if image is None else torch.tensor(image, dtype=dtype)
        )
    if page["kind"] != "traced":
        raise DomainError(
            f"a lens of the kind {page['kind']!r} is not known; there are 'thin' and 'traced'."
        )
    file = path.parent / page["file"]
    if Path(page["file"]).name != page["file"]:
        raise DomainError(
            f"the lens {page['file']!r} is not beside it; give the name of a file in the same folder."
        )
    if not file.is_file() or _digest(read_bytes(file, MOST_BYTES)) != page["sha256"]:
        said = "is missing" if not file.is_file() else "is not the one that was handed over"
        raise DomainError(f"the lens '{file.name}' {said}; put the file back, or write both anew.")
    return lenses.load(file, dtype)


def _digest(content):
    return hashlib.sha256(content).hexdigest()


def _camera(page, lens):
    film = {name: value for name, value in page.items() if name in FILM}
    if film.get("windows_px") is not None:
        film["windows_px"] = tuple(tuple(window) for window in film["windows_px"])
    rest = {name: value for name, value in page.items() if name not in FILM}
    for name in ("falloff", "aim"):
        if not isinstance(rest.get(name, False), bool):
            raise DomainError(f"{name} is {rest[name]!r}; true or false is needed.")
    spectrum = None
    if "wavelengths_um" in rest:
        spectrum = lenses.Spectrum(tuple(rest.pop("wavelengths_um")), tuple(rest.pop("weights")))
    made = render.Film(**film)
    return render.Camera(
        lens,
        made.width_px,
        made.height_px,
        made.pixel_pitch_mm,
        film=made,
        spectrum=spectrum,
        **rest,
    )
