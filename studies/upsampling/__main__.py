"""How true are events of a video that was upsampled, against events of the frames that were left out of it?

Sequences are rendered at a high rate, every k-th frame is kept, and events of the upsampled frames
(codesign.events.upsampling.upsample) are compared with events of all frames. Controls: frames between by
linear blending, and the kept frames alone. High-speed recordings likewise, with the frames that were dropped.
Frames are instantaneous, here and in the method.
"""

import sys
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import torch

from codesign import events
from codesign.events.sources.opening import open_frames
from codesign.events.upsampling.upsample import upsample
from studies.frame.run import Run, StudyConfig, main
from studies.upsampling import figures as drawn
from studies.upsampling.measure import (
    WAYS,
    Row,
    between_kept,
    blended_frames,
    event_errors,
    flow_error,
    pace,
    psnr,
)
from studies.upsampling.scenes import SCENES, STEP_PX, sequence

RECORDINGS = {"ball": ("ball_12bit.mraw", (2, 7)), "beam": ("data_showcase.mraw", (2, 4, 8))}
MOST_FRAMES = 33  # of a recording
SENSOR = events.SensorModel()


@dataclass(frozen=True)
class Config(StudyConfig):
    max_displacement_px: float = 0.5
    """Largest motion between the frames of the upsampled video, pixels."""
    recordings: Path | None = None
    """Folder of high-speed recordings; ../shared/data/highspeed beside the repository when left out, and none
    when that is absent."""


def study(run: Run[Config]) -> None:
    config = run.config
    names = ("room", "ball") if config.quick else tuple(SCENES)
    strides = (10, 40) if config.quick else (4, 10, 20, 40)
    size_px = (96, 72) if config.quick else (144, 108)
    folder = _folder(config.recordings)
    rows = []
    real = []
    recordings = {
        name: given
        for name, given in RECORDINGS.items()
        if folder is not None and not (config.quick and name == "ball")
    }
    with run.progress(len(names) * (len(strides) + 1) + len(recordings), "upsampling") as progress:
        for name in names:
            shown = sequence(name, size_px, strides)
            progress.advance()
            for stride in strides:
                rows.append(_measured(run, name, shown, stride))
                progress.advance()
        for name, (file, factors) in recordings.items():
            assert folder is not None
            real += _recording(name, folder / file, factors[:1] if config.quick else factors)
            progress.advance()
    _record(run, rows, real)
    _show(run, rows, real, folder)


def _measured(run, name, shown, stride):
    """Row of one scene at one stride."""
    kept = shown.frames[::stride]
    kept_s = shown.t_s[::stride]
    made, made_s, mpixel_per_s = pace(
        lambda: upsample(kept, kept_s, max_displacement_px=run.config.max_displacement_px)
    )
    (exact, flow), blended = between_kept(shown.frames, stride), blended_frames(shown.frames, stride)
    streams = {
        "upsampled": events.simulate(made, made_s, SENSOR),
        "blended": events.simulate(blended, shown.t_s, SENSOR),
        "kept": events.simulate(kept, kept_s, SENSOR),
    }
    truth = events.simulate(shown.frames, shown.t_s, SENSOR)
    if stride in (10, 40):
        run.figure(
            drawn.side_by_side(shown, stride, exact, blended, truth, streams),
            f"{name}_{stride}",
            _caption(name, stride),
        )
    errors = {way: event_errors(streams[way], truth, shown.t_s) for way in WAYS}
    mine, control = (psnr(frames, shown.frames, stride) for frames in (exact, blended[: len(exact)]))
    return Row(name, stride * STEP_PX, flow_error(flow, shown, stride), mine, control, errors, mpixel_per_s)


def _caption(name, stride):
    above = "Above: the middle of the first interval, and what is wrong in it (full colour: a fifth of the brightest)"
    return f"{SCENES[name].capitalize()}; {stride * STEP_PX:.3g} px between the frames kept. {above}; below: events of the whole sequence, red ON, blue OFF."


def _recording(name, path, factors):
    """Rows (name, frames kept, PSNR of both ways in the frames left out) of a recording."""
    source = open_frames(path)
    values = torch.stack(
        [torch.from_numpy(frame.astype("float32")) for frame in islice(source.read(0), MOST_FRAMES)]
    ) * (255 / source.white)
    rows = []
    for factor in factors:
        frames = values[: (len(values) - 1) // factor * factor + 1]
        made, _ = between_kept(frames, factor, len(frames))
        rows.append(
            (name, factor, *(psnr(each, frames, factor) for each in (made, blended_frames(frames, factor))))
        )
    return rows


def _folder(given):
    """Where the recordings are, or None."""
    if given is not None:
        return given
    root = Path(__file__).resolve().parents[1]
    return next(
        (
            place / "shared" / "data" / "highspeed"
            for place in (root.parent, root)
            if (place / "shared" / "data" / "highspeed").is_dir()
        ),
        None,
    )


def _record(run, rows, real):
    for row in rows:
        key = f"{row.scene}_{row.motion_px:.3g}px".replace(".", "p")
        run.record(
            **{
                f"{key}_flow_error_px": row.flow_px,
                f"{key}_psnr_upsampled_db": row.psnr_db,
                f"{key}_psnr_blended_db": row.blended_db,
                f"{key}_mpixel_per_s": row.mpixel_per_s,
            }
        )
        for way, error in row.errors.items():
            run.record(**{f"{key}_{way}_{name}": value for name, value in error._asdict().items()})
    for name, factor, upsampled, blended in real:
        run.record(
            **{
                f"recording_{name}_every_{factor}_psnr_upsampled_db": upsampled,
                f"recording_{name}_every_{factor}_psnr_blended_db": blended,
            }
        )


def _show(run, rows, real, folder):
    run.figure(
        drawn.by_motion(rows),
        "by_motion",
        "Events against those of all frames, by motion between the frames kept. Solid: upsampled; dashed: "
        "the kept frames alone.",
    )
    run.table(
        "Frames",
        (
            "scene",
            "motion, px",
            "flow error of what both frames show, px",
            "PSNR upsampled, dB",
            "PSNR blended, dB",
            "Mpixel/s of output",
        ),
        [
            (row.scene, row.motion_px, row.flow_px, row.psnr_db, row.blended_db, row.mpixel_per_s)
            for row in rows
        ],
    )
    for way in WAYS:
        run.table(
            f"Events of frames {way}",
            (
                "scene",
                "motion, px",
                "correlation of counts",
                "ON rate over true",
                "OFF rate over true",
                "wrong counts per event in 4 x 4 px and 5 ms",
            ),
            [(row.scene, row.motion_px, *row.errors[way]) for row in rows],
        )
    if real:
        run.table(
            "Recordings",
            ("recording", "kept, one of", "PSNR upsampled, dB", "PSNR blended, dB"),
            real,
            "Peak 255 is full light. Frames between were recorded and left out.",
        )
    else:
        run.text(
            f"**No recordings**: {folder or 'shared/data/highspeed'} is absent, so only rendered sequences "
            "were judged."
        )
    worse = [
        f"{row.scene} at {row.motion_px:.3g} px"
        for row in rows
        if row.errors["upsampled"].wrong > row.errors["kept"].wrong
    ]
    lead = f"{len(rows) - len(worse)} of {len(rows)} sequences give truer events when upsampled"
    run.finish("Upsampling before events", lead + (f"; not so: {', '.join(worse)}." if worse else "."))


if __name__ == "__main__":
    sys.exit(main(study, Config))
