"""Single changes of the library, drawn at random, and whether the tests notice them.

    python -m tests.mutants COPY --count 100 --seed 1

COPY is a clone of the repository in which files are changed and put back; the rows go to
tests/mutants.csv of this one as they are found, and a run that is cut goes on where it stopped. A
change is noticed when a test of its room fails, or the tests do not end.
"""

import argparse
import ast
import csv
import os
import random
import re
import subprocess
import sys
from pathlib import Path

TABLE = Path(__file__).with_name("mutants.csv")
COLUMNS = ("seed", "number", "file", "line", "old", "new", "noticed")
SWAPPED = {
    ast.Add: "-",
    ast.Sub: "+",
    ast.Mult: "/",
    ast.Div: "*",
    ast.Lt: "<=",
    ast.LtE: "<",
    ast.Gt: ">=",
    ast.GtE: ">",
    ast.Eq: "!=",
    ast.NotEq: "==",
    ast.Is: "is not",
    ast.IsNot: "is",
    ast.And: "or",
    ast.Or: "and",
}
SLOW_S = 3600  # the tests of a room take a quarter of it, alone on a core
ELSEWHERE = {  # rooms of the library without a folder of tests that bears their name
    "grad": ("tests/gradients",),
    "report": ("tests/lens", "tests/studies", "tests/test_pages.py"),
    "train": ("tests/train", "tests/flow"),
}


def sites(source: str):
    """List of (line, first column, last column, old, new) of all changes of one line of a
    module."""
    lines = source.encode().splitlines()
    tree = ast.parse(source)
    annotations = {id(part) for node in ast.walk(tree) for part in _annotations(node)}
    found = (_site(lines, node) for node in ast.walk(tree) if id(node) not in annotations)
    return sorted(site for site in found if site)


def _site(lines, node):
    """The change of a node, None where there is none: another operator or number, a sign or ``not``
    left out."""
    match node:
        case ast.BinOp(left, operator, right) | ast.Compare(left, [operator, *_], [right, *_]):
            return _between(lines, left, right, operator)
        case ast.BoolOp(operator, [left, right, *_]):
            return _between(lines, left, right, operator)
        case ast.Constant(int() | float() as value) if not isinstance(value, bool):
            new = value + 1 if isinstance(value, int) else value * 1.5 + 0.1
            return _from_to(lines, node, node.end_col_offset, lambda old: repr(new))
        case ast.UnaryOp(ast.Not() | ast.USub(), operand) if not isinstance(operand, ast.Constant):
            if node.lineno == operand.lineno:
                return _from_to(
                    lines, node, operand.col_offset, lambda old: re.sub("not |-", "", old)
                )
    return None


def _from_to(lines, node, end, change):
    old = lines[node.lineno - 1][node.col_offset : end].decode()
    return node.lineno, node.col_offset, end, old, change(old)


def _annotations(node):
    for name in ("annotation", "returns"):
        if getattr(node, name, None) is not None:
            yield from ast.walk(getattr(node, name))


def _between(lines, left, right, operator):
    """The site of an operator that stands on the line of both its sides, else None."""
    if type(operator) not in SWAPPED or left.end_lineno != right.lineno:
        return None
    between = lines[right.lineno - 1][left.end_col_offset : right.col_offset].decode()
    sign = re.search(r"is not|is|and|or|[<>=!]=|[-+*/<>]", between)
    if sign is None:
        return None
    first = left.end_col_offset + sign.start()
    return right.lineno, first, first + len(sign[0]), sign[0], SWAPPED[type(operator)]


def drawn(root: Path, count: int, seed: int):
    """``count`` changes of codesign, every site equally likely: (file, site)."""
    every = [
        (path.relative_to(root).as_posix(), site)
        for path in sorted((root / "codesign").rglob("*.py"))
        for site in sites(path.read_text())
    ]
    return random.Random(seed).sample(every, count)


def tests_of(root: Path, file: str):
    """Files of tests to run: the room's own, those first that name most of what the module defines,
    then the eight of other rooms that name most of it."""
    room = file.split("/")[1] if file.count("/") > 1 else ""
    tree = ast.parse((root / file).read_text())
    names = {
        node.name for node in tree.body if isinstance(node, ast.FunctionDef | ast.ClassDef)
    } | {Path(file).stem}
    pattern = re.compile(r"\b(" + "|".join(map(re.escape, sorted(names))) + r")\b")
    near = ELSEWHERE.get(room, (f"tests/{room}",))
    own, others = [], []
    for path in sorted((root / "tests").rglob("test_*.py")):
        name = path.relative_to(root).as_posix()
        row = -len(pattern.findall(path.read_text())), name
        if any(name == place or name.startswith(f"{place}/") for place in near):
            own.append(row)
        elif row[0]:
            others.append(row)
    return [name for _, name in sorted(own) + sorted(others)[:8]]


def noticed(root: Path, file: str, site):
    """How the tests notice a change: the test that fails, "no end", or "" when none does."""
    path = root / file
    kept = path.read_bytes()
    number, first, last, _, new = site
    lines = kept.splitlines(keepends=True)
    text = lines[number - 1]
    lines[number - 1] = text[:first] + new.encode() + text[last:]
    path.write_bytes(b"".join(lines))
    command = [
        sys.executable,
        "-m",
        "pytest",
        "-x",
        "-q",
        "-p",
        "no:cacheprovider",
        *tests_of(root, file),
    ]
    try:
        done = subprocess.run(
            command,
            cwd=root,
            env=os.environ | {"PYTHONPATH": str(root), "PYTHONDONTWRITEBYTECODE": "1"},
            capture_output=True,
            text=True,
            timeout=SLOW_S,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return "no end"
    finally:
        path.write_bytes(kept)
    failed = re.search(r"^(?:FAILED|ERROR) (\S+)", done.stdout, re.MULTILINE)
    return "" if done.returncode == 0 else failed[1] if failed else f"exit {done.returncode}"


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("copy", type=Path, help="a clone that is changed and put back")
    parser.add_argument("--count", type=int, default=100)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--table", type=Path, default=TABLE)
    given = parser.parse_args()
    rows = list(csv.DictReader(given.table.open())) if given.table.exists() else []
    done = {(int(row["seed"]), int(row["number"])) for row in rows}
    with given.table.open("a", newline="") as file:
        writer = csv.writer(file)
        if not file.tell():
            writer.writerow(COLUMNS)
        for number, (name, site) in enumerate(drawn(given.copy, given.count, given.seed)):
            if (given.seed, number) in done:
                continue
            how = noticed(given.copy, name, site)
            writer.writerow((given.seed, number, name, site[0], site[3], site[4], how))
            file.flush()
            print(number, name, site, how or "NOT NOTICED", flush=True)


if __name__ == "__main__":
    main()
