"""The design that a run handed over, to be looked at and changed."""

from dataclasses import replace
from pathlib import Path
from typing import Any

from codesign.errors import FileFormatError
from codesign.mount import yaw_pitch_roll_rad
from codesign.mount.pose import NAMES
from codesign.reading import building, read_json
from codesign.system import load_hand_over
from studies.codesign.design import BLOCKS, Space, Whole
from studies.codesign.gallery import loaded


def opened(folder: Path) -> Whole:
    """The design in the folder of a run of studies.codesign (design.yaml) or studies.placement
    (mount.yaml), in the space of its robot.

    Of a placement behind a traced lens the lens stays as it is: its numbers are not free.
    Raises: FileFormatError for a folder without either, or files that are damaged.
    """
    files = [folder / name for name in ("design.yaml", "mount.yaml")]
    found = next((path for path in files if path.is_file()), None)
    if found is None:
        raise FileFormatError(
            f"'{folder}' has no design.yaml and no mount.yaml; give the folder of a finished run of studies.codesign or "
            "studies.placement."
        )
    with building(f"the run in '{folder}'", "its config.json or hand-over is not of this version"):
        config: dict[str, Any] = read_json(folder / "config.json")
        pair = config["robot"] or config["pair"]
        if found.name == "design.yaml":
            family = None if config["family"] == "thin" else config["family"]
            space = Space.of(pair, family, config["light"], config["speed"])
            return loaded(found, space.made(space.start))
        return _mounted(found, Space.of(pair, None), traced=config["lens"] is not None)


def _mounted(path, space, traced):
    """The pair's own design behind a mount that was handed over, with its lens where it is
    traced."""
    back = load_hand_over(path)
    T_body_cam = back.mount().detach()
    numbers = [*T_body_cam[:3, 3].tolist(), *yaw_pitch_roll_rad(T_body_cam).tolist()]
    if traced:
        free = tuple(name for name in space.free if name not in BLOCKS["lens"])
        space = replace(space, free=free)
    found = Whole(space, {**space.default, **dict(zip(NAMES, numbers, strict=True))})
    vars(found)["T_body_cam"] = T_body_cam
    if traced:
        vars(found)["camera"] = back.camera
    return found
