"""Each stage of the chain alone: what one of its numbers does, as curves or a small loop.

Intensities are on the 0..255 scale, thresholds in natural log units, times in seconds; frames
[T, H, W] of one drive have the times t_s [T].
"""

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from codesign import events, lens, render
from codesign.report.chain_figures import draw_image
from codesign.system.objectives import edge_energy, edge_objective
from codesign.types import FlowField
from studies.frame.show import Panel

FULL_LIGHT = 255.0
THETA = 0.15
FADE_S = 0.01  # of the loop's traces
FULL_COUNT = 3.0  # events of full colour
POLARITIES = ("ON", "OFF")


def loop(frames: Tensor, t_s: Tensor) -> Iterator[Image.Image]:
    """Pictures of a loop, one per interval: frame, all events so far, events that fade."""
    counts = events.dense_counts(frames, t_s, events.SensorModel(THETA, THETA))
    grey = (255 * (frames[1:] / frames.max()) ** (1 / 2.2)).to(torch.uint8)
    side_by_side = (
        grey[..., None].expand(*grey.shape, 3),
        events.picture(counts.cumsum(0), 2 * FULL_COUNT),
        events.picture(events.decay(counts, t_s, FADE_S), FULL_COUNT),
    )
    for picture in torch.cat(side_by_side, 2).numpy():
        yield Image.fromarray(picture)


def lens_way(scene: Any, drive: Tensor, t_s: Tensor, steps: int) -> list[Panel]:
    """Curvatures of a triplet and the edge energy of its events, while gradients raise the edge
    energy (less a hundredth of the activity) from a lens out of focus.

    Args:
      drive: [T, 4, 4] poses of the camera before ``scene``.
    """
    geo = lens.load("cooke-triplet").scaled(0.22)
    variables = geo.variables("curvature", "focus", keep_efl=True)
    with torch.no_grad():
        variables[1] += 8.0  # of its own steps: out of focus
    camera = render.Camera(geo, 48, 48, 0.0185, samples_per_pixel=8)
    layer = events.layer("memory", events.SensorModel(THETA, THETA), learn=())
    optimiser = torch.optim.Adam(variables, lr=0.2)
    energies, curvatures = [], []
    for _ in range(steps):
        optimiser.zero_grad()
        volume = layer.volume(render.frames(camera, scene, drive)[None], t_s, 4)
        edge_objective(volume).backward()
        energies.append(float(edge_energy(volume).detach()))
        curvatures.append(geo.curvature_per_mm.detach().clone())
        optimiser.step()
    at = range(steps)
    changes = (torch.stack(curvatures) - curvatures[0]).T.numpy()
    named = {f"surface {k + 1}": (at, change) for k, change in enumerate(changes)}
    return [
        Panel(named, "step", "change of curvature (1/mm)"),
        Panel({"": (at, energies)}, "step", "edge energy (events² per px²)"),
    ]


def overlay(frame: Tensor, fields: dict[str, FlowField], every_px: int):
    """A frame [H, W] under arrows of the flow of each field, as long as the flow, in pixels."""
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, len(fields), figsize=(5 * len(fields), 4), layout="constrained")
    y, x = torch.meshgrid(
        *(torch.arange(every_px // 2, n, every_px) for n in frame.shape), indexing="ij"
    )
    how = {"angles": "xy", "scale_units": "xy", "scale": 1, "width": 0.004, "color": "#d95f02"}
    for axis, (title, field) in zip(np.atleast_1d(axes), fields.items(), strict=True):
        draw_image(axis, frame, [frame])
        seen = field.valid[0, y, x]
        axis.quiver(x[seen], y[seen], *field.flow_px[0, :, y, x].detach()[:, seen], **how)
        axis.set_title(title, fontsize=10)
    return figure


def sigmoids(frames: Tensor, sharpness: Sequence[float]) -> list[Panel]:
    """The sigmoid layer: its answer to one step of the log level, and its events over the drive, at
    several sharpnesses (times one over the threshold), beside the hard threshold per frame pair."""
    step = torch.linspace(-1, 3, 401, dtype=torch.float64)
    pair = torch.stack([0 * step, step]) * THETA
    curves = {
        f"k = {k:g}/θ": (step, events.soft(pair, THETA, sharpness=k / THETA, log_input=True)[0, 0])
        for k in sharpness
    }
    totals = [float(events.soft(frames, THETA, sharpness=k / THETA).sum()) for k in sharpness]
    change = events.lin_log(frames).diff(dim=0).abs()
    hard = [float((change >= THETA).sum())] * len(totals)
    return [
        Panel(
            {**curves, "hard": (step, (step >= 1).double())},
            "change of log level over the threshold θ",
            "ON events",
        ),
        Panel(
            {"sigmoid": (sharpness, totals), "hard": (sharpness, hard)},
            "sharpness k times θ",
            "events of the drive",
            log="xy",
        ),
    ]


def rates(frames: Tensor, t_s: Tensor, sensors: Mapping[str, events.SensorModel]) -> Panel:
    """Event rates of sensors over time, per polarity and pixel, the same noise for each."""
    series = {}
    for name, sensor in sensors.items():
        stream = events.simulate(frames, t_s, sensor, torch.Generator().manual_seed(0))
        middle_s, per_s = events.rates(events.to_counts(stream, t_s), t_s)
        for polarity, rate in zip(POLARITIES, per_s.T, strict=True):
            series[f"{polarity}, {name}"] = 1e3 * middle_s, rate / frames[0].numel()
    return Panel(series, "time (ms)", "events (per pixel and second)")


def smoothing(cutoffs_hz: Iterable[float]) -> list[Panel]:
    """A step of the log level behind the photoreceptor's low pass over time, and when it has come
    to 1 - 1/e over the time constant 1/(2 pi f) of each bandwidth f at full light."""
    at_s = torch.linspace(0, 0.02, 2001, dtype=torch.float64)
    level = (at_s > 0).double()
    reached = 1 - math.exp(-1)
    curves, constants_ms, delays_ms = {}, [], []
    for cutoff in cutoffs_hz:
        passed = events.low_pass(level, torch.full_like(level, FULL_LIGHT), at_s.diff(), cutoff)
        curves[f"{cutoff:g} Hz"] = 1e3 * at_s, passed
        constants_ms.append(1e3 / (2 * math.pi * cutoff))
        delays_ms.append(1e3 * float(at_s[passed >= reached][0]))
    return [
        Panel(curves, "time since the step (ms)", "share of the step", levels=[reached]),
        Panel(
            {"": (constants_ms, delays_ms)},
            "time constant 1/(2πf) (ms)",
            "delay until 63 % (ms)",
        ),
    ]


def thresholds(frames: Tensor, t_s: Tensor, thetas: Sequence[float]) -> Panel:
    """Events of the drive per polarity over the contrast threshold, and a line of their inverse."""
    sensors = [events.SensorModel(theta, theta) for theta in thetas]
    counts = [events.dense_counts(frames, t_s, sensor).sum((0, 2, 3)) for sensor in sensors]
    found = torch.stack(counts)
    series = {name: (thetas, found[:, k].numpy()) for k, name in enumerate(POLARITIES)}
    inverse = float(found[0].mean()) * thetas[0] / np.array(thetas)
    return Panel(
        {**series, "∝ 1/θ": (thetas, inverse)}, "threshold θ (log units)", "events", log="xy"
    )
