"""Pictures of studies.upsampling."""

from matplotlib.figure import Figure

from codesign import events
from studies.upsampling.measure import WAYS

FULL_COLOUR = 6.0  # events


def side_by_side(shown, stride, exact, blended, truth, streams):
    """Figure: the frame in the middle of the first interval, true, upsampled and blended, and the events of
    all."""
    middle = stride // 2
    ends = shown.t_s[[0, -1]]
    height, width = shown.frames.shape[1:]
    figure = Figure(figsize=(12, 2 * (3 * height / width + 0.3)), layout="constrained")
    axes = figure.subplots(2, 4)
    bright = float(shown.frames.max())
    for axis, name, frames in zip(
        axes[0], ("true", "upsampled", "blended"), (shown.frames, exact, blended), strict=False
    ):
        axis.imshow(frames[middle].numpy(), cmap="gray", vmin=0, vmax=bright)
        axis.set_title(f"{name}, frame {middle}", fontsize=9)
    difference = (exact[middle] - shown.frames[middle]).numpy()
    axes[0][3].imshow(difference, cmap="RdBu_r", vmin=-0.2 * bright, vmax=0.2 * bright)
    axes[0][3].set_title("upsampled - true", fontsize=9)
    for axis, name in zip(axes[1], ("true", *WAYS), strict=True):
        stream = truth if name == "true" else streams[name]
        axis.imshow(events.picture(events.to_counts(stream, ends)[0], FULL_COLOUR).numpy())
        axis.set_title(f"{name}: {len(stream):,} events", fontsize=9)
    for axis in axes.flat:
        axis.set_xticks([])
        axis.set_yticks([])
    return figure


def by_motion(rows):
    """Figure: errors of events over motion, a line per scene."""
    figure = Figure(figsize=(11, 3.4), layout="constrained")
    axes = figure.subplots(1, 3)
    for number, scene in enumerate(dict.fromkeys(row.scene for row in rows)):
        mine = [row for row in rows if row.scene == scene]
        motion = [row.motion_px for row in mine]
        for way, style in (("upsampled", "-o"), ("kept", "--")):
            errors = [row.errors[way] for row in mine]
            values = (
                [e.correlation for e in errors],
                [(e.on + e.off) / 2 for e in errors],
                [e.wrong for e in errors],
            )
            for axis, each in zip(axes, values, strict=True):
                axis.plot(
                    motion, each, style, ms=3, color=f"C{number}", label=scene if way == "upsampled" else None
                )
    titles = (
        "correlation of counts per pixel",
        "events over true events",
        "wrong counts per event, 4 x 4 px and 5 ms",
    )
    for axis, title in zip(axes, titles, strict=True):
        axis.set(xlabel="motion between kept frames (px)", title=title)
        axis.spines[["top", "right"]].set_visible(False)
    axes[0].legend(fontsize=8, frameon=False)
    return figure
