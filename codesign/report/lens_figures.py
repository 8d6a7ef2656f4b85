"""Pictures of what a lens does to light: spots, ray fans, wavefront, point spread, MTF. Each function returns
a matplotlib Figure."""

import math
from collections.abc import Mapping, Sequence

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
from codesign.lens.glass import WAVELENGTH_UM
from codesign.report.lens_layout import COLOURS, draw_layout, layouts, lens_layout

__all__ = [
    "COLOURS",
    "VISIBLE_UM",
    "draw_layout",
    "layouts",
    "lens_layout",
    "mtf_curves",
    "opd_maps",
    "psf_pictures",
    "ray_fans",
    "spot_diagrams",
    "spots_by_wavelength",
]

VISIBLE_UM = tuple(WAVELENGTH_UM[line] for line in "dFC")
LINE_COLOURS = (
    "#2e8b57",
    "#1b6ca8",
    "#c0392b",
    "#8e44ad",
    "#d68910",
)  # of wavelengths; the first is the reference


def spot_diagrams(
    lenses: Mapping[str, GeoLens], fields_rad: Sequence[float], pixel_mm: float, at_m: float = PARALLEL
) -> Figure:
    """Figure of spot diagrams: a row per lens (dict title -> lens), a column per field, one scale, the pixel
    drawn in. at_m, here as in the other pictures: metres to the object plane, inf for parallel light."""
    figure, axes = plt.subplots(
        len(lenses),
        len(fields_rad),
        figsize=(3.0 * len(fields_rad), 3.0 * len(lenses)),
        sharex=True,
        sharey=True,
        squeeze=False,
    )
    for row, (title, lens) in zip(axes, lenses.items(), strict=True):
        with torch.no_grad():
            points, weight = analysis.spots(lens, fields_rad, grid=24, at_m=at_m)
        for axis, p, w, field in zip(row, points, weight, fields_rad, strict=True):
            p = p[w > 0]
            centre = p.mean(0)
            rms = (p - centre).square().sum(1).mean().sqrt() * 1e3
            p = ((p - centre) * 1e3).numpy()
            axis.plot(p[:, 0], p[:, 1], ".", ms=2, color=COLOURS[0])
            half = pixel_mm * 500
            axis.plot(
                [-half, half, half, -half, -half], [-half, -half, half, half, -half], color="#c0392b", lw=1
            )
            axis.set_title(f"{title}, {math.degrees(field):.1f}°\nRMS {float(rms):.1f} µm", fontsize=9)
            axis.set_aspect("equal")
    for axis in axes[-1]:
        axis.set_xlabel("x (µm)")
    for axis in axes[:, 0]:
        axis.set_ylabel("y (µm)")
    figure.tight_layout()
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
    """Figure of spots of each field about the chief ray of the first wavelength, a colour per wavelength,
    with the Airy disc."""
    wavelengths, _ = analysis.spectral_lines(light)
    figure, axes = plt.subplots(
        1,
        len(fields_rad),
        figsize=(3.1 * len(fields_rad), 3.4),
        sharex=True,
        sharey=True,
        squeeze=False,
        layout="constrained",
    )
    airy = 1.22 * wavelengths[0] * float(lens.first_order(wavelengths[0]).fno.abs())
    for axis, field in zip(axes[0], fields_rad, strict=True):
        points, weight = analysis.polychromatic_spot(lens, field, light, grid, vignetting, at_m=at_m)
        centre = analysis.chief_ray(lens, field, wavelengths[0], at_m=at_m).position_mm[0]
        for p, w, wavelength, colour in zip(
            points, weight, wavelengths, LINE_COLOURS * len(wavelengths), strict=False
        ):
            p = ((p[w > 0] - centre) * 1e3).numpy()
            axis.plot(p[:, 0], p[:, 1], ".", ms=1.8, color=colour, label=f"{wavelength * 1e3:.0f} nm")
        axis.add_patch(plt.Circle((0, 0), airy, fill=False, color="k", lw=0.9, zorder=5))  # pyright: ignore[reportPrivateImportUsage]
        axis.set_title(
            f"{math.degrees(field):.3g}°, RMS {1e3 * float(analysis.spot_radius_mm(points, weight)):.1f} µm",
            fontsize=9,
        )
        axis.set(xlabel="x (µm)", aspect="equal")
    axes[0, 0].set_ylabel("y (µm)")
    widest = max(max(map(abs, (*axes[0, 0].get_xlim(), *axes[0, 0].get_ylim()))), 1.1 * airy)
    axes[0, 0].set(xlim=(-widest, widest), ylim=(-widest, widest))
    figure.legend(
        *axes[0, 0].get_legend_handles_labels(),
        loc="outside upper center",
        ncols=len(wavelengths),
        frameon=False,
        fontsize=8,
        markerscale=4,
    )
    return figure


