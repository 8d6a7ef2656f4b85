"""How well does event flow work on a recording: errors against true flow where there is one,
sharpness of the warped events always.

Recordings in the layout of the Event-Camera Dataset (events.txt with imu.txt, groundtruth.txt,
calib.txt), packets of events with flow files, and every event file the package reads
(docs/flow_recordings.md). Without --recording a small synthetic one is made and used, and the page
says so.
"""

import sys
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Literal

import torch

from codesign import events, flow
from codesign.errors import DomainError, FileFormatError, ShapeError
from codesign.flow import metrics
from codesign.flow.checkpoint import DELIVERED
from codesign.flow.checkpoint import load as load_network
from codesign.flow.sources import PacketOptions, read_packets, read_recording
from codesign.report.prose import counted
from studies.flow_recording import made, page, video
from studies.frame.config import check_least
from studies.frame.run import Run, StudyConfig, main
from studies.train_flow import peers  # noqa: F401  which network files know

SHOWN = 4  # packets with pictures
# options of the packets, by the same name
PASSED = (
    *("start_s", "events", "columns", "time_unit", "truth_unit", "gyro_axes"),
    *("calibration", "truth_pixels", "skip"),
)
MADE_PX = (180, 240)  # of the synthetic recording
MADE_QUICK_PX = (90, 120)


@dataclass(frozen=True)
class Config(StudyConfig):
    recording: Path | None = None
    """Folder with events.txt, folder of packets, event file, or zip archive; a synthetic one when
    left out."""
    truth: Path | None = None
    """True flow: a flow file, a folder of them, imu.txt or groundtruth.txt; what lies beside the
    events when left out."""
    estimator: str = "auto"
    """lk, refiner, a .safetensors file, or auto: lk and the delivered refiner where there is
    one."""
    window_ms: float | None = None
    """Length of the windows; the whole of a short recording or packet, else 20 ms."""
    start_s: float | None = None
    """Start of the first window, seconds after the first event; windows spread over the recording
    when left out."""
    packets: int | None = None
    """Most windows to look at; 10 where the recording does not say."""
    events: int | None = None
    """Cut windows by this number of events instead."""
    width_px: int | None = None
    """Width of the sensor, with height-px; otherwise what the files say, or the smallest known
    sensor (DAVIS240C first)."""
    height_px: int | None = None
    """Height of the sensor."""
    columns: str = "auto"
    """Order of the columns of event text, for example txyp."""
    time_unit: Literal["auto", "s", "ms", "us", "ns"] = "auto"
    """Unit of the times of event text; auto: seconds where they have a fraction, else
    microseconds."""
    truth_unit: Literal["px", "px/s"] = "px"
    """Unit of flow files."""
    truth_pixels: Literal["raw", "undistorted"] = "raw"
    """Whose pixels flow files belong to: the sensor's, or those of a pinhole, from which they are
    then carried to the sensor's by calib.txt."""
    skip: tuple[str, ...] = ()
    """Faults to leave out and count instead of refusing (events) or keeping (windows):
    events_back_in_time, events_off_sensor, windows_without_events, windows_across_gaps."""
    truth_interval_ms: float | None = None
    """What a flow file without times covers; needed where packets are cut into windows, else the
    whole packet."""
    gyro_axes: str = "xyz"
    """The camera's axes in terms of the gyroscope's, for example x-y-z."""
    calibration: Path | None = None
    """Camera file, instead of the calib.txt beside the events."""
    video: bool = False
    """Also write a video of the events with arrows of the flow, window after window (a tracker; see
    docs/flow.md)."""
    video_windows: int = 150
    """Most windows of the video."""
    video_fps: float = 15.0
    """Windows per second of the video."""
    bins: int = 8
    """Time bins of the event volumes for lk; networks have their own."""


def study(run: Run[Config]) -> None:
    config = run.config
    check_least(config, 2, "bins")
    estimators = load(config.estimator)
    recording = config.recording
    if recording is None:
        recording = run.folder / "recording"
        run.say(
            "No --recording given: making a small synthetic one (a camera that turns before a photograph)."
        )
        made.make(
            recording, *((0.06, MADE_QUICK_PX) if config.quick else (0.2, MADE_PX)), config.seed
        )
    read = options(config)
    packets = read_packets(recording, config.truth, read)
    truths = [packet.truth for packet in packets if packet.truth is not None]
    if truths and not any(bool(truth.valid.any()) for truth in truths):
        raise FileFormatError("no true flow has a number that is finite; is it the right file?")
    run.say(f"{counted(len(packets), 'packet')}; {'; '.join(packets[0].notes)}")
    rows = []
    with run.progress(len(packets) * len(estimators), "packets") as progress:
        for number, packet in enumerate(packets):
            fields = {}
            for name, (estimate, bins) in estimators.items():
                fields[name], found = measured(packet, estimate, bins or config.bins)
                rows.append((packet, name, found))
                progress.advance()
            if number < SHOWN:
                run.figure(
                    page.pictures(packet, fields), f"packet_{number:02d}", page.caption(packet)
                )
    film = filmed(run, recording, estimators, read) if config.video else None
    page.show(run, packets, rows, tuple(estimators), film)


