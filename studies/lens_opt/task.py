"""What the lens studies optimise and judge: a lens on a DAVIS346-like sensor, three field windows,
textured walls, random motions."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache

import torch
from torch import Tensor, nn

from codesign import backend, events, lens, pose, render
from codesign.errors import DomainError
from codesign.events import HardSensor
from codesign.lens.design import LensDesign, detune, edge_thickness_mm, make_design
from codesign.system import Batch, System
from codesign.system.objectives import angular_error_mrad, edge_energy, edge_objective
from scenes import textures, trajectories, worlds
from studies.lens_opt.spots import refocused, spot_rays

# DAVIS346: 346 x 260 pixels of 18.5 um
SENSOR_PX = (346, 260)
PITCH_MM = 18.5e-3
WINDOW_PX = 64
HALF_DIAGONAL_MM = math.hypot(*SENSOR_PX) / 2 * PITCH_MM
FIELDS = (0.0, 0.7, 1.0)
DISTANCE_M = 2.0
DURATION_S = 0.05
BINS = 5
DIRECTIONS = 10  # of detuning that are tried
NO_FIELD_DEG = 20.0  # half field of a lens that names none: that of the Cooke triplet
FLOOR_SHARE = 0.6  # of the thicknesses of the published lens, which no design may go below
SENSOR = events.SensorModel(theta_on=0.2, theta_off=0.2, theta_sigma=0.03, shot_rate_hz=1.0)
# daylight as a silicon sensor sees it, in four wavelengths of equal weight:
# Spectrum.from_curves(silicon_response(), daylight_d65(), 4), whose import of SciPy takes longer than a frame
LIGHT = lens.Spectrum(
    (0.4310065670078028, 0.518511483138606, 0.6040904811281692, 0.7262419614738713), (0.25,) * 4
)
TRAINING = ("gravel", "grass", "gravel:2", "grass:2", "speckle-1")
DEVELOPMENT = ("coffee", "chelsea", "rocket")  # on which settings are chosen
HELD_OUT = ("brick", "astronaut", "hubble_deep_field")
# m and rad over the interval, standard deviations
MOTION = torch.tensor([0.012, 0.012, 0.02, 0.001, 0.001, 0.006], dtype=torch.float64)


@cache
def film() -> render.Film:
    """Three windows on the sensor's diagonal, at fields 0, 0.7 and as far out as a window fits."""
    half = WINDOW_PX / 2
    room = [n / 2 - half for n in SENSOR_PX]
    corners = tuple(
        (round(SENSOR_PX[0] / 2 + h * room[0] - half), round(SENSOR_PX[1] / 2 + h * room[1] - half))
        for h in FIELDS
    )
    return render.Film(*SENSOR_PX, WINDOW_PX, WINDOW_PX, PITCH_MM, corners)


def window_shares() -> list[float]:
    """How far the middles of the windows lie, of the way from the axis to the corner."""
    room = [n - WINDOW_PX for n in SENSOR_PX]
    return [h * math.hypot(*room) / math.hypot(*SENSOR_PX) for h in FIELDS]


def log_error(every_px: int = 8) -> Callable[..., Tensor]:
    """The objective: mean log angular error over the windows, at pixels ``every_px`` apart."""

    def mean_log_error(field, camera, scene, T_world_cam):
        return angular_error_mrad(field, camera, scene, T_world_cam, every_px).log().mean()

    return mean_log_error


