"""``python -m tests.hostile fuzz`` reads mutants of every format."""

import argparse
import json
import sys
from pathlib import Path

from codesign.atomic import write_atomic
from tests.hostile import fuzz


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.hostile", description=__doc__)
    commands = parser.add_subparsers(dest="command", required=True)
    mutants = commands.add_parser("fuzz", help="mutants of every format")
    mutants.add_argument("--minutes", type=float, default=10.0)
    mutants.add_argument("--mutants", type=int, default=10**9, help="of every seed, at most")
    mutants.add_argument("--format", default="", help="end of the names of seeds, such as .npz")
    mutants.add_argument("--seed", type=int, default=0)
    mutants.add_argument("--processes", type=int, default=2)
    mutants.add_argument("--metrics", type=Path, help="file for the figures, flat name -> number")
    chosen = parser.parse_args()
    found = fuzz.fuzz(chosen.minutes, chosen.format, chosen.seed, chosen.processes, chosen.mutants)
    figures = {f"mutants_{name}": read for name, (read, _) in found.items()}
    figures |= {"mutants": sum(figures.values()), "findings": sum(len(each) for _, each in found.values())}
    print(json.dumps(figures, indent=1))
    if chosen.metrics:
        write_atomic(chosen.metrics, json.dumps(figures, indent=1).encode())
    return int(figures["findings"] > 0)


if __name__ == "__main__":
    sys.exit(main())
