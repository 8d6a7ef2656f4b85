"""Run what makes the figures of README and docs (evidence_parts.py), keep them in
docs/evidence.json, and write them into the pages.

    make evidence                              parts whose code has changed since (all: an hour on two cores)
    make evidence ARGS="lens-motion hero"      named parts
    make evidence ARGS="--write"               runs nothing: writes the kept figures into the pages
    make evidence ARGS="--again joint-flight"  finds some answers of a raw table again: are they the same?

A page names a figure as <!--fig:NAME-->text<!--/-->; the text is what this writes. A part that was
cut is taken up where it stopped (runs/evidence/PART); one that was finished begins anew.

Some parts draw what was run once from a raw table (--raw FILE): their figures are of the code of
the commit that brought the table, and they are drawn again where they are named. --again finds the
first start of each way by the present code: where these answers are the table's to six digits, its
figures are of this code too; else they stay old, and it says by how much they differ.

evidence.json: {"schema": 1, "parts": {PART: {"command", "commit", "seconds", "machine", "measured":
{folder: its tree in git}, "figures": {NAME: text}, "pictures": [FILE in docs],
"again": commit whose answers were the same, where it was asked}}}.
"""

import argparse
import json
import re
import shlex
import shutil
import subprocess
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from evidence_parts import PARTS  # noqa: E402

from codesign.atomic import write_atomic  # noqa: E402

KEPT = ROOT / "docs" / "evidence.json"
RUNS = ROOT / "runs" / "evidence"
MARK = re.compile(r"(<!--fig:([\w.-]+)-->)(.*?)(<!--/-->)", re.S)
SAME = 1e-6  # of answers that are raced again


def kept() -> dict[str, Any]:
    """What docs/evidence.json has."""
    return json.loads(KEPT.read_text(encoding="utf-8"))["parts"] if KEPT.exists() else {}


def trees(folders: tuple[str, ...], commit: str = "HEAD") -> dict[str, str]:
    """The tree that git has of each folder or file at a commit."""
    return {folder: _git("rev-parse", f"{commit}:{folder}") for folder in folders}


def run_at(command: str) -> str:
    """The commit whose code made the figures of a command: that of its raw table, or the present
    one."""
    words = shlex.split(command)
    if "--raw" not in words:
        return "HEAD"
    return _git("log", "-1", "--format=%H", "--", words[words.index("--raw") + 1])


def _git(*words: str) -> str:
    done = subprocess.run(["git", *words], cwd=ROOT, capture_output=True, text=True)
    return "" if done.returncode else done.stdout.strip()  # what is not there it says back


def stale(part: Mapping[str, Any]) -> list[str]:
    """Folders whose code has changed since the figures of what is kept of a part."""
    now = trees(tuple(part["measured"]))
    return [folder for folder, tree in part["measured"].items() if now[folder] != tree]


def run(command: str, folder: Path) -> None:
    """Run a study into a folder, or go on with it."""
    words = shlex.split(command)
    if (folder / "report.html").exists():
        shutil.rmtree(folder)
    begun = (folder / "config.json").exists()
    # what a run was begun with and what is asked now have to be the same
    more = [*words[1:], "--resume" if begun else "--out", str(folder)]
    subprocess.run([sys.executable, "-m", f"studies.{words[0]}", *more], cwd=ROOT, check=True)


def raced_again(name: str, part: dict[str, Any]) -> dict[str, Any]:
    """What is kept of a part, of this code too where it finds the same answers."""
    folder = RUNS / f"{name}-again"
    run(PARTS[name].sample, folder)
    known = answers_of(ROOT / "docs" / PARTS[name].table)
    now = answers_of(folder / "answers.jsonl")
    apart = max(abs(a - b) for row in now for a, b in zip(now[row], known[row], strict=True))
    print(f"{name}: {len(now)} answers found again, at most {apart:.1g} apart")
    if apart > SAME:
        return part
    at = trees(PARTS[name].measured)
    return {**part, "measured": at, "again": _git("rev-parse", "HEAD")}


def answers_of(table: Path) -> dict[str, list[float]]:
    """Design and errors in unseen worlds of every answer of a table, by start, arm and what else it
    is of."""
    rows = [json.loads(line) for line in table.read_text(encoding="utf-8").splitlines()]
    return {str(at): [*row.get("share", ()), *row["errors"]] for at, (row, *_) in rows}


def measured(name: str) -> dict[str, Any]:
    """Run a part, or go on with it, and give what is kept of it."""
    part, folder = PARTS[name], RUNS / name
    since = time.monotonic()
    run(part.command, folder)
    for picture, made in part.pictures.items():
        (ROOT / "docs" / picture).parent.mkdir(exist_ok=True)
        write_atomic(ROOT / "docs" / picture, (folder / made).read_bytes())
    metrics = json.loads((folder / "metrics.json").read_text(encoding="utf-8"))
    try:
        figures = {figure: text(metrics) for figure, text in part.figures.items()}
    except KeyError as missing:
        sys.exit(
            f"error: {name}: its run did not measure {missing}; are its peers installed (pip install -e '.[all,bench]')?"
        )
    return {
        "command": f"python -m studies.{part.command}",
        "commit": metrics["versions"]["commit"],
        "seconds": round(time.monotonic() - since),
        "machine": f"{metrics['hardware']['cpu']}, {metrics['hardware']['cores']} cores",
        "measured": trees(part.measured, run_at(part.command)),
        "figures": figures,
        "pictures": list(part.pictures),
    }


def pages() -> list[Path]:
    """Those that may name figures."""
    return [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]


def written(text: str, figures: Mapping[str, str]) -> str:
    """A page with its figures as they are kept.

    Raises: KeyError for a figure that no part has.

    >>> written("gains <!--fig:a-->?<!--/--> less", {"a": "16 %"})
    'gains <!--fig:a-->16 %<!--/--> less'
    """
    return MARK.sub(lambda found: found[1] + figures[found[2]] + found[4], text)


def main(arguments: list[str] | None = None) -> int:
    """Returns the exit code."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "parts", nargs="*", metavar="PART", help=f"of {', '.join(PARTS)}; else those that are old"
    )
    parser.add_argument("--write", action="store_true", help="run nothing")
    parser.add_argument("--again", action="store_true", help="find some answers of each again")
    asked = parser.parse_args(arguments)
    choice = [name for name, part in PARTS.items() if part.sample or not asked.again]
    unknown = [name for name in asked.parts if name not in choice]
    if unknown:
        print(f"error: {unknown[0]} is no part; choose from {', '.join(choice)}.", file=sys.stderr)
        return 2
    known = kept()
    old = [
        name
        for name, part in PARTS.items()
        if name not in known or (stale(known[name]) and "--raw" not in part.command)
    ]
    for name in [] if asked.write else asked.parts or (choice if asked.again else old):
        known[name] = raced_again(name, known[name]) if asked.again else measured(name)
        text = json.dumps({"schema": 1, "parts": known}, indent=1, ensure_ascii=False)
        write_atomic(KEPT, f"{text}\n".encode())
    figures = {name: text for part in known.values() for name, text in part["figures"].items()}
    for page in pages():
        before = page.read_text(encoding="utf-8")
        if missing := {name for _, name, *_ in MARK.findall(before)} - set(figures):
            print(f"error: {page.name} names {min(missing)}, not measured yet.", file=sys.stderr)
            return 2
        if (after := written(before, figures)) != before:
            write_atomic(page, after.encode())
            print(f"{page.relative_to(ROOT)}: figures written")
    for name, part in known.items():
        for folder in stale(part):
            print(f"{name}: {folder} has changed since {part['commit'][:8]}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
