"""Errors of event flow through a lens, case by case, with the same cases, samples and noise at every level."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from codesign import render
from codesign.lens import Pinhole
from codesign.render.truth import later_points
from codesign.system import Batch
from codesign.types import EventVolume, FlowField
from studies.flow_needs import cases
from studies.flow_needs.conditions import SAMPLES, Sensor, View

Estimator = Callable[[EventVolume], FlowField]
MRAD_PER_PX = 1e3 * cases.PITCH_MM / cases.EFL_MM
EVERY = 8  # pixels, in x and y, whose flow counts
IGNORED = "ignored"  # distortion judged as if it were absent


def camera_of(lens: Any, window: str, light: Any = None) -> render.Camera:
    """Camera of one window behind any lens."""
    size = cases.WINDOW_PX
    return render.Camera(
        lens, size, size, cases.PITCH_MM, SAMPLES[window], film=cases.film(window), spectrum=light
    )


@dataclass(frozen=True)
class Targets:
    """What ``angular_error_mrad`` compares with, worked out once for many flow fields of the same batch.

    camera: whose pixels the flow is in. pixels: [P, 2]. points_m: [B, P, 3] where their points lie before the camera
    in the end. seen: [B, P] 1 where there is a point, 0 elsewhere.
    """

    camera: render.Camera
    pixels: Tensor
    points_m: Tensor
    seen: Tensor

    @staticmethod
    def of(camera: render.Camera, batch: Batch) -> "Targets":
        """Targets on every EVERY-th pixel of the one window of a camera."""
        half = EVERY // 2
        pixels = (
            camera.film.pixels().reshape(*camera.film.shape[1:], 2)[half::EVERY, half::EVERY].reshape(-1, 2)
        )
        rays = camera.chief_rays(pixels)
        found = [later_points(rays, *pair) for pair in zip(batch.scene, batch.T_world_body, strict=True)]
        points_m, seen = (torch.cat(column) for column in zip(*found, strict=True))
        return Targets(camera, pixels, points_m, seen.double())

    def error_px(self, field: FlowField) -> Tensor:
        """Mean angle by which the flow [B, 2, H, W] misses the points, [B], in pixels on the axis."""
        half = EVERY // 2
        motion = field.flow_px[..., half::EVERY, half::EVERY].double().flatten(2).mT
        to = (self.pixels + motion).reshape(-1, 2)
        miss = render.angular_miss_rad(self.camera, to, self.points_m.reshape(-1, 3)).reshape(self.seen.shape)
        return 1e3 / MRAD_PER_PX * (miss * self.seen).sum(1) / self.seen.sum(1)


@torch.no_grad()
def flow_errors_px(
    camera: render.Camera,
    view: View,
    sensors: Mapping[str, Sensor],
    estimators: Mapping[str, Estimator],
    count: int,
    seed: int,
    ignore_distortion: bool = False,
) -> dict[str, Tensor]:
    """Mean angular error of every case, in pixels on the axis (1.68 mrad), and the events per pixel.

    Args: camera: of one window. sensors, estimators: by name. count, seed: of the cases. ignore_distortion: judge
      the flow a second time, taking pixels for those of a pinhole.
    Returns: [count] each: "SENSOR / ESTIMATOR", with " / ignored" behind it for the second judgement, and
      "SENSOR / events".
    """
    found: dict[str, list[Tensor]] = {}
    plain = camera.with_lens(Pinhole(cases.EFL_MM))
    for batch in cases.batches(view.texture, view.speed_px, count, seed):
        seen = camera.with_seed(batch.seed)
        frames = render.frames(seen, batch.scene, batch.T_world_body)[:, :, 0]
        eyes = {"": seen, f" / {IGNORED}": plain} if ignore_distortion else {"": seen}
        judges = {label: Targets.of(eye, batch) for label, eye in eyes.items()}
        for name, sensor in sensors.items():
            volume = sensor(frames, batch.t_s, torch.Generator().manual_seed(batch.seed))
            found.setdefault(f"{name} / events", []).append(volume.counts.sum((1, 2)).mean((1, 2)))
            for which, estimator in estimators.items():
                field = estimator(volume)
                for label, judge in judges.items():
                    found.setdefault(f"{name} / {which}{label}", []).append(judge.error_px(field))
    return {name: torch.cat([part.double() for part in parts]) for name, parts in found.items()}
