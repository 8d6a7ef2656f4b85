"""How well does event flow work on a recording: errors against true flow where there is one, sharpness of the
warped events always.

Recordings in the layout of the Event-Camera Dataset (events.txt with imu.txt, groundtruth.txt, calib.txt),
packets of events with flow files, and every event file the package reads (docs/flow_recordings.md). Without
--recording a small synthetic one is made and used, and the page says so.
"""

import statistics
import sys
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal

import torch

from codesign import events, flow
from codesign.errors import DomainError, ShapeError
from codesign.flow import metrics
from codesign.flow.checkpoint import DELIVERED
from codesign.flow.checkpoint import load as load_network
from codesign.flow.sources import PacketOptions, read_packets, read_recording
from studies.flow_recording import doubts, made, video
from studies.flow_recording import figures as drawn
from studies.frame.run import Run, StudyConfig, main

SHOWN = 4  # packets with pictures
UNITS = {
    "aee_px": "AEE, px",
    "rotation_difference_px": "difference from the flow of rotation alone, px",
    "aee_dense_px": "AEE everywhere, px",
    "zero_aee_px": "AEE of zero flow, px",
    "outlier_percent": "outliers, %",
    "angular_error_deg": "angular error, degrees",
    "fwl": "FWL",
    "rsat": "RSAT",
    "truth_fwl": "FWL of the true flow",
}


@dataclass(frozen=True)
class Config(StudyConfig):
    recording: Path | None = None
    """Folder with events.txt, folder of packets, event file, or zip archive; a synthetic one when left
    out."""
    truth: Path | None = None
    """True flow: a flow file, a folder of them, imu.txt or groundtruth.txt; what lies beside the events when
    left out."""
    estimator: str = "auto"
    """lk, refiner, a .safetensors file, or auto: lk and the delivered refiner where there is one."""
    window_ms: float | None = None
    """Length of the windows; the whole of a short recording or packet, else 20 ms."""
    start_s: float | None = None
    """Start of the first window, seconds after the first event; windows spread over the recording when left
    out."""
    packets: int | None = None
    """Most windows to look at; 10 where the recording does not say."""
    events: int | None = None
    """Cut windows by this number of events instead."""
    width_px: int | None = None
    """Width of the sensor, with height-px; otherwise what the files say, or the smallest known sensor
    (DAVIS240C first)."""
    height_px: int | None = None
    """Height of the sensor."""
    columns: str = "auto"
    """Order of the columns of event text, for example txyp."""
    time_unit: Literal["auto", "s", "ms", "us", "ns"] = "auto"
    """Unit of the times of event text; auto: seconds where they have a fraction, else microseconds."""
    truth_unit: Literal["px", "px/s"] = "px"
    """Unit of flow files."""
    truth_pixels: Literal["raw", "undistorted"] = "raw"
    """Whose pixels flow files belong to: the sensor's, or those of a pinhole, from which they are then carried to
    the sensor's by calib.txt."""
    skip: tuple[str, ...] = ()
    """Faults to leave out and count instead of refusing (events) or keeping (windows): events_back_in_time,
    events_off_sensor, windows_without_events, windows_across_gaps."""
    truth_interval_ms: float | None = None
    """What a flow file without times covers; the whole packet when left out."""
    gyro_axes: str = "xyz"
    """The camera's axes in terms of the gyroscope's, for example x-y-z."""
    calibration: Path | None = None
    """Camera file, instead of the calib.txt beside the events."""
    video: bool = False
    """Also write a video of the events with arrows of the flow, window after window (a tracker; see docs/flow.md)."""
    video_windows: int = 150
    """Most windows of the video."""
    video_fps: float = 15.0
    """Windows per second of the video."""
    bins: int = 8
    """Time bins of the event volumes for lk; networks have their own."""


