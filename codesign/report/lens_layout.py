"""Cross-section of a lens: surfaces, glass, stop, and the rays of a few fields, in millimetres."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
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
from codesign.lens.surface import sag_mm

COLOURS = ("#1b6ca8", "#2e8b57", "#c0392b", "#8e44ad")
OUTLINE = "#24425c"
GLASS = "#9cc3dd"
MIRROR = "#5f6b76"
ENDINGS = (".svg", ".png", ".pdf")


def lens_layout(
    lens: GeoLens,
    fields_rad: Sequence[float] | None = None,
    path: str | Path | None = None,
    rays: int = 5,
    at_m: float = PARALLEL,
) -> Figure:
    """Figure of a lens's cross-section with meridional rays.

    Args: fields_rad: angles; None takes 0, 0.7 and 1 of the lens's half field (10 degrees where none is
      known). path: where to save, .svg, .png or .pdf, or None. rays: per field. at_m: metres
      from the entrance pupil to the object plane. Mirrors are drawn along the unfolded axis.
    Returns: matplotlib Figure. Raises: FileFormatError for another ending or a place that is not writable.
    """
    if path is not None and Path(path).suffix.lower() not in ENDINGS:
        raise FileFormatError(
            f"drawing {path}: extension '{Path(path).suffix}' is not written; use {', '.join(ENDINGS)}."
        )
    if fields_rad is None:
        fields_rad = [math.radians(lens.half_field_deg or 10.0) * h for h in (0.0, 0.7, 1.0)]
    figure, axis = plt.subplots(figsize=(9, 4), layout="constrained")
    draw_layout(axis, lens, fields_rad, rays, at_m)
    axis.set_title(lens.name, loc="left")
    if path is not None:
        with replacing(path) as temporary:
            figure.savefig(temporary, dpi=160, facecolor="white")
    return figure


def layouts(lenses: Mapping[str, GeoLens], fields_rad: Sequence[float]) -> Figure:
    """Figure of several lenses above one another: dict title -> lens."""
    figure, axes = plt.subplots(len(lenses), 1, figsize=(9, 3.0 * len(lenses)), sharex=True, squeeze=False)
    for axis, (title, lens) in zip(axes[:, 0], lenses.items(), strict=True):
        draw_layout(axis, lens, fields_rad)
        axis.set_title(title, loc="left")
    figure.tight_layout()
    return figure


def draw_layout(
    axis: Axes, lens: GeoLens, fields_rad: Sequence[float], rays: int = 5, at_m: float = PARALLEL
) -> None:
    """Draw the cross-section of a lens with meridional rays of each field into a matplotlib axis. Lengths in
    mm."""
    surfaces = lens.to_surfaces()
    vertices = np.concatenate([[0.0], np.cumsum([s.thickness_mm for s in surfaces])])
    _draw_glass(axis, surfaces, vertices)
    for i, (s, at) in enumerate(zip(surfaces, vertices, strict=False)):
        if not s.mirror and s.phase is None and _same_media(surfaces, i):
            continue  # a stop or dummy in air: its mark below says enough
        z, y = _profile(s, at)
        obstructed = np.abs(y) < s.inner_semi_aperture_mm
        axis.plot(
            z,
            np.where(obstructed, np.nan, y),
            color=MIRROR if s.mirror else OUTLINE,
            lw=2.2 if s.mirror else 1,
            ls="--" if s.phase else "-",
        )
    tallest = max(s.semi_aperture_mm for s in surfaces)
    _draw_stop(axis, lens, surfaces, vertices, tallest)
    film = vertices[-1]
    start = -max(
        0.12 * film,
        1.05 * max(0.0, -min(_profile(s, at)[0].min() for s, at in zip(surfaces, vertices, strict=False))),
    )
    highest = 0.0
    for field, colour in zip(fields_rad, COLOURS * len(fields_rad), strict=False):
        pupil = torch.stack(
            [torch.zeros(rays, dtype=lens.dtype), torch.linspace(-1, 1, rays, dtype=lens.dtype)], 1
        )
        paths = ray_paths(lens, field, pupil, start, at_m)
        for k, path in enumerate(paths):
            axis.plot(
                path[:, 0],
                path[:, 1],
                color=colour,
                lw=0.6,
                label=f"{math.degrees(field):.3g}°" if k == 0 else None,
            )
            highest = max(highest, abs(path[-1, 1]))
    film_height = 1.1 * highest if highest > 0.05 * tallest else 0.5 * tallest
    axis.plot([film, film], [-film_height, film_height], color="k", lw=1.5)
    axis.axhline(0, color="0.6", lw=0.5, ls=(0, (8, 3, 1, 3)), zorder=0)
    axis.set(xlabel="z (mm)", ylabel="y (mm)")
    axis.set_aspect("equal")
    axis.legend(
        loc="upper left",
        bbox_to_anchor=(1.0, 1.0),
        frameon=False,
        fontsize=8,
        title="field",
        title_fontsize=8,
    )
    if any(lens.mirrors):
        axis.text(
            1.0,
            1.02,
            "mirrors (thick) along the unfolded axis",
            transform=axis.transAxes,
            ha="right",
            fontsize=8,
            color=MIRROR,
        )


def ray_paths(
    lens: GeoLens, field_rad: float, pupil: Tensor, start_z_mm: float, at_m: float = PARALLEL
) -> list[np.ndarray]:
    """Polylines [points, 2] (z, y) in mm of the rays of a field that arrive, found by tracing the lens cut
    off behind each surface."""
    surfaces = lens.to_surfaces()
    with torch.no_grad():
        origin, direction = field_rays(lens, field_rad, pupil, start_z_mm=start_z_mm, at_m=at_m)
        points = [torch.stack([origin[:, 2], origin[:, 1]], 1)]
        z = 0.0
        for i, s in enumerate(surfaces):
            part = GeoLens(
                [
                    *(replace(q, is_stop=False) for q in surfaces[:i]),
                    replace(s, thickness_mm=0.0, is_stop=False),
                ],
                lens.entrance_pupil_diameter_mm,
                lens.dtype,
            )
            out = part.trace(origin, direction)
            # rays end on the vertex plane behind surface i: step back along the ray onto the surface
            y = out.position_mm[:, 1]
            slope = out.direction[:, 1] / out.direction[:, 2]
            sag = torch.zeros_like(y)
            for _ in range(40):  # each step shrinks the miss by slope times slope of the surface
                sag = sag_mm(y + slope * sag, s.curvature_per_mm, s.conic, s.asphere)
            points.append(torch.stack([z + sag, y + slope * sag], 1))
            z += s.thickness_mm
        end = lens.trace(origin, direction)
    points.append(torch.stack([torch.full_like(end.position_mm[:, 1], z), end.position_mm[:, 1]], 1))
    passed = (end.status == 0) & (end.weight > 0)  # rays that an aperture stops are not drawn
    return [np.array([p[k].tolist() for p in points]) for k in range(pupil.shape[0]) if bool(passed[k])]


def _profile(surface, vertex_mm, height_mm=None):
    """(z, y) of a surface out to its semi-aperture, in mm."""
    reach = surface.semi_aperture_mm if height_mm is None else height_mm
    y = torch.linspace(-reach, reach, 121, dtype=torch.float64)
    return vertex_mm + sag_mm(y, surface.curvature_per_mm, surface.conic, surface.asphere).numpy(), y.numpy()


def _draw_glass(axis, surfaces, vertices):
    """Elements between surfaces with glass behind them; the smaller face gets a flat rim out to the larger
    one's edge."""
    for i, s in enumerate(surfaces[:-1]):
        behind = surfaces[i + 1]
        if s.medium is None or s.mirror or behind.mirror:
            continue
        rim = max(s.semi_aperture_mm, behind.semi_aperture_mm)
        faces = []
        for face, at in ((s, vertices[i]), (behind, vertices[i + 1])):
            z, y = _profile(face, at)
            if face.semi_aperture_mm < rim:  # flat out to the rim
                z = np.concatenate([z[:1], z, z[-1:]])
                y = np.concatenate([[-rim], y, [rim]])
            faces.append((z, y))
        (za, ya), (zb, yb) = faces
        axis.fill(
            np.concatenate([za, zb[::-1]]),
            np.concatenate([ya, yb[::-1]]),
            facecolor=GLASS,
            edgecolor=OUTLINE,
            alpha=0.55,
            lw=0.8,
        )


def _draw_stop(axis, lens, surfaces, vertices, tallest):
    """Black bars from the edge of the paraxial stop outwards."""
    radius = float(lens.first_order().stop_semi_aperture_mm.detach())
    at = (
        vertices[lens.stop_index]
        + _profile(surfaces[lens.stop_index], 0.0, min(radius, surfaces[lens.stop_index].semi_aperture_mm))[
            0
        ][-1]
    )
    for sign in (-1, 1):
        axis.plot(
            [at, at], [sign * radius, sign * max(radius * 1.25, radius + 0.12 * tallest)], color="k", lw=2
        )


def _same_media(surfaces, i):
    before = surfaces[i - 1].medium if i else None
    return before == surfaces[i].medium
