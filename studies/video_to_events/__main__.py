"""Events of an event camera that looks at a video, a folder of pictures, a stack of arrays, or a raw
recording.

Time: t of the events is that of the frames: of the container, of --fps, or of --timestamps. Light: digital
  values are taken as intensities, as v2e does;
--linear undoes the sRGB gamma first. Colour becomes luminance (0.2126 red, 0.7152 green, 0.0722 blue).
Memory: frames are read, simulated and stored in chunks, so memory does not grow with the video. Event files
  are written whole at the end, which takes 0.05 GB of memory per million events (0.13 GB for .raw), and 13 MB
  of disk until then; with --events and no name nothing grows. See docs/event_views.md.
"""

import math
import sys
import time
from contextlib import closing
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Literal

import torch

from codesign import events
from codesign.errors import DomainError
from codesign.events.sources.opening import open_frames
from codesign.optional import require
from codesign.types import EventStream
from studies.frame.run import Run, StudyConfig, main
from studies.video_to_events import page as pages
from studies.video_to_events.clock import frame_times
from studies.video_to_events.light import Light
from studies.video_to_events.log import EventLog
from studies.video_to_events.pictures import View
from studies.video_to_events.sensor import chosen_sensor, with_sensor_options
from studies.video_to_events.state import Progress
from studies.video_to_events.steps import Steps
from studies.video_to_events.upsample import pieces

PIXELS_PER_CHUNK = 2**20  # worked on together
SECONDS_BETWEEN_SAVES = 20.0
QUICK_FRAMES = 40
LOG = "events.partial"


@dataclass(frozen=True)
class Options(StudyConfig):
    """Options that do not belong to the sensor."""

    input: Path | None = None
    """Video (.mp4, .avi, .mov, .mkv, .gif …), folder of pictures (PNG, JPEG, TIFF, BMP, 8 or 16 bits), stack
    (.npy, .npz), or Photron recording (.mraw)."""
    fps: float | None = None
    """Frames per second; in place of the container's, and needed for pictures and stacks without times."""
    timestamps: Path | None = None
    """Text file with the time of every frame, one number per line; in place of --fps."""
    timestamp_unit: Literal["s", "ms", "us", "ns"] = "s"
    """Unit of --timestamps."""
    slow_motion: float = 1.0
    """How many times slower than life the input plays: 10 for 300 frames per second stored as 30."""
    start_s: float | None = None
    """Leave out frames before this time, in the time of the events (after --fps, --timestamps and
    --slow-motion)."""
    stop_s: float | None = None
    """Leave out frames after this time, likewise."""
    linear: bool = False
    """Undo the sRGB gamma, so that the sensor sees linear light; without it digital values are taken as they
    are, as in v2e."""
    white_level: float | None = None
    """Digital value of full light, 255 for the sensor; left out: 255 of 8 bits, 65535 of 16, and 255 of
    floats. 4095 for 12 bits stored in 16."""
    sensor_size: tuple[int, int] | None = None
    """Width and height of the sensor, pixels; frames are brought to it, stretched where the proportions
    differ. Left out: that of the frames."""
    upsample: float | None = None
    """Put frames between the frames, along their optical flow, until nothing moves by more than this many
    pixels from one to the next; 0.5 is good. Left out: none."""
    preset: str = "default"
    """Sensor: ideal (no noise), clean, noisy, or default: those of v2e and of its command line."""
    events: tuple[str, ...] = ("events.h5",)
    """Names of the event files, in the folder of the run; the extension says the format; no name, no file.
    0.05 GB of memory per million events."""
    preview: bool = True
    """Make the two videos, of events and of fading traces."""
    preview_fps: float = 30.0
    """Pictures per second of the videos."""
    preview_slowdown: float | None = None
    """How many times slower than the scene the videos play; left out: at life's speed, or slower until they
    last 10 s or show four pictures per frame."""
    preview_full_scale: float = 2.0
    """Events per pixel and picture that give full colour."""
    decay_tau_s: float | None = None
    """Time in which traces fade to 1/e, seconds of the scene; left out: three pictures of the video, and at
    least 1.5 frames of the input."""
    points: int = 20_000
    """Events drawn in the 3-D figure."""


Config: type[Options] = with_sensor_options(Options)


