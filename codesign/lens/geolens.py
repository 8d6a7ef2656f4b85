"""A ray-traced lens whose curvatures, thicknesses, conics, asphere terms and indices carry gradients."""

import copy
import dataclasses
import math

import torch
from torch import nn

from codesign.errors import DomainError, ShapeError, check_finite
from codesign.lens import paraxial
from codesign.lens.aiming import aim_at_stop
from codesign.lens.glass import AIR, WAVELENGTH_UM
from codesign.lens.pinhole import ThinLens
from codesign.lens.surface import scaled
from codesign.lens.trace import Prescription, Status, trace
from codesign.types import Rays

LEARNABLES = (
    "curvature_per_mm",
    "thickness_mm",
    "conic",
    "asphere",
    "index_offset",
    "phase",
    "decentre_mm",
    "tilt_rad",
)


class GeoLens(nn.Module):
    """Sequential lens. First vertex at z = 0, light along +z, flat image plane behind the last thickness.

    Learnables (nn.Parameter, one row per surface): curvature_per_mm [S], thickness_mm [S], conic [S], asphere
      [S, A],
    index_offset [S] (added to the index behind each surface, dimensionless, zero at first), phase [S, P]
    (radians per mm^2, mm^4, ...).
    Errors of assembly (buffers, with gradients after ``requires_grad_`` or through ``replace``): decentre_mm
    [S, 2], tilt_rad [S, 2].
    half_field_deg: the half field the lens is made for, or None where nobody said.
    """

    semi_aperture_mm: torch.Tensor
    decentre_mm: torch.Tensor
    tilt_rad: torch.Tensor

    def __init__(
        self,
        surfaces,
        entrance_pupil_diameter_mm,
        dtype=torch.float64,
        soft_edge_mm=0.2,
        name="lens",
        half_field_deg=None,
    ):
        super().__init__()
        surfaces = tuple(surfaces)
        if not surfaces:
            raise DomainError(f"{name}: a lens needs at least one surface; none were given.")
        for i, surface in enumerate(surfaces):
            surface.check(f"{name}, surface {i + 1}")
        if not 0 < entrance_pupil_diameter_mm < math.inf:
            raise DomainError(
                f"{name}: entrance pupil diameter {entrance_pupil_diameter_mm} mm must be positive and "
                "finite."
            )
        if not 0 <= soft_edge_mm < math.inf:
            raise DomainError(
                f"{name}: soft edge {soft_edge_mm} mm must be a finite width of at least 0; about 0.1 mm "
                "keeps gradients true."
            )
        if half_field_deg is not None and not 0 < half_field_deg < 90:
            raise DomainError(f"{name}: half field {half_field_deg} degrees must lie between 0 and 90.")
        stops = [i for i, s in enumerate(surfaces) if s.is_stop]
        if len(stops) > 1:
            raise DomainError(
                f"{name}: surfaces {[i + 1 for i in stops]} are all marked as the stop; mark one."
            )
        self.name = name
        self.surfaces = surfaces
        self.stop_index = stops[0] if stops else 0
        self.entrance_pupil_diameter_mm = float(entrance_pupil_diameter_mm)
        self.soft_edge_mm = float(soft_edge_mm)
        self.half_field_deg = half_field_deg
        self.mirrors = tuple(s.mirror for s in surfaces)

        def column(values):
            return torch.tensor(values, dtype=dtype)

        self.curvature_per_mm = nn.Parameter(column([s.curvature_per_mm for s in surfaces]))
        self.thickness_mm = nn.Parameter(column([s.thickness_mm for s in surfaces]))
        self.conic = nn.Parameter(column([s.conic for s in surfaces]))
        self.asphere = nn.Parameter(_table([s.asphere for s in surfaces], dtype))
        self.index_offset = nn.Parameter(torch.zeros(len(surfaces), dtype=dtype))
        self.phase = nn.Parameter(_table([s.phase.coefficients if s.phase else () for s in surfaces], dtype))
        self.register_buffer("decentre_mm", column([s.decentre_mm for s in surfaces]))
        self.register_buffer("tilt_rad", column([[math.radians(a) for a in s.tilt_deg] for s in surfaces]))
        self.register_buffer(
            "semi_aperture_mm", torch.tensor([s.semi_aperture_mm for s in surfaces], dtype=dtype)
        )

    @property
    def dtype(self):
        return self.curvature_per_mm.dtype

    def replace(self, **tensors):
        """A lens that shares everything with this one except the named tensors, which may depend on other
        tensors.

        The way to optimise: build curvatures and thicknesses from a design vector, put them in, trace, and go
          backward.
        """
        twin = copy.copy(self)
        twin._parameters = dict(self._parameters)
        for name, value in tensors.items():
            if name not in LEARNABLES:
                raise DomainError(f"a lens has no tensor '{name}'; it has {', '.join(LEARNABLES)}.")
            if value.shape != getattr(self, name).shape:
                raise ShapeError(
                    f"{name} has shape {tuple(getattr(self, name).shape)}, got {tuple(value.shape)}."
                )
            twin._parameters.pop(name, None)
            object.__setattr__(twin, name, value)
        return twin

    def freeze(self, *names):
        """Stop the gradient to the named tensors (all when none is named); returns the lens."""
        for name in names or tuple(self._parameters):
            if name not in LEARNABLES:
                raise DomainError(f"a lens has no tensor '{name}'; it has {', '.join(LEARNABLES)}.")
            getattr(self, name).requires_grad_(False)
        return self

    def scaled(self, factor):
        """A new lens with all lengths multiplied by ``factor`` (same f-number and angles), from the current
        values."""
        surfaces = [scaled(s, factor) for s in self.to_surfaces()]
        return GeoLens(
            surfaces,
            self.entrance_pupil_diameter_mm * factor,
            self.dtype,
            self.soft_edge_mm * factor,
            self.name,
            self.half_field_deg,
        )

    def to_surfaces(self):
        """The current values as a tuple of Surface; index offsets go into the media. A curvature or tilt that
        never changed keeps its value to the last bit."""
        found = []
        at_first = torch.tensor([s.curvature_per_mm for s in self.surfaces], dtype=self.dtype).tolist()
        tilts = torch.tensor(
            [[math.radians(a) for a in s.tilt_deg] for s in self.surfaces], dtype=self.dtype
        ).tolist()
        columns = (getattr(self, name).tolist() for name in LEARNABLES)
        for old, first, tilted, c, t, k, a, shift, phase, decentre, tilt in zip(
            self.surfaces, at_first, tilts, *columns, strict=True
        ):
            found.append(
                dataclasses.replace(
                    old,
                    radius_mm=old.radius_mm if c == first else 1 / c if c else math.inf,
                    thickness_mm=t,
                    conic=k,
                    asphere=tuple(a) if any(a) or old.asphere else (),
                    medium=(old.medium or AIR).shifted(shift) if shift else old.medium,
                    phase=old.phase and dataclasses.replace(old.phase, coefficients=tuple(phase)),
                    decentre_mm=tuple(decentre),
                    tilt_deg=old.tilt_deg if tilt == tilted else tuple(map(math.degrees, tilt)),
                )
            )
        return tuple(found)

    def index(self, wavelength_um=WAVELENGTH_UM["d"]):
        """Indices [S + 1] at a wavelength, the first before the lens (air). Behind a mirror it is the index
        before it."""
        values = [1.0, *[1.0 if s.medium is None else s.medium.index(wavelength_um) for s in self.surfaces]]
        base = torch.tensor(values, dtype=self.dtype, device=self.curvature_per_mm.device)
        found = base + torch.cat([torch.zeros_like(self.index_offset[:1]), self.index_offset])
        if not any(self.mirrors):
            return found
        source = list(range(len(values)))
        for i, mirror in enumerate(self.mirrors):
            source[i + 1] = source[i] if mirror else i + 1
        return found[source]

    def path_mm(self, wavelength_um=WAVELENGTH_UM["d"]):
        """Optical path that the diffractive phases add, as coefficients [S, P] of r^2, r^4, ... in mm."""
        orders = torch.tensor(
            [s.phase.order if s.phase else 0 for s in self.surfaces],
            dtype=self.dtype,
            device=self.phase.device,
        )
        return self.phase * (orders * (wavelength_um * 1e-3 / (2 * math.pi)))[:, None]

    def surface_power(self, wavelength_um=WAVELENGTH_UM["d"]):
        """Paraxial power of each surface, [S] per mm: vertex curvature (with the r^2 asphere term) times
        bending, and diffraction."""
        vertex = (
            self.curvature_per_mm + 2 * self.asphere[:, 0] if self.asphere.shape[1] else self.curvature_per_mm
        )
        power = vertex * paraxial.bending(self.index(wavelength_um), self.mirrors)
        return power - 2 * self.path_mm(wavelength_um)[:, 0] if self.phase.shape[1] else power

    def first_order(self, wavelength_um=WAVELENGTH_UM["d"]):
        """Paraxial figures (FirstOrder) at a wavelength, differentiable."""
        return paraxial.first_order(
            self.surface_power(wavelength_um),
            self.thickness_mm,
            self.index(wavelength_um),
            self.stop_index,
            self.entrance_pupil_diameter_mm,
        )

    def prescription(self, wavelength_um=WAVELENGTH_UM["d"]):
        """The numbers the ray-trace kernel needs."""
        shape = (self.curvature_per_mm, self.thickness_mm, self.conic, self.asphere)
        efficiency = math.prod(s.phase.efficiency(wavelength_um) for s in self.surfaces if s.phase)
        inner = tuple(s.inner_semi_aperture_mm for s in self.surfaces)
        return Prescription(
            *shape,
            self.index(wavelength_um),
            self.semi_aperture_mm,
            self.soft_edge_mm,
            self.path_mm(wavelength_um),
            self.decentre_mm,
            self.tilt_rad,
            self.mirrors,
            inner,
            efficiency,
        )

    def trace(self, origin_mm, direction, wavelength_um=WAVELENGTH_UM["d"]):
        """Trace rays to the image plane: origins [N, 3] relative to the first vertex, unit directions [N, 3]
        -> TraceResult.

        Raises: ShapeError; DomainError for origins that are not finite or directions that are not unit
          vectors.
        """
        for label, value in (("origin_mm", origin_mm), ("direction", direction)):
            if value.ndim != 2 or value.shape[1] != 3 or value.shape[0] == 0:
                raise ShapeError(f"{label} must be [N >= 1, 3], got {tuple(value.shape)}.")
        if origin_mm.shape != direction.shape:
            raise ShapeError(
                f"{origin_mm.shape[0]} origins but {direction.shape[0]} directions were given; give one of "
                "each per ray."
            )
        if not all(map(math.isfinite, _range(origin_mm, lambda rows: rows))):
            check_finite(origin_mm, "origin_mm")
        ones = direction.new_ones(3)
        shortest, longest = _range(direction, lambda rows: torch.mv(rows.square(), ones))
        if not (shortest > 0.9998 and longest < 1.0002):
            raise DomainError(
                f"direction: squared lengths lie between {shortest:.6g} and {longest:.6g}; give finite unit "
                "vectors (torch.nn.functional.normalize)."
            )
        return trace(self.prescription(wavelength_um), origin_mm, direction)

    def thin(self, wavelength_um=WAVELENGTH_UM["d"]):
        """The paraxial level of this lens: same focal length, pupil and defocus, no aberrations."""
        f = self.first_order(wavelength_um)
        return ThinLens(
            f.efl_mm, self.entrance_pupil_diameter_mm, f.efl_mm + self.thickness_mm[-1] - f.bfl_mm
        )

    def camera_rays(self, film_mm, pupil, wavelength_um=WAVELENGTH_UM["d"], aim=False):
        """Rays from image points through the lens towards the scene.

        Args:
          film_mm: [N, 2] image points as seen upright (x right, y down), millimetres from the axis; their
            dtype is that of the computation.
          pupil: [N, 2] points of the unit disc; (0, 0) is the chief ray. They lie on the paraxial exit pupil,
            or with ``aim`` on the real stop.
        Returns: Rays in camera axes, origins on the plane of the entrance pupil of the d line (the camera's
          origin), in metres.
        Gradient: to every lens tensor. The pupil sampling itself is the stop; the other surfaces clip with
          soft edges.
        Raises: DomainError when no ray passes or a pupil lies at infinity.
        """
        f = self.first_order(wavelength_um)
        if not (math.isfinite(f.exit_pupil_z_mm.item()) and math.isfinite(f.entrance_pupil_z_mm.item())):
            raise DomainError(
                f"{self.name}: a pupil lies at infinity (the lens is telecentric), so pupil points have no "
                "place; move the stop off the focal plane."
            )
        back = self.prescription(wavelength_um).reversed(-self._origin_z_mm(f, wavelength_um))
        at_stop = len(self.surfaces) - 1 - self.stop_index
        radius = f.exit_pupil_diameter_mm / 2

        def towards(film, q):
            return _towards(film, q, self.thickness_mm[-1], f.exit_pupil_z_mm)

        if aim:
            film = film_mm.to(self.dtype)

            def field(q, share):
                return towards(film.repeat(q.shape[0] // film.shape[0], 1) * share, q)

            at = aim_at_stop(
                field, back.until(at_stop), pupil.to(self.dtype), f.stop_semi_aperture_mm, radius
            )
            start, direction = (v.to(film_mm.dtype) for v in towards(film, at.point_mm))
            spread = ((f.stop_semi_aperture_mm / radius).square() / at.determinant.abs()).to(film_mm.dtype)
        else:
            start, direction = (
                v.to(film_mm.dtype) for v in towards(film_mm, pupil * radius.to(film_mm.dtype))
            )
            spread = torch.ones_like(film_mm[:, 0])
        out = trace(back.to(film_mm.dtype).opened(at_stop), start, direction)
        if bool((out.weight.detach() <= 0).all()):
            raise DomainError(
                f"{self.name}: every ray fails{self._where(out)}; weaken the curvatures or open the "
                "apertures."
            )
        return Rays(out.position_mm * 1e-3, out.direction, out.weight, spread * direction[:, 2] ** 4)

    def film_points(self, points_mm, pupil, wavelength_um=WAVELENGTH_UM["d"]):
        """Where light from points of space meets the film, through points of the paraxial entrance pupil; the
        other way of ``camera_rays``.

        Args: points_mm [N, 3] in camera axes, millimetres from the entrance pupil's centre; pupil [N, 2] on
          the unit disc, aimed at the entrance pupil.
        Returns: film_mm [N, 2] as seen upright; pupil [N, 2], the point of the exit pupil that the light
          passed, so that ``camera_rays(film_mm, pupil)``
          goes back to the point; passes [N] bool. Gradient: to points, pupil and lens.
        """
        f = self.first_order(wavelength_um)
        dtype = points_mm.dtype
        at = torch.cat(
            [pupil * (f.entrance_pupil_diameter_mm.to(dtype) / 2), torch.zeros_like(pupil[:, :1])], 1
        )
        flip = points_mm.new_tensor([1.0, 1.0, -1.0])
        start = points_mm * flip
        direction = torch.nn.functional.normalize((at - points_mm) * flip, dim=1)
        start = torch.cat([start[:, :2], start[:, 2:] + self._origin_z_mm(f, wavelength_um).to(dtype)], 1)
        out = trace(self.prescription(wavelength_um).to(dtype).opened(self.stop_index), start, direction)
        back = (
            (f.exit_pupil_z_mm - self.thickness_mm[-1]).to(dtype)
            * out.direction[:, :2]
            / out.direction[:, 2:]
        )
        return (
            -out.position_mm[:, :2],
            (out.position_mm[:, :2] + back) / (f.exit_pupil_diameter_mm.to(dtype) / 2),
            out.weight.detach() > 0,
        )

    def _origin_z_mm(self, f, wavelength_um):
        """Where the camera's origin lies: at the entrance pupil of the d line, one for all colours. f:
        first-order figures at the wavelength."""
        d = WAVELENGTH_UM["d"]
        return (f if wavelength_um == d else self.first_order(d)).entrance_pupil_z_mm

    def _where(self, out):
        """What became of most rays of a backward trace, in words; surfaces are counted from the object."""
        failed = out.failed_surface[out.status != Status.OK]
        if failed.numel() == 0:
            return " (all of them are stopped by the edges of the apertures)"
        at = len(self.surfaces) - int(failed.mode().values)
        return (
            f" (most at surface {at} of {len(self.surfaces)}, counted from the object)"
            if at
            else " (most before they leave the first surface forwards)"
        )

    def extra_repr(self):
        return f"{self.name}, {len(self.surfaces)} surfaces, entrance pupil {self.entrance_pupil_diameter_mm:g} mm"


def _range(rows, function):
    """Least and largest value of a function of rows [N, 3], in blocks that stay in the cache; NaN where there
    is one."""
    found = torch.stack([torch.stack(torch.aminmax(function(part))) for part in rows.detach().split(65_536)])
    return found[:, 0].min().item(), found[:, 1].max().item()


def _towards(film_mm, at_mm, last_mm, exit_z_mm):
    """Rays from upright image points [N, 2] to points [N, 2] of the exit pupil's plane, in the axes of the
    reversed lens: start and direction [N, 3]."""

    def place(points, z):
        return torch.cat([points, -z.to(points.dtype).expand(points.shape[0], 1)], 1)

    start = place(-film_mm, last_mm)  # the image is inverted on the film
    direction = torch.nn.functional.normalize(place(at_mm, exit_z_mm) - start, dim=1)
    return start, direction * torch.sign(
        direction[:, 2:]
    )  # a virtual exit pupil behind the film points the other way


def _table(rows, dtype):
    """Rows of different length as one tensor, filled up with zeros."""
    width = max(map(len, rows))
    return torch.tensor([[*row, *[0.0] * (width - len(row))] for row in rows], dtype=dtype).reshape(
        len(rows), width
    )
