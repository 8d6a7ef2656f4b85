"""Speed of what the project lives by, in two commands.

    make bench-check                  times over those of plain torch work in the same run, against docs/bench.json
    make bench-check ARGS=--write     measures anew and writes docs/bench.json and docs/speed.md
    make cuda-check                   on a GPU: its tests, the same work there, training in bfloat16, two GPUs;
                                      writes docs/speed_cuda.md; without one it says what is missing
    make cuda-check ARGS="--device cpu --quick"    the same path on the processor: does the command work?

Work and yardstick take turns, and a ratio is of the least times of both, which what else the machine
does hardly meets; what is slower than committed is measured once more. A yardstick is the least kernel of
the same compiler that does this kind of work, or a convolution: beside a copy, ratios are those of the
machine's memory.
"""

import argparse
import json
import statistics
import subprocess
import sys
from collections.abc import Callable, Collection
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

import drjit  # noqa: E402
import torch  # noqa: E402
from torch.utils.flop_counter import FlopCounterMode  # noqa: E402

from codesign import doctor, events, flow, lens, mount, render  # noqa: E402
from codesign.backend import arrays  # noqa: E402
from codesign.errors import CodesignError, DomainError  # noqa: E402
from codesign.events.kernels import Lanes  # noqa: E402
from codesign.system import Batch, System  # noqa: E402
from codesign.train.batches import to_device  # noqa: E402
from codesign.train.learner import Learner  # noqa: E402
from codesign.types import EventVolume, FlowField, FlowWindows  # noqa: E402
from scenes import textures, trajectories, worlds  # noqa: E402
from studies.frame import machine  # noqa: E402
from studies.frame.bench import measure  # noqa: E402

KEPT = ROOT / "docs" / "bench.json"
LIMITS = ROOT / "docs" / "speed.md"
TABLE = "<!--limits-->"  # before and after it
PAGE = ROOT / "docs" / "speed_cuda.md"
WORSE = 1.2  # of the committed ratio fails
TESTS = (
    "tests/test_devices.py",
    "tests/events/test_layers.py",
    "tests/flow/test_lk_kernels.py",
    "tests/studies/test_on_a_device.py",
)
MOVED, SUMS = 2**29, 9 * 32 * 32 * 256**2  # bytes of the copy, multiply-adds of the convolution
SURFACES = 11  # of the double Gauss
EVENT = 13  # bytes: 2 + 2 of the place, 1 of the polarity, 8 of the time
STEP = "robot step, 12 drives"


@dataclass(frozen=True)
class Work:
    """call: one go. amount: how much of ``unit`` it does, in millions. beside: its yardstick.
    moved: bytes a unit that have to pass through memory: what comes in once, what goes out once.
    bare: units of the yardstick that a unit does at least; 0 where nobody counted.
    least: what is asked of an H100-class GPU, millions of the unit a second."""

    call: Callable[[], Any]
    amount: float
    unit: str
    beside: str = "rows"
    moved: float = 0
    bare: float = 0
    least: float | None = None


def slopes(function: Callable[[], torch.Tensor], *leaves: torch.Tensor) -> Callable[[], Any]:
    """A pass with gradients to the leaves, of ones that are there: a loss would be timed along."""
    ones = torch.ones_like(function())
    return lambda: torch.autograd.grad(function(), leaves, ones, allow_unused=True)