@torch.no_grad()
def ray_fans(
    lens: GeoLens,
    fields_rad: Sequence[float],
    light: analysis.Light = VISIBLE_UM,
    vignetting: bool = False,
    at_m: float = PARALLEL,
) -> Figure:
    """Figure of ray fans: transverse aberration (upper) and optical path difference (lower) over the pupil, a
    pair of columns per field, relative to the first wavelength's chief ray."""
    wavelengths, _ = analysis.spectral_lines(light)
    figure, axes = plt.subplots(
        2,
        2 * len(fields_rad),
        figsize=(3.4 * len(fields_rad), 4.6),
        sharey="row",
        sharex=True,
        squeeze=False,
        layout="constrained",
    )
    for k, field in enumerate(fields_rad):
        reference = analysis.chief_ray(lens, field, wavelengths[0], at_m=at_m).position_mm[0]
        for wavelength, colour in zip(wavelengths, LINE_COLOURS * len(wavelengths), strict=False):
            fan = analysis.ray_fan(lens, field, wavelength, 65, vignetting, reference, at_m=at_m)
            rows = (fan.tangential_mm * 1e3, fan.sagittal_mm * 1e3, fan.tangential_waves, fan.sagittal_waves)
            weights = (fan.tangential_weight, fan.sagittal_weight) * 2
            for axis, values, weight in zip(
                (*axes[0, 2 * k : 2 * k + 2], *axes[1, 2 * k : 2 * k + 2]), rows, weights, strict=True
            ):
                axis.plot(
                    fan.pupil.numpy(),
                    torch.where(weight > 0, values, math.nan).numpy(),
                    color=colour,
                    lw=1.1,
                    label=f"{wavelength * 1e3:.0f} nm",
                )
        axes[0, 2 * k].set_title(f"{math.degrees(field):.3g}°, tangential", fontsize=8)
        axes[0, 2 * k + 1].set_title(f"{math.degrees(field):.3g}°, sagittal", fontsize=8)
    for axis in axes.flat:
        axis.axhline(0, color="0.5", lw=0.6)
        axis.axvline(0, color="0.5", lw=0.6)
        axis.set_xlim(-1, 1)
    for axis in axes[1]:
        axis.set_xlabel("pupil", fontsize=8)
    axes[0, 0].set_ylabel("transverse (µm)")
    axes[1, 0].set_ylabel("path difference (waves)")
    figure.legend(
        *axes[0, 0].get_legend_handles_labels(),
        loc="outside upper center",
        ncols=len(wavelengths),
        frameon=False,
        fontsize=8,
    )
    return figure


