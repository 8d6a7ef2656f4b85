"""Cross-section of a lens: surfaces, glass, stop, and the rays of a few fields, in millimetres."""

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from torch import Tensor

from codesign.atomic import replacing
from codesign.errors import FileFormatError
from codesign.lens.analysis.rays import field_rays
from codesign.lens.distance import PARALLEL
from codesign.lens.geolens import GeoLens
from codesign.lens.pinhole import ThinLens
from codesign.lens.surface import sag_mm
from codesign.lens.trace import at_surfaces

COLOURS = ("#1b6ca8", "#2e8b57", "#c0392b", "#8e44ad")
OUTLINE = "#24425c"
GLASS = "#9cc3dd"
MIRROR = "#5f6b76"
ENDINGS = (".svg", ".png", ".pdf")


def degrees(angle_rad: float) -> str:
    """An angle as it stands in a title."""
    # neither −0 nor what rounding leaves of it
    return f"{round(math.degrees(angle_rad), 6) + 0.0:.3g}°"


def coloured(fields_rad: Sequence[float]) -> Iterator[tuple[float, str]]:
    """Each field with its colour."""
    return zip(fields_rad, itertools.cycle(COLOURS))


def lens_layout(
    lens: GeoLens,
    fields_rad: Sequence[float] | None = None,
    path: str | Path | None = None,
    at_m: float = PARALLEL,
) -> Figure:
    """Figure of a lens's cross-section with meridional rays.

    Args:
      fields_rad: angles; None takes 0, 0.7 and 1 of the lens's half field (10 degrees where none is
        known).
      path: where to save, .svg, .png or .pdf, or None.
      at_m: metres from the entrance pupil to the object plane. Mirrors are drawn along the unfolded
        axis.
    Returns: matplotlib Figure. Raises: FileFormatError for another ending or a place that is not
      writable.
    """
    if path is not None and Path(path).suffix.lower() not in ENDINGS:
        raise FileFormatError(
            f"drawing {path}: extension '{Path(path).suffix}' is not written; use {', '.join(ENDINGS)}."
        )
    if fields_rad is None:
        fields_rad = [math.radians(lens.half_field_deg or 10.0) * h for h in (0.0, 0.7, 1.0)]
    figure, axis = plt.subplots(figsize=(9, 4), layout="constrained")
    draw_layout(axis, lens, fields_rad, at_m=at_m)
    axis.set_title(lens.name, loc="left")
    if path is not None:
        with replacing(path) as temporary:
            figure.savefig(temporary, dpi=160, facecolor="white")
    return figure


def layouts(lenses: Mapping[str, GeoLens], fields_rad: Sequence[float]) -> Figure:
    """Figure of several lenses above one another: dict title -> lens."""
    figure, axes = plt.subplots(
        len(lenses), 1, figsize=(9, 3.0 * len(lenses)), sharex=True, squeeze=False
    )
    for axis, (title, lens) in zip(axes[:, 0], lenses.items(), strict=True):
        draw_layout(axis, lens, fields_rad)
        axis.set_title(title, loc="left")
    figure.tight_layout()
    return figure


def draw_layout(
    axis: Axes, lens: GeoLens, fields_rad: Sequence[float], rays: int = 5, at_m: float = PARALLEL
) -> None:
    """Draw the cross-section of a lens with meridional rays of each field into a matplotlib axis.
    Lengths in mm."""
    surfaces = lens.to_surfaces()
    *vertices, film = np.cumsum([0.0, *(s.thickness_mm for s in surfaces)])
    outlines = [_outline(s, at) for s, at in zip(surfaces, vertices, strict=True)]
    tallest = max(s.semi_aperture_mm for s in surfaces)
    before = None
    for i, (s, (z, y)) in enumerate(zip(surfaces, outlines, strict=True)):
        is_glass = s.medium is not None and not s.mirror
        if is_glass and i + 1 < len(surfaces) and not surfaces[i + 1].mirror:
            _draw_glass(axis, outlines[i : i + 2])
        # a stop or dummy in one medium: its mark below says enough
        if s.mirror or s.phase is not None or before != s.medium:
            y = np.where(np.abs(y) < s.inner_semi_aperture_mm, np.nan, y)
            look = {"color": MIRROR, "lw": 2.2} if s.mirror else {"color": OUTLINE, "lw": 1}
            axis.plot(z, y, ls="--" if s.phase else "-", **look)
        before = s.medium
    # black bars from the edge of the paraxial stop outwards
    stop = surfaces[lens.stop_index]
    radius = float(lens.first_order().stop_semi_aperture_mm.detach())
    at = _outline(stop, vertices[lens.stop_index], min(radius, stop.semi_aperture_mm))[0][-1]
    for sign in (-1, 1):
        reach = max(radius * 1.25, radius + 0.12 * tallest)
        axis.plot([at, at], [sign * radius, sign * reach], color="k", lw=2)
    start = min(-0.12 * film, 1.05 * min(z.min() for z, _ in outlines))
    line = torch.linspace(-1, 1, rays, dtype=lens.dtype)
    pupil = torch.stack([torch.zeros_like(line), line], 1)
    highest = 0.0
    for field, colour in coloured(fields_rad):
        for k, path in enumerate(ray_paths(lens, field, pupil, start, at_m)):
            axis.plot(*path.T, color=colour, lw=0.6, label=None if k else degrees(field))
            highest = max(highest, abs(path[-1, 1]))
    film_height = 1.1 * highest if highest > 0.05 * tallest else 0.5 * tallest
    axis.plot([film, film], [-film_height, film_height], color="k", lw=1.5)
    _finish(axis)
    if any(lens.mirrors):
        note = "mirrors (thick) along the unfolded axis"
        axis.text(1.0, 1.02, note, transform=axis.transAxes, ha="right", fontsize=8, color=MIRROR)