@dataclass(frozen=True)
class LensTask:
    """What a lens is designed for, and from where: the design variables around the detuned start
    (variables = 0), which is in best focus.

    nominal: the published lens scaled to the sensor and focused on the wall. defocused: the detuned
      lens with the focus error that its curvature errors make. device: where rays, events and flow
      are computed; the lens's numbers stay on the processor.
    """

    nominal: lens.GeoLens
    defocused: lens.GeoLens
    design: LensDesign
    fields_rad: tuple[float, ...]
    device: torch.device | str = "cpu"

    def around(self, optics: lens.GeoLens) -> LensDesign:
        """The same free variables and limits, in steps around another lens."""
        return make_design(optics, self.fields_rad, PITCH_MM, self.design)

    def camera(self, optics, samples: int, seed: int = 0) -> render.Camera:
        return render.Camera(
            optics.replace().to(self.device),
            WINDOW_PX,
            WINDOW_PX,
            PITCH_MM,
            samples,
            seed,
            film(),
            spectrum=LIGHT,
        )

    def rms_spot_um(self, optics) -> torch.Tensor:
        """RMS spot of points of the wall at the three fields, all wavelengths together, [3] um."""
        return spot_rays(optics, self.fields_rad, DISTANCE_M, LIGHT).rms_mm() * 1e3

    def system(self, camera, layer, flow, objective: str = "flow", every_px: int = 8) -> System:
        """System of a camera (or what makes one), an event stage and a flow stage.

        objective: "flow" (mean log angular error over the windows) or "edge" (the seed project's).
          every_px: spacing of the pixels whose flow counts.
        """
        found = {"flow": log_error(every_px), "edge": lambda volume: edge_objective(volume)}[
            objective
        ]
        return System(
            camera=camera,
            events=layer,
            flow=flow,
            objectives={objective: found},
            bins=bins_of(flow),
        )

    def judge(self, optics, case: Batch, flow, samples: int = 32) -> dict[str, float]:
        """Errors of a lens on one case with hard events: the physical sensor with true timestamps,
        no surrogate anywhere.

        Returns: dict of flow_error_mrad, edge_energy, events_per_pixel, and the flow error of each
          window, flow_error_mrad_field_0 and so on.
        """
        hard = HardSensor(SENSOR, bins_of(flow))
        with torch.no_grad():
            seen = self.system(self.camera(optics, samples), hard, flow).begin(case)
            error = angular_error_mrad(
                seen["field"], seen["camera"], seen["scene"], seen["T_world_cam"]
            )
            counts = seen["volume"].counts
        return {
            "flow_error_mrad": float(error.mean()),
            "edge_energy": float(edge_energy(seen["volume"])),
            "events_per_pixel": float(counts.sum()) / counts[:, 0, 0].numel(),
            **{
                f"flow_error_mrad_field_{h:g}": float(e) for h, e in zip(FIELDS, error, strict=True)
            },
        }


class DesignedCamera(nn.Module):
    """The camera of a task at learnable design variables, zero at the detuned start."""

    def __init__(self, task: LensTask, samples: int):
        super().__init__()
        self.task = task
        self.samples = samples
        self.variables = nn.Parameter(torch.zeros(task.design.basis.shape[1], dtype=torch.float64))

    def optics(self) -> lens.GeoLens:
        return self.task.design.lens(self.variables)

    def forward(self) -> render.Camera:
        return self.task.camera(self.optics(), self.samples)


def bins_of(flow) -> int:
    """Time bins that an estimator takes: those a network was built for, or BINS."""
    return getattr(flow, "config", {}).get("bins", BINS)