@torch.no_grad()
def opd_maps(
    lens: GeoLens,
    fields_rad: Sequence[float],
    wavelength_um: float = WAVELENGTH_UM["d"],
    grid: int = 96,
    vignetting: bool = False,
    at_m: float = PARALLEL,
) -> Figure:
    """Figure of optical path difference maps over the pupil, piston and tilt removed, one scale in waves."""
    pupil = analysis.pupil_grid(grid, lens.dtype)
    fronts = [
        analysis.remove_fit(analysis.wavefront(lens, field, wavelength_um, grid, vignetting, at_m=at_m))
        for field in fields_rad
    ]
    limit = max(float(f.waves[f.weight > 0].abs().max()) for f in fronts) or 1e-12
    figure, axes = plt.subplots(
        1, len(fronts), figsize=(2.9 * len(fronts) + 0.8, 3.1), squeeze=False, layout="constrained"
    )
    place = ((pupil + 1) / 2 * grid).long()
    for axis, front, field in zip(axes[0], fronts, fields_rad, strict=True):
        picture = np.full((grid, grid), np.nan)
        picture[place[:, 1], place[:, 0]] = torch.where(front.weight > 0, front.waves, math.nan).numpy()
        axis.imshow(
            picture,
            origin="lower",
            extent=(-1, 1, -1, 1),
            cmap="RdBu_r",
            vmin=-limit,
            vmax=limit,
            interpolation="nearest",
        )
        strehl = float(analysis.strehl_direct(front))
        axis.set_title(
            f"{math.degrees(field):.3g}°, RMS {float(analysis.rms_waves(front)):.3f} waves\nStrehl "
            f"{strehl:.2g}",
            fontsize=9,
        )
        axis.set(xticks=[-1, 0, 1], yticks=[-1, 0, 1], xlabel="pupil x")
    axes[0, 0].set_ylabel("pupil y")
    figure.colorbar(axes[0, 0].images[0], ax=list(axes[0]), label="waves", shrink=0.85)
    return figure


def psf_pictures(psfs: Sequence[Psf], titles: Sequence[str], floor: float = 1e-4) -> Figure:
    """Figure of point spreads (list of ``Psf``), each over its own peak on a logarithmic scale. Axes in µm
    about the reference point."""
    figure, axes = plt.subplots(
        1, len(psfs), figsize=(2.9 * len(psfs) + 0.8, 3.0), squeeze=False, layout="constrained"
    )
    for axis, psf, title in zip(axes[0], psfs, titles, strict=True):
        energy = psf.energy.detach().numpy()
        half_x, half_y = (energy.shape[0] / 2 * float(p) * 1e3 for p in psf.pitch_mm.detach())
        picture = np.maximum(energy / max(energy.max(), 1e-300), floor)
        axis.imshow(
            picture,
            origin="lower",
            extent=(-half_x, half_x, -half_y, half_y),
            cmap="magma",
            norm=LogNorm(floor, 1),
        )
        axis.set(xlabel="x (µm)")
        axis.set_title(title, fontsize=9)
    axes[0, 0].set_ylabel("y (µm)")
    figure.colorbar(axes[0, 0].images[0], ax=list(axes[0]), label="energy / peak", shrink=0.85)
    return figure


def mtf_curves(
    frequency_per_mm: Tensor, curves: Mapping[str, Tensor], ideal: Tensor | None = None, title: str = ""
) -> Figure:
    """Figure of MTFs. Args: frequency_per_mm [K]; curves: dict title -> [2, K] tangential (full line),
    sagittal (dashed); ideal [K] or None."""
    figure, axis = plt.subplots(figsize=(7, 3.8), layout="constrained")
    frequency = np.asarray(frequency_per_mm)
    if ideal is not None:
        axis.plot(frequency, np.asarray(ideal.detach()), color="k", lw=1, ls=":", label="perfect lens")
    for (label, values), colour in zip(curves.items(), COLOURS * len(curves), strict=False):
        for style, row, name in zip(
            ("-", "--"), values.detach().numpy(), ("tangential", "sagittal"), strict=True
        ):
            axis.plot(frequency, row, style, color=colour, lw=1.4, label=f"{label}, {name}")
    axis.set(
        xlabel="line pairs per mm", ylabel="modulation", ylim=(0, 1.02), xlim=(0, float(frequency.max()))
    )
    axis.set_title(title, loc="left", fontsize=10)
    axis.grid(alpha=0.3)
    axis.legend(fontsize=8, frameon=False)
    return figure
