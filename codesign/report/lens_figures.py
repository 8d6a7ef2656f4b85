"""Pictures of a lens: layout with rays, and spot diagrams."""

import math
from dataclasses import replace

import matplotlib.pyplot as plt
import numpy as np
import torch

from codesign.lens.analysis import field_rays, spots
from codesign.lens.geolens import GeoLens
from codesign.lens.surface import sag_mm

COLOURS = ("#1b6ca8", "#2e8b57", "#c0392b", "#8e44ad")


def draw_layout(axis, lens, fields_rad, rays=5):
    """Cross-section of a lens with meridional rays of each field. Lengths in mm."""
    surfaces = lens.to_surfaces()
    vertices = np.concatenate([[0.0], np.cumsum([s.thickness_mm for s in surfaces])])
    edges = []
    for s, at in zip(surfaces, vertices, strict=False):
        y = torch.linspace(-s.semi_aperture_mm, s.semi_aperture_mm, 61, dtype=torch.float64)
        edges.append((at + sag_mm(y, s.curvature_per_mm, s.conic, s.asphere).numpy(), y.numpy()))
    for i, s in enumerate(surfaces[:-1]):
        if s.medium is not None:
            (za, ya), (zb, yb) = edges[i], edges[i + 1]
            axis.fill(np.concatenate([za, zb[::-1]]), np.concatenate([ya, yb[::-1]]), color="#9cc3dd", alpha=0.55, lw=0)
    for sag, y in edges:
        axis.plot(sag, y, color="#24425c", lw=1)
    stop = lens.stop_index
    radius = float(lens.first_order().stop_semi_aperture_mm.detach())
    for sign in (-1, 1):
        axis.plot([vertices[stop]] * 2, [sign * radius, sign * max(radius * 1.25, surfaces[stop].semi_aperture_mm)], color="k", lw=2)
    film = vertices[-1]
    start = -0.12 * film
    tallest = max(s.semi_aperture_mm for s in surfaces)
    for field, colour in zip(fields_rad, COLOURS, strict=False):
        pupil = torch.stack([torch.zeros(rays, dtype=torch.float64), torch.linspace(-1, 1, rays, dtype=torch.float64)], 1)
        for path in _paths(lens, field, pupil, start):
            axis.plot(path[:, 0], path[:, 1], color=colour, lw=0.6)
            tallest = max(tallest, np.abs(path[:, 1]).max())
    axis.plot([film, film], [-tallest, tallest], color="k", lw=1.5)
    axis.set(xlabel="z (mm)", ylabel="y (mm)")
    axis.set_aspect("equal")


def _paths(lens, field, pupil, start):
    """Polylines (z, y) of rays, found by tracing the lens cut after each surface."""
    surfaces = lens.to_surfaces()
    origin, direction = field_rays(lens, field, pupil, start_z_mm=start)
    points = [torch.stack([origin[:, 2], origin[:, 1]], 1)]
    z = 0.0
    for i, s in enumerate(surfaces):
        part = GeoLens([*surfaces[:i], replace(s, thickness_mm=0.0, is_stop=False)], lens.entrance_pupil_diameter_mm, lens.curvature_per_mm.dtype)
        with torch.no_grad():
            out = part.trace(origin, direction)
        # rays end on the vertex plane behind surface i: step back along the ray onto the surface
        y, slope = out.position_mm[:, 1], out.direction[:, 1] / out.direction[:, 2]
        sag = torch.zeros_like(y)
        for _ in range(8):
            sag = sag_mm(y + slope * sag, s.curvature_per_mm, s.conic, s.asphere)
        points.append(torch.stack([z + sag, y + slope * sag], 1))
        z += s.thickness_mm
    with torch.no_grad():
        end = lens.trace(origin, direction)
    points.append(torch.stack([torch.full_like(end.position_mm[:, 1], z), end.position_mm[:, 1]], 1))
    ok = end.status == 0
    return [np.array([p[k].tolist() for p in points]) for k in range(pupil.shape[0]) if bool(ok[k])]


def layouts(lenses, fields_rad):
    """Figure of several lenses above one another: dict title -> lens."""
    figure, axes = plt.subplots(len(lenses), 1, figsize=(9, 3.0 * len(lenses)), sharex=True, squeeze=False)
    for axis, (title, lens) in zip(axes[:, 0], lenses.items(), strict=True):
        draw_layout(axis, lens, fields_rad)
        axis.set_title(title, loc="left")
    figure.tight_layout()
    return figure


def spot_diagrams(lenses, fields_rad, pixel_mm):
    """Figure of spot diagrams: a row per lens (dict title -> lens), a column per field, one scale, the pixel drawn in."""
    figure, axes = plt.subplots(len(lenses), len(fields_rad), figsize=(3.0 * len(fields_rad), 3.0 * len(lenses)), sharex=True, sharey=True, squeeze=False)
    for row, (title, lens) in zip(axes, lenses.items(), strict=True):
        with torch.no_grad():
            points, weight = spots(lens, fields_rad, grid=24)
        for axis, p, w, field in zip(row, points, weight, fields_rad, strict=True):
            p = p[w > 0]
            centre = p.mean(0)
            rms = (p - centre).square().sum(1).mean().sqrt() * 1e3
            p = ((p - centre) * 1e3).numpy()
            axis.plot(p[:, 0], p[:, 1], ".", ms=2, color=COLOURS[0])
            half = pixel_mm * 500
            axis.plot([-half, half, half, -half, -half], [-half, -half, half, half, -half], color="#c0392b", lw=1)
            axis.set_title(f"{title}, {math.degrees(field):.1f}°\nRMS {float(rms):.1f} µm", fontsize=9)
            axis.set_aspect("equal")
    for axis in axes[-1]:
        axis.set_xlabel("x (µm)")
    for axis in axes[:, 0]:
        axis.set_ylabel("y (µm)")
    figure.tight_layout()
    return figure
