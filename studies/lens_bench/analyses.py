"""Analysis functions and a design step, ours and optiland's in turns in one process.

    python -m studies.lens_bench.analyses BACKEND ROUNDS

prints one line of JSON: work -> seconds of every round and a figure of merit, ours and the peer's. Both have the same
double Gauss, fields and wavelengths, and as many rays (at least as many on our side); figures that do not depend on
where the rays of a grid lie agree, the others nearly. A design step is the squared spot of three fields and its
gradient to all curvatures and distances.
"""

import contextlib
import json
import math
import sys
import time
import warnings

HALF_DEG = 14.0
FIELDS = (0.0, 0.7, 1.0)
LINES = "dFC"
SPOT_GRID = 32
FAN_RAYS = 65
OPD_GRID = 64
PSF_GRID = 128
PADDED = 512
POINTS = 128
WARM = 2  # rounds that import and compile


def ours(torch):
    """Work -> function that does it once and returns a float."""
    from codesign import lens
    from codesign.lens import analysis
    from codesign.lens.seidel import seidel_sums

    geo = lens.load("double-gauss").requires_grad_(False)
    learned = lens.load("double-gauss").freeze("conic", "asphere", "index_offset")
    half = math.radians(HALF_DEG)
    fields = [share * half for share in FIELDS]
    line = [half * (k / (POINTS - 1)) for k in range(POINTS)]
    frequency = torch.linspace(0, 500, PADDED // 2, dtype=geo.dtype)

    def spot():
        found = [lens.spots(geo, fields, lens.WAVELENGTH_UM[k], SPOT_GRID) for k in LINES]
        return analysis.spot_radius_mm(found[0][0][2], found[0][1][2])

    def fan():
        found = [analysis.ray_fan(geo, f, lens.WAVELENGTH_UM[k], FAN_RAYS) for f in fields for k in LINES]
        return found[6].tangential_mm[-1]

    def wavefront():
        front = analysis.wavefront(geo, fields[2], grid=OPD_GRID)
        return front.waves.std()

    def psf():
        return analysis.diffraction_psf(
            geo, fields[0], grid=PSF_GRID, padding=PADDED // PSF_GRID
        ).energy.max()

    def mtf():
        found = [analysis.diffraction_mtf(geo, f, frequency, grid=PSF_GRID) for f in fields]
        return found[0][0, 20]

    def seidel():
        return seidel_sums(geo, half).total[0]

    def distortion():
        return analysis.distortion_percent(geo, line)[-1]

    def field_curvature():
        return analysis.focus_shift_mm(geo, line)[-1, 0]

    def design_step():
        learned.zero_grad()
        loss = lens.rms_spot_mm(learned, fields, grid=SPOT_GRID).square().sum()
        loss.backward()
        return learned.thickness_mm.grad[0]

    still = (spot, fan, wavefront, psf, mtf, seidel, distortion, field_curvature)
    return {f.__name__: torch.no_grad()(f) for f in still} | {"design_step": design_step}


def theirs(backend):
    """The same of optiland."""
    import optiland.backend as be  # pyright: ignore[reportMissingImports]
    from optiland.aberrations import Aberrations  # pyright: ignore[reportMissingImports]
    from optiland.analysis import (  # pyright: ignore[reportMissingImports]
        Distortion,
        FieldCurvature,
        RayFan,
        SpotDiagram,
    )
    from optiland.mtf import FFTMTF  # pyright: ignore[reportMissingImports]
    from optiland.optimization import OptimizationProblem  # pyright: ignore[reportMissingImports]
    from optiland.psf import FFTPSF  # pyright: ignore[reportMissingImports]
    from optiland.wavefront import OPD  # pyright: ignore[reportMissingImports]

    from codesign.lens import WAVELENGTH_UM

    be.set_backend(backend)
    if backend == "torch":
        be.set_device("cpu")
        be.set_precision("float64")
        be.grad_mode.disable()
    optic = double_gauss()
    edge = (0, 1)

    def spot():
        found = SpotDiagram(optic, num_rings=SPOT_GRID, distribution="uniform")
        at = found.data[2][0]
        x, y = at.x - at.x.mean(), at.y - at.y.mean()
        return ((x * x + y * y).mean()) ** 0.5

    def fan():
        found = RayFan(optic, num_points=FAN_RAYS)
        return found.data[f"{found.fields[2].coord}"][f"{WAVELENGTH_UM['d']}"]["y"][-1]

    def wavefront():
        found = OPD(optic, edge, "primary", num_rays=OPD_GRID, distribution="uniform")
        return next(iter(found.data.values())).opd.std()

    def psf():
        return FFTPSF(optic, (0, 0), "primary", num_rays=PSF_GRID, grid_size=PADDED).psf.max()

    def mtf():
        found = FFTMTF(optic, num_rays=PSF_GRID, grid_size=PADDED)
        return found.mtf[0][0][20]

    def seidel():
        Aberrations(optic).third_order()
        return -Aberrations(optic).seidels()[0]

    def distortion():
        return Distortion(optic, wavelengths="primary", num_points=POINTS).data[0][-1]

    def field_curvature():
        return FieldCurvature(optic, wavelengths="primary", num_points=POINTS).data[0][0][-1]

    works = {f.__name__: f for f in (spot, fan, wavefront, psf, mtf, seidel, distortion, field_curvature)}
    if backend == "torch":
        works["design_step"] = design_step(double_gauss(), be, OptimizationProblem)
    return works


def design_step(optic, be, problem_type):
    """One step of a torch optimiser of optiland without the optimiser: update, merit, gradient."""
    import torch

    be.grad_mode.enable()
    problem = problem_type()
    for share in FIELDS:
        problem.add_operand(
            "rms_spot_size",
            target=0,
            weight=1,
            input_data={
                "optic": optic,
                "surface_number": -1,
                "Hx": 0,
                "Hy": share,
                "num_rays": SPOT_GRID,
                "wavelength": optic.primary_wavelength,
                "distribution": "uniform",
            },
        )
    count = optic.surfaces.num_surfaces
    for k in range(1, count - 1):
        if bool(be.isfinite(optic.surfaces.radii[k])):
            problem.add_variable(optic, "radius", surface_number=k)
        problem.add_variable(optic, "thickness", surface_number=k)
    parameters = [torch.nn.Parameter(be.array(v.value)) for v in problem.variables]
    be.grad_mode.disable()

    def design_step():
        with be.grad_mode.temporary_enable():
            for parameter, variable in zip(parameters, problem.variables, strict=True):
                parameter.grad = None
                variable.update(parameter)
            problem.update_optics()
            problem.sum_squared().backward()
        return parameters[1].grad

    return design_step


def double_gauss():
    """The published double Gauss in optiland, with its field angles and the lines d, F, C."""
    import numpy as np
    from optiland.materials import IdealMaterial  # pyright: ignore[reportMissingImports]
    from optiland.optic import Optic  # pyright: ignore[reportMissingImports]

    from codesign import lens

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


def run(backend, rounds):
    """Wall and processor seconds and figures of every work, ours and the peer's in turns, one thread each."""
    import drjit
    import torch

    warnings.simplefilter("ignore")
    torch.set_num_threads(1)
    drjit.set_thread_count(1)
    pairs = {"ours": ours(torch), "peer": theirs(backend)}
    found = {}
    with contextlib.redirect_stdout(sys.stderr):
        for name in pairs["peer"]:
            found[name] = {f"{side}_{kind}": [] for side in pairs for kind in ("wall_s", "cpu_s")}
            for k in range(rounds + WARM):
                for side, works in pairs.items():
                    wall = time.perf_counter()
                    cpu = time.process_time()
                    value = works[name]()
                    if k >= WARM:
                        found[name][f"{side}_wall_s"].append(time.perf_counter() - wall)
                        found[name][f"{side}_cpu_s"].append(time.process_time() - cpu)
                    found[name][f"{side}_value"] = float(value)
    return found


if __name__ == "__main__":
    backend, rounds = sys.argv[1:]
    sys.stdout.write(json.dumps(run(backend, int(rounds))) + "\n")
