"""Calls of every public function of flow with one value exchanged for another that somebody might give."""

import math
import random
from collections.abc import Callable
from dataclasses import dataclass, is_dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from codesign import flow
from codesign.events import FastSigmoid, write
from codesign.events.stream import ordered
from codesign.flow import baselines, checkpoint, contrast, losses, metrics, sources, warp
from codesign.flow.export import evenly_timed
from codesign.flow.sources import attitude, calibration, chain, collate, rectified, truth
from codesign.types import EventStream, FlowField

BINS = 2
HEIGHT = 16
WIDTH = 18


@dataclass(frozen=True)
class Call:
    """A function with arguments that are right."""

    function: Callable[..., Any]
    given: dict[str, Any]


def calls(folder: Path) -> dict[str, Call]:
    """{name: Call} of the public functions of codesign.flow; files are written into ``folder``."""
    draw = torch.Generator().manual_seed(0)

    def rand(*shape):
        return torch.rand(*shape, generator=draw)

    volume = evenly_timed(rand(2, 2, BINS, HEIGHT, WIDTH), 0.02)
    flow_px = 4 * rand(2, 2, HEIGHT, WIDTH) - 2
    other_px = 4 * rand(2, 2, HEIGHT, WIDTH) - 2
    mask = rand(2, HEIGHT, WIDTH) > 0.3
    field = FlowField(flow_px, mask, 0.02, rand(2, HEIGHT, WIDTH))
    spread = replace(
        field,
        covariance_px2=torch.stack([1 + rand(2, HEIGHT, WIDTH)] * 3, 1)
        * torch.tensor([1, 0.1, 1])[:, None, None],
    )
    whole = FlowField(other_px, mask, 0.02)
    n = 60
    columns = (
        torch.arange(n) * 300,
        torch.arange(n) % WIDTH,
        torch.arange(n) % HEIGHT,
        2 * (torch.arange(n) % 2) - 1,
    )
    stream = ordered(*columns, HEIGHT, WIDTH)
    tracks = contrast.volume_tracks(volume, flow_px)
    jacobian = contrast.warp_jacobian(tracks, BINS, 0.5)
    directions = metrics.pinhole_directions(HEIGHT, WIDTH, 20.0)
    network = flow.FlowNetEvents(BINS, width=4.0)
    spiking = flow.SpikeFlowNet(BINS, width=4.0)
    refiner = flow.Refiner(BINS, width=16, steps=1)
    flow.save(network, folder / "n.safetensors")
    for name in ("f.flo", "f.png"):
        flow.write_flow(folder / name, flow_px[0])
    np.save(folder / "f.npy", flow_px[0].numpy())
    lines = [
        f"{t * 1e-6:.6f} {x} {y} {(p + 1) // 2}"
        for t, x, y, p in zip(*(c.tolist() for c in columns), strict=True)
    ]
    (folder / "recording").mkdir()
    (folder / "recording" / "events.txt").write_text("\n".join(lines) + "\n")
    (folder / "recording" / "calib.txt").write_text("20 20 8.5 7.5 0 0 0 0 0\n")
    motion = np.column_stack([np.arange(40) * 1e-3, np.zeros((40, 6))])
    np.savetxt(folder / "recording" / "imu.txt", motion)
    np.savetxt(folder / "groundtruth.txt", np.column_stack([motion[:, :7], np.ones(40)]))
    np.savetxt(folder / "flow.txt", np.ones((HEIGHT * WIDTH, 2)))
    write(folder / "e.npz", stream)
    options = sources.PacketOptions(size_px=(HEIGHT, WIDTH))
    times = torch.linspace(0, 1, BINS)
    return {
        name: Call(function, given)
        for name, function, given in (
            (
                "estimate_lk",
                flow.estimate_lk,
                {
                    "volume": volume,
                    "model": "affine",
                    "prior_px": 3.0,
                    "levels_px": (2.0, 1.0),
                    "steps": 1,
                    "noise_floor": 0.02,
                    "start_px": flow_px,
                },
            ),
            ("FlowNetEvents()", network, {"volume": volume}),
            ("ECN()", flow.ECN(BINS, width=4.0), {"volume": volume}),
            ("IDNet()", flow.IDNet(BINS, width=4.0), {"volume": volume}),
            (
                "Tracker",
                flow.Tracker,
                {"estimate": network, "window_s": 0.01, "bins": BINS, "size_px": (HEIGHT, WIDTH), "skip": ()},
            ),
            (
                "Tracker.add",
                lambda chunk: list(flow.Tracker(network, events=20).track([chunk])),
                {"chunk": stream},
            ),
            (
                "Tracker.add arrays",
                lambda chunk: list(flow.Tracker(network, events=20, size_px=(HEIGHT, WIDTH)).track([chunk])),
                {"chunk": columns},
            ),
            ("read_recording", sources.read_recording, {"path": folder / "recording", "options": options}),
            ("SpikeFlowNet()", spiking, {"volume": volume}),
            ("ECN()", flow.ECN(BINS, width=4.0), {"volume": volume}),
            ("IDNet()", flow.IDNet(BINS, width=4.0, iterations=2), {"volume": volume}),
            ("ECN", flow.ECN, {"bins": 2, "width": 4.0, "hidden": 4, "seed": 0}),
            ("ECN.with_weights", flow.ECN.with_weights, {"weights": 30_000, "bins": 2, "seed": 0}),
            ("IDNet", flow.IDNet, {"bins": 2, "width": 4.0, "hidden": 4, "iterations": 2, "seed": 0}),
            (
                "IDNet.with_weights",
                flow.IDNet.with_weights,
                {"weights": 40_000, "bins": 2, "seed": 0, "iterations": 2},
            ),
            ("Refiner()", refiner, {"volume": volume}),
            ("Refiner.predictions", refiner.predictions, {"volume": volume, "start_px": flow_px}),
            ("SpikeFlowNet.encode", spiking.encode, {"halves": rand(1, 4, 16, 16, 1)}),
            ("FlowNetEvents", flow.FlowNetEvents, {"bins": 2, "width": 4.0, "hidden": 4, "seed": 0}),
            (
                "FlowNetEvents.with_weights",
                flow.FlowNetEvents.with_weights,
                {"weights": 30_000, "bins": 2, "seed": 0},
            ),
            (
                "SpikeFlowNet",
                flow.SpikeFlowNet,
                {"bins": 2, "width": 4.0, "hidden": 4, "threshold": 0.75, "surrogate_width": 0.75, "seed": 0},
            ),
            (
                "SpikeFlowNet.with_weights",
                flow.SpikeFlowNet.with_weights,
                {"weights": 30_000, "bins": 2, "seed": 0},
            ),
            ("Refiner", flow.Refiner, {"bins": 2, "width": 16, "steps": 1}),
            ("to_halves", baselines.to_halves, {"counts": volume.counts}),
            ("from_halves", baselines.from_halves, {"halves": rand(1, 4, 4, 4, 2)}),
            ("rescale_flow", baselines.rescale_flow, {"flow_px": flow_px, "size": (20, 20)}),
            (
                "integrate_and_fire",
                baselines.integrate_and_fire,
                {"current": rand(3, 4), "threshold": 0.5, "surrogate": FastSigmoid.unit(0.5)},
            ),
            ("along_flow", warp.along_flow, {"bins": volume.counts, "flow_px": flow_px, "time": times}),
            (
                "volume_tracks",
                contrast.volume_tracks,
                {"volume": volume, "flow_px": flow_px, "carry_steps": 1},
            ),
            (
                "stream_tracks",
                contrast.stream_tracks,
                {"stream": stream, "flow_px": flow_px[0], "t0_us": 0, "t1_us": 20_000, "carry_steps": 1},
            ),
            ("count_image", contrast.count_image, {"tracks": tracks, "at": 1.0}),
            ("time_image", contrast.time_image, {"tracks": tracks, "at": 1.0}),
            ("nearest_images", contrast.nearest_images, {"tracks": tracks, "at": 1.0}),
            ("leaving", contrast.leaving, {"tracks": tracks, "at": 1.0}),
            (
                "smooth_image",
                contrast.smooth_image,
                {"tracks": tracks, "at": 1.0, "weight": rand(2, BINS * HEIGHT * WIDTH)},
            ),
            ("still_image", contrast.still_image, {"counts": volume.counts}),
            ("warp_jacobian", contrast.warp_jacobian, {"tracks": tracks, "bins": BINS, "at": 0.5}),
            ("area_change", contrast.area_change, {"jacobian": jacobian}),
            ("sharpness", contrast.sharpness, {"image": volume.counts[:, :, 0]}),
            ("charbonnier", losses.charbonnier, {"squared": rand(3), "epsilon": 0.01, "exponent": 0.5}),
            (
                "supervised_loss",
                losses.supervised_loss,
                {
                    "predictions": [field, spread],
                    "truth": whole,
                    "gamma": 0.8,
                    "epsilon": 0.01,
                    "unit_per_px": 1.0,
                },
            ),
            (
                "likelihood_loss",
                losses.likelihood_loss,
                {
                    "predictions": [field, spread],
                    "truth": whole,
                    "gamma": 0.8,
                    "floor_px": 0.1,
                    "prior_px": 8.0,
                },
            ),
            ("relative_unit", losses.relative_unit, {"truth": whole, "floor_px": 1.0}),
            ("require_valid", losses.require_valid, {"truth": whole}),
            *(
                (
                    function.__name__,
                    function,
                    {"volume": volume, "flow_px": flow_px, **more, "references": ((0.0, 0.5), (1.0, 0.5))},
                )
                for function, more in (
                    (losses.contrast_loss, {"carry_steps": 1}),
                    (losses.plain_contrast_loss, {"carry_steps": 0}),
                    (losses.collapse_penalty, {"least": 0.8}),
                )
            ),
            (
                "photometric_loss",
                losses.photometric_loss,
                {
                    "frames": 255 * rand(2, 2, HEIGHT, WIDTH),
                    "flow_px": flow_px,
                    "epsilon": 1e-3,
                    "exponent": 0.45,
                },
            ),
            (
                "smoothness_loss",
                losses.smoothness_loss,
                {
                    "flow_px": flow_px,
                    "frame": 255 * rand(2, HEIGHT, WIDTH),
                    "epsilon": 1e-3,
                    "exponent": 0.45,
                    "edge": 0.1,
                },
            ),
            *(
                (function.__name__, function, {"flow": flow_px, "truth": other_px, "mask": mask})
                for function in (metrics.aee, metrics.angular_error_deg)
            ),
            ("endpoint_error", metrics.endpoint_error, {"flow": flow_px, "truth": other_px}),
            ("zero_flow_error", metrics.zero_flow_error, {"truth": other_px, "mask": mask}),
            (
                "outlier_percent",
                metrics.outlier_percent,
                {"flow": flow_px, "truth": other_px, "mask": mask, "pixels": 3.0, "share": 0.05},
            ),
            ("npe", metrics.npe, {"flow": flow_px, "truth": other_px, "pixels": 1.0, "mask": mask}),
            (
                "ray_error_mrad",
                metrics.ray_error_mrad,
                {"flow": flow_px, "truth": other_px, "direction": directions, "mask": mask},
            ),
            ("mrad_per_pixel", metrics.mrad_per_pixel, {"direction": directions}),
            (
                "pinhole_directions",
                metrics.pinhole_directions,
                {
                    "height_px": 4,
                    "width_px": 5,
                    "focal_px": 20.0,
                    "centre_px": (2.0, 1.5),
                    "dtype": torch.float64,
                },
            ),
            ("event_mask", metrics.event_mask, {"volume": volume}),
            ("masks", metrics.masks, {"volume": volume, "truth": whole}),
            (
                "fwl",
                metrics.fwl,
                {
                    "stream": stream,
                    "flow_px": flow_px[0],
                    "t0_us": 0,
                    "t1_us": 20_000,
                    "at": 1.0,
                    "carry_steps": 0,
                },
            ),
            (
                "rsat",
                metrics.rsat,
                {"stream": stream, "flow_px": flow_px[0], "t0_us": 0, "t1_us": 20_000, "carry_steps": 0},
            ),
            ("evenly_timed", evenly_timed, {"counts": volume.counts, "interval_s": 0.02}),
            (
                "export",
                flow.export,
                {
                    "network": network,
                    "path": folder / "program.pt2",
                    "height_px": 16,
                    "width_px": 16,
                    "batch": 1,
                },
            ),
            (
                "save",
                flow.save,
                {"network": network, "path": folder / "other.safetensors", "metadata": {"a": 1}},
            ),
            ("load", flow.load, {"name_or_path": folder / "n.safetensors"}),
            ("read", checkpoint.read, {"path": folder / "n.safetensors"}),
            *(
                (
                    f"write_flow {kind}",
                    flow.write_flow,
                    {"path": folder / f"again.{kind}", "flow_px": flow_px[0], "valid": mask[0]},
                )
                for kind in ("png", "flo")
            ),
            *(
                (f"read_flow {kind}", flow.read_flow, {"path": folder / f"f.{kind}"})
                for kind in ("png", "flo")
            ),
            (
                "read_packets",
                sources.read_packets,
                {"path": folder / "recording", "truth_path": folder / "f.flo", "options": options},
            ),
            (
                "read_packets of text",
                sources.read_packets,
                {"path": folder / "recording", "truth_path": folder / "flow.txt", "options": options},
            ),
            (
                "read_packets of motion",
                sources.read_packets,
                {
                    "path": folder / "recording" / "events.txt",
                    "truth_path": folder / "recording" / "imu.txt",
                    "options": options,
                },
            ),
            (
                "read_packets of arrays",
                sources.read_packets,
                {"path": folder / "e.npz", "truth_path": folder / "f.npy", "options": options},
            ),
            (
                "read_text_events",
                sources.read_text_events,
                {
                    "path": folder / "recording" / "events.txt",
                    "size": (HEIGHT, WIDTH),
                    "told": (HEIGHT, WIDTH),
                    "told_by": "it",
                    "columns": "txyp",
                    "time_unit": "s",
                },
            ),
            (
                "open_windows",
                sources.open_windows,
                {"folder": folder, "bins": 2, "window_frames": 1, "crop_px": (4, 4), "seed": 0},
            ),
            ("read_truth", truth.read_truth, {"path": folder / "f.npy", "size_px": (HEIGHT, WIDTH)}),
            ("read_calibration", calibration.read_calibration, {"path": folder / "recording" / "calib.txt"}),
            (
                "read_gyroscope",
                attitude.read_gyroscope,
                {"path": folder / "recording" / "imu.txt", "axes": np.eye(3)},
            ),
            ("read_poses", attitude.read_poses, {"path": folder / "groundtruth.txt"}),
            ("signed_axes", calibration.signed_axes, {"text": "xyz"}),
            ("chained", chain.chained, {"flows_px": flow_px, "valid": mask, "hidden": mask}),
            ("bin_times", collate.bin_times, {"bins": 2, "seconds": 0.1}),
            (
                "splatted",
                rectified.splatted,
                {
                    "t_us": columns[0],
                    "x_px": rand(n),
                    "y_px": rand(n),
                    "on": columns[3] > 0,
                    "t0_us": 0,
                    "t1_us": 20_000,
                    "bins": 2,
                    "height_px": HEIGHT,
                    "width_px": WIDTH,
                },
            ),
        )
    }


