"""Long studies killed at random moments, resumed, and compared with the run that nobody killed.

A full disk is RLIMIT_FSIZE set on the running process, as root or not: from then on every write
beyond it fails.
"""

import contextlib
import itertools
import json
import os
import random
import re
import resource
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

from codesign.atomic import UNFINISHED
from tests.processes import ROOT

# whose state is kept between steps, in small sizes; without those that begin with a recording
STUDIES = {
    "lens_tolerance": "--lens la1509 --half-field-deg 3 --trials 120",
    "make_dataset": "--trajectories 2 --frames 14 --size 24 --samples 2 --chunk 4 --rate-hz 90",
    "train_flow": "--steps 8 --save-every 1 --validate-every 4 --batch 2 --height-px 32 --width-px 32 "
    "--reuse 2 --validation-windows 2 --final-windows 2",
    "gradient_flow": "--quick --cases chain joint",
    "spike_esim": "--quick",
    "placement": "--seeds 1 --steps 2 --worlds 1 --per-world 1 --judged-worlds 1 --judged-drives 2 --searches random",
    "lens_opt": "--quick --after-steps 1 --cases 1 --scored 1 --spot-steps 1 --steps 2 --judged 2 --samples 4",
}
KINDS = {
    "SIGKILL": signal.SIGKILL,
    "SIGTERM": signal.SIGTERM,
    "SIGINT": signal.SIGINT,
    "full_disk": 0,
}
# Python itself ends by SIGINT, after our sentence, where KeyboardInterrupt came from within exec of
# a text, as dataclasses use
ENDS = {"SIGKILL": {-9}, "SIGTERM": {143, -2}, "SIGINT": {130, -2}, "full_disk": {2}}
KILLS = 3  # of one run, at most
LONGEST_S = 400.0
IGNORED = re.compile(
    r"(^|_)(seconds|minutes|hours|s|ms|mib|gib|mb|date)(_|$)|per_second|versions|hardware"
)


def _started(arguments):
    """On one core, so that drjit and torch have one thread each and sums one order."""
    core = min(os.sched_getaffinity(0)) if os.getpid() % 2 else max(os.sched_getaffinity(0))
    return subprocess.Popen(
        [sys.executable, "-m", *arguments],
        cwd=ROOT,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT)},
        preexec_fn=lambda: os.sched_setaffinity(0, {core}),
    )


def _words(study, folder, seed):
    """How a run begins."""
    return [f"studies.{study}", *STUDIES[study].split(), f"--seed={seed}", "--out", str(folder)]


def _kept(folder):
    return folder.is_dir() and any(
        path.is_file()
        and path.name not in ("config.json", ".lock")
        and not UNFINISHED.fullmatch(path.name)
        for path in folder.rglob("*")
    )


def _ended(process):
    """(exit code, last line of what it said)."""
    try:
        said = process.communicate(timeout=LONGEST_S)[1]
    except subprocess.TimeoutExpired:
        process.kill()
        return None, (process.communicate()[1].splitlines() or [""])[-1]
    return process.returncode, (said.splitlines() or [""])[-1]


def _numbers(folder):
    stored = json.loads((folder / "metrics.json").read_text())
    return {name: value for name, value in stored.items() if not IGNORED.search(name)}


def _whole(study, folder, seed):
    """(numbers, seconds until something is kept, seconds in all) of a run that nobody kills."""
    began = time.monotonic()
    process = _started(_words(study, folder, seed))
    while process.poll() is None and not _kept(folder):
        time.sleep(0.02)
    first_s = time.monotonic() - began
    code, said = _ended(process)
    if code != 0:
        raise RuntimeError(f"{study} itself ends with {code}: {said}")
    return _numbers(folder), first_s, time.monotonic() - began


def _holds(process):
    """Whether a run has begun: it heeds signals, and holds its folder."""
    with contextlib.suppress(OSError):
        opened = (os.readlink(link) for link in Path(f"/proc/{process.pid}/fd").iterdir())
        return any(name.endswith("/.lock") for name in opened)
    return False


def _kill(process, kind, order):
    if kind == "full_disk":
        most = order.choice((0, 300, 5000))
        resource.prlimit(process.pid, resource.RLIMIT_FSIZE, (most, resource.RLIM_INFINITY))
    else:
        process.send_signal(KINDS[kind])


def measure(
    count: int, seed: int, say=print, studies=tuple(STUDIES)
) -> tuple[dict[str, float], list[str]]:
    """Kill until ``count`` kills hit. A kill that comes after the end, or before anything was kept,
    is no hit."""
    order = random.Random(seed)
    hits: Counter[str] = Counter()
    hit_studies = set()
    kills = compared = equal = 0
    findings = []
    whole = {}
    with tempfile.TemporaryDirectory() as place:
        for number in itertools.count():
            if sum(hits.values()) >= count:
                break
            study = studies[number % len(studies)]
            if study not in whole:
                whole[study] = _whole(study, Path(place) / study, seed)
                say(f"{study}: first kept after {whole[study][1]:.1f} s of {whole[study][2]:.1f} s")
            expected, first_s, all_s = whole[study]
            folder = Path(place) / f"{study}-{number}"
            arguments = _words(study, folder, seed)
            story = []
            code = None
            for _ in range(order.randint(1, KILLS)):
                kind = order.choice(list(KINDS))
                process = _started(arguments)
                after_s = order.uniform(0.0, all_s - first_s)
                while process.poll() is None and not _holds(process):
                    time.sleep(0.02)
                try:
                    process.wait(after_s)
                except subprocess.TimeoutExpired:
                    _kill(process, kind, order)
                    kills += 1
                code, said = _ended(process)
                if code == 0:
                    break
                story.append(f"{kind} at {after_s:.1f} s")
                # behind the run's end
                late = (folder / "metrics.json").exists() and code == -KINDS.get(kind, 0)
                if code not in ENDS[kind] and not late:
                    findings.append(f"{study}, {', '.join(story)}: ends with {code}: {said}")
                if _kept(folder):
                    hits[kind] += 1
                    hit_studies.add(study)
                if (folder / "config.json").exists():
                    arguments = [f"studies.{study}", "--resume", str(folder)]
            if not story:
                continue
            if code != 0:
                code, said = _ended(_started(arguments))
            found = _numbers(folder) if code == 0 else {}
            different = [name for name in expected | found if expected.get(name) != found.get(name)]
            left = [path.name for path in folder.rglob(".*")]
            compared += 1
            equal += not different and not left
            told = f"{study}, {', '.join(story)}"
            if code != 0:
                findings.append(f"{told}: resuming ends with {code}: {said}")
            elif different or left:
                pairs = [
                    f"{name} {found.get(name)} for {expected.get(name)}" for name in different[:3]
                ]
                findings.append(f"{told}: {len(different)} differ: {pairs}; left: {left}")
            say(f"{told}: {'equal' if not different and not left else findings[-1]}")
    figures = {f"kill_hits_{kind}": hits[kind] for kind in KINDS}
    figures |= {"kills": kills, "kill_hits": sum(hits.values()), "kill_studies": len(hit_studies)}
    return figures | {"killed_runs": compared, "killed_runs_equal": equal}, findings