def yardsticks(device: torch.device) -> dict[str, tuple[Callable[[], Any], float]]:
    """Plain work, and how many units it does: "copy", 256 MiB into memory that is there, bytes read
    and written; "convolution", multiply-adds; "surfaces", the operations of a sphere met and
    refracted at, one after the other; "rows", a loop over time that reads a number of every pixel
    and writes two."""
    memory = torch.ones(MOVED // 8, device=device)
    there = torch.zeros_like(memory)  # new pages from the system cost now this, now that
    image = torch.ones(1, 32, 256, 256, device=device)
    taps = torch.ones(32, 32, 3, 3, device=device)
    arr = arrays(device.type, torch.float32)
    ray = drjit.linspace(arr.Float, 1, 2, 2**20)
    one = drjit.opaque(arr.Float, 1)
    frames = torch.rand(100, 260, 346, device=device)
    lanes = Lanes(frames, frames[0].numel())
    numbers, target = lanes.load(frames), lanes.fresh(2 * len(frames))

    def surfaces():
        value = ray
        for _ in range(SURFACES):
            for _ in range(45):
                value = drjit.fma(value, one, one)
            value = drjit.sqrt(one / (one / (one / drjit.sqrt(value))))
        drjit.eval(value)
        drjit.sync_thread()

    def rows():
        def step(index, total):
            value = lanes.at(numbers, index)
            lanes.put(target, value, 2 * index)
            lanes.put(target, total, 2 * index + 1)
            return (total + value,)

        drjit.eval(lanes.loop(lanes.opaque(0), lanes.opaque(len(frames)), step, lanes.lane * one))
        drjit.eval(target)
        drjit.sync_thread()

    return {
        "copy": (lambda: there.copy_(memory), MOVED),
        "convolution": (lambda: torch.conv2d(image, taps, padding=1), SUMS),
        "surfaces": (surfaces, SURFACES * 2**20),
        "rows": (rows, frames.numel()),
    }


def works(device: torch.device, small: bool) -> dict[str, Work]:
    """What is timed, by name."""
    share = 16 if small else 1
    return {**_of_lens(device, share), **_of_events(device, small), **_of_flow(device, small)}


def _of_lens(device, share):
    count = 2**20 // share
    geo = lens.load("double-gauss", torch.float32).to(device)
    curves = geo.curvature_per_mm
    at = torch.rand(count, 2, device=device) - 0.5
    origin = torch.cat([10 * at, torch.full_like(at[:, :1], -20.0)], 1)
    ahead = torch.cat([0.1 * at.flip(1), torch.ones_like(at[:, :1])], 1)
    ahead = ahead / ahead.norm(dim=1, keepdim=True)

    def trace():
        return geo.trace(origin, ahead).position_mm

    @torch.no_grad()
    def forward():
        return trace()

    rays = SURFACES * count / 1e6
    # six numbers in and three out over all surfaces
    each = {
        "amount": rays,
        "unit": "ray-surfaces",
        "beside": "surfaces",
        "moved": 36 / SURFACES,
    }
    return {
        "tracing": Work(forward, **each, bare=1, least=20_000),
        "tracing with gradient": Work(slopes(trace, curves), **each, bare=3),
    }


def _of_events(device, small):
    height, width, count = (65, 87, 20) if small else (260, 346, 100)
    x = torch.linspace(0, 40, width, device=device)
    y = torch.linspace(0, 30, height, device=device)[:, None]
    t_s = torch.arange(count, dtype=torch.float64) * 1e-3

    def shown(speed):
        t = torch.arange(count, device=device)[:, None, None] * speed
        return 120 + 80 * torch.sin(x + t) * torch.cos(y + 0.5 * t)

    calm, busy = (shown(speed) for speed in (0.02, 0.2))  # 0.02 and 0.2 events a pixel and frame
    pixels = {"amount": calm.numel() / 1e6, "unit": "pixels"}

    def hard(frames):
        return lambda: events.simulate(frames, t_s, events.SensorModel())

    def layer(name, frames=calm):
        made = events.layer(name, events.SensorModel(0.2, 0.2)).to(device)
        leaf = frames.clone().requires_grad_()
        # frames in twice; counts out; what they are worth in; slopes out
        return Work(slopes(lambda: made(leaf, t_s), leaf), **pixels, moved=28, bare=2)

    drive = torch.rand(40 if small else 200, 2, 128, 128, device=device).requires_grad_()
    spikes = slopes(lambda: events.srm(drive, theta=1.0, tau_r=3.0)[0], drive)
    return {
        "hard events": Work(hard(calm), **pixels, moved=4, bare=1, least=5000),
        "hard events, busy": Work(hard(busy), **pixels, moved=4 + 0.2 * EVENT, bare=1),
        "memory layer with gradient": layer("memory"),
        "memory layer with gradient, busy": layer("memory", busy),
        "sigmoid with gradient": layer("sigmoid"),
        # drives in twice, spikes and potentials out, what spikes are worth in, slopes out
        "spikes (SRM) with gradient": Work(spikes, drive.numel() / 1e6, "neuron steps", moved=24),
    }


def _of_flow(device, small):
    side = 64 if small else 256
    volume = _volume(1, side, device)
    counts = volume.counts.clone().requires_grad_()
    learnt = flow.load("refiner").to(device).eval()
    pixels = {"amount": side**2 / 1e6, "unit": "pixels", "beside": "convolution", "moved": 72}

    def estimated(estimate):
        return lambda: estimate(replace(volume, counts=counts)).flow_px

    def forward(estimate):
        @torch.no_grad()
        def call():
            return estimate(volume).flow_px

        return call

    with FlopCounterMode(display=False) as counted, torch.no_grad():
        learnt(volume)
    sums = counted.get_total_flops() / 2 / side**2
    step = _robot_step(device, 2 if small else 12)
    return {
        "closed form": Work(forward(flow.estimate_lk), **pixels),
        "closed form with gradient": Work(slopes(estimated(flow.estimate_lk), counts), **pixels),
        "refiner": Work(forward(learnt), **pixels, bare=sums),
        STEP: Work(step, 1e-6, "steps", "convolution", least=1e-4),
    }


def _volume(batch: int, side: int, device: torch.device) -> EventVolume:
    """8 bins of counts that drift by a pixel from bin to bin."""
    generator = torch.Generator().manual_seed(0)
    still = torch.poisson(torch.rand(batch, 2, side, side, generator=generator), generator)
    counts = torch.stack([still.roll(k, -1) for k in range(8)], 2).to(device)
    t_s = torch.linspace(0, 0.02, 9, dtype=torch.float64)
    empty = events.from_counts(torch.zeros(8, 2, 1, 1), t_s, 8)
    return replace(to_device(empty, device), counts=counts)


def _robot_step(device, drives):
    """Lens, mount and thresholds to the velocity of a body: nine windows of 32 x 32, eight rays a
    pixel, nine frames, forward and backward."""
    geo = lens.load("cooke-triplet", torch.float32).scaled(0.22).to(device)
    windows = tuple((64 * i, 64 * j) for i in range(3) for j in range(3))
    film = render.Film(160, 160, 32, 32, 0.02, windows)
    place = mount.Mount((0.0, 0.0, 0.4), (0.1, 0.1, 0.1), pitch_rad=0.9).to(device)
    system = System(
        camera=render.Camera(geo, 160, 160, 0.02, 8, film=film),
        mount=place,
        events=events.layer("memory", events.SensorModel(0.2, 0.2)).to(device),
        flow=flow.estimate_lk,
        estimate=mount.EgoVelocity(),
        scene=worlds.ground(textures.speckle(0, 512), 0.01, device=device.type),
        objectives={"speed": lambda estimate: estimate.velocity.square().sum()},
    )
    t_s = torch.linspace(0, 0.02, 9, dtype=torch.float64)
    start = torch.eye(4, dtype=torch.float64)
    paths = [trajectories.translation(start, (0.3 + 0.1 * k, 0, 0), t_s) for k in range(drives)]
    batch = Batch(torch.stack(paths).to(device), t_s)
    geo.requires_grad_()

    def step():
        system.zero_grad()
        system(batch).backward()

    return step


def seconds(call: Callable[[], Any], device: torch.device, repeats: int) -> tuple[float, ...]:
    """Of every go: by the clock on a GPU, which is waited for, of the processor elsewhere."""
    if device.type == "cpu":
        return measure(call, repeats, warm=0).cpu_s

    def waited():
        call()
        torch.cuda.synchronize()

    torch.cuda.synchronize()
    return measure(waited, repeats, warm=0).wall_s


def timed(
    device: torch.device, rounds: int, small: bool, only: Collection[str] = ()
) -> dict[str, dict[str, Any]]:
    """Of every work (``only``: of these) its median time, its ratio to its yardstick, and how the
    second go compares with the tenth."""
    beside = yardsticks(device)
    found = {}
    for name, work in works(device, small).items():
        if only and name not in only:
            continue
        yard, units = beside[work.beside]
        first = seconds(work.call, device, 10)
        own, other = [], []
        for _ in range(rounds):
            own += seconds(work.call, device, 1)
            other += seconds(yard, device, 1)
        time_s = statistics.median(own)
        found[name] = {
            "ms": 1e3 * time_s,
            "over_yardstick": min(own) / min(other),
            "yardstick": work.beside,
            "yardstick_ns": 1e9 * min(other) / units,
            "least_ns": 1e3 * min(own) / work.amount,
            "million_per_s": work.amount / time_s,
            "unit": work.unit,
            "second_over_tenth": first[1] / first[9],
            "asked_million_per_s": work.least,
            "moved_b": work.moved,
            "bare": work.bare,
        }
        print(f"{name}: {found[name]['ms']:.3g} ms", flush=True)
    return found


def is_worse(row: dict[str, Any], kept: dict[str, Any]) -> bool:
    """Whether a ratio is more than WORSE of the committed one."""
    alike = row["yardstick"] == kept["yardstick"]
    return alike and row["over_yardstick"] > WORSE * kept["over_yardstick"]


def worse(found: dict[str, dict[str, Any]], kept: dict[str, Any]) -> list[str]:
    """Sentences on ratios that are worse, and on work that is not there."""
    said = [f"{name}: no longer measured" for name in kept if name not in found]
    for name, row in found.items():
        if name not in kept or kept[name]["yardstick"] != row["yardstick"]:
            said.append(f"{name}: not in docs/bench.json; measure with --write")
        elif is_worse(row, kept[name]):
            said.append(
                f"{name}: {row['over_yardstick']:.3g} times its {row['yardstick']}, "
                f"{kept[name]['over_yardstick']:.3g} when committed"
            )
    return said


def bench_check(options: argparse.Namespace) -> int:
    if options.quick and options.write:
        raise DomainError("--quick measures small works; leave it out to --write.")
    torch.set_num_threads(1)
    drjit.set_thread_count(1)  # two spin while they wait for each other
    found = timed(torch.device("cpu"), options.rounds, options.quick)
    if options.quick:
        return 0  # nothing to compare with
    if options.write:
        result = {"machine": machine.hardware(), "works": found}
        KEPT.write_text(json.dumps(result, indent=1) + "\n")
        copy, units = yardsticks(torch.device("cpu"))["copy"]
        byte_ns = 1e9 * min(measure(copy, 11, warm=2).cpu_s) / units
        before, _, after = LIMITS.read_text().split(TABLE)
        LIMITS.write_text(f"{before}{TABLE}\n{limits(found, byte_ns)}\n{TABLE}{after}")
        return 0
    kept = json.loads(KEPT.read_text())["works"]
    if slow := [name for name in found.keys() & kept.keys() if is_worse(found[name], kept[name])]:
        for name, row in timed(torch.device("cpu"), options.rounds, options.quick, slow).items():
            found[name] = min(found[name], row, key=lambda each: each["over_yardstick"])
    said = worse(found, kept)
    print("\n".join(said) or f"{len(found)} works within {WORSE:g} times their committed ratios")
    return bool(said)


def limits(found: dict[str, dict[str, Any]], byte_ns: float) -> str:
    """Table of how near each work comes to what a copy and its yardstick of the same run allow.

    byte_ns: least time of the copy, a byte."""
    lines = [
        "| work | ns a unit | unit | a copy takes | the bare kernel takes | of the nearer limit |",
        "|---|---|---|---|---|---|",
    ]
    for name, row in found.items():
        if row["moved_b"]:
            by = [row["moved_b"] * byte_ns, row["bare"] * row["yardstick_ns"]]
            told = [f"{float(f'{each:.2g}'):g}" if each else "not counted" for each in by]
            least_ns = row["least_ns"]
            time = f"{float(f'{least_ns:.3g}'):g}"
            unit = row["unit"].removesuffix("s")
            share = f"{100 * max(by) / least_ns:.2g} %" if by[1] else "not told"
            lines.append(f"| {name} | {time} | {unit} | {told[0]} | {told[1]} | {share} |")
    return "\n".join(lines)


def training(device: torch.device, small: bool) -> dict[str, dict[str, Any]]:
    """A training step of the refiner, in float32 and, on a GPU, under bfloat16; and whether memory
    stays level over ten robot steps."""
    side, count = (32, 2) if small else (128, 8)
    flow_px = torch.ones(count, 2, side, side)
    truth = FlowField(flow_px, torch.ones(count, side, side, dtype=torch.bool), 0.02)
    windows = FlowWindows(_volume(count, side, device), to_device(truth, device), None)
    found = {}
    for name, mixed in (("float32", False), ("bfloat16", True)):
        if mixed and device.type == "cpu":
            continue
        network = flow.load("refiner").to(device)
        learner = Learner(
            network,
            lambda told, batch: flow.losses.laplace_loss(told, batch.truth),
            mixed_precision=mixed,
        )
        times = seconds(partial(learner.step, windows), device, 6)
        found[f"training step, {name}"] = {"ms": 1e3 * statistics.median(times[1:])}
    if device.type == "cuda":
        step = _robot_step(device, 2)
        free = [(step(), torch.cuda.mem_get_info()[0])[1] for _ in range(12)]  # of drjit and torch
        found["memory that ten robot steps keep"] = {"MB": (free[1] - free[-1]) / 1e6}
    return found


def commands(device: torch.device) -> dict[str, str]:
    """What the marked tests, and two processes of a training run, answer."""
    asked = {"tests": [sys.executable, "-m", "pytest", "-q", "-m", "cuda", *TESTS]}
    if torch.cuda.device_count() > 1:
        asked["two GPUs"] = [
            *(sys.executable, "-m", "torch.distributed.run", "--nproc-per-node", "2"),
            *("--no-python", "sh", "-c", 'CUDA_VISIBLE_DEVICES=$LOCAL_RANK exec "$@"', "sh"),
            *(sys.executable, "-m", "studies.train_flow", "--quick", "--device", device.type),
        ]
    found = {}
    for name, command in asked.items():
        done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
        last = (done.stdout.strip().splitlines() or done.stderr.strip().splitlines() or [""])[-1]
        found[name] = last if done.returncode == 0 else f"FAILED ({done.returncode}): {last}"
        print(f"{name}: {found[name]}", flush=True)
    if len(asked) == 1:
        found["two GPUs"] = f"not run: {torch.cuda.device_count()} here"
    return found


def page(result: dict[str, Any]) -> str:
    """docs/speed_cuda.md of the JSON."""
    rows = []
    for name, row in result["works"].items():
        asked = row.get("asked_million_per_s")
        rate = f"{row['million_per_s']:,.4g}" if row["unit"] != "steps" else ""
        wanted = f"{asked:,.4g}" if asked and row["unit"] != "steps" else ""
        if name == STEP:
            wanted = f"{1e-3 / asked:.3g} ms"
        rows.append(
            f"| {name} | {row['ms']:.3g} | {rate} {row['unit'] if rate else ''} | {wanted} |"
        )
    more = [
        f"| {name} | {' '.join(f'{value:.3g} {unit}' for unit, value in row.items())} |"
        for name, row in result["training"].items()
    ]
    said = [f"- {name}: {text}" for name, text in result["commands"].items()]
    head = (
        f"# Speed on {result['device']}\n\nWritten by `make cuda-check`; torch {torch.__version__}, commit "
        f"{result['commit']}. Medians by the clock, the device waited for; float32.\n\n"
    )
    table = "| work | ms | millions a second | asked |\n|---|---|---|---|\n"
    return (
        head
        + table
        + "\n".join(rows)
        + "\n\n| | |\n|---|---|\n"
        + "\n".join(more)
        + "\n\n"
        + "\n".join(said)
        + "\n"
    )


def cuda_check(options: argparse.Namespace) -> int:
    device = torch.device(options.device)
    if doctor.main(device.type):
        return 2
    result = {
        "device": torch.cuda.get_device_name(0) if device.type == "cuda" else "the processor",
        "commit": machine.versions()["commit"],
        "commands": commands(device) if device.type == "cuda" else {},
        "works": timed(device, options.rounds, options.quick),
        "training": training(device, options.quick),
    }
    out = options.out or ROOT / "runs" / "cuda_check"
    out.mkdir(parents=True, exist_ok=True)
    (out / "speed.json").write_text(json.dumps(result, indent=1) + "\n")
    target = PAGE if device.type == "cuda" and not options.out else out / PAGE.name
    target.write_text(page(result))
    print(f"{out / 'speed.json'}\n{target}")
    return any(text.startswith("FAILED") for text in result["commands"].values())


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    kinds = parser.add_subparsers(required=True)
    for name, function in (("check", bench_check), ("cuda", cuda_check)):
        kind = kinds.add_parser(name)
        kind.set_defaults(function=function)
        kind.add_argument("--rounds", type=int, default=11, help="turns of each work")
        kind.add_argument("--quick", action="store_true", help="small work: does the command work?")
        if function is bench_check:
            kind.add_argument("--write", action="store_true", help="commit these ratios")
        else:
            kind.add_argument("--device", choices=("cuda", "cpu"), default="cuda")
            kind.add_argument("--out", type=Path, help="folder instead of runs/cuda_check and docs")
    options = parser.parse_args(arguments)
    try:
        return int(options.function(options))
    except CodesignError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2


if __name__ == "__main__":
    sys.exit(main())
