"""One call that draws whatever a stage made: ``codesign.show``.

lens ─▶ cross-section    frames ─▶ grey pictures    events ─▶ red and blue    flow ─▶ colours and their wheel
"""

import math
from collections.abc import Iterable
from contextlib import suppress
from io import BytesIO
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import torch
from matplotlib.figure import Figure
from torch import Tensor

from codesign.atomic import write_atomic
from codesign.checks import check_choice, check_number
from codesign.errors import CodesignError, DomainError, NonFiniteError, ShapeError
from codesign.events import picture, to_counts
from codesign.lens.pinhole import ThinLens
from codesign.mount import Mount
from codesign.report.chain_figures import draw_image
from codesign.report.flow_colours import draw_wheel, flow_colours
from codesign.report.lens_layout import draw_layout, draw_thin
from codesign.report.robot_figures import draw_robot, view_lines
from codesign.system.run import Pass
from codesign.types import EventStream, EventVolume, FlowField

MOST = 4  # pictures of a batch or of a film
FIELDS = (0.0, 0.7, 1.0)  # shares of the half field whose rays are drawn
QUANTILE = 0.98  # of lengths and counts, that has full colour
TICKS = 12  # headings on a path
WHEEL = 0.22  # of the picture's width
HANDLED = (
    "a lens, a camera, frames [..., H, W], poses [T, 4, 4], an EventStream, an EventVolume, a FlowField, a Mount (with camera= and body=), "
    "or what a system's `begin` returns"
)


class Shown(Figure):
    """A figure that a notebook shows without pyplot."""

    def image(self, kind: str, dpi: int) -> bytes:
        """The figure as a file of that kind, such as "png"."""
        buffer = BytesIO()
        with matplotlib.rc_context({"pdf.fonttype": 42, "ps.fonttype": 42}):  # as journals ask
            self.savefig(buffer, format=kind, dpi=dpi)
        return buffer.getvalue()

    def _repr_png_(self):
        return self.image("png", 110)


