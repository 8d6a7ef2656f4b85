"""Pictures of lens errors over the field, over focus, and over the surfaces: distortion, field
curvature, through focus, Seidel sums.

at_m, in all of them: metres to the object plane, inf for parallel light. The first wavelength is
the reference.
"""

import math
from collections.abc import Sequence

import matplotlib.pyplot as plt
import numpy as np
import torch
from matplotlib.figure import Figure

from codesign.lens import analysis
from codesign.lens.distance import PARALLEL
from codesign.lens.geolens import GeoLens
from codesign.lens.glass import D_UM
from codesign.lens.seidel import SeidelSums
from codesign.report.lens_figures import SIDES, VISIBLE_UM, draw_sides, finish
from codesign.report.lens_layout import COLOURS, coloured, degrees

SEIDEL_NAMES = ("spherical $S_I$", "coma $S_{II}$", "astigmatism $S_{III}$", "Petzval $S_{IV}$")
SEIDEL_NAMES += ("distortion $S_V$",)
SEIDEL_COLOURS = ("#1b6ca8", "#2e8b57", "#d68910", "#8e44ad", "#c0392b")


@torch.no_grad()
def field_errors(
    lens: GeoLens,
    half_field_rad: float,
    light: analysis.Light = VISIBLE_UM,
    count: int = 21,
    at_m: float = PARALLEL,
) -> Figure:
    """Figure over the field: tangential and sagittal focus, distortion, and, of several wavelengths,
    lateral colour."""
    reference, *others = analysis.spectral_lines(light)[0]
    fields = [half_field_rad * i / (count - 1) for i in range(count)]
    angles = np.degrees(fields)
    figure, axes = plt.subplots(
        1, 3 if others else 2, figsize=(10, 3.8), sharey=True, layout="constrained"
    )
    shifts = analysis.focus_shift_mm(lens, fields, reference, at_m=at_m)
    for column, style, side in zip(shifts.T, ("-", "--"), SIDES, strict=True):
        axes[0].plot(column.numpy(), angles, style, color=COLOURS[0], label=side)
    axes[0].set(xlabel="focus shift (mm)", ylabel="field (degrees)", title="Field curvature")
    distortion = analysis.distortion_percent(lens, fields, wavelength_um=reference, at_m=at_m)
    axes[1].plot(distortion.numpy(), angles, color=COLOURS[2])
    axes[1].set(xlabel="distortion (%), f-tan", title="Distortion")
    if others:
        colours = analysis.lateral_colour_mm(lens, fields, others, reference, at_m).T
        for k, (wavelength, shift) in enumerate(zip(others, colours, strict=True)):
            label = f"{wavelength * 1e3:.0f} nm"
            axes[2].plot(1e3 * shift.numpy(), angles, color=COLOURS[1:][k % 3], label=label)
        label = f"height − that at {reference * 1e3:.0f} nm (µm)"
        axes[2].set(xlabel=label, title="Lateral colour")
    for axis in axes:
        axis.axvline(0, color="0.5", lw=0.6)
        widest = np.abs(axis.get_xlim()).max()
        finish(axis, xlim=(-widest, widest), ylim=(0, angles[-1]))
    return figure


@torch.no_grad()
def through_focus(
    lens: GeoLens,
    fields_rad: Sequence[float],
    defocus_mm: Sequence[float] | np.ndarray,
    frequency_per_mm: float,
    light: analysis.Light = D_UM,
    vignetting: bool = False,
    at_m: float = PARALLEL,
) -> Figure:
    """Figure over the position of the image plane: RMS spot, and MTF of the rays at one
    frequency."""
    figure, axes = plt.subplots(1, 2, figsize=(10, 3.6), layout="constrained")
    z = np.asarray(defocus_mm, dtype=float)
    sizes = analysis.through_focus_spot_mm(lens, fields_rad, z, light, 32, vignetting, at_m) * 1e3
    for (field, colour), row in zip(coloured(fields_rad), sizes, strict=True):
        axes[0].plot(z, row.numpy(), color=colour, label=degrees(field))
        curves = analysis.through_focus_mtf(
            lens, field, frequency_per_mm, z, light, "geometric", vignetting, at_m
        )
        draw_sides(axes[1], z, curves, colour, degrees(field))
    for axis in axes:
        axis.axvline(0, color="0.5", lw=0.6)
    finish(axes[0], xlabel="defocus (mm)", ylabel="RMS spot (µm)", ylim=(0, None))
    label = f"geometric MTF at {frequency_per_mm:g} / mm"
    finish(axes[1], xlabel="defocus (mm)", ylabel=label, ylim=(0, 1.02))
    return figure


