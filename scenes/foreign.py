"""Worlds from Mitsuba scenes that others wrote: files, dictionaries, or scenes that are loaded
already.

What is taken is what can be seen and what lights it. Sensors, films, samplers and file output are
left out of the world; ``view_of`` reads the first perspective sensor as a place to start from.
Mitsuba runs in one channel here, as event sensors do: colours become luminance before light
bounces, so light between strongly coloured surfaces is a little off from the luminance of a colour
rendering.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from codesign import backend, lens
from codesign.checks import check_choice, check_positive, check_whole
from codesign.errors import DomainError, FileFormatError
from codesign.exclusive import exclusive
from codesign.reading import building, reading
from codesign.render import Camera
from codesign.render.light import PathScene, bake
from codesign.render.placed import PlacedScene, Placement
from scenes import trial_load, units

Up = Literal["y", "z"]
# from the axes of a file with this up axis to ours, z up
UP: dict[str, list[list[float]]] = {
    "y": [[1, 0, 0], [0, 0, -1], [0, 1, 0]],
    "z": [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
}
Level = Literal["auto", "emissive", "baked", "path"]
LEVELS: tuple[Level, ...] = ("auto", "emissive", "baked", "path")
TEXELS = 60_000  # of baked light, in all, where no size is given
INTEGRATORS = (
    "PathIntegrator",
    "DirectIntegrator",
    "VolumetricPathIntegrator",
    "VolumetricMisPathIntegrator",
)


@exclusive
def from_mitsuba(
    source: str | Path | Mapping[str, Any] | Any,
    light: Level = "auto",
    device: str = "cpu",
    *,
    unit_m: float = 1.0,
    up: Up = "y",
    gain: float = 1.0,
    samples: int | None = None,
    seed: int = 0,
    texel_m: float | None = None,
    towards_m: Sequence[float] | None = None,
    matte: bool = False,
    **parameters: Any,
) -> Any:
    """A world out of a Mitsuba scene.

    Args:
      source: path of an .xml file, a dictionary as mi.load_dict takes it, or an mi.Scene loaded in
        the variant of ``backend.variant(device)``.
      light: "path", what Mitsuba renders, by ``samples`` (16) paths per camera ray, without
        gradient (PathScene); "baked", light worked out once (light.bake); "emissive", without
        light: what glows shows its emission, and anything else its albedo, as radiance; "auto",
        emissive where every surface is an emitter, otherwise baked.
      unit_m: metres per unit of the scene's lengths. up: the axis that points up in it; worlds have
        z up.
      gain: factor on its radiance; 255 brings pictures made for a white of 1 to the scale of the
        other worlds.
      samples: paths per camera ray, or per texel (64); seed: of their random numbers. Paths are as
        long as the integrator of the scene has them where it samples camera rays, and of any length
        where there is none.
      texel_m: size of the texels of baked light, None for as large as makes TEXELS of them.
        towards_m, matte: of surfaces that shine, mirror or let light through, as in ``light.bake``.
      parameters: values of $parameters in an .xml file.
    Returns: a scene for ``render.frames`` with ``radiance``, ``radiance_and_distance``, ``hit`` and
      ``outline``.
    Gradient: baked and emissive worlds, as MitsubaScene.
    Warns: UserWarning when the scene is more than 100 m or less than 1 cm wide (scenes.units).
    Raises: FileFormatError for a file that is missing or that Mitsuba cannot load (an unknown
      plugin, a missing picture); DomainError for a dictionary it cannot load, a scene without
      shapes or light, what cannot be baked (light.bake), an unknown level, unit or axis.
    """
    check_choice(light, "light", LEVELS)
    if samples is not None:
        samples = check_whole(samples, "samples")
    mi = backend.mitsuba(device)
    place = Placement(_axes(up, unit_m), unit_m, gain)
    scene = loaded(mi, source, parameters, merge=light == "path")
    name = f"the scene '{source}'" if isinstance(source, (str, Path)) else "the scene"
    if not scene.shapes():
        raise DomainError(f"{name} has no shapes, so there is nothing to see; give one that has.")
    if light == "auto":
        light = "emissive" if all(shape.is_emitter() for shape in scene.shapes()) else "baked"
    if light != "emissive" and not scene.emitters():
        raise DomainError(
            f"{name} has no light, so it is black at the level '{light}'; add an emitter, or choose 'emissive'."
        )
    units.hint(
        *([unit_m * v for v in corner] for corner in (scene.bbox().min, scene.bbox().max)),
        name,
        unit_m,
    )
    integrator = _integrator(mi, scene)
    if light == "path":
        return PlacedScene(
            PathScene(scene, device, samples=samples or 16, seed=seed, integrator=integrator), place
        )
    area_m2 = unit_m**2 * sum(_area(shape) for shape in scene.shapes())
    return bake(
        scene,
        device,
        texel_m=math.sqrt(max(area_m2, 1e-12) / TEXELS) if texel_m is None else texel_m,
        samples=samples or 64,
        seed=seed,
        towards_m=towards_m,
        matte=matte,
        integrator=integrator if light == "baked" else None,
        lit=light == "baked",
        placement=place,
    )


def _area(shape):
    """In the scene's unit; 0 for a shape that does not know its own, as an instance."""
    try:
        return float(shape.surface_area()[0])
    except RuntimeError:
        return 0.0


