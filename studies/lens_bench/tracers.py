"""The tracers that lens_bench times, each a process of its own: ours and the peers that are installed.

    python -m studies.lens_bench.tracers TRACER PRECISION KIND RAYS REPEATS SEED

prints one line of JSON: seconds of every repeat, memory that the work took, and checksums of the rays. Every
  tracer gets the same double Gauss
(indices of the d line), the same rays, and, going backward, a seed of ones on all image positions; gradients
reach all curved radii and, where the tracer
has them as variables, all distances.
"""

import contextlib
import json
import resource
import sys
import time
import warnings
from pathlib import Path

SURFACES = 11


def tracing_work(geo, kind, origin, direction):
    """A function that traces rays once ("forward"), or traces them and goes back to all that the lens learns
    ("forward_backward"); returns positions."""
    import torch

    seeds = torch.ones_like(origin)

    def work():
        if kind == "forward":
            with torch.no_grad():
                return geo.trace(origin, direction).position_mm
        geo.zero_grad()
        position = geo.trace(origin, direction).position_mm
        position.backward(seeds)
        return position

    return work


def codesign(precision, kind, rays):
    import torch

    from codesign import lens

    geo = lens.load("double-gauss", getattr(torch, precision)).freeze("conic", "asphere", "index_offset")
    return tracing_work(geo, kind, *map(torch.as_tensor, rays)), lambda position: position.detach().numpy()[
        :, :2
    ]


def codesign_chunks(precision, kind, rays):
    """The same work as a sum over chunks: only the gradient is kept, and memory stays that of one chunk."""
    import torch

    from codesign import lens
    from codesign.lens.trace import sum_over_chunks

    geo = lens.load("double-gauss", getattr(torch, precision)).freeze("conic", "asphere", "index_offset")
    origin = torch.as_tensor(rays[0])
    direction = torch.as_tensor(rays[1])

    def work():
        geo.curvature_per_mm.grad = geo.thickness_mm.grad = None
        sum_over_chunks(lambda o, d: geo.trace(o, d).position_mm.sum(), origin, direction).backward()
        return geo.curvature_per_mm.grad

    return work, lambda gradient: gradient.numpy()


def optiland(precision, kind, rays, backend="torch"):
    import numpy as np
    import optiland.backend as be  # pyright: ignore[reportMissingImports]
    from optiland.materials import IdealMaterial  # pyright: ignore[reportMissingImports]
    from optiland.optic import Optic  # pyright: ignore[reportMissingImports]
    from optiland.rays import RealRays  # pyright: ignore[reportMissingImports]

    from codesign import lens

    be.set_backend(backend)
    if backend == "torch":
        be.set_device("cpu")
        be.set_precision(precision)
        (be.grad_mode.disable if kind == "forward" else be.grad_mode.enable)()
    optic = Optic()
    add = optic.surfaces.add if hasattr(optic, "surfaces") else optic.add_surface
    add(index=0, thickness=np.inf)
    published = lens.load("double-gauss")
    for i, s in enumerate(published.surfaces):
        add(
            index=i + 1,
            radius=s.radius_mm,
            thickness=s.thickness_mm,
            material=IdealMaterial(s.medium.index_d) if s.medium else "air",
            is_stop=i == published.stop_index,
        )
    add(index=SURFACES + 1)
    group = optic.surfaces if hasattr(optic, "surfaces") else optic.surface_group
    learned = []
    if kind != "forward":
        for surface in group.surfaces[1:-1]:
            for value in (surface.geometry.radius, surface.geometry.cs.z):
                if bool(be.isfinite(value)):
                    value.requires_grad_(True)
                    learned.append(value)
    (x, y, z), (cx, cy, cz) = (part.T for part in rays)
    if backend == "torch":
        x, y, z, cx, cy, cz = (be.array(part.copy()) for part in (x, y, z, cx, cy, cz))
    ones = be.ones_like(x)

    def work():
        traced = RealRays(x, y, z, cx, cy, cz, ones, 0.5875618 * ones)
        group.trace(traced)
        if kind != "forward":
            (traced.x.sum() + traced.y.sum()).backward()
            for value in learned:
                value.grad = None
        return traced

    def plain(v):
        return v.detach().numpy() if backend == "torch" else v

    return work, lambda traced: np.stack([plain(traced.x), plain(traced.y)], 1)


