"""A camera's chief rays as polynomials, so that points of space are projected in a few
multiplications instead of ray traces.

A chief ray that leaves with slope s (dx/dz, dy/dz) starts at base B(s) on the plane of the entrance
pupil and comes from the pixel U(s). The image of a point (X, Y, z) is U(s) with s = (X, Y)/z -
B(s)/z, an equation that fixed-point steps solve, since B is a part of a millimetre and z is metres.
U and B are Chebyshev series in both components of s, interpolated at their nodes and checked
against traced rays.
"""

from typing import Any

import torch
from torch import Tensor

from codesign import backend
from codesign.render.camera import Camera, lines, project
from codesign.render.film import border_px

FAR_M = 1e9  # at which a point is its direction
DEGREES = (8, 12, 16, 20)
TOLERANCE_PX = 1e-6
MARGINS = (0.2, 0.1, 0.03, 0.0)  # of the film's field, beyond its border
STEPS = 3
NEGLIGIBLE = 1e-12  # of the largest coefficient: symmetry makes most of them nothing but rounding


class ProjectionTable:
    """``project`` for one camera, from a table; also gives the chief ray that leads to the point.

    Where the lens has no such polynomials to 1e-6 px, and for points outside the table, rays are
    traced as in codesign.render.project.
    """

    @torch.no_grad()
    def __init__(self, camera: Camera):
        """camera: Camera, whose lens is read as it is now."""
        self.camera = camera
        self.series = None
        film = camera.film
        border = border_px(torch.zeros_like(film.sensor_px), film.sensor_px, 17)
        rays = camera.chief_rays(torch.cat([border, film.middle_px[None]]))
        slope = lines(rays)[1].double()
        if not bool(slope.isfinite().all() & (rays.weight > 0).all()):
            return  # the film is larger than the field of the lens
        middle = (slope.amax(0) + slope.amin(0)) / 2
        half = (slope.amax(0) - slope.amin(0)) / 2
        for margin in MARGINS:
            self.middle = middle
            self.half = half * (1 + margin)
            for degree in DEGREES:
                if (found := self._fitted(degree)) is None:
                    break  # the lens does not reach as far: try a smaller margin
                self.series = found
                if self._error_px() < TOLERANCE_PX:
                    return
                self.series = None

    @torch.no_grad()
    def __call__(self, points_cam_m: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Image and chief ray of points [N, 3] in camera axes with z > 0.

        Returns: pixels [N, 2] (NaN where there is no image), base [N, 2] metres and slope [N, 2] of
          the chief ray, all float64. No gradient.
        """
        pixels, base, slope, inside = self._from_series(points_cam_m)
        if not bool(inside.all()):
            rest = ~inside
            pixels[rest] = project(self.camera, points_cam_m[rest])
            found = rest & pixels.isfinite().all(1)
            if bool(found.any()):
                base[found], slope[found] = lines(self.camera.chief_rays(pixels[found]))
        return pixels, base, slope

    def _from_series(self, points_cam_m):
        count = len(points_cam_m)
        if self.series is None or not count:  # a kernel needs a point
            straight = points_cam_m[:, :2] / points_cam_m[:, 2:]
            return (
                torch.full_like(straight, torch.nan),
                torch.zeros_like(straight),
                straight,
                torch.zeros_like(straight[:, 0], dtype=torch.bool),
            )
        found = backend.run_kernel(
            self._solved, points_cam_m.T.contiguous().unbind(), [(count,)] * 7
        )
        pixels, base, slope = (torch.stack(found[k : k + 2], 1) for k in (0, 2, 4))
        return pixels, base, slope, found[6] > 0

    def _solved(self, arr, x, y, z):
        """Kernel: pixel, base and slope of points, two components each, and 1 where they are in the
        table. A point's bits do not depend on those beside it."""
        import drjit as dr

        slope = straight = [x / z, y / z]
        for _ in range(STEPS):
            base = self._series_at(arr, slope, (2, 3))
            before = slope
            slope = [s - b / z for s, b in zip(straight, base, strict=True)]
        inside = arr.Bool(True)
        for s, b, middle, half in zip(slope, before, *self._span(), strict=True):
            inside &= (dr.abs((s - middle) / half) <= 1) & (dr.abs(s - b) < 1e-9)
        pixels = self._series_at(arr, slope, (0, 1))
        return *pixels, *base, *slope, dr.select(inside, arr.Float(1), 0)

    def _series_at(self, arr, slope, kinds):
        """Values of the series of some kinds at slopes, as literals: a table has a kernel of its
        own, which leaves out what is 0."""
        import drjit as dr

        count = len(self.series)
        across, down = (
            _chebyshev(dr.clip((s - middle) / half, -1, 1), count)
            for s, middle, half in zip(slope, *self._span(), strict=True)
        )
        values = []
        for kind in kinds:
            value = arr.Float(0)
            for coefficients, term in zip(self.series[..., kind].tolist(), across, strict=True):
                row = [c * each for c, each in zip(coefficients, down, strict=True) if c]
                value = value + term * sum(row[1:], row[0]) if row else value
            values.append(value)
        return values

    def _span(self):
        return self.middle.tolist(), self.half.tolist()

    def _fitted(self, degree):
        """Coefficients [degree + 1, degree + 1, 4] of pixel and base; None when a node lies outside
        the lens's field."""
        count = degree + 1
        k = torch.arange(count, dtype=torch.float64, device=self.middle.device)
        nodes = torch.cos(torch.pi * (k + 0.5) / count)
        x, y = torch.meshgrid(nodes, nodes, indexing="ij")
        slope = self.middle + self.half * torch.stack([x.reshape(-1), y.reshape(-1)], 1)
        pixels = project(self.camera, torch.cat([slope, torch.ones_like(slope[:, :1])], 1) * FAR_M)
        if not bool(pixels.isfinite().all()):
            return None
        base, _ = lines(self.camera.chief_rays(pixels))
        values = torch.cat([pixels, base], 1).double().reshape(count, count, 4)
        # interpolation at the nodes: discrete orthogonality
        basis = torch.stack(_chebyshev(nodes, count), 1) * (2 / count)
        basis[:, 0] /= 2
        series = torch.einsum("ik,jl,ijc->klc", basis, basis, values)
        least = NEGLIGIBLE * series.abs().amax((0, 1))
        return torch.where(series.abs() < least, 0.0, series)

    def _error_px(self):
        """Largest error against traced rays, at points of a spiral over the table and three
        depths."""
        k = torch.arange(96, dtype=torch.float64, device=self.middle.device)
        radius = ((k + 0.5) / 96).sqrt() * 1.3
        angle = k * 2.399963
        at = (radius[:, None] * torch.stack([angle.cos(), angle.sin()], 1)).clamp(-0.98, 0.98)
        depth = k.new_tensor([0.3, 1.5, 20.0]).repeat(32)[:, None]
        points = torch.cat([self.middle + self.half * at, torch.ones_like(depth)], 1) * depth
        pixels, _, _, inside = self._from_series(points)
        truth = project(self.camera, points)
        both = inside & truth.isfinite().all(1)
        return float((pixels - truth)[both].abs().max()) if bool(both.any()) else float("inf")


def _chebyshev(at: Any, count: int) -> list[Any]:
    """T_0 .. T_(count - 1) at values in [-1, 1]."""
    terms = [at * 0 + 1, at]
    for _ in range(2, count):
        terms.append(2 * at * terms[-1] - terms[-2])
    return terms
