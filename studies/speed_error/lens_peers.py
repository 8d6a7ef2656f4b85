"""What the stage "lens" times, each in a process of its own: tracers, analysis functions, a design step;
ours and optiland's (pip install "codesign[bench]").

Every tracer gets the same double Gauss (indices of the d line), the same rays, and, going backward, a seed
of ones on all image positions; gradients reach all curved radii and all distances.
"""

import math
import warnings
from collections.abc import Callable
from typing import Any

import drjit
import numpy as np
import torch

from codesign import lens
from codesign.lens import analysis
from codesign.lens.seidel import seidel_sums
from codesign.lens.trace import sum_over_chunks
from studies.frame.bench import measure, peak_mb, turns

HALF_DEG = 14.0
FIELDS = (0.0, 0.7, 1.0)
LINES = "dFC"
SPOT_GRID = 32
FAN_RAYS = 65
OPD_GRID = 64
PSF_GRID = 128
PADDED = 512
POINTS = 128
LOOKED_AT = 256  # rays whose error is told


def rays(count: int, precision: str, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Origins and directions [N, 3] of parallel rays over a square of 20 mm, 5.7 degrees off the axis."""
    across = np.random.default_rng(seed).uniform(-10, 10, (count, 2))
    origin = np.concatenate([across, np.full((count, 1), -5.0)], 1)
    direction = np.tile([0.0, 0.1, 0.99**0.5], (count, 1))
    return origin.astype(precision), direction.astype(precision)


def double_gauss(precision: str = "float64") -> lens.GeoLens:
    """The published lens; its curvatures and distances ask for gradients."""
    return lens.load("double-gauss", getattr(torch, precision)).freeze("conic", "asphere", "index_offset")


def work_of_tracing(geo: lens.GeoLens, kind: str, count: int, seed: int) -> Callable[[], torch.Tensor]:
    """A function that traces rays once ("forward"), or traces them and goes back to all that the lens learns
    ("forward_backward"); returns positions."""
    precision = str(geo.dtype).removeprefix("torch.")
    origin, direction = map(torch.as_tensor, rays(count, precision, seed))
    seeds = torch.ones_like(origin)

    def work():
        if kind == "forward":
            with torch.no_grad():
                return geo.trace(origin, direction).position_mm
        geo.zero_grad()
        position = geo.trace(origin, direction).position_mm
        position.backward(seeds)
        return position.detach()

    return work


def work_in_chunks(count, seed):
    """Forward and backward as a sum over chunks: only the gradient is kept."""
    geo = double_gauss("float32")
    origin, direction = map(torch.as_tensor, rays(count, "float32", seed))

    def work():
        geo.zero_grad()
        sum_over_chunks(lambda o, d: geo.trace(o, d).position_mm.sum(), origin, direction).backward()

    return work


def work_of_optiland(backend, precision, kind, count, seed):
    import optiland.backend as be  # pyright: ignore[reportMissingImports]
    from optiland.rays import RealRays  # pyright: ignore[reportMissingImports]

    _prepare(be, backend, precision, kind == "forward_backward")
    group = optiland_double_gauss().surfaces
    learned = []
    if kind == "forward_backward":
        values = [v for s in group.surfaces[1:-1] for v in (s.geometry.radius, s.geometry.cs.z)]
        learned = [v.requires_grad_(True) for v in values if bool(be.isfinite(v))]
    parts = [part for each in rays(count, precision, seed) for part in each.T]
    if backend == "torch":
        parts = [be.array(part.copy()) for part in parts]
    ones = be.ones_like(parts[0])

    def work():
        traced = RealRays(*parts, ones, lens.WAVELENGTH_UM["d"] * ones)
        group.trace(traced)
        if learned:
            (traced.x.sum() + traced.y.sum()).backward()
            for value in learned:
                value.grad = None
        x, y = (v.detach().numpy() if backend == "torch" else v for v in (traced.x, traced.y))
        return np.stack([x, y], 1)

    return work


def tracing(case: list[str], count: int, repeats: int, seed: int, turn: int = 0) -> dict[str, Any]:
    """Times, peak memory and largest error of one tracer, of (tracer, precision, kind).

    The error is that of some of the rays against our own trace in float64, which tests/lens holds to 3e-14
    mm.
    """
    tracer, precision, kind = case
    warnings.simplefilter("ignore")

    def prepared(count) -> Callable[[], Any]:
        if tracer == "codesign":
            return work_of_tracing(double_gauss(precision), kind, count, seed)
        if tracer == "codesign-chunks":
            return work_in_chunks(count, seed)
        return work_of_optiland(tracer.removeprefix("optiland-"), precision, kind, count, seed)

    prepared(LOOKED_AT)()  # imports, and compiles what does not depend on the number of rays
    work = prepared(count)
    peak = peak_mb(work)
    timing = measure(work, repeats, warm=0)
    found = {"wall_s": timing.wall_s, "cpu_s": timing.cpu_s, "peak_mb": peak}
    if tracer == "codesign-chunks":
        return found
    origin, direction = (torch.as_tensor(part[:LOOKED_AT]).double() for part in rays(count, precision, seed))
    truth = double_gauss().trace(origin, direction / direction.norm(dim=1, keepdim=True)).position_mm
    here = np.asarray(work()[:LOOKED_AT], dtype=float)[:, :2]
    return found | {"error_mm": float(np.abs(here - truth.detach().numpy()[:, :2]).max())}


def stack(count: int, alike: bool) -> lens.GeoLens:
    """A lens of weak surfaces, glass and air in turns; "alike": a stack of spheres, as lenses are when all
    their numbers ask for a gradient; otherwise every eighth has asphere terms of its own number, with
    shapes held, so that no two parts share a kernel."""
    glass = lens.Glass.from_indices(1.5, 1.5, 1.5)
    surfaces = [
        lens.Surface(
            900.0 if i % 2 else -900.0,
            1.0,
            None if i % 2 else glass,
            80.0,
            asphere=() if alike or i % 8 else (1e-9,) * (1 + i // 8),
        )
        for i in range(count)
    ]
    geo = lens.GeoLens(surfaces, 10.0)
    return geo if alike else geo.freeze("conic", "asphere")


def first_gradient(count: int, alike: bool) -> dict[str, float]:
    """Seconds of this process's first trace and gradient, after a lens of two surfaces has started the
    compiler."""
    origin = torch.tensor([[1.0, 2.0, -5.0]] * 16, dtype=torch.float64)
    direction = torch.tensor([[0.0, 0.0, 1.0]] * 16, dtype=torch.float64)

    def step(geo):
        geo.trace(origin, direction).position_mm.square().sum().backward()

    step(stack(2, True))
    geo = stack(count, alike)
    timing = measure(lambda: step(geo), 1, warm=0)
    return {"cpu_s": timing.cpu, "wall_s": timing.wall}


def analyses(backend: str, rounds: int) -> list[dict[str, Any]]:
    """Rows (work, ours and the peer's median milliseconds, ratios of processor and wall time), in turns
    with one thread each. Both have the same double Gauss, fields and wavelengths, and as many rays (at
    least as many on our side)."""
    warnings.simplefilter("ignore")
    torch.set_num_threads(1)
    drjit.set_thread_count(1)
    ours = our_analyses()
    rows = []
    for name, peer in optiland_analyses(backend).items():
        found = turns({"ours": ours[name], "peer": peer}, rounds, warm=0 if rounds > 1 else 1)
        times = found["ours"], found["peer"]
        rows.append(
            {
                "work": name,
                "ours_ms": 1e3 * times[0].cpu,
                "peer_ms": 1e3 * times[1].cpu,
                "ratio": times[1].cpu / times[0].cpu,
                "wall_ratio": times[1].wall / times[0].wall,
            }
        )
    return rows


def our_analyses() -> dict[str, Callable[[], Any]]:
    """Analysis functions and a design step by name."""
    geo = lens.load("double-gauss").requires_grad_(False)
    learned = double_gauss()
    half = math.radians(HALF_DEG)
    fields = [share * half for share in FIELDS]
    line = [half * (k / (POINTS - 1)) for k in range(POINTS)]
    frequency = torch.linspace(0, 500, PADDED // 2, dtype=geo.dtype)

    def spot():
        found = [lens.spots(geo, fields, lens.WAVELENGTH_UM[k], SPOT_GRID) for k in LINES]
        return analysis.spot_radius_mm(found[0][0][2], found[0][1][2])

    def design_step():
        learned.zero_grad()
        lens.rms_spot_mm(learned, fields, grid=SPOT_GRID).square().sum().backward()

    still = {
        "spot": spot,
        "fan": lambda: [
            analysis.ray_fan(geo, f, lens.WAVELENGTH_UM[k], FAN_RAYS) for f in fields for k in LINES
        ],
        "wavefront": lambda: analysis.wavefront(geo, fields[2], grid=OPD_GRID).waves.std(),
        "psf": lambda: analysis.diffraction_psf(geo, fields[0], grid=PSF_GRID, padding=PADDED // PSF_GRID),
        "mtf": lambda: [analysis.diffraction_mtf(geo, f, frequency, grid=PSF_GRID) for f in fields],
        "seidel": lambda: seidel_sums(geo, half).total,
        "distortion": lambda: analysis.distortion_percent(geo, line),
        "field_curvature": lambda: analysis.focus_shift_mm(geo, line),
    }
    return {name: torch.no_grad()(work) for name, work in still.items()} | {"design_step": design_step}


def optiland_analyses(backend: str) -> dict[str, Callable[[], Any]]:
    """The same of optiland; the design step where its backend has gradients."""
    import optiland.analysis as peer  # pyright: ignore[reportMissingImports]
    import optiland.backend as be  # pyright: ignore[reportMissingImports]
    from optiland.aberrations import Aberrations  # pyright: ignore[reportMissingImports]
    from optiland.mtf import FFTMTF  # pyright: ignore[reportMissingImports]
    from optiland.psf import FFTPSF  # pyright: ignore[reportMissingImports]
    from optiland.wavefront import OPD  # pyright: ignore[reportMissingImports]

    _prepare(be, backend, "float64", gradients=False)
    optic = optiland_double_gauss()

    def spot():
        found = peer.SpotDiagram(optic, num_rings=SPOT_GRID, distribution="uniform").data[2][0]
        x, y = found.x - found.x.mean(), found.y - found.y.mean()
        return ((x * x + y * y).mean()) ** 0.5

    def wavefront():
        found = OPD(optic, (0, 1), "primary", num_rays=OPD_GRID, distribution="uniform")
        return next(iter(found.data.values())).opd.std()

    def seidel():
        Aberrations(optic).third_order()
        return Aberrations(optic).seidels()

    works = {
        "spot": spot,
        "fan": lambda: peer.RayFan(optic, num_points=FAN_RAYS),
        "wavefront": wavefront,
        "psf": lambda: FFTPSF(optic, (0, 0), "primary", num_rays=PSF_GRID, grid_size=PADDED).psf.max(),
        "mtf": lambda: FFTMTF(optic, num_rays=PSF_GRID, grid_size=PADDED).mtf,
        "seidel": seidel,
        "distortion": lambda: peer.Distortion(optic, wavelengths="primary", num_points=POINTS).data,
        "field_curvature": lambda: peer.FieldCurvature(optic, wavelengths="primary", num_points=POINTS).data,
    }
    return works | ({"design_step": optiland_design_step(be)} if backend == "torch" else {})


def optiland_design_step(be: Any) -> Callable[[], None]:
    """One step of a torch optimiser of optiland without the optimiser: update, merit, gradient."""
    from optiland.optimization import OptimizationProblem  # pyright: ignore[reportMissingImports]

    be.grad_mode.enable()
    optic = optiland_double_gauss()
    problem = OptimizationProblem()
    for share in FIELDS:
        asked = {
            "optic": optic,
            "surface_number": -1,
            "Hx": 0,
            "Hy": share,
            "num_rays": SPOT_GRID,
            "wavelength": optic.primary_wavelength,
            "distribution": "uniform",
        }
        problem.add_operand("rms_spot_size", target=0, weight=1, input_data=asked)
    for k in range(1, optic.surfaces.num_surfaces - 1):
        if bool(be.isfinite(optic.surfaces.radii[k])):
            problem.add_variable(optic, "radius", surface_number=k)
        problem.add_variable(optic, "thickness", surface_number=k)
    parameters = [torch.nn.Parameter(be.array(v.value)) for v in problem.variables]
    be.grad_mode.disable()

    def step():
        with be.grad_mode.temporary_enable():
            for parameter, variable in zip(parameters, problem.variables, strict=True):
                parameter.grad = None
                variable.update(parameter)
            problem.update_optics()
            problem.sum_squared().backward()

    return step


def optiland_double_gauss() -> Any:
    """The published double Gauss in optiland, with its field angles and the lines d, F, C."""
    from optiland.materials import IdealMaterial  # pyright: ignore[reportMissingImports]
    from optiland.optic import Optic  # pyright: ignore[reportMissingImports]

    optic = Optic()
    optic.surfaces.add(index=0, thickness=np.inf)
    published = lens.load("double-gauss")
    for i, s in enumerate(published.surfaces):
        optic.surfaces.add(
            index=i + 1,
            radius=s.radius_mm,
            thickness=s.thickness_mm,
            material=IdealMaterial(s.medium.index_d) if s.medium else "air",
            is_stop=i == published.stop_index,
        )
    optic.surfaces.add(index=len(published.surfaces) + 1)
    optic.set_aperture("EPD", published.entrance_pupil_diameter_mm)
    optic.set_field_type("angle")
    for share in FIELDS:
        optic.add_field(y=share * HALF_DEG)
    for k in LINES:
        optic.add_wavelength(value=lens.WAVELENGTH_UM[k], is_primary=k == "d")
    return optic


def _prepare(be, backend, precision, gradients):
    be.set_backend(backend)
    if backend == "torch":
        be.set_device("cpu")
        be.set_precision(precision)
        (be.grad_mode.enable if gradients else be.grad_mode.disable)()