def study(run: Run[Config]) -> None:
    config = run.config
    estimators = load(config.estimator)
    recording = config.recording
    synthetic = config.recording is None
    if recording is None:
        recording = run.folder / "recording"
        duration_s, size_px = (0.06, (90, 120)) if config.quick else (0.2, (180, 240))
        run.say(
            "No --recording given: making a small synthetic one (a camera that turns in a rendered room)."
        )
        made.make(recording, duration_s, size_px, config.seed)
    packets = read_packets(recording, config.truth, options(config, synthetic))
    run.say(f"{len(packets)} packet(s); {'; '.join(packets[0].notes)}")
    rows = []
    with run.progress(len(packets) * len(estimators), "packets") as progress:
        for number, packet in enumerate(packets):
            fields = {}
            for name, (estimate, bins) in estimators.items():
                fields[name], found = measured(packet, estimate, bins)
                rows.append((packet, name, found))
                progress.advance()
            if number < SHOWN:
                run.figure(drawn.packet(packet, fields), f"packet_{number:02d}", caption(packet))
    made_video = config.video and filmed(run, recording, estimators, options(config, synthetic))
    show(run, packets, rows, tuple(estimators), synthetic, made_video)


def filmed(run, recording, estimators, read):
    """The Film of a recording, by the last of the estimators; its figures are recorded."""
    name, (estimate, bins) = list(estimators.items())[-1]
    held = read_recording(recording, read)
    tracker = flow.Tracker(
        estimate,
        None if read.events else read.window_s or 0.02,
        read.events,
        bins or run.config.bins,
        skip=("windows_without_events",),
    )
    film = video.write(run, held, tracker, name, read.start_s or 0.0)
    run.record(**film.metrics)
    return film


def load(name):
    """{name: (estimator, bins it needs, None: any)}."""
    closed_form = {"lk": (partial(flow.estimate_lk, clock="events"), None)}
    if name == "lk":
        return closed_form
    if name == "auto":
        return closed_form | load("refiner") if DELIVERED["refiner"].is_file() else closed_form
    network = load_network(name).requires_grad_(False)
    return {name if name == "refiner" else Path(name).stem: (network, network.config.get("bins", 8))}


def options(config, synthetic):
    """PacketOptions of the command line."""
    if (config.width_px is None) != (config.height_px is None):
        raise DomainError("give both --width-px and --height-px, or neither.")
    size = (
        (config.height_px, config.width_px)
        if config.height_px is not None and config.width_px is not None
        else None
    )
    if synthetic:
        size = (90, 120) if config.quick else (180, 240)

    def seconds(ms):
        return None if ms is None else ms * 1e-3

    return PacketOptions(
        seconds(config.window_ms or (20.0 if synthetic else None)),
        config.start_s,
        config.packets,
        config.events,
        size,
        config.columns,
        config.time_unit,
        config.truth_unit,
        seconds(config.truth_interval_ms),
        config.gyro_axes,
        config.calibration,
        config.truth_pixels,
        config.skip,
    )


@torch.no_grad()
def measured(packet, estimate, bins):
    """(FlowField, {figure: value}) of a packet; a figure is None where it is not defined (no truth, no
    events)."""
    volume = events.from_stream(packet.stream, packet.t0_us, packet.t1_us, bins or 8)
    field = estimate(volume)
    found: dict[str, Any] = dict.fromkeys(UNITS)
    if packet.truth is not None:
        truth = packet.truth.flow_px
        valid = packet.truth.valid
        if truth.shape != field.flow_px.shape:
            raise ShapeError(
                f"{packet.name}: the true flow has shape {list(truth.shape)}, the estimate "
                f"{list(field.flow_px.shape)}; give the sensor's size."
            )
        both = valid & (volume.counts.sum((1, 2)) > 0)
        if packet.translates:  # what rotation alone says is no truth then
            if bool(both.any()):
                found["rotation_difference_px"] = float(metrics.aee(field.flow_px, truth, both))
        else:
            found |= errors(field.flow_px, truth, valid, both)
        if len(packet.stream):
            found["truth_fwl"] = float(metrics.fwl(packet.stream, truth, packet.t0_us, packet.t1_us))
    if len(packet.stream):
        found["fwl"] = float(metrics.fwl(packet.stream, field.flow_px, packet.t0_us, packet.t1_us))
        found["rsat"] = float(metrics.rsat(packet.stream, field.flow_px, packet.t0_us, packet.t1_us))
    return field, found


