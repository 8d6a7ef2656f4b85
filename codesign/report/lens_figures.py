"""Pictures of what a lens does to light: spots, ray fans, wavefront, point spread, MTF. Each
function returns a matplotlib Figure.

at_m, in all of them: metres to the object plane, inf for parallel light. The first wavelength is
the reference.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import torch
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from torch import Tensor

from codesign.lens import analysis
from codesign.lens.analysis.psf import Psf
from codesign.lens.distance import PARALLEL
from codesign.lens.geolens import GeoLens
from codesign.lens.glass import D_UM, WAVELENGTH_UM
from codesign.report.lens_layout import COLOURS, degrees
from codesign.report.lens_layout import draw_layout as draw_layout
from codesign.report.lens_layout import layouts as layouts
from codesign.report.lens_layout import lens_layout as lens_layout

VISIBLE_UM = tuple(WAVELENGTH_UM[line] for line in "dFC")
SIDES = ("tangential", "sagittal")
FLOOR = 1e-4  # of the peak of a point spread
LINE_COLOURS = ("#2e8b57", "#1b6ca8", "#c0392b", "#8e44ad", "#d68910")


@torch.no_grad()
def spot_diagrams(
    lenses: Mapping[str, GeoLens],
    fields_rad: Sequence[float],
    pixel_mm: float,
    at_m: float = PARALLEL,
) -> Figure:
    """Figure of spot diagrams: a row per lens (dict title -> lens), a column per field, one scale,
    the pixel drawn in."""
    figure, axes = _grid(len(lenses), len(fields_rad), 3.0, 3.0, sharex=True, sharey=True)
    half = pixel_mm * 500
    for row, (title, lens) in zip(axes, lenses.items(), strict=True):
        points, weight = analysis.spots(lens, fields_rad, grid=24, at_m=at_m)
        for axis, p, w, field in zip(row, points, weight, fields_rad, strict=True):
            p = (p - p[w > 0].mean(0))[w > 0] * 1e3
            axis.plot(*p.T.numpy(), ".", ms=2, color=COLOURS[0])
            axis.plot(
                [-half, half, half, -half, -half],
                [-half, -half, half, half, -half],
                color="#c0392b",
                lw=1,
            )
            rms = float(p.square().sum(1).mean().sqrt())
            axis.set_title(f"{title}, {math.degrees(field):.1f}°\nRMS {rms:.1f} µm", fontsize=9)
            axis.set(aspect="equal", xlabel="x (µm)")
            axis.label_outer()
        row[0].set_ylabel("y (µm)")
    return figure


@torch.no_grad()
def spots_by_wavelength(
    lens: GeoLens,
    fields_rad: Sequence[float],
    light: analysis.Light = VISIBLE_UM,
    grid: int = 24,
    vignetting: bool = False,
    at_m: float = PARALLEL,
) -> Figure:
    """Figure of spots of each field about the chief ray, a colour per wavelength, with the Airy
    disc."""
    lines = list(_lines(light))
    first_um = lines[0][0]
    figure, axes = _grid(1, len(fields_rad), 3.1, 3.4, sharex=True, sharey=True)
    airy = 1.22 * first_um * float(analysis.working_fno(lens, first_um, at_m))
    for axis, field in zip(axes[0], fields_rad, strict=True):
        points, weight = analysis.polychromatic_spot(
            lens, field, light, grid, vignetting, at_m=at_m
        )
        centre = analysis.chief_ray(lens, field, first_um, at_m=at_m).position_mm[0]
        for p, w, (_, colour, label) in zip(points, weight, lines, strict=True):
            axis.plot(
                *((p[w > 0] - centre) * 1e3).T.numpy(), ".", ms=1.8, color=colour, label=label
            )
        axis.add_patch(plt.Circle((0, 0), airy, fill=False, color="k", lw=0.9, zorder=5))  # pyright: ignore[reportPrivateImportUsage]
        rms = 1e3 * float(analysis.spot_radius_mm(points, weight))
        axis.set_title(f"{degrees(field)}, RMS {rms:.1f} µm", fontsize=9)
        axis.set(xlabel="x (µm)", aspect="equal")
    axes[0, 0].set_ylabel("y (µm)")
    widest = max(*map(abs, (*axes[0, 0].get_xlim(), *axes[0, 0].get_ylim())), 1.1 * airy)
    axes[0, 0].set(xlim=(-widest, widest), ylim=(-widest, widest))
    return _legend(figure, axes, markerscale=4)


@torch.no_grad()
def ray_fans(
    lens: GeoLens,
    fields_rad: Sequence[float],
    light: analysis.Light = VISIBLE_UM,
    vignetting: bool = False,
    at_m: float = PARALLEL,
) -> Figure:
    """Figure of ray fans: transverse aberration (upper) and optical path difference (lower) over
    the pupil, a pair of columns per field, relative to the chief ray."""
    lines = list(_lines(light))
    figure, axes = _grid(2, 2 * len(fields_rad), 1.35, 2.1, sharey="row", sharex=True)
    for k, field in enumerate(fields_rad):
        reference = analysis.chief_ray(lens, field, lines[0][0], at_m=at_m).position_mm[0]
        for wavelength, colour, label in lines:
            fan = analysis.ray_fan(lens, field, wavelength, 65, vignetting, reference, at_m=at_m)
            for column, side in enumerate(SIDES, 2 * k):
                weight = getattr(fan, f"{side}_weight")
                values = getattr(fan, f"{side}_mm") * 1e3, getattr(fan, f"{side}_waves")
                for axis, value in zip(axes[:, column], values, strict=True):
                    shown = torch.where(weight > 0, value, math.nan)
                    axis.plot(fan.pupil.numpy(), shown.numpy(), color=colour, lw=1.1, label=label)
                axes[0, column].set_title(f"{degrees(field)}\n{side}", fontsize=10)
    for axis in axes.flat:
        axis.axhline(0, color="0.5", lw=0.6)
        axis.axvline(0, color="0.5", lw=0.6)
        axis.set(xlim=(-1, 1), xlabel="pupil")
        axis.label_outer()
    axes[0, 0].set_ylabel("transverse (µm)")
    axes[1, 0].set_ylabel("path difference (waves)")
    return _legend(figure, axes)


@torch.no_grad()
def opd_maps(
    lens: GeoLens,
    fields_rad: Sequence[float],
    wavelength_um: float = D_UM,
    grid: int = 96,
    vignetting: bool = False,
    at_m: float = PARALLEL,
) -> Figure:
    """Figure of optical path difference maps over the pupil, piston and tilt removed, one scale in
    waves."""
    column, row = ((analysis.pupil_grid(grid, lens.dtype) + 1) / 2 * grid).long().unbind(1)
    fronts = [
        analysis.remove_fit(
            analysis.wavefront(lens, field, wavelength_um, grid, vignetting, at_m=at_m)
        )
        for field in fields_rad
    ]
    limit = max(float(f.waves[f.weight > 0].abs().max()) for f in fronts) or 1e-12
    figure, axes = _grid(1, len(fronts), 2.9, 3.1)
    for axis, front, field in zip(axes[0], fronts, fields_rad, strict=True):
        picture = np.full((grid, grid), np.nan)
        picture[row, column] = torch.where(front.weight > 0, front.waves, math.nan).numpy()
        scale = {"cmap": "RdBu_r", "vmin": -limit, "vmax": limit, "interpolation": "nearest"}
        axis.imshow(picture, origin="lower", extent=(-1, 1, -1, 1), **scale)
        rms, strehl = float(analysis.rms_waves(front)), float(analysis.strehl_direct(front))
        axis.set_title(f"{degrees(field)}, RMS {rms:.3f} waves\nStrehl {strehl:.2g}", fontsize=9)
        axis.set(xticks=[-1, 0, 1], yticks=[-1, 0, 1], xlabel="pupil x")
    axes[0, 0].set_ylabel("pupil y")
    figure.colorbar(axes[0, 0].images[0], ax=list(axes[0]), label="waves", shrink=0.85)
    return figure


def psf_pictures(psfs: Sequence[Psf], titles: Sequence[str]) -> Figure:
    """Figure of point spreads (list of ``Psf``), each over its own peak on a logarithmic scale.
    Axes in µm about the reference point."""
    figure, axes = _grid(1, len(psfs), 2.9, 3.0)
    for axis, psf, title in zip(axes[0], psfs, titles, strict=True):
        energy = psf.energy.detach().numpy()
        count = len(energy)  # the reference is in the middle of pixel count // 2
        edges = np.array([-(count // 2), count - count // 2]) - 0.5
        x, y = (edges * float(p) * 1e3 for p in psf.pitch_mm.detach())
        picture = np.maximum(energy / max(energy.max(), 1e-300), FLOOR)
        axis.imshow(picture, origin="lower", extent=(*x, *y), cmap="magma", norm=LogNorm(FLOOR, 1))
        axis.set(xlabel="x (µm)")
        axis.set_title(title, fontsize=9)
    axes[0, 0].set_ylabel("y (µm)")
    figure.colorbar(axes[0, 0].images[0], ax=list(axes[0]), label="energy / peak", shrink=0.85)
    return figure


def mtf_curves(
    frequency_per_mm: Tensor,
    curves: Mapping[str, Tensor],
    ideal: Tensor | None = None,
) -> Figure:
    """Figure of MTFs.

    Args:
      frequency_per_mm: [K].
      curves: dict title -> [2, K] tangential (full line), sagittal (dashed).
      ideal: [K] or None.
    """
    figure, axis = plt.subplots(figsize=(7, 3.8), layout="constrained")
    frequency = np.asarray(frequency_per_mm)
    if ideal is not None:
        axis.plot(frequency, ideal.detach().numpy(), color="k", lw=1, ls=":", label="perfect lens")
    for (label, values), colour in zip(curves.items(), COLOURS * len(curves), strict=False):
        draw_sides(axis, frequency, values.detach(), colour, label)
    limits = {"ylim": (0, 1.02), "xlim": (0, float(frequency.max()))}
    finish(axis, xlabel="line pairs per mm", ylabel="modulation", **limits)
    return figure


def draw_sides(axis: Any, x: Any, curves: Tensor, colour: str, label: str) -> None:
    """Draw curves [2, K], tangential (full line) and sagittal (dashed), into an axis."""
    for curve, style, side in zip(curves, ("-", "--"), SIDES, strict=True):
        axis.plot(x, curve.numpy(), style, color=colour, lw=1.4, label=f"{label}, {side}")


def finish(axis: Any, **options: Any) -> None:
    """Labels and limits of an axis, a grid, and a legend where anything has a label."""
    axis.set(**options)
    axis.grid(alpha=0.3)
    if axis.get_legend_handles_labels()[0]:
        axis.legend(fontsize=8, frameon=False)


def _grid(
    rows: int,
    columns: int,
    width: float,
    height: float,
    **shared: Any,
) -> tuple[Figure, Any]:
    """A figure and its axes [rows, columns], each that large in inches."""
    size = (width * columns + 0.4, height * rows)
    return plt.subplots(rows, columns, figsize=size, squeeze=False, layout="constrained", **shared)


def _lines(light: analysis.Light) -> Iterator[tuple[float, str, str]]:
    """Wavelength in um, colour and label of the lines of light."""
    wavelengths, _ = analysis.spectral_lines(light)
    for i, wavelength_um in enumerate(wavelengths):
        yield wavelength_um, LINE_COLOURS[i % len(LINE_COLOURS)], f"{wavelength_um * 1e3:.0f} nm"


def _legend(figure, axes, **options):
    """The figure with the legend of its first axis above all."""
    handles = axes[0, 0].get_legend_handles_labels()
    figure.legend(
        *handles, loc="outside upper center", ncols=5, frameon=False, fontsize=10, **options
    )
    return figure
