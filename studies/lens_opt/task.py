"""What the lens studies optimise and judge: a lens on a DAVIS346-like sensor, three field windows, textured
walls, random motions."""

import math
from dataclasses import dataclass
from functools import cached_property

import torch
from kornia.filters import spatial_gradient

from codesign import events, flow, graph, lens, pose, render
from codesign.errors import DomainError
from codesign.lens.design import LensDesign, detune, make_design
from scenes import textures, trajectories, worlds

# DAVIS346: 346 x 260 pixels of 18.5 um
SENSOR_PX = (346, 260)
PITCH_MM = 18.5e-3
WINDOW_PX = 64
HALF_DIAGONAL_MM = math.hypot(*SENSOR_PX) / 2 * PITCH_MM
FIELDS = (0.0, 0.7, 1.0)
DISTANCE_M = 2.0
DURATION_S = 0.05
BINS = 5
SENSOR = events.SensorModel(theta_on=0.2, theta_off=0.2, theta_sigma=0.03, shot_rate_hz=1.0)
TRAINING = ("gravel", "grass", "gravel:2", "grass:2", "speckle-1")
HELD_OUT = ("brick", "astronaut", "hubble_deep_field")
MOTION = torch.tensor(
    [0.012, 0.012, 0.02, 0.001, 0.001, 0.006], dtype=torch.float64
)  # m and rad over the interval, standard deviations


@dataclass(frozen=True)
class Case:
    """One sample: a world, poses [T, 4, 4] at times t_s [T], and a seed for film samples and sensor noise."""

    world: object
    poses: torch.Tensor
    t_s: torch.Tensor
    seed: int


@dataclass(frozen=True)
class LensTask:
    """A nominal lens scaled to the sensor, and the design variables around its detuned twin (the start,
    variables = 0)."""

    nominal: lens.GeoLens
    design: LensDesign
    fields_rad: tuple[float, ...]

    @cached_property
    def film(self):
        """Three windows on the sensor's diagonal, at fields 0, 0.7 and as far out as a window fits."""
        half = WINDOW_PX / 2
        room = [n / 2 - half for n in SENSOR_PX]
        corners = tuple(
            (round(SENSOR_PX[0] / 2 + h * room[0] - half), round(SENSOR_PX[1] / 2 + h * room[1] - half))
            for h in FIELDS
        )
        return render.Film(*SENSOR_PX, WINDOW_PX, WINDOW_PX, PITCH_MM, corners)

    @cached_property
    def lattice(self):
        """Indices of 8 x 8 pixels of every window, where flow errors are measured."""
        line = torch.arange(4, WINDOW_PX, 8)
        inside = (line[:, None] * WINDOW_PX + line).reshape(-1)
        return (torch.arange(len(FIELDS))[:, None] * WINDOW_PX**2 + inside).reshape(-1)

    def camera(self, optics, samples, seed):
        return render.Camera(optics, WINDOW_PX, WINDOW_PX, PITCH_MM, samples, seed, self.film)

    def rms_spot_um(self, optics):
        """RMS spot at the three fields, d line, [3] um."""
        return lens.rms_spot_mm(optics, self.fields_rad) * 1e3

    def angular_error_mrad(self, field, camera, case):
        """Mean angle by which flow misses the world points under the lattice pixels, [fields] mrad over the
        interval."""
        pixels = self.film.pixels()[self.lattice]
        motion = field.flow_px.permute(0, 2, 3, 1).reshape(-1, 2)[self.lattice].double()
        points, _, valid = render.truth.world_points(camera.chief_rays(pixels), case.world, case.poses[0])
        if not bool(valid.all()):
            raise DomainError("some window pixels see no surface; the wall must fill the view.")
        later = pose.apply(pose.inverse(case.poses[-1]), points)
        return 1e3 * render.angular_miss_rad(camera, pixels + motion, later).reshape(len(FIELDS), -1).mean(1)

    def chain(self, samples, layer="memory", objective="flow", optics=None, sensor=SENSOR):
        """Chain over designs {"variables": [V], "case": Case}; ``optics`` maps a design to a lens (default:
        the variables through the lens design).

        layer: "memory" (hard counts, straight-through), "counts" (the same without quantisation) or "sigmoid"
          (the seed project's). objective: "flow" or "edge".
        """
        optics = optics or (lambda design: self.design.lens(design["variables"]))
        objectives = {
            "flow": lambda field, camera, design: (
                self.angular_error_mrad(field, camera, design["case"]).log().mean()
            ),
            "edge": lambda score, camera, design: score.flow_px,
        }
        estimators = {
            "flow": lambda volume, design: flow.estimate_lk(volume),
            "edge": lambda volume, design: _EdgeScore(edge_objective(volume)),
        }
        return graph.Chain(
            lens=lambda design: self.camera(optics(design), samples, design["case"].seed),
            render=lambda rays, design: self.frames(rays, design["case"], samples),
            events=lambda frames, design: self.volume(frames, design["case"], layer, sensor),
            flow=estimators[objective],
            objective=objectives[objective],
        )

    def frames(self, rays, case, samples):
        return render.shade(rays, case.world, case.poses, samples).reshape(
            case.poses.shape[0], *self.film.shape
        )

    def volume(self, frames, case, layer, sensor=SENSOR):
        """Event volume of a case, with the sensor's threshold mismatch and shot noise drawn from the case's
        seed."""
        noise = torch.Generator().manual_seed(case.seed)
        thresholds = events.draw_thresholds(sensor, self.film.shape, noise, dtype=frames.dtype)
        shot = events.draw_shot_counts(sensor, self.film.shape, case.t_s.diff(), noise, dtype=frames.dtype)
        if layer == "memory":
            counts, _ = events.memory(frames, *thresholds)
        elif layer == "counts":
            counts = events.soft_counts(frames, *thresholds)
        else:
            counts = events.soft(frames, sensor.theta_on)
        return events.from_counts(counts + shot, case.t_s, BINS)

    def judge(self, optics, case, samples=32):
        """Errors of a lens on one case with hard events: the physical sensor with true timestamps, no
        surrogate anywhere.

        Returns: dict of flow_error_mrad, edge_energy, events_per_pixel.
        """
        with torch.no_grad():
            camera = self.camera(optics, samples, case.seed)
            frames = self.frames(camera.rays(), case, samples)
            tall = frames.reshape(frames.shape[0], -1, WINDOW_PX)  # the windows stacked, as one sensor
            stream = events.simulate(tall, case.t_s, SENSOR, torch.Generator().manual_seed(case.seed))
            volume = events.from_stream(stream, 0, round(DURATION_S * 1e6), BINS)
            counts = (
                volume.counts.reshape(2, BINS, len(FIELDS), WINDOW_PX, WINDOW_PX)
                .permute(2, 0, 1, 3, 4)
                .contiguous()
            )
            volume = type(volume)(counts, volume.centroid_s, volume.collected_s)
            error = self.angular_error_mrad(flow.estimate_lk(volume), camera, case)
            return {
                "flow_error_mrad": float(error.mean()),
                "edge_energy": float(edge_energy(volume)),
                "events_per_pixel": len(stream) / tall[0].numel(),
            }