@torch.no_grad()
def study(run: Run[Options]) -> None:
    config = checked(run.config)
    if (run.folder / "report.html").exists():
        run.say(f"This run is complete: {run.folder / 'report.html'}")
        return
    assert config.input is not None
    sensor = chosen_sensor(config)
    source = open_frames(config.input)
    t_s, first, last, clock = frame_times(config, source, QUICK_FRAMES if config.quick else None)
    width, height = config.sensor_size or (source.width_px, source.height_px)
    check_outputs(run, config, height, width)
    light = Light(config.white_level or source.white, config.linear, config.sensor_size, run.device)
    state = Progress.load(
        run, first, config.seed, {"frames": last - first, "height_px": height, "width_px": width}
    )
    log = EventLog(run.path(LOG), state.events, height, width)
    steps = Steps(sensor, state)

    run.on_interrupt(lambda: state.save(run, steps))
    size = max(2, PIXELS_PER_CHUNK // max(height * width, source.height_px * source.width_px))
    chunks = math.ceil((last - first) / size)
    done = (state.next_frame - first) // size
    saved = time.monotonic()
    with closing(source.read(state.next_frame)) as frames, run.progress(chunks, "chunks", done) as progress:
        while state.next_frame < last:
            start = time.perf_counter()
            index = slice(state.next_frame, min(state.next_frame + size, last))
            seen = light(list(islice(frames, index.stop - index.start)), index.start)
            begun = time.perf_counter()
            for shown, shown_s in pieces(
                config.upsample, steps.before, state.sensor.time_s, seen, t_s[index]
            ):
                found = events.simulate(shown, shown_s, sensor, state=state.sensor)
                steps.add(shown)
                log.append(found)
                state.count(found, len(shown))
            state.simulating_s += time.perf_counter() - begun
            state.advance(index.stop, light.largest, time.perf_counter() - start)
            if state.next_frame == last or time.monotonic() - saved > SECONDS_BETWEEN_SAVES:
                state.save(run, steps)
                saved = time.monotonic()
            progress.advance(events=state.events)
    view = View(run, config, source, light, log, t_s[first:last], first)
    pages.show(view, state, steps, sensor, clock, write_outputs(run, config, log))
    (run.folder / LOG).unlink()


def checked(config):
    """The configuration. Raises: DomainError for options that cannot be, before anything is read."""
    if config.input is None:
        raise DomainError(
            "no input given; name a video, a folder of pictures, a .npy or .npz stack, or a .mraw recording "
            "with --input."
        )
    for name in (
        "fps",
        "slow_motion",
        "white_level",
        "preview_slowdown",
        "decay_tau_s",
        "preview_full_scale",
        "upsample",
    ):
        value = getattr(config, name)
        if value is not None and not 0 < value < math.inf:
            raise DomainError(f"--{name.replace('_', '-')} is {value:g}; a finite number above 0 is needed.")
    if not 1 <= config.preview_fps <= 240:
        raise DomainError(
            f"--preview-fps is {config.preview_fps:g}; 1 to 240 pictures per second are possible."
        )
    if config.sensor_size is not None and not all(1 <= side <= 65535 for side in config.sensor_size):
        raise DomainError(
            f"--sensor-size is {config.sensor_size}; width and height of 1 to 65535 pixels are possible."
        )
    if config.points < 1:
        raise DomainError(f"--points is {config.points}; at least 1 is needed.")
    return config


def check_outputs(run, config, height, width):
    """Write and remove a file of one event in every format asked for, so that one that cannot be is told now
    and not after the simulation; likewise what the preview needs."""
    zero = torch.zeros(1, dtype=torch.int64)
    if config.preview:
        require("imageio_ffmpeg", "video", "a preview (--no-preview leaves it out)")
    for name in config.events:
        path = run.path(name)
        events.write(path, EventStream(zero, zero, zero, zero + 1, height, width))
        path.unlink()


def write_outputs(run, config, log):
    """Write the event files; returns their paths."""
    paths = [run.path(name) for name in config.events]
    if not paths:
        return paths
    stream = log.read(0, log.count)
    for path in paths:
        events.write(path, stream)
        run.say(f"Written: {path}")
    return paths


if __name__ == "__main__":
    sys.exit(main(study, Config))
