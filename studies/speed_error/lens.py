"""Stage "lens": speed, memory and error of ray tracing beside optiland's, analysis functions, growth with
rays and surfaces, and seconds until the first gradient."""

import math
import tempfile

import numpy as np

from codesign.lens import GeoLens
from studies.frame.bench import Timing, apart, installed, turns
from studies.frame.run import Run
from studies.frame.show import Asked, Panel, asked, panels, table
from studies.frame.sweep import column, metrics, select, sweep
from studies.speed_error import Config, lens_peers

PEERS = {"optiland-torch": "optiland", "optiland-numpy": "optiland"}
CASES = [
    (tracer, precision, kind)
    for precision in ("float32", "float64")
    for kind in ("forward", "forward_backward")
    for tracer in ("codesign", *PEERS)
    if tracer != "optiland-numpy" or (precision, kind) == ("float64", "forward")
]
ASKED_SPEED = {
    ("float32", "forward"): 15.0,
    ("float32", "forward_backward"): 10.0,
    ("float64", "forward"): 10.0,
    ("float64", "forward_backward"): 8.0,
}
ASKED_MEMORY = 0.2
ASKED_LINEAR = 0.15
ASKED_ANALYSIS = 5.0
SURFACES = 11  # of the double Gauss
LONGER = (12, 22, 44, 88)
COLD = (10, 20, 40, 80)


def stage(run: Run[Config]) -> str:
    """Ray tracers and analysis functions beside those that are installed."""
    count = 100_000 if run.config.quick else 1_000_000
    peers = installed(PEERS)
    figures = tracers(run, peers, count) + (analyses(run) if peers else [])
    figures += growth(run, 10 * count)
    chunks(run, 10 * count)
    compiling(run)
    lead = asked(run, figures)
    return lead if peers else f"{lead} Not installed, hence not compared: optiland."


def tracers(run: Run[Config], peers: list[str], count: int) -> list[Asked]:
    """Every tracer in processes of its own, in turns."""
    seed, repeats = run.config.seed, run.config.repeats
    cases = [case for case in CASES if case[0] == "codesign" or case[0] in peers]
    found = sweep(
        run,
        lens_peers.tracing,
        "tracers",
        processes=1,
        turn=range(run.config.rounds),
        case={" ".join(case): case for case in cases},
        count=[count],
        repeats=[repeats],
        seed=[seed],
    )
    rows = {}
    for case in cases:
        parts = select(found, case=" ".join(case))
        timing = sum((Timing(tuple(p["wall_s"]), tuple(p["cpu_s"])) for p in parts), Timing((), ()))
        rows[case] = {
            "case": " ".join(case),
            "wall_s": timing.wall,
            "cpu_s": timing.cpu,
            "million_ray_surfaces_per_s": SURFACES * count / timing.wall / 1e6,
            "million_ray_surfaces_per_cpu_s": SURFACES * count / timing.cpu / 1e6,
            "peak_mb": float(np.median([p["peak_mb"] for p in parts])),
            "max_error_mm": max(p["error_mm"] for p in parts),
        }
    run.record(**metrics(rows.values(), "case"))
    run.section(
        "Tracers",
        f"Double Gauss of eleven surfaces, d line, {count:,} rays. Going backward, ours reaches all "
        "curvatures and distances, the peer all radii and vertex positions. Memory: the peak above what "
        "was in use before. Error: largest, of 256 rays, against our trace in float64, which the tests "
        "hold to 3e-14 mm.",
    )
    run.table("Medians", *table(rows.values()))
    points = {
        row["case"]: ([row["million_ray_surfaces_per_s"]], [max(row["max_error_mm"], 1e-15)])
        for row in rows.values()
    }
    chart = Panel(points, "million ray-surfaces per second", "largest position error, mm", "xy")
    run.figure(panels(chart, width=8), "tracers", "Further right is faster, further down is truer.")
    judged = []
    for (precision, kind), least in ASKED_SPEED.items():
        if "optiland-torch" in peers:
            ours, peer = (rows[tracer, precision, kind] for tracer in ("codesign", "optiland-torch"))
            what = f"{kind} {precision}".replace("_", " + ")
            judged += [
                Asked(
                    f"speed over optiland with torch, {what}", peer["wall_s"] / ours["wall_s"], least=least
                ),
                Asked(
                    f"memory over optiland's, {what}", ours["peak_mb"] / peer["peak_mb"], most=ASKED_MEMORY
                ),
            ]
    return judged


