"""Errors of event flow through a lens, case by case, with the same cases, samples and noise at every level."""

from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch import Tensor

from codesign import render
from codesign.lens import Pinhole
from codesign.system.objectives import angular_error_mrad
from codesign.types import EventVolume, FlowField
from studies.flow_needs import cases
from studies.flow_needs.conditions import SAMPLES, Sensor, View

Estimator = Callable[[EventVolume], FlowField]
MRAD_PER_PX = 1e3 * cases.PITCH_MM / cases.EFL_MM
IGNORED = "ignored"  # distortion judged as if it were absent


def camera_of(lens: Any, window: str, light: Any = None) -> render.Camera:
    """Camera of one window behind any lens."""
    size = cases.WINDOW_PX
    return render.Camera(
        lens, size, size, cases.PITCH_MM, SAMPLES[window], film=cases.film(window), spectrum=light
    )


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
        for name, sensor in sensors.items():
            volume = sensor(frames, batch.t_s, torch.Generator().manual_seed(batch.seed))
            found.setdefault(f"{name} / events", []).append(volume.counts.sum((1, 2)).mean((1, 2)))
            for which, estimator in estimators.items():
                field = estimator(volume)
                judged = {"": seen, f" / {IGNORED}": plain} if ignore_distortion else {"": seen}
                for label, eye in judged.items():
                    error = angular_error_mrad(field, eye, batch.scene, batch.T_world_body)
                    found.setdefault(f"{name} / {which}{label}", []).append(error / MRAD_PER_PX)
    return {name: torch.cat([part.double() for part in parts]) for name, parts in found.items()}
