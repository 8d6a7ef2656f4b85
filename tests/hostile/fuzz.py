"""Mutants of every seed, read in processes of their own that are started anew where they die or
hang."""

import importlib
import json
import queue
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from tests.hostile.reader import SECONDS, numbered, seed_of
from tests.processes import ROOT

HERE = Path(__file__).parent
CRASHES = HERE / "crashes"
MOST_KEPT = 20_000  # bytes of a crash that is kept
START_S = 120


def seeds(only: str = "") -> list[tuple[str, str]]:
    """(module, name) of every seed whose name ends in ``only``."""
    modules = [f"tests.hostile.{path.stem}" for path in sorted(HERE.glob("seeds_*.py"))]
    return [
        (module, name)
        for module in modules
        for name in importlib.import_module(module).SEEDS
        if name.endswith(only)
    ]


def read_mutants(module: str, name: str, seed: int, count: int, seconds: float = float("inf")):
    """(mutants read, findings [{"index", "kind", "found"}]) of one seed; the time counts from the
    first mutant on."""
    findings = []
    first, last, until = 1, 1 + count, float("inf")
    while first < last and time.monotonic() < until:
        words = ("-m", "tests.hostile.reader", module, name, *map(str, (seed, first, last - first)))
        pipe = subprocess.PIPE
        process = subprocess.Popen(
            [sys.executable, *words], cwd=ROOT, stdout=pipe, stderr=pipe, text=True
        )
        said: queue.Queue[str | None] = queue.Queue()
        threading.Thread(target=_passed_on, args=(process.stdout, said), daemon=True).start()
        current, wait_s = None, float(START_S)
        while True:
            try:
                line = said.get(timeout=wait_s)
            except queue.Empty:
                line = None
            told = json.loads(line) if line else None
            if told is None or "done" in told or time.monotonic() > until:
                break
            if "next" in told:
                until = min(until, time.monotonic() + seconds)
                current, wait_s = told["next"], 3.0 * SECONDS
            else:
                findings.append(told)
        ended = told is not None
        process.kill()
        complaint = process.stderr.read()[-2000:] if process.stderr else ""
        code = process.wait()
        if not ended:
            if current is None:
                raise RuntimeError(f"{module} {name}: the file itself cannot be read: {complaint}")
            what = f"exit code {code}: {complaint[-300:]}"
            kind = "hang" if code == -9 else "died"
            findings.append({"index": current, "kind": kind, "found": what})
            first = current + 1
        else:
            first = last if "done" in told else current or first
    return first - 1, findings


def _passed_on(pipe, said):
    for line in pipe:
        if line.startswith("{"):
            said.put(line)
    said.put(None)


def measure(
    count: int,
    seed: int,
    say: Callable[[str], Any] = print,
    *,
    minutes: float = 10.0,
    format: str = "",
    processes: int = 2,
) -> tuple[dict[str, float], list[str]]:
    """Read ``count`` mutants of every seed whose name ends in ``format``, or as many as the time
    allows.

    Returns: {name of the seed: mutants read} with their sum, and a sentence for each finding, whose
      file is kept.
    """
    chosen = seeds(format)
    share_s = minutes * 60 * processes / max(len(chosen), 1)

    def one(place):
        module, name = place
        read, found = read_mutants(module, name, seed, count, share_s)
        say(f"{name:28} {read:9d} mutants, {len(found)} findings")
        for finding in found:
            kept(module, name, seed, finding)
        told = [f"{name} {each['index']}: {each['kind']}: {each['found']}" for each in found]
        return name, read, told

    with ThreadPoolExecutor(processes) as pool:
        rows = list(pool.map(one, chosen))
    figures = {name: read for name, read, _ in rows}
    findings = [each for _, _, found in rows for each in found]
    return {**figures, "all": sum(figures.values())}, findings


def kept(module, name, seed, finding):
    """Keep a small crash with its reason, one of a kind and place."""
    reasons = CRASHES / "reasons.json"
    known = json.loads(reasons.read_text()) if reasons.exists() else {}
    reason = f"{finding['kind']}: {finding['found']}"
    print(f"  {name} {finding['index']}: {reason}", flush=True)
    content = numbered(seed_of(module, name)[0], name, seed, finding["index"])
    if len(content) > MOST_KEPT or any(
        key.startswith(f"{Path(name).stem}-") and old.split("(")[-1] == reason.split("(")[-1]
        for key, old in known.items()
    ):
        return
    file = f"{Path(name).stem}-{finding['index']}{Path(name).suffix}"
    (CRASHES / file).write_bytes(content)
    reasons.write_text(json.dumps({**known, file: reason}, indent=1, sort_keys=True) + "\n")