def errors(flow_px, truth, valid, both):
    """{figure: value} of the errors where the truth is valid, and where events are too (``both``)."""
    found = {}
    if bool(both.any()):
        found["aee_px"] = float(metrics.aee(flow_px, truth, both))
        found["zero_aee_px"] = float(metrics.aee(torch.zeros_like(truth), truth, both))
        found["outlier_percent"] = float(metrics.outlier_percent(flow_px, truth, both))
        found["angular_error_deg"] = float(metrics.angular_error_deg(flow_px, truth, both))
    if bool(valid.any()):
        found["aee_dense_px"] = float(metrics.aee(flow_px, truth, valid))
    return found


def caption(packet):
    length = 1e-3 * (packet.t1_us - packet.t0_us)
    return f"{packet.name}: {len(packet.stream)} events in {length:.2f} ms. {'; '.join(packet.notes)}. Hue is the direction of the flow, saturation its length; black where nothing is known."


def show(run, packets, rows, names, synthetic, made_video):
    """Figures, tables and page."""
    for name in names:
        mine = [found for _, estimator, found in rows if estimator == name]
        key = name.replace("-", "_").replace(".", "_")
        for figure in UNITS:
            values = [found[figure] for found in mine if found[figure] is not None]
            if values:
                run.record(**{f"{key}_{figure}": statistics.fmean(values)})
        sharp = [found["fwl"] for found in mine if found["fwl"] is not None]
        if sharp:
            run.record(
                **{
                    f"{key}_fwl_least": min(sharp),
                    f"{key}_fwl_above_1_share": sum(value > 1 for value in sharp) / len(sharp),
                }
            )
        worse = [found["aee_px"] > found["zero_aee_px"] for found in mine if found["aee_px"] is not None]
        if worse:
            run.record(**{f"{key}_worse_than_zero_share": sum(worse) / len(worse)})
    run.record(packets=len(packets), **doubts.counts(packets, rows, names[-1]))
    main_one = (
        names[-1].replace("-", "_").replace(".", "_")
    )  # the trained network where there is one; its figures also under plain names
    run.record(
        **{
            figure: run.metrics[f"{main_one}_{figure}"]
            for figure in UNITS
            if f"{main_one}_{figure}" in run.metrics
        }
    )
    for label, figure, unit in (("AEE where events are", "aee_px", " px"), ("FWL", "fwl", "")):
        if f"{main_one}_{figure}" in run.metrics:
            note = (
                f"zero flow: {run.metrics[f'{main_one}_zero_aee_px']:.3f} px"
                if figure == "aee_px"
                else f"above 1 in {100 * run.metrics[f'{main_one}_fwl_above_1_share']:.0f} % of packets"
            )
            run.card(f"{label}, {names[-1]}", f"{run.metrics[f'{main_one}_{figure}']:.3f}{unit}", note)
    made_up = (
        "**The recording is synthetic**: a camera that turns in a rendered room; the simulator's events, "
        "the gyroscope's exact rates. "
        if synthetic
        else ""
    )
    run.section("Packets", made_up + " ".join(f"{note}." for note in packets[0].notes))
    columns = ("packet", "ms", "events", "estimator", *UNITS.values())
    table = [
        (packet.name, 1e-3 * (packet.t1_us - packet.t0_us), len(packet.stream), name, *found.values())
        for packet, name, found in rows
    ]
    legend = "AEE, outliers (above 3 px and 5 % of the true length) and angles where events are and the truth is valid, unless said otherwise. "
    run.table(
        "Every packet",
        columns,
        table,
        legend + "FWL above 1: sharper than without flow; RSAT below 1 likewise.",
    )
    means = [
        (name, *(run.metrics.get(f"{name.replace('-', '_').replace('.', '_')}_{figure}") for figure in UNITS))
        for name in names
    ]
    run.table("Means over packets", ("estimator", *UNITS.values()), means)
    for sentence in doubts.sentences(packets, rows, names[-1]):
        run.text(sentence)
    if made_video:
        run.section("Video", made_video.sentence)
        run.video(made_video.path.name, made_video.caption)
    source = "a synthetic recording" if synthetic else f"`{run.config.recording}`"
    run.finish("Event flow on a recording", f"{len(packets)} packets of {source}.")


if __name__ == "__main__":
    sys.exit(main(study, Config))
