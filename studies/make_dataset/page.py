"""What a data set looks like: statistics of its sequences, read back from their files, and a
contact sheet."""

import json

import numpy as np
import torch

from codesign.events import picture, to_counts
from codesign.report.flow_colours import flow_colours
from codesign.report.prose import counted
from codesign.types import EventStream
from studies.frame.show import pictures, table
from studies.make_dataset.store import h5

SHOWN_FRAMES = 5  # whose events are in one picture
BLOCK = 16  # frames read at a time
COLUMNS = {
    "sequence": "sequence",
    "events": "events",
    "events_per_pixel_s": "per pixel and s",
    "on_share": "ON",
    "mean_flow_px": "mean flow, px",
    "largest_flow_px": "largest, px",
    "valid_share": "valid",
    "occluded_share": "occluded",
    "nearest_m": "nearest, m",
    "farthest_m": "farthest, m",
    "path_m": "path, m",
}


def statistics(folder):
    """Figures of a sequence, from its files: plain numbers."""
    with h5(folder / "events.h5") as file, h5(folder / "frames.h5") as frames:
        events = file["events/t"].shape[0]
        on = float(np.mean(file["events/p"])) if file["events/t"].shape[0] else 0.0
        count = frames["frames"].shape[0]
        poses = frames["poses"][()]
        duration_s = float(frames["t_s"][-1])
        nearest = []
        farthest = [0.0]
        light = 0.0
        for start in range(0, count, BLOCK):
            depth = frames["depth"][start : start + BLOCK]
            hit = depth[depth > 0]
            if hit.size:
                nearest.append(float(hit.min()))
                farthest.append(float(hit.max()))
            light += float(frames["frames"][start : start + BLOCK].sum(dtype=np.float64))
        pixels = frames["frames"].size
        occluded = sum(int(frames["occluded"][k : k + BLOCK].sum()) for k in range(0, count, BLOCK))
        lengths = [_lengths(frames["flow"][k], frames["valid"][k]) for k in range(count - 1)]
    mean_px, largest_px, valid = zip(*lengths, strict=True)
    return {
        "frames": count,
        "duration_s": duration_s,
        "events": events,
        "events_per_pixel_s": events / duration_s / (pixels / count),
        "on_share": on,
        "mean_flow_px": np.mean(mean_px),
        "largest_flow_px": max(largest_px),
        "valid_share": np.mean(valid),
        "occluded_share": occluded / (pixels - pixels // count),  # of frames with flow
        "nearest_m": min(nearest, default=0.0),
        "farthest_m": max(farthest),
        "mean_radiance": light / pixels,
        "path_m": np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1).sum(),
    }


def _lengths(flow, valid):
    length = np.hypot(*flow)[valid]
    return (
        (float(length.mean()), float(length.max()), float(valid.mean()))
        if length.size
        else (0.0, 0.0, 0.0)
    )


def show(run, names, spent, wall_s, frames_made):
    folders = {name: run.folder / name for name in names}
    rows = [
        {"sequence": name, **json.loads((folder / "sequence.json").read_text(encoding="utf-8"))}
        for name, folder in folders.items()
    ]
    files = [path for folder in folders.values() for path in folder.rglob("*") if path.is_file()]
    disk_mb = sum(path.stat().st_size for path in files) / 1e6
    events, frames = (sum(row[name] for row in rows) for name in ("events", "frames"))
    run.record(
        frames=frames, events=events, disk_mb=disk_mb, sequences=len(names), session_wall_s=wall_s
    )
    run.record(
        **{f"session_{part.replace(' ', '_')}_s": seconds for part, seconds in spent.items()}
    )
    run.card("Frames", f"{frames}", f"in {counted(len(names), 'sequence')}")
    run.card(
        "Events",
        f"{events / 1e6:.2f} million",
        f"{events / max(frames - len(names), 1):.0f} per frame",
    )
    # else the figures of the session that made the last ones stay
    if frames_made:
        run.record(session_frames_per_s=frames_made / wall_s)
        run.card("Speed", f"{frames_made / wall_s:.1f} frames/s", f"{wall_s:.0f} s in this session")
    run.card("Disk", f"{disk_mb:.0f} MB", f"{1e3 * disk_mb / frames:.0f} kB per frame, everything")
    text = (
        "The middle of every sequence: frame, events of five frames (red brighter, blue darker), flow to the "
        "next frame (hue: direction, saturation: length, full at the longest), depth (dark is near)."
    )
    sheet = {name.removeprefix("sequence_"): _pictures(folder) for name, folder in folders.items()}
    run.figure(pictures(sheet, flow=True), "contact_sheet", text)
    run.table("Every sequence", *table(rows, **COLUMNS))
    times = [
        {"part": part, "seconds": seconds, "ms per frame": 1e3 * seconds / max(frames_made, 1)}
        for part, seconds in spent.items()
    ]
    caption = "Of this session, all processes together. Writing includes joining the parts and the statistics."
    run.table("Time", *table(times), caption)
    run.text("`manifest.json` holds the SHA-256 of every file; `docs/datasets.md` the layout.")
    run.finish(
        "Data set",
        f"{counted(len(names), 'sequence')} with {counted(frames, 'frame')}, their flow, depth and poses, and {events} events, "
        f"{disk_mb:.0f} MB, are complete in this folder.",
    )


def _pictures(folder):
    with h5(folder / "frames.h5") as frames, h5(folder / "events.h5") as events:
        middle = (frames["frames"].shape[0] - 1) // 2
        image, depth, flow, valid = (
            frames[name][middle] for name in ("frames", "depth", "flow", "valid")
        )
        t_s = frames["t_s"][middle : middle + SHOWN_FRAMES + 1]
        index = events["ms_to_idx"][()]
        first = int(index[int(t_s[0] * 1e3)])
        last = int(index[min(int(t_s[-1] * 1e3) + 1, len(index) - 1)])
        x, y, p, t = (
            torch.from_numpy(events[f"events/{name}"][first:last].astype(np.int64))
            for name in "xypt"
        )
    counts = to_counts(EventStream(t, x, y, 2 * p - 1, *image.shape), t_s).sum(0)
    return {
        "frame": _grey(image) ** (1 / 2.2),  # linear light, with a display's gamma
        "events": picture(counts, 3).numpy(),
        "flow": np.where(valid[..., None], flow_colours(flow), 0.0),
        "depth": _grey(np.where(depth > 0, depth, depth.max())),  # 0 where nothing is, as far
    }


def _grey(image):
    """[H, W, 3] with the largest value white."""
    return np.repeat((image / max(float(image.max()), 1e-9)).clip(0, 1)[..., None], 3, 2)