def rayoptics(precision, kind, rays):
    import numpy as np
    from rayoptics.environment import OpticalModel  # pyright: ignore[reportMissingImports]
    from rayoptics.raytr import raytrace  # pyright: ignore[reportMissingImports]

    from codesign import lens

    model = OpticalModel()
    sequence = model["seq_model"]
    sequence.gaps[0].thi = 10.0
    for s in lens.load("double-gauss").surfaces:
        sequence.add_surface(
            [s.curvature_per_mm, s.thickness_mm, *([s.medium.index_d, 60.0] if s.medium else [])]
        )  # the Abbe number plays no part at the d line
    model.update_model()
    path = list(sequence.path(587.5618))
    starts = rays[0] + np.array([0.0, 0.0, 10.0])  # counted from the object surface

    def work():
        found = []
        for start, direction in zip(starts, rays[1], strict=True):
            hits, *_ = raytrace.trace_raw(iter(path), start, direction, 587.5618, intersect_obj=False)
            found.append(hits[-1][0][:2])
        return np.array(found)

    return work, lambda found: found


TRACERS = {
    "codesign": codesign,
    "codesign-chunks": codesign_chunks,
    "optiland-torch": optiland,
    "optiland-numpy": lambda p, k, r: optiland(p, k, r, "numpy"),
    "rayoptics": rayoptics,
}


def make_rays(count, precision, seed):
    """Origins and directions [N, 3] of parallel rays over a square of 20 mm, 5.7 degrees off the axis."""
    import numpy as np

    across = np.random.default_rng(seed).uniform(-10, 10, (count, 2))
    origin = np.concatenate([across, np.full((count, 1), -5.0)], 1).astype(precision)
    return origin, np.ascontiguousarray(
        np.broadcast_to(np.array([0.0, 0.1, 0.99**0.5]), (count, 3)), dtype=precision
    )


def resident():
    """Memory in use now, bytes; 0 where the system does not tell."""
    try:
        return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize()
    except OSError:
        return 0


def forget_peak():
    """Start the count of the largest memory anew; returns what is in use. Where the system cannot (not
    Linux), earlier peaks count too."""
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")
    return resident()


def peak():
    """Largest memory in use since ``forget_peak``, bytes."""
    try:
        line = next(x for x in Path("/proc/self/status").read_text().splitlines() if x.startswith("VmHWM"))
        return int(line.split()[1]) * 1024
    except (OSError, StopIteration):
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)


def run(tracer, precision, kind, count, repeats, seed):
    """Time one tracer in this process; returns a dictionary."""
    import numpy as np

    warnings.simplefilter("ignore")
    small = make_rays(256, precision, seed)
    work, _ = TRACERS[tracer](precision, kind, small)
    work()  # imports, compilation of what does not depend on the number of rays
    rays = make_rays(count, precision, seed)
    work, positions = TRACERS[tracer](precision, kind, rays)
    before = forget_peak()
    walls = []
    cpus = []
    result = work()
    sample = positions(result)[:256].tolist()
    del result
    for _ in range(repeats):
        wall = time.perf_counter()
        cpu = time.process_time()
        result = work()
        walls.append(time.perf_counter() - wall)
        cpus.append(time.process_time() - cpu)
        del result
    return {
        "wall_s": walls,
        "cpu_s": cpus,
        "peak_bytes": peak() - before,
        "sample": np.asarray(sample, dtype=float).tolist(),
    }


if __name__ == "__main__":
    tracer, precision, kind, *numbers = sys.argv[1:]
    sys.stdout.write(json.dumps(run(tracer, precision, kind, *map(int, numbers))) + "\n")
