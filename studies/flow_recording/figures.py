"""Pictures of studies.flow_recording."""

import torch
from matplotlib.figure import Figure

from codesign.flow.contrast import count_image, stream_tracks
from codesign.report.flow_colours import flow_colours

BRIGHT = 0.99  # quantile of the counts of the still events that is shown white


def packet(packet, fields):
    """Figure: per estimator a row of the events as they came, the events warped to the window's end, the
    flow, and the true flow.

    Args: packet: Packet. fields: {name: FlowField}.
    """
    height = packet.stream.height_px
    width = packet.stream.width_px
    figure = Figure(figsize=(12, (2.9 * height / width + 0.35) * len(fields)), layout="constrained")
    axes = figure.subplots(len(fields), 4, squeeze=False)
    still = _warped(packet, torch.zeros(1, 2, height, width))
    bright = float(still[still > 0].quantile(BRIGHT)) if bool((still > 0).any()) else 1.0
    truth = None if packet.truth is None else packet.truth
    longest = (
        float(truth.flow_px[truth.valid[:, None].expand_as(truth.flow_px)].abs().max())
        if truth is not None and bool(truth.valid.any())
        else None
    )
    for row, (name, field) in zip(axes, fields.items(), strict=True):
        full = longest or max(float(field.flow_px.abs().max()), 1e-6)
        pictures = [("events as they came", still), (f"warped by {name}", _warped(packet, field.flow_px))]
        for axis, (title, image) in zip(row, pictures, strict=False):
            axis.imshow(image.numpy(), cmap="gray", vmin=0, vmax=2 * bright)
            axis.set_title(title, fontsize=9)
        known = torch.ones_like(field.valid[0]) if field.confidence is None else field.confidence[0] > 0
        row[2].imshow(_colours(field.flow_px[0], known & field.valid[0], full))
        row[2].set_title(f"{name}, full colour {full:.1f} px", fontsize=9)
        if truth is not None:
            row[3].imshow(_colours(truth.flow_px[0], truth.valid[0], full))
        row[3].set_title("true flow" if truth is not None else "no true flow", fontsize=9)
        row[3].set_aspect(1.0 if truth is not None else height / width)
        for axis in row:
            axis.set_xticks([])
            axis.set_yticks([])
    return figure


def _colours(flow_px, known, full):
    colours = torch.from_numpy(flow_colours(flow_px.numpy(), full))
    return torch.where(known[..., None], colours, torch.zeros_like(colours)).numpy()


def _warped(packet, flow_px):
    if not len(packet.stream):
        return torch.zeros(flow_px.shape[2:])
    return count_image(stream_tracks(packet.stream, flow_px, packet.t0_us, packet.t1_us), 1.0)[0].sum(0)
