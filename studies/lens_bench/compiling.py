"""Seconds until the first gradient of a lens is there, in a process and a kernel cache of its own.

    python -m studies.lens_bench.compiling 80 alike

prints processor and wall seconds of the first trace and its backward pass, as JSON. "alike": a stack of spheres, as
lenses are when all their numbers ask for a gradient. "unlike": every eighth of the surfaces has asphere terms of its
own number, with shapes held, so that no two parts share a kernel.
"""

import json
import math
import os
import subprocess
import sys
import tempfile
import time

import torch

from codesign import lens
from codesign.errors import DomainError

SURFACES = (10, 20, 40, 80)
KINDS = ("alike", "unlike")


def stack(count: int, kind: str) -> lens.GeoLens:
    """A lens of weak surfaces, glass and air in turns."""
    glass = lens.Glass.from_indices(1.5, 1.5, 1.5)

    def terms(i):
        return () if kind == "alike" or i % 8 else (1e-9,) * (1 + i // 8)

    surfaces = [
        lens.Surface(
            900.0 if i % 2 else -900.0, 1.0, None if i % 2 else glass, 80.0, asphere=terms(i), conic=0.0
        )
        for i in range(count)
    ]
    geo = lens.GeoLens(surfaces, 10.0)
    return geo if kind == "alike" else geo.freeze("conic", "asphere")


def first_gradient(count: int, kind: str) -> dict[str, float]:
    """Processor and wall seconds of this process for its first trace and gradient, after a lens of two surfaces has
    started the compiler."""
    origin = torch.tensor([[1.0, 2.0, -5.0]] * 16, dtype=torch.float64)
    direction = torch.tensor([[0.0, 0.0, 1.0]] * 16, dtype=torch.float64)

    def step(geo):
        geo.trace(origin, direction).position_mm.square().sum().backward()

    step(stack(2, "alike"))
    geo = stack(count, kind)
    wall, cpu = time.perf_counter(), time.process_time()
    step(geo)
    return {"cpu_s": time.process_time() - cpu, "wall_s": time.perf_counter() - wall}


def measure(count: int, kind: str) -> dict[str, float]:
    """``first_gradient`` in a fresh process with an empty kernel cache."""
    with tempfile.TemporaryDirectory() as home:
        command = [sys.executable, "-m", "studies.lens_bench.compiling", str(count), kind]
        done = subprocess.run(
            command, capture_output=True, text=True, check=False, env={**os.environ, "HOME": home}
        )
    if done.returncode:
        raise DomainError(
            f"the first gradient of {count} surfaces ended with code {done.returncode}: "
            f"{(done.stderr.strip().splitlines() or [''])[-1][:200]}"
        )
    return json.loads(done.stdout.splitlines()[-1])


def show(run, found):
    """Metrics and table. found: {(kind, surfaces): seconds}."""
    run.record(
        **{
            f"compile_first_gradient_{clock}_at_{count}_surfaces{'' if kind == 'alike' else '_unlike'}": seconds[
                clock
            ]
            for (kind, count), seconds in found.items()
            for clock in ("cpu_s", "wall_s")
        },
        # 1: time grows in proportion to the surfaces
        compile_first_gradient_exponent=math.log2(found["alike", 80]["cpu_s"] / found["alike", 20]["cpu_s"])
        / 2,
        compile_first_gradient_exponent_unlike=math.log2(
            found["unlike", 80]["cpu_s"] / found["unlike", 20]["cpu_s"]
        )
        / 2,
    )
    run.table(
        "First gradient of a long lens, kernels compiled from nothing: seconds",
        ("surfaces", "parts", "processor", "wall"),
        [
            (count, kind, f"{seconds['cpu_s']:.2f}", f"{seconds['wall_s']:.2f}")
            for (kind, count), seconds in found.items()
        ],
        "Alike: all numbers ask for a gradient, so every part of eight surfaces shares a kernel. Unlike: no two parts do.",
    )


if __name__ == "__main__":
    print(json.dumps(first_gradient(int(sys.argv[1]), sys.argv[2])))