def anything(draw: random.Random) -> Any:
    """A value of a kind that few arguments take."""
    return draw.choice(
        [
            None,
            "text",
            "",
            -1,
            0,
            3,
            2.5,
            math.nan,
            math.inf,
            -math.inf,
            True,
            [],
            [1, 2],
            (3, 4),
            {},
            {"a": 1},
            b"x",
            1j,
        ]
        + [
            torch.zeros(()),
            torch.ones(3),
            torch.ones(2, 2),
            np.ones((2, 3)),
            object(),
            print,
            10**30,
            "1",
            -0.5,
        ]
    )


def bent(tensor: torch.Tensor, draw: random.Random) -> Any:
    """A tensor of another shape, type, or with other values."""
    numbers = tensor if tensor.dtype != torch.bool else tensor.float()
    axis = draw.randrange(tensor.ndim) if tensor.ndim else 0
    ways = [
        lambda: tensor[None],
        lambda: tensor.flatten(),
        lambda: tensor.tolist(),
        lambda: tensor.numpy(),
        lambda: tensor.to_sparse(),
        lambda: tensor.to("meta"),
        lambda: numbers.long(),
        lambda: numbers.to(torch.int8),
        lambda: numbers.half(),
        lambda: numbers.double(),
        lambda: numbers.to(torch.complex64),
        lambda: tensor > 0,
        lambda: numbers.float() * math.nan,
        lambda: numbers.float() + math.inf,
        lambda: -numbers.float(),
        lambda: numbers.float() * 1e30,
        lambda: torch.zeros_like(tensor),
    ]
    if tensor.ndim:
        ways += [
            lambda: tensor[0],
            lambda: tensor.narrow(axis, 0, 0),
            lambda: tensor.narrow(axis, 0, 1),
            lambda: torch.cat([tensor, tensor], axis),
            lambda: tensor.movedim(axis, 0),
        ]
    return draw.choice(ways)()


