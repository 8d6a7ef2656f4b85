"""A ray-traced lens whose curvatures, thicknesses, conics, asphere terms and indices carry
gradients."""

import dataclasses
import itertools
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, ClassVar

import torch
from torch import nn

from codesign.checks import check_number, check_positive
from codesign.errors import DomainError
from codesign.lens import camera, paraxial
from codesign.lens.analysis.spots import spots
from codesign.lens.distance import real_numbers
from codesign.lens.glass import AIR, D_UM, Glass
from codesign.lens.pinhole import ThinLens
from codesign.lens.replaceable import Replaceable, settled
from codesign.lens.solves import focus_at, hold_efl, holding_surface
from codesign.lens.surface import Surface, checked, described, scaled, with_medium
from codesign.lens.trace import PlateAt, Prescription, TraceResult, check_rays, trace
from codesign.lens.variables import Bound, checked_step, kinds
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


class GeoLens(Replaceable):
    """Sequential lens. First vertex at z = 0, light along +z, flat image plane behind the last
    thickness.

    >>> from codesign import lens
    >>> geo = lens.load("cooke-triplet")
    >>> optimiser = torch.optim.Adam(geo.variables("curvature", "focus"), lr=0.1)
    >>> geo.focus_at(2.0).thickness_mm[-1] > geo.thickness_mm[-1]
    tensor(True)

    Learnables (nn.Parameter, one row per surface): curvature_per_mm [S], thickness_mm [S], conic
    [S], asphere [S, A], index_offset [S] (added to the index of the glass behind each surface,
    dimensionless, zero at first; rows of air and of mirrors do nothing and have no gradient), phase
    [S, P] (radians per mm^2, mm^4, ...).
    ``variables`` turns the named ones into functions of dimensionless variables and holds the
    others. Errors of assembly (buffers, with gradients after ``requires_grad_`` or through
    ``replace``): decentre_mm [S, 2], tilt_rad [S, 2]; and semi_aperture_mm [S], the same way.
    half_field_deg: the half field the lens is made for, or None where nobody said.
    plate: a phase plate, see ``diffraction.with_plate``; plate_at: the surface it follows, and mm
      behind its vertex.
    """

    tensor_names: tuple[str, ...] = (*LEARNABLES, "semi_aperture_mm")
    parameter_names = LEARNABLES[:6]
    solved_tensors: ClassVar = {
        "efl_mm": "curvature_per_mm",
        "efl_surface": "curvature_per_mm",
        "focus_m": "thickness_mm",
    }
    curvature_per_mm: torch.Tensor
    thickness_mm: torch.Tensor
    conic: torch.Tensor
    asphere: torch.Tensor
    index_offset: torch.Tensor
    phase: torch.Tensor
    semi_aperture_mm: torch.Tensor
    decentre_mm: torch.Tensor
    tilt_rad: torch.Tensor
    glass: torch.Tensor
    pupil_mm: torch.Tensor | None

    def __init__(
        self,
        surfaces: Iterable[Surface],
        entrance_pupil_diameter_mm: float,
        dtype: torch.dtype = torch.float64,
        soft_edge_mm: float = 0.2,
        name: str = "lens",
        half_field_deg: float | None = None,
    ) -> None:
        super().__init__()
        surfaces, stop = checked(name, surfaces)
        check_number(
            soft_edge_mm, f"{name}: soft_edge_mm", 0.0, remedy="about 0.1 keeps gradients true"
        )
        if half_field_deg is not None:
            check_number(half_field_deg, f"{name}: half_field_deg", above=0.0, below=90.0)
        self.name = name
        self.surfaces = surfaces
        self.stop_index = stop
        # the pupil's diameter where gradients go to it: ``with_pupil``
        self.register_buffer("pupil_mm", None, persistent=False)
        self.entrance_pupil_diameter_mm = float(entrance_pupil_diameter_mm)
        self.soft_edge_mm = float(soft_edge_mm)
        self.half_field_deg = half_field_deg
        self.mirrors = tuple(s.mirror for s in surfaces)
        self.plate: Any = None
        self.plate_at: tuple[int, float] = (0, 0.0)
        for tensor, value in _tensors(surfaces, dtype).items():
            if tensor in self.parameter_names:
                self.register_parameter(tensor, nn.Parameter(value))
            else:
                self.register_buffer(tensor, value)
        glass = [s.medium not in (None, AIR) and not s.mirror for s in surfaces]
        self.register_buffer("glass", torch.tensor(glass), persistent=False)

    @property
    def dtype(self) -> torch.dtype:
        return self.semi_aperture_mm.dtype

    @property
    def entrance_pupil_diameter_mm(self) -> float:
        """The entrance pupil as it is now, also where a tensor makes it."""
        return self._diameter_mm if self.pupil_mm is None else float(self.pupil_mm.detach())

    @entrance_pupil_diameter_mm.setter
    def entrance_pupil_diameter_mm(self, value: float | torch.Tensor) -> None:
        self._diameter_mm = check_positive(value, f"{self.name}: entrance_pupil_diameter_mm")
        self.pupil_mm = value.to(self.semi_aperture_mm) if isinstance(value, torch.Tensor) else None

    def variables(
        self,
        *names: str,
        step_mm: float | None = None,
        bounds: Mapping[str, tuple[Bound, Bound]] | None = None,
        mask: Mapping[str, Sequence[bool]] | None = None,
        keep_efl: bool = False,
        focus_at_m: float | None = None,
        fields_rad: Sequence[float] | None = None,
        wavelength_um: float = D_UM,
    ) -> list[nn.Parameter]:
        """Make the named numbers variables for torch.optim; every other number of the lens is held.

        From then on the lens's tensors are functions of these Parameters: trace, render, go
        backward, and step. They are dimensionless, zero now, and a unit of each moves the rays of a
        bundle on the film by ``step_mm`` RMS, so one learning rate suits them all, whatever the
        lens's size. Another call starts anew from the lens as it then is.

        >>> from codesign import lens
        >>> geo = lens.load("cooke-triplet")
        >>> [v.shape[0] for v in geo.variables("curvature", "thickness", "focus", keep_efl=True)]
        [5, 5, 1]
        >>> curvature, focus = geo.variables("curvature", "focus", bounds={"focus": (40.0, 45.0)})

        Args:
          names: of "curvature", "thickness" (all gaps but the last), "focus" (the last), "conic",
            "asphere" (coefficients, surface after surface), "index" (offset of every glass),
            "phase". Numbers that move no ray (the curvature of a stop in air, the conic of a plane,
            what a solve makes) and thicknesses of 0 are left out.
          step_mm: the natural step, for example the pixel pitch; None is 1/1000 of the focal
            length.
          bounds: (low, high) per name, numbers or one per entry, None for no bound; reached only in
            the limit. Thicknesses and focus stay above 0 unless others are given.
          mask: per name, which of its entries (one per surface, gap, coefficient or glass) may
            vary.
          keep_efl: whether the curvature of ``solves.holding_surface`` is solved for today's focal
            length.
          focus_at_m: the distance that stays in focus, the last thickness being solved for it; see
            ``focus_at``.
          fields_rad: fields of the bundle; None is 0, 0.7 and 1 of the half field
            (10 degrees where unknown).
        A number so weak that its natural step would be out of proportion (0.1 focal lengths of a
        thickness, a sag slope of 0.1 at the rim for a shape, 0.05 of an index) gets that as its
        unit.
        Returns: one Parameter [K] per name.
        Raises: DomainError for unknown names, values outside their bounds, names with nothing to
          vary, and numbers of glass that the light passes twice.
        """
        efl = self.first_order().efl_mm.detach()
        held = {}
        if keep_efl:
            held["efl_mm"] = efl
            held["efl_surface"] = torch.tensor(holding_surface(self.replace()))
        if focus_at_m is not None:
            held["focus_m"] = real_numbers(focus_at_m, "object distances").double()
        if step_mm is None:
            step_mm = 1e-3 * abs(float(efl))
        if fields_rad is None:
            half = math.radians(self.half_field_deg or 10.0)
            fields_rad = (0.0, 0.7 * half, half)
        return self._make_variables(
            names,
            step_mm=checked_step(step_mm),
            bounds=bounds or {},
            mask=mask or {},
            fields_rad=fields_rad,
            wavelength_um=wavelength_um,
            held=held,
        )

    def _known(self, name):
        if name in ("medium", "glass"):
            raise DomainError(
                f"{self.name}: a {name} is no tensor; exchange it with replace_glass(surface, glass)."
            )
        super()._known(name)

    def _identity(self):
        return {
            "entrance pupil diameter in mm": self.entrance_pupil_diameter_mm,
            "soft edge in mm": self.soft_edge_mm,
            "half field in degrees": self.half_field_deg or 0.0,
            "stop": self.stop_index + 1.0,
            "plate's surface": self.plate_at[0] if self.plate is not None else 0.0,
            "plate's distance in mm": float(self.plate_at[1]) if self.plate is not None else 0.0,
        } | described(self.surfaces)

    def _kinds(self):
        return kinds(self)

    def _solved(self, tensors, held):
        if not held:
            return tensors
        twin = self._with(tensors)
        if "efl_mm" in held:
            twin = hold_efl(twin, held["efl_mm"], int(held["efl_surface"]))
        if "focus_m" in held:
            twin = twin.focus_at(held["focus_m"])
        return tensors | {
            name: getattr(twin, name) for name in ("curvature_per_mm", "thickness_mm")
        }

    def _landing(self, fields_rad, wavelength_um):
        return spots(self, fields_rad, wavelength_um, grid=8)

    @settled
    def focus_at(
        self,
        distance_m: float | torch.Tensor,
        wavelength_um: float = D_UM,
        spot_grid: int | None = None,
    ) -> "GeoLens":
        """The lens with its film where a point of the axis at ``distance_m`` is imaged: a solve of
        the last thickness in closed form.

        >>> from codesign import lens
        >>> geo = lens.load("cooke-triplet")
        >>> near, far = geo.focus_at(1.0), geo.focus_at(float("inf"))
        >>> bool(near.thickness_mm[-1] > far.thickness_mm[-1])
        True

        Args:
          distance_m: number or scalar tensor, metres before the camera's origin (the entrance pupil
            of the d line); inf is allowed.
          wavelength_um: whose paraxial rays meet on the film.
          spot_grid: pupil samples across, for the film of the least RMS spot of the point in place
            of the paraxial one.
        Returns: a lens as from ``replace``; this one stays as it is. Its last thickness is the
          image distance.
        Gradient: to every lens tensor that bends or moves light, and to the distance.
        Raises: DomainError for a point that does not lie before the lens, or whose light does not
          meet again behind it; and for a spot of a single ray.
        """
        return focus_at(self, distance_m, wavelength_um, spot_grid)

    def replace_glass(self, surface: int, glass: Glass | str | None) -> "GeoLens":
        """The lens with another medium behind a surface; shapes, gaps and apertures stay, the focal
        length does not (``design.with_glass`` holds it).

        >>> from codesign import lens
        >>> geo = lens.load("cooke-triplet").replace_glass(2, "SF2")
        >>> round(geo.index()[3].item(), 5)
        1.64769

        Args:
          surface: counted from 0, from the last when negative.
          glass: a Glass, a name or code as ``Glass.named`` takes, None for air.
        Returns: a lens as from ``replace``, without Parameters and variables of its own; this one
          stays as it is.
        Gradient: to every tensor of this lens but the index offset of that surface, which belonged
          to the glass that went: the new one has 0.
        Raises: DomainError for a surface that is not there or a mirror, for glass that the light
          passes again behind a mirror, and for a name the catalogue does not know, with the nearest
          it knows.
        """
        surfaces = with_medium(self.name, self.surfaces, surface, glass)
        row = torch.arange(len(surfaces), device=self.glass.device) == range(len(surfaces))[surface]
        now = self._now()
        twin = self._with(now | {"index_offset": torch.where(row, 0, now["index_offset"])})
        twin.surfaces = surfaces
        twin.glass = torch.where(row, surfaces[surface].medium is not None, self.glass)
        return twin

    def with_pupil(self, diameter_mm: float | torch.Tensor) -> "GeoLens":
        """The lens with another entrance pupil, all else as it is; gradients reach a tensor."""
        twin = self._with(self._now())
        twin.entrance_pupil_diameter_mm = diameter_mm
        return twin

    def scaled(self, factor: float) -> "GeoLens":
        """A new lens with all lengths multiplied by ``factor`` (same f-number and angles, also of
        diffractive phases in the same light), from the current values."""
        surfaces = [scaled(s, factor) for s in self.to_surfaces()]
        return GeoLens(
            surfaces,
            self.entrance_pupil_diameter_mm * factor,
            self.dtype,
            self.soft_edge_mm * factor,
            self.name,
            self.half_field_deg,
        )

    @settled
    def to_surfaces(self) -> tuple[Surface, ...]:
        """The current values as a tuple of Surface; index offsets go into the media. A curvature or
        tilt that never changed keeps its value to the last bit. Raises: DomainError for a lens with
        a phase plate."""
        if self.plate is not None:
            raise DomainError(
                f"{self.name}: its phase plate is no surface, so files, drawings and copies by surfaces "
                "cannot hold it; take it out with diffraction.with_plate(lens, None)."
            )
        bent = torch.tensor([s.curvature_per_mm for s in self.surfaces], dtype=self.dtype).tolist()
        tilted = torch.tensor([_tilt_rad(s) for s in self.surfaces], dtype=self.dtype).tolist()
        now = self._now() | {"index_offset": torch.where(self.glass, self.index_offset, 0)}
        columns = (now[name].tolist() for name in self.tensor_names)
        found = []
        for (
            old,
            first_c,
            first_tilt,
            c,
            t,
            k,
            a,
            shift,
            phase,
            decentre,
            tilt,
            semi_aperture,
        ) in zip(self.surfaces, bent, tilted, *columns, strict=True):
            found.append(
                dataclasses.replace(
                    old,
                    radius_mm=old.radius_mm if c == first_c else 1 / c if c else math.inf,
                    thickness_mm=t,
                    semi_aperture_mm=semi_aperture,
                    conic=k,
                    asphere=tuple(a) if any(a) or old.asphere else (),
                    medium=(old.medium or AIR).shifted(shift) if shift else old.medium,
                    phase=old.phase and dataclasses.replace(old.phase, coefficients=tuple(phase)),
                    decentre_mm=tuple(decentre),
                    tilt_deg=old.tilt_deg if tilt == first_tilt else tuple(map(math.degrees, tilt)),
                )
            )
        return tuple(found)

    def index(self, wavelength_um: float = D_UM) -> torch.Tensor:
        """Indices [S + 1] at a wavelength, the first before the lens (air). Behind a mirror it is
        the index before it."""
        media = (s.medium for s in self.surfaces)
        values = [
            1.0 if medium is None else medium.index(wavelength_um) for medium in (None, *media)
        ]
        base = torch.tensor(values, dtype=self.dtype, device=self.semi_aperture_mm.device)
        offset = torch.where(self.glass, self.index_offset, 0)
        found = base + torch.cat([torch.zeros_like(offset[:1]), offset])
        return found[self._unfolded([*range(len(values))])] if any(self.mirrors) else found

    def _unfolded(self, gaps):
        """What is said of gaps [S + 1], the one before the lens among them; behind a mirror that of
        the one before."""
        for i, mirror in enumerate(self.mirrors):
            gaps[i + 1] = gaps[i] if mirror else gaps[i + 1]
        return gaps

    def path_mm(self, wavelength_um: float = D_UM) -> torch.Tensor:
        """Optical path that the diffractive phases add, as coefficients [S, P] of r^2, r^4, ... in
        mm."""
        orders = torch.tensor(
            [s.phase.order if s.phase else 0 for s in self.surfaces],
            dtype=self.dtype,
            device=self.phase.device,
        )
        return self.phase * (orders * (wavelength_um * 1e-3 / (2 * math.pi)))[:, None]

    @settled
    def surface_power(self, wavelength_um: float = D_UM) -> torch.Tensor:
        """Paraxial power of each surface, [S] per mm: vertex curvature (with the r^2 asphere term)
        times bending, and diffraction."""
        vertex = (
            self.curvature_per_mm + 2 * self.asphere[:, 0]
            if self.asphere.shape[1]
            else self.curvature_per_mm
        )
        power = vertex * paraxial.bending(self.index(wavelength_um), self.mirrors)
        return power - 2 * self.path_mm(wavelength_um)[:, 0] if self.phase.shape[1] else power

    @settled
    def first_order(self, wavelength_um: float = D_UM) -> paraxial.FirstOrder:
        """Paraxial figures (FirstOrder) at a wavelength, differentiable.

        Example:
        >>> from codesign import lens
        >>> figures = lens.load("cooke-triplet").first_order()
        >>> round(figures.efl_mm.item(), 1), round(figures.fno.item(), 1)
        (50.0, 5.0)
        """
        return paraxial.first_order(
            self.surface_power(wavelength_um),
            self.thickness_mm,
            self.index(wavelength_um),
            self.stop_index,
            self.entrance_pupil_diameter_mm if self.pupil_mm is None else self.pupil_mm,
        )

    @settled
    def prescription(self, wavelength_um: float = D_UM) -> Prescription:
        """The numbers the ray-trace kernel needs."""
        shape = (self.curvature_per_mm, self.thickness_mm, self.conic, self.asphere)
        efficiency = math.prod(s.phase.efficiency(wavelength_um) for s in self.surfaces if s.phase)
        inner = tuple(s.inner_semi_aperture_mm for s in self.surfaces)
        filled = self._unfolded([False, *self.glass.tolist()])
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
            tuple(before or behind for before, behind in itertools.pairwise(filled)),
            efficiency,
            plate=self.plate
            and PlateAt(self.plate.look, *self.plate_at, self.plate.mm_per_rad(wavelength_um)),
        )

    @settled
    def trace(
        self, origin_mm: torch.Tensor, direction: torch.Tensor, wavelength_um: float = D_UM
    ) -> TraceResult:
        """Trace rays to the image plane: origins [N, 3] relative to the first vertex, unit
        directions [N, 3] -> TraceResult.

        Raises: ShapeError; DomainError for origins that are not finite or directions that are not
          unit vectors.

        Example:
        >>> from codesign import lens
        >>> geo = lens.load("cooke-triplet")
        >>> rays = geo.trace(*lens.aimed_rays(geo, 0.1, lens.pupil_grid(8)))  # 0.1 rad off the axis
        >>> height = rays.position_mm[:, 1].mean() / geo.first_order().efl_mm
        >>> round(height.item(), 2)
        0.1
        """
        check_rays(origin_mm, direction)
        return trace(self.prescription(wavelength_um), origin_mm, direction)

    @settled
    def thin(self) -> ThinLens:
        """The paraxial level of this lens: same focal length, pupil and defocus, no aberrations. The
        lengths behind it are those of air: an image in a medium has them divided by its index."""
        f = self.first_order()
        image_mm = f.efl_mm + self.thickness_mm[-1] - f.bfl_mm
        index = self.index()[-1]
        return ThinLens(f.efl_mm / index, self.entrance_pupil_diameter_mm, image_mm / index)

    @settled
    def camera_rays(
        self,
        film_mm: torch.Tensor,
        pupil: torch.Tensor,
        wavelength_um: float = D_UM,
        aim: bool = False,
    ) -> Rays:
        """Rays from image points through the lens towards the scene.

        Args:
          film_mm: [N, 2] image points as seen upright (x right, y down), millimetres from the axis;
            their dtype is that of the computation.
          pupil: [N, 2] points of the unit disc; (0, 0) is the chief ray. They lie on the paraxial
            exit pupil, or with ``aim`` on the real stop, which is solved for in float64.
        Returns: Rays in camera axes, origins on the plane of the entrance pupil of the d line
          (the camera's origin), in metres.
        Gradient: to every lens tensor. The pupil sampling itself is the stop; the other surfaces
          clip with soft edges.
        Raises: DomainError when no ray passes or a pupil lies at infinity.
        """
        return camera.camera_rays(self, film_mm, pupil, wavelength_um, aim)

    @settled
    def film_points(
        self, points_mm: torch.Tensor, pupil: torch.Tensor, wavelength_um: float = D_UM
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Where light from points of space meets the film, through points of the paraxial entrance
        pupil; the other way of ``camera_rays``.

        Args: points_mm [N, 3] in camera axes, millimetres from the entrance pupil's centre; pupil
          [N, 2] on the unit disc, aimed at the entrance pupil.
        Returns: film_mm [N, 2] as seen upright; pupil [N, 2], the point of the exit pupil that the
          light passed, so that ``camera_rays(film_mm, pupil)`` goes back to the point; passes [N]
          bool. Gradient: to points, pupil and lens.
        """
        return camera.film_points(self, points_mm, pupil, wavelength_um)

    def extra_repr(self) -> str:
        return f"{self.name}, {len(self.surfaces)} surfaces, entrance pupil {self.entrance_pupil_diameter_mm:g} mm"


def _tilt_rad(surface):
    return [math.radians(angle) for angle in surface.tilt_deg]


def _tensors(surfaces, dtype):
    """The tensors of a lens of these surfaces, by name; rows of different length are filled up with
    zeros."""

    def filled(rows):
        width = max(map(len, rows))
        return [[*row, *[0.0] * (width - len(row))] for row in rows]

    rows = {
        "curvature_per_mm": [s.curvature_per_mm for s in surfaces],
        "thickness_mm": [s.thickness_mm for s in surfaces],
        "conic": [s.conic for s in surfaces],
        "asphere": filled([s.asphere for s in surfaces]),
        "index_offset": [0.0 for _ in surfaces],
        "phase": filled([s.phase.coefficients if s.phase else () for s in surfaces]),
        "decentre_mm": [s.decentre_mm for s in surfaces],
        "tilt_rad": [_tilt_rad(s) for s in surfaces],
        "semi_aperture_mm": [s.semi_aperture_mm for s in surfaces],
    }
    return {name: torch.tensor(values, dtype=dtype) for name, values in rows.items()}
