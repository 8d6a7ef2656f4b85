"""Run every command that README, docs and Makefile name, in its quick form, and print what became
of each.

    make try-all                      from a fresh clone; ARGS="--only lens --limit 120" runs a part
    make try-all ARGS="--resume"      after a cut: what went as it should is not run again

Results are kept command by command in runs/try_all.jsonl, with the commit that they are of. A new
command on a page is tried by itself. A study runs with --quick in a folder of its own, through its
target of make where it has one. A command that names a file of the reader's own must end in a
sentence (exit 2).
"""

import argparse
import json
import os
import re
import resource
import shlex
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
MAKEFILE = (ROOT / "Makefile").read_text(encoding="utf-8")
TARGETS = re.findall(r"^([a-z][a-z-]*):", MAKEFILE, re.M)
LISTED = re.search(r"^STUDIES := ((?:.*\\\n)*.*)", MAKEFILE, re.M)
STUDIES = LISTED[1].replace("\\\n", " ").split() if LISTED else []
# of modules that differ from the target's
NAMES = dict(re.findall(r"^([a-z-]+): STUDY := (\w+)", MAKEFILE, re.M))
MODULES = {NAMES.get(target, target.replace("-", "_")): target for target in STUDIES}
COMMAND = re.compile(r"(?:\.venv/bin/)?python -m studies\.[a-z].*|make [a-z].*|codesign [a-z].*")
INSTEAD = {"NAME_OR_FILE": "cooke-triplet", "--lens NAME": "--lens cooke-triplet"}
# what else stands for something of the reader's own
OWN = re.compile(
    r"\b(?!ARGS\b)[A-Z]{3,}\b|\bmine:|\w\.(mp4|npz|npy|txt|yaml|urdf)\b|frames/|runs/|--recording |--video$"
)
NEEDS = re.compile(r"\b(?:give|needs?|pass|with|required:)\b.*?(--[a-z][a-z-]*)")
# what is no study is made short by what it is given last
SHORT = {"fuzz": ["--minutes", "1"], "kill-test": ["--count", "1"]}
KEPT = ROOT / "runs" / "try_all.jsonl"
ELSEWHERE = (
    "help",
    "setup",
    "docs",
    "evidence",
    "test",
    "test-bits",
    "lint",
    "core-check",
    "clean",
    "try-all",
)