def show(
    x: Any,
    path: str | Path | None = None,
    *,
    camera: Any = None,
    body: Iterable[Any] = (),
    width_in: float | None = None,
) -> Shown:
    """Draw what a stage of the chain made.

    In a notebook the figure shows itself; elsewhere give ``path``, or use ``figure.savefig``.

    Args:
      x: lens (traced, thin or a pinhole) or camera: cross-section with rays to the middle, 0.7 and
        the corner of the field. Frames [..., H, W], tensor or array of numpy, linear light: at most
        four of the first sample over time, with the screen's gamma. Poses ``T_world_cam`` [..., T, 4, 4]: their
        paths from above, with where the camera looks (+z). ``EventStream`` and ``EventVolume``: ON red, OFF blue, both purple.
        ``FlowField``: hue the direction, saturation the length, with a wheel that says how far.
        ``Mount``, with the camera that it carries and the meshes of its robot. What
        ``System.begin`` returns: all of the chain in a row.
      path: file to write, of a kind that matplotlib knows (.png, .svg, .pdf).
      camera: that a mount carries. body: meshes with vertices_m [V, 3] and faces [F, 3], in body
        axes.
      width_in: width of the figure, inches, 1 to 30, such as that of a column of a paper: the
        height follows, letters keep their size in points. None: 3.4 for each picture.
    Raises: DomainError for something else, or another width.

    >>> import codesign
    >>> figure = codesign.show(codesign.lens.load("cooke-triplet"))
    >>> len(figure.axes)
    1
    """
    if isinstance(x, np.ndarray) and x.dtype.kind in "buif":
        paths = x.shape[-2:] == (4, 4)  # they may lie far from the origin
        x = torch.from_numpy(x.astype(np.float64 if paths else np.float32))
    if isinstance(x, Mount):
        figure = _mount(x, camera, list(body))
    elif isinstance(x, EventStream):
        first_us, last_us = x.t_us[[0, -1]].tolist() if len(x) else (0, 0)
        ends_us = torch.tensor([first_us - 1, last_us], dtype=torch.float64)
        counts = to_counts(x, 1e-6 * ends_us)
        figure = _row([(f"{len(x):,} events", counts, _events)])
    elif isinstance(x, EventVolume):
        sums = x.counts.detach().sum(2)[:MOST]
        figure = _row(
            [(f"events {k}" if k else "events", sums[[k]], _events) for k in range(len(sums))]
        )
    elif isinstance(x, FlowField):
        flows = [_sample(x, k) for k in range(min(MOST, len(x.flow_px)))]
        full = max(map(_longest, flows), default=1e-9)
        figure = _row(
            [(f"flow {k}" if k else "flow", (px, full), _flow) for k, px in enumerate(flows)]
        )
    elif isinstance(x, Tensor) and _are_poses(x):
        figure = _row([("from above", x.detach().double().cpu(), _paths)])
    elif isinstance(x, Tensor):
        if x.ndim < 2 or not x.numel() or x.dtype.is_complex:
            raise ShapeError(
                f"frames are {x.dtype} {list(x.shape)}; real [..., H, W] with a pixel is needed."
            )
        if x.ndim > 2 and x.shape[-1] == 3:
            raise ShapeError(
                f"frames {list(x.shape)} look like colour, [..., H, W, 3]; give their light, [..., H, W]."
            )
        if x.ndim > 2 and x.shape[-3] == 2 and (x.ndim > 3 or bool((x < 0).any())):
            raise ShapeError(
                f"{list(x.shape)} may be counts or flow, [..., 2, H, W]: give an EventVolume, a FlowField, or frames [T, H, W]."
            )
        films = x.detach().float().reshape(-1, *(1, *x.shape)[-3:])
        if not films.isfinite().all():
            raise NonFiniteError("frames hold NaN, infinities or numbers beyond single precision.")
        film, *others = films
        of = f", sample 0 of {len(films)}" if others else ""
        picked = np.unique(np.linspace(0, len(film) - 1, MOST).round().astype(int)).tolist()
        figure = _row([(f"frame {k}{of}", (film[k], film[picked]), _frame) for k in picked])
    elif isinstance(x, Pass):
        figure = _chain(x)
    elif _has_section(x):
        figure = _row([("", x, _lens)])
    else:
        raise DomainError(f"nothing is known of how to draw {type(x).__name__}; give {HANDLED}.")
    if width_in is not None:
        width_in = check_number(width_in, "width_in", 1.0, 30.0, remedy="give it in inches")
        figure.set_size_inches(width_in, 1.0 + width_in * figure.bbox.height / figure.bbox.width)
        figure.draw_without_rendering()
        figure.set_figheight(figure.get_tightbbox().height + 0.1)
    if path is not None:
        kind = Path(path).suffix[1:].lower() or "png"
        check_choice(kind, "the kind of file", figure.canvas.get_supported_filetypes())
        write_atomic(Path(path), figure.image(kind, 150))
    return figure


def _has_section(x):
    """Whether it is a lens, or a camera with one, whose cross-section is known."""
    lens = getattr(x, "lens", x)
    return isinstance(lens, ThinLens) or hasattr(lens, "to_surfaces")


def _sample(field, k):
    flow = field.flow_px[k].detach()
    return torch.where(field.valid[k], flow, math.nan).double().numpy()


def _row(parts):
    """Figure of (title, what, how to draw it) side by side; a lens gets more room."""
    if not parts:
        raise ShapeError("there is no sample in it to draw.")
    wide = [1.5 if draw is _lens else 1.0 for _, _, draw in parts]
    figure = Shown(figsize=(3.4 * sum(wide) + 0.6, 3.3), layout="constrained")
    axes = figure.subplots(1, len(parts), squeeze=False, width_ratios=wide)[0]
    for axis, (title, what, draw) in zip(axes, parts, strict=True):
        draw(axis, what)
        axis.set_title(title, fontsize=10)
        if draw not in (_lens, _paths):
            axis.set(xticks=[], yticks=[])
    return figure


def _frame(axis, frame_and_films):
    draw_image(axis, *frame_and_films)


def _are_poses(x):
    """Whether it is [4, 4] or [..., T, 4, 4] with the last row of rigid motions."""
    if x.ndim < 2 or x.shape[-2:] != (4, 4) or not x.numel():
        return False
    return bool((x[..., 3, :] == x.new_tensor([0, 0, 0, 1])).all())