def damaged(path: Path, draw: random.Random, folder: Path) -> Any:
    """A path to nothing, or to a copy of the file that is cut, changed, or of another ending."""
    if path.is_dir() or not path.exists():
        return draw.choice(
            [
                folder / "absent",
                folder / "f.flo",
                str(folder),
                folder / "no" / "where" / "x.png",
                Path(),
                "\0",
            ]
        )
    content = path.read_bytes()
    at = draw.randrange(len(content))
    content = draw.choice(
        [
            b"",
            content[:at],
            content[at:],
            content[:at] + bytes([draw.randrange(256)]) + content[at + 1 :],
            content + content,
            draw.randbytes(50),
        ]
    )
    place = folder / f"damaged{draw.randrange(10**9)}"
    place.mkdir()
    suffix = draw.choice([path.suffix] * 4 + [".txt", ".npy", ".png", ".xyz", ".mat", ".npz"])
    copy = place / f"{path.stem}{suffix}"
    copy.write_bytes(content)
    return draw.choice([copy, copy, copy, str(copy), folder])


def exchanged(value: Any, draw: random.Random, folder: Path) -> Any:
    """Another value in the place of a right one."""
    if draw.random() < 0.3:
        return anything(draw)
    if isinstance(value, torch.Tensor):
        return bent(value, draw)
    if is_dataclass(value) and not isinstance(value, type):
        name = draw.choice([name for name in vars(value) if not name.startswith("_")])
        return replace(value, **{name: exchanged(getattr(value, name), draw, folder)})
    if isinstance(value, Path):
        return damaged(value, draw, folder)
    if isinstance(value, (list, tuple)) and value:
        at = draw.randrange(len(value))
        return draw.choice(
            [value[:at], type(value)([*value[:at], exchanged(value[at], draw, folder), *value[at + 1 :]])]
        )
    if isinstance(value, (int, float)) and not isinstance(value, bool):
        return draw.choice(
            [
                0,
                -value,
                value * 1e30,
                value + 0.5,
                math.nan,
                math.inf,
                str(value),
                None,
                torch.tensor(value),
                np.float32(value),
            ]
        )
    return anything(draw)


def wrong(call: Call, draw: random.Random, folder: Path) -> tuple[str, dict[str, Any]]:
    """(name of the argument, arguments) of the call with one argument exchanged."""
    name = draw.choice(list(call.given))
    return name, {**call.given, name: exchanged(call.given[name], draw, folder)}


__all__ = ["Call", "EventStream", "calls", "wrong"]