def analyses(run: Run[Config]) -> list[Asked]:
    """Analysis functions and a design step against both of optiland's backends."""
    rounds = 3 if run.config.quick else 11
    rows = sweep(
        run, lens_peers.analyses, "analyses", processes=1, backend=("torch", "numpy"), rounds=[rounds]
    )
    run.record(**metrics(rows, "work", "backend", prefix="analysis"))
    run.section(
        "Analysis functions and a design step",
        "Double Gauss, float64, in turns in one process with one thread each. Spots and fans: three "
        "fields and three wavelengths, 800 rays and 2 x 65 rays each; wavefront of 64 cells, point spread"
        " of 128 cells padded to 512, MTF of three fields with 256 frequencies, distortion and field "
        "curvature at 128 fields; a design step is the merit of three fields with 800 rays each and its "
        "gradient to all curvatures and distances.",
    )
    titles = {
        "ours_ms": "ours, CPU-ms",
        "peer_ms": "optiland, CPU-ms",
        "ratio": "ratio",
        "wall_ratio": "by the clock",
    }
    run.table("Against optiland, medians", *table(rows, work="work", backend="backend", **titles))
    return [
        Asked("least speed of an analysis over optiland", min(column(rows, "ratio")), least=ASKED_ANALYSIS)
    ]


def growth(run: Run[Config], most: int) -> list[Asked]:
    """Time against rays and surfaces: least of many turns, since what else runs on the machine only adds,
    and a straight line a + b N fitted to the relative errors."""
    counts = [n for n in (10_000, 30_000, 100_000, 300_000, 1_000_000, 3_000_000, 10_000_000) if n <= most]
    charts = []
    rows = []
    for label, numbers in (("rays", counts), ("surfaces", LONGER)):
        series = {}
        for kind in ("forward", "forward_backward"):
            if label == "rays":
                geo = lens_peers.double_gauss("float32")
                works = {n: lens_peers.work_of_tracing(geo, kind, n, run.config.seed) for n in numbers}
            else:
                works = {
                    n: lens_peers.work_of_tracing(weak(n), kind, 300_000, run.config.seed) for n in numbers
                }
            with run.progress(8 * len(works), f"growth with {label}") as progress:
                found = turns(works, rounds=8, repeats=2, after_each=progress.advance)
            least = [min(timing.wall_s) for timing in found.values()]
            fixed, each, worst = line(numbers, least)
            name = kind.replace("_", " + ")
            series |= {
                name: (numbers, least),
                f"{name}, line": (numbers, [fixed + each * n for n in numbers]),
            }
            rows.append(
                {"work": name, "over": label, "fixed_ms": 1e3 * fixed, "ns_each": 1e9 * each, "worst": worst}
            )
        charts.append(Panel(series, label, "seconds", "xy"))
    run.record(**metrics(rows, "work", "over"))
    run.section("Growth", "Ours, float32. Lines: a fixed cost of the call and a cost per ray or surface.")
    run.table("Straight lines", *table(rows))
    run.figure(panels(*charts), "growth", "Time against rays (11 surfaces) and surfaces (300,000 rays).")
    return [Asked("departure from a line", max(column(rows, "worst")), most=ASKED_LINEAR)]


def weak(count: int) -> GeoLens:
    """A lens of so many weak surfaces, glass and air in turns, in float32."""
    return lens_peers.stack(count, alike=True).float().freeze("conic", "asphere", "index_offset")


def line(x, y) -> tuple[float, float, float]:
    """Fit y = a + b x with equal relative weights; returns a, b and the largest relative departure."""
    x = np.array(x, dtype=float)
    y = np.array(y)
    a, b = np.linalg.lstsq(np.stack([1 / y, x / y], 1), np.ones_like(y), rcond=None)[0]
    return float(a), float(b), float(np.abs((a + b * x) / y - 1).max())


def chunks(run: Run[Config], most: int) -> None:
    """Peak memory of a gradient, whole and as a sum over chunks."""
    rows = sweep(
        run,
        lens_peers.tracing,
        "memory",
        processes=1,
        case={way: (way, "float32", "forward_backward") for way in ("codesign", "codesign-chunks")},
        count=(most // 10, most),
        repeats=[1],
        seed=[run.config.seed],
    )
    run.record(**metrics(rows, "case", "count", prefix="memory"))
    run.table(
        "Peak memory of a gradient beside the rays, float32",
        *table(rows, case="way", count="rays", peak_mb="MB"),
    )


def compiling(run: Run[Config]) -> None:
    """Seconds until the first gradient of a lens is there, with an empty kernel cache."""
    rows = sweep(run, first_gradient, "compiling", parts={"alike": True, "unlike": False}, count=COLD)
    run.record(**metrics(rows, "parts", "count", prefix="compile_first_gradient"))
    for parts in ("alike", "unlike"):
        first, last = (column(rows, "cpu_s", parts=parts, count=n)[0] for n in (COLD[1], COLD[-1]))
        exponent = math.log(last / first) / math.log(COLD[-1] / COLD[1])
        run.record(**{f"compile_first_gradient_exponent_{parts}": exponent})
    run.table(
        "First gradient of a long lens, kernels compiled from nothing",
        *table(rows, count="surfaces", parts="parts", cpu_s="CPU-s", wall_s="wall s"),
        "Alike: all numbers ask for a gradient, so every part of eight surfaces shares a kernel.",
    )


def first_gradient(count: int, parts: bool) -> dict[str, float]:
    """``lens_peers.first_gradient`` in a fresh process with a kernel cache of its own."""
    with tempfile.TemporaryDirectory() as home:
        return apart(lens_peers.first_gradient, count, parts, environment={"HOME": home})
