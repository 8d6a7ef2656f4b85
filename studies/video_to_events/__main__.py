"""Events of an event camera that looks at a video, a folder of pictures, a stack of arrays, or a
raw recording.

Time: t of the events is that of the frames: of the container, of --fps, or of --timestamps. Light:
  digital values are taken as intensities, as v2e does; --linear undoes the sRGB gamma first. Colour
  becomes luminance (0.2126 red, 0.7152 green, 0.0722 blue).
Memory: frames are read, simulated and stored in chunks, so memory does not grow with the video.
  Event files are written whole at the end, which takes 0.05 GB of memory per million events
  (0.13 GB for .raw), and 13 MB of disk until then; with --events and no name nothing grows. See
  docs/event_views.md.
"""

import math
import sys
import time
from contextlib import closing
from itertools import islice

import torch

from codesign import events
from codesign.optional import require
from codesign.types import EventStream
from studies.frame.run import Run, main
from studies.video_to_events import page as pages
from studies.video_to_events.input import Light, frame_times, pieces
from studies.video_to_events.options import Config, Options, checked, chosen_sensor
from studies.video_to_events.state import EventLog, Progress

PIXELS_PER_CHUNK = 2**20  # worked on together
SECONDS_BETWEEN_SAVES = 20.0
QUICK_FRAMES = 40
LOG = "events.partial"


@torch.no_grad()
def study(run: Run[Options]) -> None:
    config = checked(run.config)
    if (run.folder / "report.html").exists():
        run.say(f"This run is complete: {run.folder / 'report.html'}")
        return
    assert config.input is not None
    sensor = chosen_sensor(config)
    source = events.open_frames(config.input)
    t_s, first, last, clock = frame_times(config, source, QUICK_FRAMES if config.quick else None)
    width, height = config.sensor_size or (source.width_px, source.height_px)
    check_outputs(run, config, height, width)
    light = Light(config.white_level or source.white, config.linear, config.sensor_size, run.device)
    facts = {"frames": last - first, "height_px": height, "width_px": width}
    state = Progress.load(run, first, config.seed, facts)
    log = EventLog(run.path(LOG), state.events, height, width)

    run.on_interrupt(lambda: state.save(run))
    size = max(2, PIXELS_PER_CHUNK // max(height * width, source.height_px * source.width_px))
    chunks = math.ceil((last - first) / size)
    done = (state.next_frame - first) // size
    saved = time.monotonic()
    with (
        closing(source.read(state.next_frame)) as frames,
        run.progress(chunks, "chunks", done) as progress,
    ):
        while state.next_frame < last:
            start = time.perf_counter()
            index = slice(state.next_frame, min(state.next_frame + size, last))
            seen = light(list(islice(frames, index.stop - index.start)), index.start)
            for shown, shown_s in pieces(
                config.upsample, state.before, state.sensor.time_s, seen, t_s[index]
            ):
                found = events.simulate(shown, shown_s, sensor, state=state.sensor)
                log.append(found)
                state.add(shown, found, (sensor.theta_on, sensor.theta_off))
            state.next_frame = index.stop
            state.largest = max(state.largest, light.largest)
            state.seconds += time.perf_counter() - start
            if state.next_frame == last or time.monotonic() - saved > SECONDS_BETWEEN_SAVES:
                state.save(run)
                saved = time.monotonic()
            progress.advance(events=state.events)
    view = pages.View(run, config, source, light, log, t_s[first:last], first)
    pages.write_page(view, state, sensor, clock, write_outputs(run, config, log))
    (run.folder / LOG).unlink()


def check_outputs(run, config, height, width):
    """Write and remove a file of one event in every format asked for, so that one that cannot be is
    told now and not after the simulation; likewise what the preview needs."""
    zero = torch.zeros(1, dtype=torch.int64)
    if config.preview:
        require("imageio_ffmpeg", "video", "a preview (--no-preview leaves it out)")
    for name in config.events:
        path = run.path(name)
        events.write(path, EventStream(zero, zero, zero, zero + 1, height, width))
        path.unlink()


def write_outputs(run, config, log):
    paths = [run.path(name) for name in config.events]
    if paths:
        stream = log.read(0, log.count)
        for path in paths:
            events.write(path, stream)
            run.say(f"Written: {path}")
    return paths


if __name__ == "__main__":
    sys.exit(main(study, Config))