def _integrator(mi, scene):
    """The scene's own where it gives radiance along camera rays; otherwise paths, through media
    where there are any."""
    own = scene.integrator()
    if isinstance(own, mi.SamplingIntegrator) and own.class_name() in INTEGRATORS:
        return own
    media = any(
        s.interior_medium() is not None or s.exterior_medium() is not None for s in scene.shapes()
    )
    return mi.load_dict({"type": "volpath" if media else "path", "max_depth": -1})


@dataclass(frozen=True)
class FileView:
    """A perspective sensor of a scene: T_world_cam [4, 4] (x right, y down, z forward, metres), its
    horizontal field of view in radians, and the size of its film in pixels."""

    T_world_cam: Tensor
    field_of_view_rad: float
    width_px: int
    height_px: int

    def camera(
        self,
        samples_per_pixel: int = 16,
        width_px: int | None = None,
        seed: int = 0,
    ) -> Camera:
        """A pinhole of this field of view before a film of this size, or of ``width_px`` columns
        and as many rows as keep its proportions."""
        columns = self.width_px if width_px is None else width_px
        rows = max(1, round(self.height_px * columns / self.width_px))
        focal_mm = 8.0
        pitch_mm = 2 * focal_mm * math.tan(self.field_of_view_rad / 2) / columns
        return Camera(lens.Pinhole(focal_mm), columns, rows, pitch_mm, samples_per_pixel, seed)


@exclusive
def view_of(
    source: str | Path | Mapping[str, Any] | Any,
    number: int = 0,
    *,
    unit_m: float = 1.0,
    up: Up = "y",
    **parameters: Any,
) -> FileView:
    """The sensor of a Mitsuba scene as a pose and a field of view to start from.

    Args:
      source, unit_m, up, parameters: as for ``from_mitsuba``.
      number: which of its sensors.
    Returns: FileView. Near and far clipping, an aperture, the film's window and filter are left
      out.
    Raises: as ``from_mitsuba``; DomainError when there is no such sensor, or it is not a
      perspective one, mirrors, or has its principal point off the film's middle.
    """
    mi = backend.mitsuba()
    R_world_file = _axes(up, unit_m)
    sensors = loaded(mi, source, parameters).sensors()
    if not 0 <= number < len(sensors):
        raise DomainError(
            f"the scene has {len(sensors)} sensors, so there is no number {number}; choose one of them, or place "
            "the camera with pose.look_at."
        )
    sensor = sensors[number]
    values = mi.traverse(sensor)
    if "x_fov" not in values:
        raise DomainError(
            f"sensor {number} of the scene is a {sensor.class_name()}, not a perspective one; place the camera "
            "with pose.look_at."
        )
    offsets = [values.get(f"principal_point_offset_{axis}", [0.0]) for axis in "xy"]
    if any(float(offset[0]) != 0 for offset in offsets):
        raise DomainError(
            f"sensor {number} of the scene has its principal point off the middle of its film, which cameras here "
            "have not; place the camera with pose.look_at."
        )
    T_file_sensor = torch.tensor(np.array(values["to_world"].matrix, dtype=float)).reshape(4, 4)
    # the nearest rotation: float32 has rounded it
    u, _, v = torch.linalg.svd(T_file_sensor[:3, :3])
    T = torch.eye(4, dtype=torch.float64)
    T[:3, :3] = R_world_file @ u @ v * torch.tensor([-1.0, -1.0, 1.0])
    T[:3, 3] = unit_m * R_world_file @ T_file_sensor[:3, 3]
    if torch.linalg.det(T[:3, :3]) < 0:
        raise DomainError(
            f"sensor {number} of the scene mirrors its picture, which no pose does; place the camera with "
            "pose.look_at, or take the mirror out of its to_world."
        )
    film = sensor.film()
    width_px, height_px = (int(v) for v in film.size())
    return FileView(T, math.radians(values["x_fov"][0]), width_px, height_px)


