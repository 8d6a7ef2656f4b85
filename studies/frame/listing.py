"""The studies there are, by question, and what to say of a name that is none of them. Reads their
files and imports nothing, so that it takes no time."""

import ast
import difflib
import re
import shutil
import sys
import textwrap
from itertools import pairwise
from pathlib import Path

FOLDER = Path(__file__).resolve().parents[1]
GROUPS = {
    "lens": ("lens_report", "lens_tolerance"),
    "render": ("make_dataset",),
    "events": ("video_to_events", "sensor_fit", "spike_esim"),
    "flow": ("train_flow", "flow_quality", "flow_recording"),
    "whole chain": (
        *("lens_opt", "lens_motion", "placement"),
        *("codesign", "joint_map", "joint_levers", "joint_controls"),
        *("joint_answer", "velocity_head"),
        *("gradient_flow", "speed_error", "stability", "chain_picture", "hero", "viewer"),
    ),
}
OTHERS = "others"  # where a study is listed that no group names
RUNS = re.compile(r'^if __name__ == "__main__":', re.M)


def studies() -> dict[str, Path]:
    """Name -> file of every study: a file of the folder studies, or a folder there with a
    __main__.py."""
    found = {path.parent.name: path for path in FOLDER.glob("*/__main__.py")}
    found |= {
        path.stem: path for path in FOLDER.glob("*.py") if path.stem[0] != "_" and _runs(path)
    }
    return dict(sorted(found.items()))


def question(path: Path) -> str:
    """First sentence of a file's docstring, on one line; "" where there is none."""
    text = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or ""
    first = " ".join(text.split("\n\n")[0].split())
    return re.split(r"(?<=[.?!])\s", first, maxsplit=1)[0]


def by_group() -> dict[str, list[str]]:
    """Names of the studies by group, each once; those that no group names under OTHERS."""
    names = list(studies())
    grouped = {
        group: [name for name in members if name in names] for group, members in GROUPS.items()
    }
    rest = [name for name in names if not any(name in members for members in GROUPS.values())]
    return {**grouped, OTHERS: rest} if rest else grouped


def show(columns: int | None = None) -> str:
    """The list as text: every study with its question, by group.

    Args:
      columns: width of the text; that of the terminal when left out.
    """
    columns = columns or min(shutil.get_terminal_size().columns, 120)
    files = studies()
    width = max(map(len, files)) + 4
    lines = [
        "codesign run NAME [OPTIONS] (in a checkout also python -m studies.NAME); --help explains."
    ]
    for group, names in by_group().items():
        lines += ["", group]
        lines += [
            textwrap.fill(
                f"  {name:<{width - 2}}{question(files[name])}",
                max(columns, width + 20),
                subsequent_indent=" " * width,
                break_on_hyphens=False,
            )
            for name in names
        ]
    return "\n".join(lines)


def refusal(name: str) -> str:
    """The sentence about a name that is no study; "" for one that is.

    Args:
      name: what stands behind "studies.", or behind `codesign run`.
    """
    files = studies()
    if name in files:
        return ""
    if name and (
        FOLDER.joinpath(*name.split(".")).with_suffix(".py").is_file() or (FOLDER / name).is_dir()
    ):
        return f"studies.{name} is a part of the studies and no study; 'codesign list' lists them."
    near = difflib.get_close_matches(name.replace("-", "_"), files, n=1)
    hint = f"did you mean {near[0]}? " if near else ""
    return f"there is no study '{name}'; {hint}'codesign list' lists them."


def refuse_parts(command: list[str]):
    """End with exit code 2 when Python was started as `python -m studies.NAME` for something that
    would run in silence, or not at all: a part of a study, or a name that is none.

    Args:
      command: sys.orig_argv.
    """
    module = next((following for word, following in pairwise(command) if word == "-m"), "")
    name = module.removeprefix("studies.")
    path = FOLDER.joinpath(*name.split(".")).with_suffix(".py")
    # some studies start files of theirs in processes of their own
    if name == module or name == "__main__" or (path.is_file() and _runs(path)):
        return
    if complaint := refusal(name):
        print(f"error: {complaint}", file=sys.stderr)
        sys.exit(2)


def _runs(path):
    return RUNS.search(path.read_text(encoding="utf-8")) is not None