def _paths(axis, T_world_cam):
    """Paths over the ground, and where the camera looks, at most TICKS times on each."""
    for poses in T_world_cam.reshape(-1, *(1, *T_world_cam.shape)[-3:]):
        x, y = poses[:, :2, 3].T.numpy()
        (line,) = axis.plot(x, y, linewidth=1)
        some = slice(None, None, math.ceil(len(poses) / TICKS))
        ahead = poses[some, :2, 2].T.numpy()
        axis.quiver(x[some], y[some], *ahead, color=line.get_color(), width=0.006)
    axis.set_aspect("equal", "datalim")
    axis.set(xlabel="x (m)", ylabel="y (m)")


def _events(axis, counts):
    some = counts[counts > 0]
    full = float(torch.quantile(some.flatten()[::7].double(), QUANTILE)) if len(some) else 1.0
    axis.imshow(picture(counts.clamp_min(0), max(full, 1e-9))[0].numpy())


def _longest(flow_px):
    """Of what moves: pixels without flow would be most of a sparse field."""
    length = np.hypot(*flow_px)
    some = length[length > 0]
    return float(np.quantile(some, QUANTILE)) if some.size else 1e-9


def _flow(axis, flow_and_full):
    flow_px, full = flow_and_full
    known = np.isfinite(flow_px).all(0)
    colours = flow_colours(np.where(known, flow_px, 0.0), full)
    axis.imshow(np.where(known[..., None], colours, 0))  # black where it is not known
    draw_wheel(axis, (1 - WHEEL, 0, WHEEL, WHEEL))
    axis.text(
        0.99 - WHEEL, 0.02, f"rim {full:.2g} px", transform=axis.transAxes, ha="right", size=8
    )


def _lens(axis, x):
    """Of a lens, or of a camera, whose film's corner is the field."""
    lens = getattr(x, "lens", x)
    thin = isinstance(lens, ThinLens)
    half_rad = math.radians(getattr(lens, "half_field_deg", None) or 10.0)
    if hasattr(x, "film"):
        across_mm = math.hypot(x.film.sensor_width_px, x.film.sensor_height_px)
        across_mm *= x.film.pixel_pitch_mm
        reach = lens.image_distance_mm if thin else lens.first_order().efl_mm
        half_rad = math.atan(across_mm / 2 / abs(float(reach.detach())))
    (draw_thin if thin else draw_layout)(axis, lens, [share * half_rad for share in FIELDS])


def _mount(mount, camera, body):
    if camera is None or not body:
        raise DomainError(
            "a mount is drawn on its robot: give camera= and body=, meshes such as `bodies.values()` of a pair."
        )
    T_body_cam = mount().detach()
    figure = Shown(figsize=(5, 4.4), layout="constrained")
    triangles = np.concatenate([np.asarray(m.vertices_m)[np.asarray(m.faces)] for m in body])
    normal = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    up = normal[:, 2] / np.linalg.norm(normal, axis=1).clip(1e-12)
    size_m = float(np.ptp(triangles.reshape(-1, 3), axis=0).max())
    lines = view_lines(camera, T_body_cam, 0.7 * size_m)
    draw_robot(figure.add_subplot(projection="3d"), triangles, 0.55 + 0.25 * up, lines)
    return figure


def _chain(run):
    """Lens, middle frame, events and flow of the first sample of a pass."""
    with torch.no_grad():
        camera = run["camera"]
        parts = [("lens", camera, _lens)] if _has_section(camera) else []
        frames = run["frames"].detach()
        films = run._samples(frames)[0]
        parts.append(("frame", (films[len(films) // 2], films), _frame))
        parts.append(("events", run["volume"].counts[:1].sum(2), _events))
        flows = {"flow, estimated": run["field"]}
        with suppress(CodesignError):  # a recording has no truth
            flows["flow, true"] = run["truth"]
        known = {title: _sample(f, 0) for title, f in flows.items() if isinstance(f, FlowField)}
        full = max(map(_longest, known.values()), default=1e-9)
        parts += [(title, (flow_px, full), _flow) for title, flow_px in known.items()]
    return _row(parts)
