"""Studies as somebody types them, and what their folders hold afterwards."""

import importlib
import json
import shlex
from pathlib import Path

from studies.frame.run import main
from tests.processes import ROOT


def module_of(name):
    """The module of a study, a file or a folder."""
    return importlib.import_module(
        f"studies.{name}" + ".__main__" * (ROOT / "studies" / name).is_dir()
    )


def ran(study, options="", *more):
    """Exit code of a study with options in one text, and ``more`` words as they are; study: its
    module, or what takes its words."""
    words = [*shlex.split(options), *map(str, more)]
    return study(words) if callable(study) else main(study.study, study.Config, words)


def stored(folder, name):
    return json.loads((folder / f"{name}.json").read_text())


def numbers(folder):
    return {k: v for k, v in stored(folder, "metrics").items() if k not in ("versions", "hardware")}


def page(folder):
    return (folder / "report.html").read_text(encoding="utf-8")


def lines(path):
    """What the lines of a table hold; nothing where there is none."""
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


def contents(folder):
    return {path.name: path.read_bytes() for path in Path(folder).rglob("*") if path.is_file()}