@dataclass(frozen=True)
class _EdgeScore:
    """Stands where the flow field stands when the objective reads event frames only."""

    flow_px: torch.Tensor


def edge_energy(volume):
    """Mean squared Sobel gradient of the signed event frames (one per bin), events^2 per pixel^2."""
    signed = volume.counts[:, 0] - volume.counts[:, 1]
    return spatial_gradient(signed, mode="sobel", normalized=True).square().sum(2).mean()


def edge_objective(volume, activity_weight=0.01):
    """The seed project's objective: -(edge energy of event frames - weight * events per pixel and bin)."""
    return activity_weight * volume.counts.sum(1).mean() - edge_energy(volume)


def make_task(source, seed, detuned_px=2.2):
    """Load a lens, scale it so that its published field fills the sensor's diagonal, and detune it by
    ``seed``.

    Args: source: catalogue name or file. detuned_px: mean RMS spot of the detuned start, in pixels (above
      two, so that the flow suffers).
    """
    published = lens.load(source)
    if str(source) in lens.catalogue.LENSES:
        half_field = math.radians(lens.half_field_deg(str(source)))
    else:
        half_field = math.radians(20.0)  # files do not say their field; that of the Cooke triplet
    nominal = published.scaled(
        HALF_DIAGONAL_MM / (float(published.first_order().efl_mm.detach()) * math.tan(half_field))
    ).freeze()
    fields = tuple(math.atan(h * HALF_DIAGONAL_MM / float(nominal.first_order().efl_mm)) for h in FIELDS)
    published_px = float(lens.rms_spot_mm(nominal, fields).mean()) / PITCH_MM
    if published_px > 0.5 * detuned_px:
        raise DomainError(
            f"lens {source}: its mean RMS spot is {published_px:.3g} pixels before any detuning, so there "
            "is little to win back; give a sharper lens or a larger --detuned-px."
        )
    around = make_design(nominal, fields, PITCH_MM)
    start = detune(around, fields, detuned_px * PITCH_MM, torch.Generator().manual_seed(seed))
    return LensTask(nominal, make_design(start, fields, PITCH_MM, floors=around), fields)


def make_worlds(names):
    """A wall per texture name: photographs at 3 mm a texel (about a pixel) or, as "name:2", twice as coarse;
    band-limited "speckle-SEED".

    Coarse detail survives strong blur and fine detail judges weak blur: with both, the error falls all the
    way to focus.
    """
    found = []
    for entry in names:
        name, _, zoom = entry.partition(":")
        pattern = (
            textures.speckle(int(name.split("-")[1])) if name.startswith("speckle-") else textures.photo(name)
        )
        found.append(worlds.wall(textures.shrunk(pattern, 2), texel_m=0.003 * float(zoom or 1)))
    return found


def draw_case(pool, seed, frames=9):
    """A world out of ``pool``, a place before it and a motion, all from one seed."""
    generator = torch.Generator().manual_seed(seed)
    world = pool[int(torch.randint(len(pool), (1,), generator=generator))]
    place = 2 * torch.rand(2, generator=generator, dtype=torch.float64) - 1
    motion = torch.randn(6, generator=generator, dtype=torch.float64)
    start = pose.look_at(
        (float(place[0]), -DISTANCE_M, float(place[1])), (float(place[0]), 0.0, float(place[1]))
    )
    t_s = torch.linspace(0, DURATION_S, frames, dtype=torch.float64)
    return Case(world, trajectories.body_twist(start, MOTION * motion / DURATION_S, t_s), t_s, seed)
