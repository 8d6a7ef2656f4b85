"""Attacks from outside, and the figures of docs/safety.md.

``python -m tests.hostile PART`` attacks one part and writes what was found into
``runs/hostile/metrics.json``, beside the figures of the other parts; exit code 1 where something
was found.
"""

import argparse
import importlib
import json
import sys
from pathlib import Path

from codesign.atomic import write_atomic

# part: (what it does, how many it makes where --count is left out)
PARTS = {
    "fuzz": ("mutants of every file format", 10**9),
    "calls": ("wrong calls into every public function, through the tests' own right ones", 20),
    "kills": ("long studies killed at random, resumed and compared", 50),
    "threads": ("rounds of thirty threads with gradients, beside serial work", 20),
    "worlds": ("random worlds, three lenses each, gradients beside differences", 300),
    "listed": ("worlds whose gradients at silhouettes once were wrong, beside differences", 100),
    "stages": ("stages of a System that are cut, wrapped or misshapen", 300),
}


def main() -> int:
    form = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(
        prog="python -m tests.hostile", description=__doc__, formatter_class=form
    )
    parts = parser.add_subparsers(dest="part", required=True)
    for name, (words, count) in PARTS.items():
        part = parts.add_parser(name, help=words)
        part.add_argument("--count", type=int, default=count, help=f"how many (default {count})")
        part.add_argument("--seed", type=int, default=0)
        part.add_argument("--out", type=Path, default="runs/hostile", help="of metrics.json")
        if name == "fuzz":
            ends = "end of the names of seeds, such as .npz"
            part.add_argument("--minutes", type=float, default=10.0)
            part.add_argument("--format", default="", help=ends)
            part.add_argument("--processes", type=int, default=2)
        if name == "calls":
            asked = "tests whose calls are exchanged"
            part.add_argument("paths", nargs="*", default=["tests"], help=asked)
    chosen = vars(parser.parse_args())
    part, out = chosen.pop("part"), chosen.pop("out")
    figures, findings = importlib.import_module(f"tests.hostile.{part}").measure(**chosen)
    metrics = out / "metrics.json"
    known = json.loads(metrics.read_text()) if metrics.exists() else {}
    figures = {f"{part}_{name.removeprefix(part + '_')}": value for name, value in figures.items()}
    figures[f"{part}_findings"] = len(findings)
    out.mkdir(parents=True, exist_ok=True)
    write_atomic(metrics, json.dumps(dict(sorted({**known, **figures}.items())), indent=1).encode())
    print(*findings, json.dumps(figures, indent=1), f"written to {metrics}", sep="\n")
    return int(bool(findings))


if __name__ == "__main__":
    sys.exit(main())