@backend.threads(most=1)
def make_task(source, seed, detuned_px=1.5, device="cpu"):
    """Load a lens, scale it so that its published field fills the sensor's diagonal, focus it on
    the wall, and detune its curvatures by ``seed``.

    Args:
      source: catalogue name or file.
      detuned_px: mean RMS spot of the detuned lens in pixels, at its best focus (above one, so that
        the flow suffers).
    """
    published = lens.load(source)
    half_field = math.radians(published.half_field_deg or NO_FIELD_DEG)
    nominal = published.scaled(
        HALF_DIAGONAL_MM / (float(published.first_order().efl_mm.detach()) * math.tan(half_field))
    ).freeze()
    fields = tuple(
        math.atan(h * HALF_DIAGONAL_MM / float(nominal.first_order().efl_mm)) for h in FIELDS
    )
    nominal = in_focus(nominal, fields).freeze()
    published_px = float(spot_rays(nominal, fields, DISTANCE_M, LIGHT).rms_mm().mean()) / PITCH_MM
    if published_px > 0.5 * detuned_px:
        raise DomainError(
            f"lens {source}: its mean RMS spot is {published_px:.3g} pixels before any detuning, so there "
            "is little to win back; give a sharper lens or a larger --detuned-px."
        )
    around = make_design(nominal, fields, PITCH_MM, floor_share=FLOOR_SHARE)
    defocused = _detuned(around, fields, detuned_px * PITCH_MM, torch.Generator().manual_seed(seed))
    start = in_focus(defocused, fields)
    # the start is within its limits: where it is thinner than the published lens allows, they give
    # way to it
    floors = replace(
        around,
        floor_mm=torch.minimum(around.floor_mm, FLOOR_SHARE * start.thickness_mm),
        edge_floor_mm=torch.minimum(around.edge_floor_mm, edge_thickness_mm(start)),
    )
    design = make_design(start, fields, PITCH_MM, floors)
    return LensTask(nominal, defocused, design, fields, device)


def _detuned(around, fields, target_mm, generator):
    """Detuned so that the spot at best focus has the target; where a direction changes little but
    the focus, or makes a lens without edges, another is drawn."""

    def spot_in_focus(made):
        rays = spot_rays(made, fields, DISTANCE_M, LIGHT, grid=8)
        return rays.shifted(rays.best_focus_mm()).rms_mm().mean()

    for last in range(DIRECTIONS - 1, -1, -1):
        try:
            made = detune(around, fields, target_mm, generator, spot_in_focus)
        except DomainError:
            if not last:
                raise
            continue
        if (edge_thickness_mm(made) > around.edge_floor_mm.clamp_max(0)).all():
            return made
    raise DomainError(
        f"{DIRECTIONS} detunings leave no edge to some element; choose another seed, or a smaller --detuned-px."
    )


def in_focus(optics, fields_rad):
    """The lens with its film at the best focus of the wall, over all fields and wavelengths."""
    return refocused(optics, fields_rad, DISTANCE_M, LIGHT)


def make_worlds(names, device="cpu"):
    """A wall per texture name: photographs at 3 mm a texel (about a pixel) or, as "name:2", twice
    as coarse; band-limited "speckle-SEED".

    Coarse detail survives strong blur and fine detail judges weak blur: with both, the error falls
    all the way to focus.
    """
    found = []
    for entry in names:
        name, _, zoom = entry.partition(":")
        pattern = (
            textures.speckle(int(name.split("-")[1]))
            if name.startswith("speckle-")
            else textures.photo(name)
        )
        found.append(
            worlds.wall(
                textures.shrunk(pattern, 2),
                texel_m=0.003 * float(zoom or 1),
                device=torch.device(device).type,
            )
        )
    return found


def draw_case(pool, seed, frames=9, device="cpu"):
    """A world out of ``pool``, a place before it and a motion, all from one seed."""
    generator = torch.Generator().manual_seed(seed)
    world = pool[int(torch.randint(len(pool), (1,), generator=generator))]
    start = drawn_place(generator)
    motion = torch.randn(6, generator=generator, dtype=torch.float64)
    t_s = torch.linspace(0, DURATION_S, frames, dtype=torch.float64)
    drive = trajectories.body_twist(start, MOTION * motion / DURATION_S, t_s)
    return Batch(drive.to(device), t_s, world, seed)


def drawn_place(generator):
    """Pose [4, 4] of a camera that stands before the wall somewhere, and looks across it."""
    x_m, z_m = (2 * torch.rand(2, generator=generator, dtype=torch.float64) - 1).tolist()
    return pose.look_at((x_m, -DISTANCE_M, z_m), (x_m, 0.0, z_m))