def _axes(up, unit_m):
    """R_world_file [3, 3]."""
    check_choice(up, "up", UP)
    check_positive(
        unit_m, "unit_m", remedy="it is metres per unit of the file, 0.01 for centimetres"
    )
    return torch.tensor(UP[up], dtype=torch.float64)


@exclusive
def loaded(mi: Any, source: Any, parameters: Mapping[str, Any], merge: bool = True) -> Any:
    """The mi.Scene of a path, a dictionary or itself.

    Raises: FileFormatError for a file that is missing or that Mitsuba cannot load; DomainError for
      what is neither, or a dictionary that Mitsuba cannot load.
    """
    if isinstance(source, (str, Path)):
        return _from_file(mi, Path(source), parameters, merge)
    if parameters:
        raise DomainError(
            f"'{next(iter(parameters))}' is no argument of from_mitsuba, and $parameters belong to .xml files only; "
            "leave it out."
        )
    if isinstance(source, Mapping):
        found = _from_dictionary(mi, source, merge)
    elif isinstance(source, mi.Scene):
        found = source
    elif type(source).__name__ == "Scene" and hasattr(source, "variant_name"):
        raise DomainError(
            f"the scene was loaded in Mitsuba's variant {source.variant_name()}, but worlds are made in "
            f"{mi.variant()}; call mi.set_variant('{mi.variant()}') before you load it, or give the file itself."
        )
    else:
        raise DomainError(
            f"a Mitsuba scene is the path of an .xml file, a dictionary or an mi.Scene, not a "
            f"{type(source).__name__}; give one of these."
        )
    return found


def _from_file(mi, path, parameters, merge):
    if not path.is_file():
        raise FileFormatError(
            f"scene '{path}' is not a file; give the path of a Mitsuba scene (.xml)."
        )
    if path.suffix.lower() != ".xml":
        raise FileFormatError(
            f"scene '{path}' ends in '{path.suffix}'; Mitsuba scenes are .xml files, so export it as one."
        )
    with (
        _quiet(mi),
        building(f"scene '{path}'", "Mitsuba cannot load it; correct it, or export it anew"),
    ):
        config = mi.parser.ParserConfig(mi.variant())
        trial_load.check(
            mi, mi.parser.parse_file(config, str(path), **parameters), path, parameters.items()
        )
        found = mi.load_file(str(path), optimize=merge, **parameters)
    if not isinstance(found, mi.Scene):
        raise FileFormatError(
            f"'{path}' holds a {type(found).__name__}, not a scene; give a file of a <scene>."
        )
    return found


def _from_dictionary(mi, source, merge):
    _check_variants(mi, source, "")
    with (
        _quiet(mi),
        reading("the scene's dictionary", "Mitsuba cannot build the scene from it", DomainError),
    ):
        scene = {"type": "scene", **source}
        trial_load.check(mi, mi.parser.parse_dict(mi.parser.ParserConfig(mi.variant()), scene))
        return mi.load_dict(scene, optimize=merge)


def _check_variants(mi, entry, place):
    """Objects of another variant would be taken, and end the process when they are rendered."""
    for key, value in entry.items():
        if isinstance(value, Mapping):
            _check_variants(mi, value, f"{place}{key}.")
        elif getattr(value, "variant_name", str)() not in ("", mi.variant()):
            raise DomainError(
                f"'{place}{key}' of the scene was made in Mitsuba's variant {value.variant_name()}, but worlds are "
                f"made in {mi.variant()}; call mi.set_variant('{mi.variant()}') before you make it."
            )


@contextmanager
def _quiet(mi) -> Iterator[None]:
    """Without its warnings about sensors, which are left out; reading what there is to read."""
    level = mi.logger().log_level()
    mi.set_log_level(mi.LogLevel.Error)
    try:
        with backend.threads(least=2):
            yield
    finally:
        mi.set_log_level(level)
