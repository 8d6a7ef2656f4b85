"""Speed against error of ray tracers: ours and the peers that are installed, on the same lens and the same
rays.

Every case runs in a process of its own, in turns with the others, so that memory is counted apart and a
change of the machine's load meets all. The error is that of 256 of the timed rays against a trace with 30
digits. Analysis functions and a design step follow against optiland's own. A second part shows how our time and memory grow with rays and surfaces. Peers: pip install
".[bench]".
"""

import importlib.util
import json
import math
import statistics
import subprocess
import sys
from dataclasses import dataclass
from importlib.metadata import version
from typing import ClassVar

import matplotlib.pyplot as plt
import mpmath
import numpy as np
import torch

from codesign import lens
from codesign.errors import DomainError
from studies.frame.run import Run, StudyConfig, main
from studies.frame.timing import Timing, measure
from studies.lens_bench import compiling
from studies.lens_bench.compared import show_analyses, time_analyses
from studies.lens_bench.tracers import SURFACES, make_rays, tracing_work

PEERS = {"optiland-torch": "optiland", "optiland-numpy": "optiland", "rayoptics": "rayoptics"}
CASES = [
    ("codesign", "float32", "forward"),
    ("optiland-torch", "float32", "forward"),
    ("codesign", "float32", "forward_backward"),
    ("optiland-torch", "float32", "forward_backward"),
    ("codesign", "float64", "forward"),
    ("optiland-torch", "float64", "forward"),
    ("optiland-numpy", "float64", "forward"),
    ("rayoptics", "float64", "forward"),
    ("codesign", "float64", "forward_backward"),
    ("optiland-torch", "float64", "forward_backward"),
]
ASKED = {
    ("float32", "forward"): 15.0,
    ("float32", "forward_backward"): 10.0,
    ("float64", "forward"): 10.0,
    ("float64", "forward_backward"): 8.0,
}
ASKED_MEMORY = 0.2
ASKED_LINEAR = 0.15
COLOURS = {
    "codesign": "#1b6ca8",
    "optiland-torch": "#c0392b",
    "optiland-numpy": "#e08e0b",
    "rayoptics": "#2e8b57",
}
SLOW = 200  # rayoptics traces ray by ray in Python: it gets this many times fewer rays


@dataclass(frozen=True)
class Config(StudyConfig):
    QUICK: ClassVar = {
        "rays": 100_000,
        "repeats": 3,
        "rounds": 1,
        "most_rays": 1_000_000,
        "analysis_rounds": 3,
    }
    rays: int = 1_000_000
    """Rays of the comparison."""
    repeats: int = 7
    """Timed repeats per process."""
    rounds: int = 2
    """Times that every tracer gets its turn."""
    most_rays: int = 10_000_000
    """Largest number of rays of the growth curves."""
    analysis_rounds: int = 11
    """Timed turns of the analysis functions."""


