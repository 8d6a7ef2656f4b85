"""The part of lens_bench about analysis functions and a design step: ratios of the peer's time to ours."""

import importlib.util
import json
import statistics
import subprocess
import sys

from codesign.errors import DomainError

ASKED_ANALYSIS = 5.0
BACKENDS = ("torch", "numpy")


def time_analyses(rounds, progress):
    """{backend of the peer: {work: seconds and figures}}; empty where the peer is not installed."""
    found = {}
    for backend in BACKENDS if importlib.util.find_spec("optiland") else ():
        command = [sys.executable, "-m", "studies.lens_bench.analyses", backend, str(rounds)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            last = (done.stderr.strip().splitlines() or [""])[-1][:200]
            raise DomainError(
                f"the analyses against optiland ({backend}) ended with code {done.returncode}: {last}"
            )
        found[backend] = json.loads(done.stdout.splitlines()[-1])
        progress.advance()
    return found


def show_analyses(run, found):
    """Table, card and metrics of the ratios of median processor times; wall times beside them."""
    if not found:
        return
    rows = []
    least = {}
    for backend, works in found.items():
        for name, times in works.items():
            ours, peer = (statistics.median(times[f"{side}_cpu_s"]) for side in ("ours", "peer"))
            wall = statistics.median(times["peer_wall_s"]) / statistics.median(times["ours_wall_s"])
            label = name.replace("_", " ")
            rows.append((label, backend, 1e3 * ours, 1e3 * peer, peer / ours, wall, ASKED_ANALYSIS))
            least[name] = min(least.get(name, peer / ours), peer / ours)
            run.record(
                **{
                    f"analysis_speed_ratio_{name}_{backend}": peer / ours,
                    f"analysis_wall_ratio_{name}_{backend}": wall,
                    f"analysis_ours_{name}_{backend}_ms": 1e3 * ours,
                }
            )
    run.record(
        **{f"analysis_speed_ratio_{name}": ratio for name, ratio in least.items()},
        analysis_speed_ratio_least=min(least.values()),
    )
    slowest = min(least, key=lambda name: least[name])
    run.card(
        "Analysis, design step",
        f"{least[slowest]:.1f} x",
        f"the speed of optiland at least ({slowest.replace('_', ' ')}), against the faster of its backends; asked: "
        f"{ASKED_ANALYSIS:g}",
    )
    run.section(
        "Analysis functions and a design step",
        "Double Gauss, float64, in turns in one process with one thread each. Spots and fans: three fields and three "
        "wavelengths, 800 rays and 2 x 65 rays each; wavefront of 64 cells, point spread of 128 cells padded to 512, MTF "
        "of three fields with 256 frequencies, distortion and field curvature at 128 fields; a design step is the merit "
        "of three fields with 800 rays each and its gradient to all curvatures and distances. Medians of processor "
        "time, which what else runs on the machine disturbs less than wall time.",
    )
    run.table(
        "Against optiland",
        ("work", "backend of optiland", "ours ms", "optiland ms", "ratio", "ratio of wall times", "asked"),
        rows,
    )
