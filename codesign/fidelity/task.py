"""What a scene is looked at for: camera, sensor, drives, and what is judged of them."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

from torch import Tensor

from codesign.checks import check, check_kind
from codesign.errors import DomainError
from codesign.events import SensorModel
from codesign.events.entry import check_times
from codesign.render import Camera, Film

CROP_PX = 48  # side of the windows that stand for a larger film
CROP_DRIVES = 2


def flow_px(field: Any) -> Tensor:
    """What is judged by default: the flow, [N, 2, H, W] px."""
    return field.flow_px


@dataclass(frozen=True)
class Task:
    """A camera that drives before a scene, at its finest, and what is read from it.

    Args:
      camera: render.Camera; its lens and its samples per pixel are the finest.
      sensor: SensorModel of the events.
      T_world_body: [..., T, 4, 4] poses over one window of time, at the finest frame times; of the
        camera itself without a mount. T - 1 should be a power of two, such as 65 poses: coarser
        levels take every second, fourth, ... of them.
      t_s: [T] seconds, increasing.
      flow: EventVolume -> FlowField that is yours; None lets the estimator be chosen too.
      mount, estimate: as of ``codesign.System``.
      judged: what is judged, [N] or with components in axis 1 ([N, K, ...]); asks for what it needs
        by name, as an objective of a System. The flow when left out.
      name, unit: of what is judged, for sentences.
      gradient: whether the chain is to be differentiated, so that no stage may be hard.
    Raises: ShapeError, DomainError where times and poses do not belong together.
    """

    camera: Camera
    sensor: SensorModel
    T_world_body: Tensor
    t_s: Tensor
    flow: Callable[..., Any] | None = None
    mount: Callable[..., Tensor] | None = None
    estimate: Callable[..., Any] | None = None
    judged: Callable[..., Tensor] = flow_px
    name: str = "flow"
    unit: str = "px"
    gradient: bool = False

    def __post_init__(self) -> None:
        check_kind(self.camera, Camera, "the task's camera")
        check_kind(self.sensor, SensorModel, "the task's sensor")
        times = len(check_times(self.t_s))
        check(self.T_world_body, "... T>=3 4 4", "the task's poses", sizes={"T": times})
        if times < 3:
            raise DomainError("the task has 2 frame times; give 3 at least, or 2^n + 1.")

    def cropped(self) -> "Task":
        """The same on a few windows of the film (its corners and its middle) and its first drives;
        a small film, or one of windows, stays whole."""
        poses = self.T_world_body.reshape(-1, *self.T_world_body.shape[-3:])[:CROP_DRIVES]
        film = self.camera.film
        free = film.width_px - CROP_PX, film.height_px - CROP_PX
        if film.windows_px is not None or min(free) < CROP_PX // 2:
            return replace(self, T_world_body=poses)
        corners = [(x, y) for x in (0, free[0]) for y in (0, free[1])]
        windows = (*corners, (free[0] // 2, free[1] // 2))
        sensor = film.sensor_width_px, film.sensor_height_px
        crop = Film(*sensor, CROP_PX, CROP_PX, film.pixel_pitch_mm, windows)
        return replace(self, T_world_body=poses, camera=self.camera.with_film(crop))