def commands() -> dict[str, str]:
    """{command: the page that names it first}: code spans, lines of code blocks, targets of studies
    no page names."""
    found = {}
    for page in (ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md")), ROOT / "Makefile"):
        text = page.read_text(encoding="utf-8").replace("```", "")
        spans = (
            re.findall(r"`((?:python|make|codesign|\.venv)[^`\n]*)`", text)
            if page.suffix
            else re.findall(r"## .*?: (make .*)", text)
        )
        lines = re.findall(r"^(?:    |#   )?([\w.].*)$", text, re.M)
        for said in (*spans, *lines):
            if COMMAND.fullmatch(said) and "`" not in said and (plain := normal(said)):
                found.setdefault(plain, page.relative_to(ROOT).as_posix())
    unnamed = [t for t in STUDIES if not any(c.split()[1] == t for c in found)]
    return found | {f"make {target}": "Makefile" for target in unnamed}


def normal(said: str) -> str:
    """One spelling of a command: without remarks, what may be left out, --quick and --out; "" where
    it is none."""
    said = re.sub(
        r"\s+#.*|\s{2,}.*|\[[^]]*\]|…|\.venv/bin/|--quick|--out [^\s\"]+", "", said
    ).strip()
    for word, value in INSTEAD.items():
        said = said.replace(word, value)
    try:
        name, *words = shlex.split(said)
    except ValueError:  # a quote was cut
        return ""
    if name == "make":
        target, given = (
            words[0],
            " ".join(w.removeprefix("ARGS=") for w in words[1:] if w.startswith("ARGS=")),
        )
    elif name == "python":
        target, given = MODULES.get(words[1].removeprefix("studies."), ""), " ".join(words[2:])
    else:
        return "" if words[0] == "run" else said
    if name == "python" and not target:
        return said
    given = " ".join(given.split())
    return (
        (f'make {target} ARGS="{given}"' if given else f"make {target}")
        if target in TARGETS + STUDIES
        else ""
    )


def outcome(command: str, limit_s: float) -> tuple[bool, str, str]:
    """Whether it went as it should, its exit and the first line of its error."""
    name, *words = shlex.split(command)
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "MPLBACKEND": "Agg"}
    with tempfile.TemporaryDirectory(prefix="try-all-") as folder:
        # pages name raw tables as from the project's folder
        os.symlink(ROOT / "docs", f"{folder}/docs")
        study = name == "python" or words[0] in STUDIES
        more = ["--quick", "--out", f"{folder}/out"] if study else SHORT.get(words[0], [])
        if name == "make":
            given = " ".join(["".join(words[1:]).removeprefix("ARGS="), *more])
            words = ["make", "-C", str(ROOT), words[0], f"ARGS={given}"]
        else:
            words = [sys.executable, *([] if name == "python" else ["-m", name]), *words, *more]
        pipe = subprocess.PIPE
        # in a session of its own, so that what make has started ends with it
        started = subprocess.Popen(
            words,
            cwd=folder,
            env=environment,
            stdout=pipe,
            stderr=pipe,
            text=True,
            start_new_session=True,
        )
        try:
            _, errors = started.communicate(timeout=limit_s)
        except BaseException as error:
            os.killpg(started.pid, signal.SIGKILL)
            started.communicate()
            if not isinstance(error, subprocess.TimeoutExpired):
                raise
            return False, "time", ""
    code = re.findall(r"^make: \*\*\* .* Error (\d+)", errors, re.M) or [str(started.returncode)]
    traced = "Traceback (most" in errors
    lines = [
        line for line in errors.splitlines() if line.strip() and not line.startswith("make")
    ] or [""]
    # exit 2 is right only where the command names data of the reader's own, or asks for an option
    # that it lacks; an option that is not there is refused without such a sentence
    sentence = next((line for line in lines if line.startswith("error: ")), "")
    asked = NEEDS.search(sentence)
    theirs = OWN.search(command) or (asked and asked[1] not in command)
    right = code[0] == "0" or (code[0] == "2" and bool(sentence and theirs))
    return (
        right,
        code[0],
        "" if code[0] == "0" else (lines[-1] if traced else sentence or lines[0])[:160],
    )


def cpu_s() -> float:
    """Processor time of all commands that have ended."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def main() -> int:
    asked = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    asked.add_argument("--only", default="", help="try the commands that hold this text")
    asked.add_argument("--metrics", type=Path, help="file for the figures commands and failed")
    asked.add_argument("--limit", type=float, default=900.0, help="seconds that a command may take")
    asked.add_argument(
        "--resume", action="store_true", help="leave out what went as it should before"
    )
    options = asked.parse_args()
    commit = subprocess.run(
        ["git", "-C", str(ROOT), "rev-parse", "--short", "HEAD"],
        capture_output=True,
        text=True,
        check=False,
    ).stdout.strip()
    KEPT.parent.mkdir(exist_ok=True)
    if not options.resume:
        KEPT.write_text("")
    lines = KEPT.read_text(encoding="utf-8").splitlines() if KEPT.exists() else []
    known = {row["command"]: row for row in map(json.loads, lines) if row["right"]}
    tried = failed = 0
    print(
        "| command | page | exit | seconds | CPU-s | first line of the error |\n|---|---|---|---|---|---|"
    )
    for command, page in commands().items():
        if options.only not in command or command.split()[1] in ELSEWHERE:
            continue
        row = known.get(command)
        if row is None:
            began, used_s = time.monotonic(), cpu_s()
            right, code, said = outcome(command, options.limit)
            row = {"command": command, "right": right, "exit": code, "said": said}
            row |= {"seconds": round(time.monotonic() - began), "cpu_s": round(cpu_s() - used_s)}
            with KEPT.open("a", encoding="utf-8") as file:
                file.write(json.dumps({**row, "commit": commit}) + "\n")
        tried, failed = tried + 1, failed + (not row["right"])
        if options.metrics:
            options.metrics.write_text(
                json.dumps({"commands": tried, "failed": failed}), encoding="utf-8"
            )
        mark = "" if row["right"] else " **fails**"
        times = f"{row['seconds']} | {row['cpu_s']}"
        print(
            f"| `{command}` | {page} | {row['exit']}{mark} | {times} | {row['said']} |", flush=True
        )
    print(f"{failed} failed; {', '.join(ELSEWHERE)} are left to CI and to you")
    return min(failed, 1)


if __name__ == "__main__":
    sys.exit(main())
