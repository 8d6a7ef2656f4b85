"""Stage "lens": speed, memory and error of ray tracing, and analysis functions, beside optiland's
(pip install "codesign[bench]").

Every tracer gets the same double Gauss (indices of the d line), the same rays, and, going backward,
a seed of ones on all image positions; gradients reach all curved radii and all distances.
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
from studies.frame.bench import cost, installed, turns
from studies.frame.run import Run
from studies.frame.show import Asked, tabulate
from studies.frame.sweep import column, sweep
from studies.speed_error import Config

ASKED_SPEED = {
    ("float32", "forward"): 15.0,
    ("float32", "forward_backward"): 10.0,
    ("float64", "forward"): 10.0,
    ("float64", "forward_backward"): 8.0,
}
ASKED_MEMORY = 0.2
ASKED_ANALYSIS = 5.0
SURFACES = 11
HALF_DEG = 14.0
FIELDS = (0.0, 0.7, 1.0)
LINES = "dFC"
SPOT_GRID = 32
FAN_RAYS = 65
OPD_GRID = 64
PSF_GRID = 128
PADDED = 512
POINTS = 128
LOOKED_AT = 256


def stage(run: Run[Config]) -> list[Asked] | list[str]:
    """Rays through a double Gauss of eleven surfaces, d line, each tracer in processes of its own,
    in turns.
    Memory: peak of the first call above what was in use. Error: largest, of 256 rays, against our
    trace in float64, which the tests hold to 3e-14 mm. Analyses: float64, one thread, in turns in
    one process; three fields and lines of 800 rays, fans of 65 rays, wavefronts of 64 cells, point
    spreads of 128 cells padded to 512; a design step is the merit of three fields and its gradient
    to all curvatures and distances."""
    config = run.config
    peer = bool(installed({"optiland": "optiland"}))
    count = 100_000 if config.quick else 1_000_000
    axes = {
        "precision": ("float32", "float64"),
        "kind": ("forward", "forward_backward"),
        "tracer": ("codesign", "optiland") if peer else ("codesign",),
    }
    given = {"count": count, "repeats": config.repeats, "seed": config.seed}
    rows = sweep(run, tracing, "tracers", processes=1, turns=config.rounds, given=given, **axes)
    tabulate(run, f"{count:,} rays, medians", rows, *axes, prefix="trace")
    if not peer:
        return [alone(rows)]
    figures = []
    for (precision, kind), least in ASKED_SPEED.items():
        wall_s, peak_mb = (
            column(rows, name, precision=precision, kind=kind) for name in ("wall_s", "peak_mb")
        )
        what = f"{precision} {kind}, optiland with torch"
        figures.append(Asked(f"{what}: time over ours", wall_s[1] / wall_s[0], least=least))
        figures.append(
            Asked(f"{what}: our memory over its", peak_mb[0] / peak_mb[1], most=ASKED_MEMORY)
        )
    given = {"rounds": 3 if config.quick else 11}
    rows = sweep(run, analyses, "analyses", processes=1, given=given, backend=("torch", "numpy"))
    tabulate(run, "Analyses against optiland, medians", rows, "work", "backend", prefix="analysis")
    what = "least CPU time of an analysis by optiland over ours"
    return [*figures, Asked(what, min(column(rows, "ratio")), least=ASKED_ANALYSIS)]


def alone(rows: list[dict[str, Any]]) -> str:
    """One sentence of the quickest of our traces, where there is no peer."""
    best = max(rows, key=lambda row: row["million_ray_surfaces_per_s"])
    return (
        f"Rays meet {best['million_ray_surfaces_per_s']:.3g} million surfaces a second, {best['error_mm']:.2g} mm "
        f"off at most ({best['precision']}); optiland is not installed, hence not compared."
    )


def tracing(
    precision: str,
    kind: str,
    tracer: str,
    count: int,
    repeats: int,
    seed: int,
) -> dict[str, Any]:
    warnings.simplefilter("ignore")
    make = trace_by_optiland if tracer == "optiland" else trace_by_us
    # imports, and compiles what does not depend on the number of rays
    make(precision, kind, *rays(LOOKED_AT, precision, seed))()
    origin, direction = rays(count, precision, seed)
    work = make(precision, kind, origin, direction)
    found = cost(work, repeats)
    few, where = (part[:LOOKED_AT].double() for part in (origin, direction))
    with torch.no_grad():
        truth = (
            double_gauss().trace(few, where / where.norm(dim=1, keepdim=True)).position_mm[:, :2]
        )
    error = float((work()[:LOOKED_AT, :2].double() - truth).abs().max())
    speed = SURFACES * count / found["wall_s"] / 1e6
    return found | {"million_ray_surfaces_per_s": speed, "error_mm": error}


def rays(count: int, precision: str, seed: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Origins and directions [N, 3] of parallel rays over a square of 20 mm, 5.7 degrees off the
    axis."""
    across = np.random.default_rng(seed).uniform(-10, 10, (count, 2))
    origin = np.concatenate([across, np.full((count, 1), -5.0)], 1)
    direction = np.tile([0.0, 0.1, 0.99**0.5], (count, 1))
    return torch.tensor(origin.astype(precision)), torch.tensor(direction.astype(precision))