def filmed(run, recording, estimators, read):
    """The Film of a recording, by the last of the estimators; its figures are recorded."""
    name, (estimate, bins) = list(estimators.items())[-1]
    window_s = None if read.events else read.window_s or 0.02
    skip = ("windows_without_events",)
    tracker = flow.Tracker(estimate, window_s, read.events, bins or run.config.bins, skip=skip)
    film = video.write(run, read_recording(recording, read), tracker, name, read.start_s or 0.0)
    run.record(**film.metrics)
    return film


def load(name):
    """{name: (estimator, bins it needs, None: any)}."""
    closed_form = {"lk": (partial(flow.estimate_lk, clock="events"), None)}
    if name == "auto" and DELIVERED["refiner"].is_file():
        return closed_form | load("refiner")
    if name in ("lk", "auto"):
        return closed_form
    network = load_network(name).requires_grad_(False)
    return {
        name if name == "refiner" else Path(name).stem: (network, network.config.get("bins", 8))
    }


def options(config):
    height, width = config.height_px, config.width_px
    if (width is None) != (height is None):
        raise DomainError("give both --width-px and --height-px, or neither.")
    size = None if width is None else (height, width)
    window_ms = config.window_ms
    if config.recording is None:
        size = MADE_QUICK_PX if config.quick else MADE_PX
        if config.events is None:
            window_ms = window_ms or 20.0
    times_ms = {"window_s": window_ms, "truth_interval_s": config.truth_interval_ms}
    times_s = {name: None if ms is None else ms * 1e-3 for name, ms in times_ms.items()}
    same = {name: getattr(config, name) for name in PASSED}
    return PacketOptions(count=config.packets, size_px=size, **times_s, **same)


@torch.no_grad()
def measured(packet, estimate, bins):
    """(FlowField, {figure: value}) of a packet; only figures that are defined (truth, events)."""
    volume = events.from_stream(packet.stream, packet.t0_us, packet.t1_us, bins)
    field = estimate(volume)
    found = {}
    span = (packet.t0_us, packet.t1_us)
    if packet.truth is not None:
        truth = packet.truth.flow_px
        if truth.shape != field.flow_px.shape:
            raise ShapeError(
                f"{packet.name}: the true flow has shape {list(truth.shape)}, the estimate "
                f"{list(field.flow_px.shape)}; give the sensor's size."
            )
        both = packet.truth.valid & metrics.event_mask(volume)
        # what rotation alone says is no truth where the camera translates
        pair = field.flow_px, truth
        if both.any() and packet.translates:
            found["rotation_difference_px"] = metrics.aee(*pair, both)
        elif both.any():
            found["aee_px"] = metrics.aee(*pair, both)
            found["zero_aee_px"] = metrics.aee(torch.zeros_like(truth), truth, both)
            found["outlier_percent"] = metrics.outlier_percent(*pair, both)
            found["angular_error_deg"] = metrics.angular_error_deg(*pair, both)
        if packet.truth.valid.any() and not packet.translates:
            found["aee_dense_px"] = metrics.aee(*pair, packet.truth.valid)
        known = _where(packet.stream, packet.truth.valid[0])
        if len(known):
            found["truth_fwl"] = metrics.fwl(known, truth, *span)
            found["fwl_where_known"] = metrics.fwl(known, field.flow_px, *span)
    if len(packet.stream):
        for name, sharpness in (("fwl", metrics.fwl), ("rsat", metrics.rsat)):
            # undefined for few events: as many on every pixel, all at the start, all moved off
            with suppress(DomainError):
                found[name] = sharpness(packet.stream, field.flow_px, *span)
    return field, {name: float(value) for name, value in found.items()}


def _where(stream, valid):
    """The events on pixels [H, W] that are valid."""
    kept = valid.to(stream.x.device)[stream.y.long(), stream.x.long()]
    return replace(
        stream, **{name: getattr(stream, name)[kept] for name in ("t_us", "x", "y", "p")}
    )


if __name__ == "__main__":
    sys.exit(main(study, Config))