def _finish(axis):
    """The optical axis, what the axes are, and which colour is which field."""
    axis.axhline(0, color="0.6", lw=0.5, ls=(0, (8, 3, 1, 3)), zorder=0)
    axis.set(xlabel="z (mm)", ylabel="y (mm)", aspect="equal")
    place = {"loc": "upper left", "bbox_to_anchor": (1.0, 1.0)}
    axis.legend(frameon=False, fontsize=8, title="field", title_fontsize=8, **place)


def draw_thin(axis: Axes, lens: ThinLens, fields_rad: Sequence[float], rays: int = 5) -> None:
    """Draw an ideal lens as a line as tall as its pupil, its film, and parallel light of each
    field, refracted paraxially, into a matplotlib axis. Lengths in mm."""
    efl, film = float(lens.efl_mm.detach()), float(lens.image_distance_mm.detach())
    radius = lens.entrance_pupil_diameter_mm / 2
    q = np.linspace(-radius, radius, rays) if radius else np.zeros(1)
    start, highest = -0.5 * film, max(radius, 0.05 * film)
    for field, colour in coloured(fields_rad):
        slope = math.tan(field)
        ends = q + film * (slope - q / efl)
        lines = axis.plot([start, 0, film], [q + start * slope, q, ends], color=colour, lw=0.6)
        lines[0].set_label(degrees(field))
        highest = max(highest, np.abs(ends).max())
    axis.plot([0, 0], [-radius, radius], color=OUTLINE, lw=2, marker="o", ms=2)
    axis.plot([film, film], [-1.1 * highest, 1.1 * highest], color="k", lw=1.5)
    _finish(axis)


@torch.no_grad()
def ray_paths(
    lens: GeoLens, field_rad: float, pupil: Tensor, start_z_mm: float, at_m: float = PARALLEL
) -> list[np.ndarray]:
    """Polylines [points, 2] (z, y) in mm of the rays of a field that arrive, found by tracing them
    up to each surface."""
    rays = field_rays(lens, field_rad, pupil, start_z_mm=start_z_mm, at_m=at_m)
    end = lens.trace(*rays)
    vertices = [0.0, *lens.thickness_mm.cumsum(0).tolist()]
    places = [rays[0]]
    for at, z in zip([*at_surfaces(lens.prescription(), *rays), end], vertices, strict=True):
        places.append(at.position_mm + at.position_mm.new_tensor([0.0, 0.0, z]))
    points = torch.stack(places)[..., [2, 1]]
    # rays that an aperture stops are not drawn
    passed = (end.status == 0) & (end.weight > 0)
    return list(points.transpose(0, 1)[passed].numpy())


def _outline(surface, vertex_mm, height_mm=None):
    """(z, y) of a surface out to its semi-aperture, in mm."""
    reach = surface.semi_aperture_mm if height_mm is None else height_mm
    y = torch.linspace(-reach, reach, 121, dtype=torch.float64)
    return vertex_mm + sag_mm(
        y, surface.curvature_per_mm, surface.conic, surface.asphere
    ).numpy(), y.numpy()


def _draw_glass(axis, faces):
    """A piece of glass between two outlines; the smaller face gets a flat rim out to the larger
    one's edge."""
    rim = max(y[-1] for _, y in faces)
    (za, ya), (zb, yb) = (
        (np.concatenate([z[:1], z, z[-1:]]), np.concatenate([[-rim], y, [rim]])) for z, y in faces
    )
    outline = np.concatenate([za, zb[::-1]]), np.concatenate([ya, yb[::-1]])
    axis.fill(*outline, facecolor=GLASS, edgecolor=OUTLINE, alpha=0.55, lw=0.8)