def seidel_bars(sums: SeidelSums, wavelength_um: float = D_UM) -> Figure:
    """Figure of Seidel sums (``SeidelSums``) per surface and, on a scale of its own, in total; in
    waves."""
    values, total = (
        v.detach().numpy() / (wavelength_um * 1e-3) for v in (sums.per_surface, sums.total)
    )
    figure, axes = plt.subplots(
        1, 2, figsize=(10, 3.6), width_ratios=[4, 1.2], layout="constrained"
    )
    place = np.arange(len(values))
    for k, (name, colour) in enumerate(zip(SEIDEL_NAMES, SEIDEL_COLOURS, strict=True)):
        axes[0].bar(place + 0.16 * (k - 2), values[:, k], 0.16, color=colour, label=name)
    axes[1].bar(["I", "II", "III", "IV", "V"], total, 0.7, color=SEIDEL_COLOURS)
    axes[0].set_xticks(place, place + 1)
    axes[0].set(xlabel="surface", ylabel="waves")
    axes[1].set(xlabel="sum", title="whole lens")
    for axis in axes:
        axis.axhline(0, color="k", lw=0.7)
        axis.grid(axis="y", alpha=0.3)
    handles = axes[0].get_legend_handles_labels()
    figure.legend(*handles, loc="outside upper left", frameon=False, fontsize=8, ncols=5)
    return figure


@torch.no_grad()
def encircled_curves(
    lens: GeoLens,
    fields_rad: Sequence[float],
    light: analysis.Light = D_UM,
    vignetting: bool = False,
    at_m: float = PARALLEL,
) -> Figure:
    """Figure of encircled energy (rays, about their mean) over the radius, a curve per field."""
    figure, axis = plt.subplots(figsize=(7, 3.4), layout="constrained")
    options = {"light": light, "grid": 48, "vignetting": vignetting, "at_m": at_m}
    largest = max(
        float(analysis.encircled_radius_mm(lens, field, 1.0, **options)) for field in fields_rad
    )
    radii = torch.linspace(0, 1.02 * largest, 200, dtype=lens.dtype)
    for field, colour in coloured(fields_rad):
        energy = analysis.encircled_energy(lens, field, radii, **options)
        axis.plot(radii.numpy() * 1e3, energy.numpy(), color=colour, label=degrees(field))
    finish(
        axis, xlabel="radius (µm)", ylabel="share of rays inside", ylim=(0, 1.02), xlim=(0, None)
    )
    return figure


@torch.no_grad()
def depth_curves(
    lens: GeoLens,
    fields_rad: Sequence[float],
    near_m: float,
    far_m: float,
    blur_mm: float,
    wavelength_um: float = D_UM,
) -> Figure:
    """Figure over the distance of the object, even in 1 / distance: RMS spot of each field with the
    film where it is, and the RMS radius of a disc ``blur_mm`` across as a dashed line."""
    vergence = torch.linspace(1 / far_m, 1 / near_m, 129, dtype=lens.dtype)
    sizes = analysis.rms_spot_mm(lens, fields_rad, wavelength_um, 16, 1 / vergence, True) * 1e3
    figure, axis = plt.subplots(figsize=(7, 3.4), layout="constrained")
    for (field, colour), column in zip(coloured(fields_rad), sizes.T, strict=True):
        axis.plot(vergence.numpy(), column.numpy(), color=colour, label=degrees(field))
    axis.axhline(1e3 * blur_mm / math.sqrt(8), color="0.4", ls="--", lw=1)
    ticks = np.linspace(1 / far_m, 1 / near_m, 7)
    axis.set_xticks(ticks, [f"{1 / t:.3g}" if t > 0 else "∞" for t in ticks])
    finish(axis, xlabel="distance of the object (m)", ylabel="RMS spot (µm)", ylim=(0, None))
    return figure
