"""What a data set looks like: statistics of its sequences, read back from their files, and a contact
sheet."""

import json

import matplotlib.pyplot as plt
import numpy as np
import torch

from codesign.events import picture, to_counts
from codesign.report.flow_colours import flow_colours
from codesign.types import EventStream
from studies.make_dataset.store import h5

SHOWN_FRAMES = 5  # whose events are in one picture
BLOCK = 16  # frames read at a time
COLUMNS = {
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
        "mean_flow_px": float(np.mean(mean_px)),
        "largest_flow_px": float(max(largest_px)),
        "valid_share": float(np.mean(valid)),
        "occluded_share": occluded / pixels,
        "nearest_m": min(nearest, default=0.0),
        "farthest_m": max(farthest),
        "mean_radiance": light / pixels,
        "path_m": float(np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1).sum()),
    }


def _lengths(flow, valid):
    length = np.hypot(*flow)[valid]
    return (
        (float(length.mean()), float(length.max()), float(valid.mean())) if length.size else (0.0, 0.0, 0.0)
    )


def show(run, names, spent, wall_s, frames_made):
    """Metrics and the page of a finished data set."""
    folders = [run.folder / name for name in names]
    facts = [json.loads((folder / "sequence.json").read_text(encoding="utf-8")) for folder in folders]
    sizes = [path.stat().st_size for folder in folders for path in folder.rglob("*") if path.is_file()]
    disk_mb = sum(sizes) / 1e6
    events = sum(each["events"] for each in facts)
    frames = sum(each["frames"] for each in facts)
    run.record(frames=frames, events=events, disk_mb=disk_mb, sequences=len(names), session_wall_s=wall_s)
    run.record(**{f"session_{part.replace(' ', '_')}_s": seconds for part, seconds in spent.items()})
    run.card("Frames", f"{frames}", f"in {len(names)} sequences")
    run.card("Events", f"{events / 1e6:.2f} million", f"{events / max(frames - len(names), 1):.0f} per frame")
    # else the figures of the session that made the last ones stay
    if frames_made:
        run.record(session_frames_per_s=frames_made / wall_s)
        run.card("Speed", f"{frames_made / wall_s:.1f} frames/s", f"{wall_s:.0f} s in this session")
    run.card("Disk", f"{disk_mb:.0f} MB", f"{1e3 * disk_mb / frames:.0f} kB per frame, everything")
    run.section(
        "Contact sheet",
        "The middle of every sequence: frame, events of five frames (red brighter, blue darker), flow to "
        "the next frame, depth.",
    )
    run.figure(
        contact_sheet(folders),
        "contact_sheet",
        "Flow by colour: hue is the direction as in the wheel at the bottom, saturation the length, full at "
        "the longest of the picture. Depth: dark is near.",
    )
    run.section("Sequences")
    rows = [(name, *(each[key] for key in COLUMNS)) for name, each in zip(names, facts, strict=True)]
    run.table("Every sequence", ("sequence", *COLUMNS.values()), rows)
    times = [(part, seconds, 1e3 * seconds / max(frames_made, 1)) for part, seconds in spent.items()]
    run.table(
        "Time",
        ("part", "seconds", "ms per frame"),
        times,
        "Of this session. Writing includes joining the parts and the statistics.",
    )
    run.text("`manifest.json` holds the SHA-256 of every file; `docs/datasets.md` the layout.")
    run.finish("Data set", f"{len(names)} sequences, {frames} frames and {events} events, {disk_mb:.0f} MB.")


def contact_sheet(folders):
    """Figure: one row per sequence, and the colour wheel."""
    figure, axes = plt.subplots(
        len(folders) + 1,
        4,
        figsize=(9, 2.3 * len(folders) + 1.5),
        squeeze=False,
        layout="constrained",
        height_ratios=[*[1] * len(folders), 0.5],
    )
    for row, folder in zip(axes, folders, strict=False):
        for axis, (title, image, options) in zip(row, _pictures(folder), strict=True):
            axis.imshow(image, **options)
            axis.set_title(title, fontsize=8)
            axis.set_xticks([])
            axis.set_yticks([])
        row[0].set_ylabel(folder.name.removeprefix("sequence_"), fontsize=8)
    for axis in axes[-1]:
        axis.axis("off")
    y, x = np.mgrid[-1:1:128j, -1:1:128j]
    axes[-1, 2].imshow(np.where((np.hypot(x, y) <= 1)[..., None], flow_colours(np.stack([x, y]), 1.0), 1.0))
    return figure


def _pictures(folder):
    with h5(folder / "frames.h5") as frames, h5(folder / "events.h5") as events:
        middle = (frames["frames"].shape[0] - 1) // 2
        image, depth, flow, valid = (frames[name][middle] for name in ("frames", "depth", "flow", "valid"))
        height, width = image.shape
        t_s = frames["t_s"][middle : middle + SHOWN_FRAMES + 1]
        index = events["ms_to_idx"][()]
        first = int(index[int(t_s[0] * 1e3)])
        last = int(index[min(int(t_s[-1] * 1e3) + 1, len(index) - 1)])
        x, y, p, t = (
            torch.from_numpy(events[f"events/{name}"][first:last].astype(np.int64)) for name in "xypt"
        )
    counts = to_counts(EventStream(t, x, y, 2 * p - 1, height, width), t_s).sum(0)
    longest = float(np.hypot(*flow).max())
    colours = np.where(valid[..., None], flow_colours(flow), 0.0)
    seen = depth[depth > 0]
    limits = {"vmin": float(seen.min(initial=1e9)), "vmax": float(seen.max(initial=0))}
    return (
        (f"frame {middle}", image, {"cmap": "gray"}),
        (f"{int(counts.sum())} events", picture(counts, 3).numpy(), {}),
        (f"flow, up to {longest:.2f} px", colours, {}),
        (
            f"depth {limits['vmin']:.2f} to {limits['vmax']:.2f} m",
            np.where(depth > 0, depth, np.nan),
            {"cmap": "magma", **limits},
        ),
    )