def study(run: Run[Config]) -> None:
    config = run.config
    if (
        config.rays < 1000
        or config.repeats < 3
        or config.rounds < 1
        or config.most_rays < 20_000
        or config.analysis_rounds < 1
    ):
        raise DomainError(
            f"rays {config.rays}, repeats {config.repeats}, rounds {config.rounds}, most_rays "
            f"{config.most_rays}, analysis_rounds {config.analysis_rounds}: give at least 1000, 3, 1, 20000 and 1."
        )
    rays = config.rays
    most = config.most_rays
    cases = [case for case in CASES if case[0] not in PEERS or importlib.util.find_spec(PEERS[case[0]])]
    counts = [n for n in (10_000, 30_000, 100_000, 300_000, 1_000_000, 3_000_000, 10_000_000) if n <= most]
    found: dict[tuple, list[dict]] = {case: [] for case in cases}
    with run.progress(
        config.rounds * len(cases) + 2 * len(counts) + 2 * len(LONGER) + 4 + 2 + len(COLD), "timing"
    ) as progress:
        for _ in range(config.rounds):
            for case in cases:
                found[case].append(
                    in_process(
                        *case,
                        max(rays // SLOW, 256) if case[0] == "rayoptics" else rays,
                        config.repeats,
                        config.seed,
                    )
                )
                progress.advance()
        analyses = time_analyses(config.analysis_rounds, progress)
        growth = growth_in_rays(counts, config.seed, progress)
        longer = growth_in_surfaces(config.seed, progress)
        memory = {}
        for way in ("codesign", "codesign-chunks"):
            for count in (most // 10, most):
                memory[way, count] = in_process(way, "float32", "forward_backward", count, 1, config.seed)
                progress.advance()
        cold = {}
        for kind, count in COLD:
            cold[kind, count] = compiling.measure(count, kind)
            progress.advance()
    missing = sorted({package for tracer, package in PEERS.items() if not importlib.util.find_spec(package)})
    show(run, compare(run, found, rays, config.seed), missing)
    show_analyses(run, analyses)
    show_growth(run, counts, growth, longer)
    show_memory(run, memory)
    compiling.show(run, cold)
    run.finish(
        "Ray tracers",
        "Time, memory and error of ray tracers on the same lens and rays, in one run."
        + (f" Not installed, hence not compared: {', '.join(missing)}." if missing else ""),
    )


def in_process(tracer, precision, kind, rays, repeats, seed):
    """One case in its own process; returns what it printed."""
    command = [
        sys.executable,
        "-m",
        "studies.lens_bench.tracers",
        tracer,
        precision,
        kind,
        str(rays),
        str(repeats),
        str(seed),
    ]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise DomainError(
            f"{tracer} ({precision}, {kind}) ended with code {done.returncode}: "
            f"{(done.stderr.strip().splitlines() or [''])[-1][:200]}"
        )
    return {**json.loads(done.stdout.splitlines()[-1]), "rays": rays}


def compare(run, found, rays, seed):
    """Rows of the table; ratios to optiland-torch go into the metrics."""
    truth = {precision: reference(*make_rays(rays, precision, seed)) for precision in ("float32", "float64")}
    rows = []
    speed = {}
    memory = {}
    for (tracer, precision, kind), parts in found.items():
        timing = Timing(
            tuple(t for p in parts for t in p["wall_s"]), tuple(t for p in parts for t in p["cpu_s"])
        )
        count = parts[0]["rays"]
        reach = truth[precision] if count == rays else reference(*make_rays(count, precision, seed))
        error = float(np.abs(np.array(parts[0]["sample"]) - reach).max())
        speed[tracer, precision, kind], memory[tracer, precision, kind] = (
            SURFACES * count / timing.wall / 1e6,
            statistics.median(p["peak_bytes"] for p in parts) / 1e6,
        )
        name = f"{tracer.replace('-', '_')}_{kind}_{precision}"
        run.record(
            **{
                f"{name}_million_ray_surfaces_per_s": speed[tracer, precision, kind],
                f"{name}_wall_s": timing.wall,
                f"{name}_wall_iqr_s": timing.wall_iqr,
                f"{name}_cpu_s": timing.cpu,
                f"{name}_peak_mb": memory[tracer, precision, kind],
                f"{name}_max_error_mm": error,
                f"{name}_rays": count,
            }
        )
        rows.append(
            (
                tracer,
                precision,
                kind.replace("_", " + "),
                count,
                timing.wall,
                timing.wall_iqr,
                timing.cpu,
                speed[tracer, precision, kind],
                memory[tracer, precision, kind],
                error,
            )
        )
    return rows, speed, memory


def show(run, compared, missing):
    rows, speed, memory = compared
    run.section(
        "Comparison",
        "Double Gauss of eleven surfaces, d line. Going backward, ours reaches all curvatures and "
        "distances, the peer all radii and vertex positions.",
    )
    run.table(
        "Tracers",
        (
            "tracer",
            "precision",
            "work",
            "rays",
            "wall s, median",
            "IQR",
            "CPU s",
            "million ray-surfaces/s",
            "memory MB",
            "largest error mm",
        ),
        rows,
        "Memory is the peak above what was in use before the work. Error: against a 30-digit trace of 256 "
        "of the rays.",
    )
    judged = []
    for (precision, kind), asked in ASKED.items():
        ours = ("codesign", precision, kind)
        peer = ("optiland-torch", precision, kind)
        if peer not in speed:
            continue
        ratio = speed[ours] / speed[peer]
        share = memory[ours] / memory[peer]
        run.record(
            **{
                f"speed_over_optiland_torch_{kind}_{precision}": ratio,
                f"memory_over_optiland_torch_{kind}_{precision}": share,
            }
        )
        judged.append(
            (
                precision,
                kind.replace("_", " + "),
                ratio,
                asked,
                share,
                ASKED_MEMORY,
                "yes" if ratio >= asked and share <= ASKED_MEMORY else "no",
            )
        )
        run.card(
            f"{kind.replace('_', ' + ')}, {precision}",
            f"{ratio:.1f} x",
            f"the speed of optiland with torch; asked: {asked:g}; memory {share:.2f} of it, asked: "
            f"{ASKED_MEMORY:g}",
        )
    if judged:
        run.table(
            "Against optiland with torch",
            ("precision", "work", "speed ratio", "asked", "memory ratio", "allowed", "met"),
            judged,
        )
    if not missing:
        run.record(
            **{
                f"{package}_version_{i}": int(part)
                for package in ("optiland", "rayoptics")
                for i, part in enumerate(version(package).split(".")[:3])
                if part.isdigit()
            }
        )
    figure, axis = plt.subplots(figsize=(8, 4), layout="constrained")
    for tracer, colour in COLOURS.items():
        for precision, marker in (("float32", "o"), ("float64", "s")):
            for kind, face in (("forward", colour), ("forward + backward", "none")):
                points = [
                    (rate, max(error, 1e-15))
                    for t, p, k, *_, rate, _, error in rows
                    if (t, p, k) == (tracer, precision, kind)
                ]
                if points:
                    axis.loglog(
                        *points[0],
                        marker,
                        ms=9,
                        mec=colour,
                        mfc=face,
                        mew=1.6,
                        ls="",
                        label=f"{tracer}, {precision}{'' if kind == 'forward' else ', with gradient'}",
                    )
    axis.set(xlabel="million ray-surfaces per second", ylabel="largest position error, mm")
    axis.grid(alpha=0.3)
    axis.legend(fontsize=7, frameon=False, bbox_to_anchor=(1.01, 1), loc="upper left")
    run.figure(figure, "speed_error", "Further right is faster, further down is truer.")


def reference(origin, direction, most=256):
    """Image points [min(N, most), 2] of rays through the published double Gauss, with 30 digits: the
    quadratic of each sphere solved in the centre's frame."""
    mpmath.mp.dps = 30
    surfaces = lens.load("double-gauss").surfaces
    found = []
    for start, along in zip(origin[:most].tolist(), direction[:most].tolist(), strict=True):
        p = mpmath.matrix(start)
        d = mpmath.matrix(along)
        before = mpmath.mpf(1)
        d = d / mpmath.norm(d)
        for s in surfaces:
            after = mpmath.mpf(s.medium.index_d if s.medium else 1)
            if math.isinf(s.radius_mm):
                p = p - d * (p[2] / d[2])
                normal = mpmath.matrix([0, 0, 1])
            else:
                radius = mpmath.mpf(1) / mpmath.mpf(s.curvature_per_mm)
                away = p - mpmath.matrix([0, 0, radius])
                b = _dot(away, d)
                c = _dot(away, away) - radius**2
                p = p + d * (-b - mpmath.sign(radius) * mpmath.sqrt(b * b - c))
                normal = (mpmath.matrix([0, 0, radius]) - p) / radius
            ratio = before / after
            cosine = _dot(d, normal)
            d = ratio * d + (mpmath.sqrt(1 - ratio**2 * (1 - cosine**2)) - ratio * cosine) * normal
            p = p - mpmath.matrix([0, 0, s.thickness_mm])
            before = after
        p = p - d * (p[2] / d[2])
        found.append([float(p[0]), float(p[1])])
    return np.array(found)


def _dot(a, b):
    return sum(x * y for x, y in zip(a, b, strict=True))


LONGER = (1, 2, 4, 8)  # times the surfaces of a double Gauss
COLD = tuple((kind, count) for kind in compiling.KINDS for count in compiling.SURFACES)
KINDS = ("forward", "forward_backward")
ROUNDS = 8


def growth_in_rays(counts, seed, progress):
    """Least seconds of a call per kind and number of rays."""
    geo = lens.load("double-gauss", torch.float32).freeze("conic", "asphere", "index_offset")
    return {
        kind: least(
            [tracing_work(geo, kind, *rays_for(n, seed)) for n in counts],
            [max(2, min(20, 1_000_000 // n)) for n in counts],
            progress,
        )
        for kind in KINDS
    }


def growth_in_surfaces(seed, progress):
    """Numbers of weak surfaces, and least seconds of a call with 300 000 rays per kind."""
    glass = lens.Glass.from_indices(1.5, 1.5, 1.5)
    numbers = [2 * ((SURFACES * times + 1) // 2) for times in LONGER]

    def stack(n):
        return [
            lens.Surface(900.0 if i % 2 else -900.0, 1.0, None if i % 2 else glass, 80.0) for i in range(n)
        ]

    lenses = [
        lens.GeoLens(stack(n), 10.0, torch.float32).freeze("conic", "asphere", "index_offset")
        for n in numbers
    ]
    return numbers, {
        kind: least(
            [tracing_work(geo, kind, *rays_for(300_000, seed)) for geo in lenses], [4] * len(lenses), progress
        )
        for kind in KINDS
    }


def rays_for(count, seed):
    return map(torch.as_tensor, make_rays(count, "float32", seed))


def least(works, repeats, progress):
    """Least wall seconds of each function over rounds in turns: what else runs on the machine only ever adds,
    and seldom to every round."""
    found = [math.inf] * len(works)
    for _ in range(ROUNDS):
        for i, (work, count) in enumerate(zip(works, repeats, strict=True)):
            found[i] = min(found[i], *measure(work, count, warm=1).wall_s)
    for _ in works:
        progress.advance()
    return found


def show_growth(run, counts, growth, longer):
    """Time against rays and surfaces, with the straight line a + b N fitted to the relative errors."""
    figure, axes = plt.subplots(1, 2, figsize=(9, 3.4), layout="constrained")
    rows = []
    for kind, colour in (("forward", "#1b6ca8"), ("forward_backward", "#c0392b")):
        for axis, label, x, y in (
            (axes[0], "rays", counts, growth[kind]),
            (axes[1], "surfaces", longer[0], longer[1][kind]),
        ):
            fixed, each, worst = line(x, y)
            run.record(
                **{
                    f"{kind}_fixed_s_over_{label}": fixed,
                    f"{kind}_ns_per_{label}": each * 1e9,
                    f"{kind}_worst_departure_from_line_over_{label}": worst,
                }
            )
            rows.append(
                (kind.replace("_", " + "), label, x[0], x[-1], fixed * 1e3, each * 1e9, worst, ASKED_LINEAR)
            )
            axis.loglog(x, y, "o", color=colour, label=kind.replace("_", " + "))
            axis.loglog(x, [fixed + each * v for v in x], "-", lw=1, color=colour)
            axis.set(xlabel=label, ylabel="seconds")
    axes[0].legend(frameon=False)
    run.section(
        "Growth",
        "Ours, float32: least time of repeats, since what else runs on the machine only adds. Lines: a "
        "fixed cost of the call and a cost per ray or surface.",
    )
    run.table(
        "Straight lines",
        ("work", "over", "from", "to", "fixed ms", "ns each", "largest relative departure", "allowed"),
        rows,
    )
    run.figure(
        figure,
        "growth",
        "Time against the number of rays (11 surfaces) and of surfaces (300 000 rays). Lines: fixed cost "
        "plus cost per item.",
    )


def line(x, y):
    """Fit y = a + b x with equal relative weights; returns a, b and the largest relative departure."""
    x = np.array(x, dtype=float)
    y = np.array(y)
    a, b = np.linalg.lstsq(np.stack([1 / y, x / y], 1), np.ones_like(y), rcond=None)[0]
    return float(a), float(b), float(np.abs((a + b * x) / y - 1).max())


def show_memory(run, memory):
    """Peak memory of a gradient, whole and as a sum over chunks."""
    rows = [
        (way, count, memory[way, count]["peak_bytes"] / 1e6, memory[way, count]["peak_bytes"] / count)
        for way, count in memory
    ]
    run.record(**{f"peak_mb_{way.replace('-', '_')}_{count}_rays": mb for way, count, mb, _ in rows})
    run.section(
        "Memory",
        "Peak above the rays themselves, forward and backward in float32. A whole trace keeps its outputs "
        "and their gradients; a sum over chunks keeps one chunk.",
    )
    run.table("Memory of a gradient", ("way", "rays", "MB", "bytes per ray"), rows)


if __name__ == "__main__":
    sys.exit(main(study, Config))