def double_gauss(precision: str = "float64") -> lens.GeoLens:
    """The published lens; its curvatures and distances ask for gradients."""
    return lens.load("double-gauss", getattr(torch, precision)).freeze(
        "conic", "asphere", "index_offset"
    )


def trace_by_us(precision, kind, origin, direction) -> Callable[[], torch.Tensor]:
    """A function that traces the rays once, or goes back to all that the lens learns; returns
    positions."""
    geo = double_gauss(precision)
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


def trace_by_optiland(precision, kind, origin, direction) -> Callable[[], torch.Tensor]:
    import optiland.backend as be  # pyright: ignore[reportMissingImports]
    from optiland.rays import RealRays  # pyright: ignore[reportMissingImports]

    _prepare(be, "torch", precision, kind == "forward_backward")
    group = optiland_double_gauss().surfaces
    learned = []
    if kind == "forward_backward":
        values = [v for s in group.surfaces[1:-1] for v in (s.geometry.radius, s.geometry.cs.z)]
        learned = [v.requires_grad_(True) for v in values if bool(be.isfinite(v))]
    parts = [be.array(part.numpy().copy()) for part in (*origin.T, *direction.T)]
    ones = be.ones_like(parts[0])

    def work():
        traced = RealRays(*parts, ones, lens.WAVELENGTH_UM["d"] * ones)
        group.trace(traced)
        if learned:
            (traced.x.sum() + traced.y.sum()).backward()
            for value in learned:
                value.grad = None
        return torch.stack([traced.x.detach(), traced.y.detach()], 1)

    return work


def analyses(backend: str, rounds: int) -> list[dict[str, Any]]:
    """Rows (work, ours and the peer's median processor time, ratios), in turns. Both have the same
    double Gauss, fields and wavelengths, and as many rays (at least as many on our side)."""
    warnings.simplefilter("ignore")
    torch.set_num_threads(1)
    drjit.set_thread_count(1)
    ours = our_analyses()
    rows = []
    for name, peer in optiland_analyses(backend).items():
        found = turns({"ours": ours[name], "peer": peer}, rounds, warm=0 if rounds > 1 else 1)
        ours_s, peer_s = found["ours"], found["peer"]
        cpu = {
            "ours_ms": 1e3 * ours_s.cpu,
            "peer_ms": 1e3 * peer_s.cpu,
            "ratio": peer_s.cpu / ours_s.cpu,
        }
        rows.append({"work": name, **cpu, "wall_ratio": peer_s.wall / ours_s.wall})
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
        "psf": lambda: analysis.diffraction_psf(
            geo, fields[0], grid=PSF_GRID, padding=PADDED // PSF_GRID
        ),
        "mtf": lambda: [analysis.diffraction_mtf(geo, f, frequency, grid=PSF_GRID) for f in fields],
        "seidel": lambda: seidel_sums(geo, half).total,
        "distortion": lambda: analysis.distortion_percent(geo, line),
        "field_curvature": lambda: analysis.focus_shift_mm(geo, line),
    }
    return {name: torch.no_grad()(work) for name, work in still.items()} | {
        "design_step": design_step
    }


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
        "psf": lambda: FFTPSF(
            optic, (0, 0), "primary", num_rays=PSF_GRID, grid_size=PADDED
        ).psf.max(),
        "mtf": lambda: FFTMTF(optic, num_rays=PSF_GRID, grid_size=PADDED).mtf,
        "seidel": seidel,
        "distortion": lambda: peer.Distortion(optic, wavelengths="primary", num_points=POINTS).data,
        "field_curvature": lambda: (
            peer.FieldCurvature(optic, wavelengths="primary", num_points=POINTS).data
        ),
    }
    return works | ({"design_step": optiland_design_step(be)} if backend == "torch" else {})


def optiland_design_step(be: Any) -> Callable[[], None]:
    """One step of a torch optimiser of optiland without the optimiser: update, merit, gradient."""
    from optiland.optimization import OptimizationProblem  # pyright: ignore[reportMissingImports]

    be.grad_mode.enable()
    optic = optiland_double_gauss()
    problem = OptimizationProblem()
    spot = {"optic": optic, "surface_number": -1, "Hx": 0, "num_rays": SPOT_GRID}
    spot |= {"wavelength": optic.primary_wavelength, "distribution": "uniform"}
    for share in FIELDS:
        problem.add_operand("rms_spot_size", target=0, weight=1, input_data={**spot, "Hy": share})
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
