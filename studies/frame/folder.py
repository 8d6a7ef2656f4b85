"""The folder of a run: made fresh, or found again; never a folder that holds anything else."""

import json
from datetime import datetime
from pathlib import Path

from codesign.atomic import write_atomic
from codesign.errors import CodesignError
from studies.frame.config import resume_command

REMEDY = "choose a folder you may write to with --out"


def fresh(study: str, out: Path | None):
    """Make and return the folder of a new run: ``out``, or runs/<study>/<time>.

    Raises: CodesignError when it cannot be made or written, or holds something already.
    """
    folder = out or _timed(Path("runs") / study)
    try:
        holds = sorted(entry.name for entry in folder.iterdir()) if folder.exists() else []
    except OSError as error:
        raise CodesignError(
            f"the output folder '{folder}' cannot be read ({error.strerror}); {REMEDY}."
        ) from error
    # a run that stopped at bad input leaves config.json alone, and nothing is lost by starting over it
    if holds and (holds != ["config.json"] or owner(folder) != study):
        if owner(folder) == study:
            raise CodesignError(
                f"'{folder}' already holds a run of this study; choose another folder with --out, or go on "
                f"with it: {resume_command(study, folder)}"
            )
        raise CodesignError(
            f"the output folder '{folder}' holds other things "
            f"({', '.join(holds[:3])}{', …' if len(holds) > 3 else ''}); {REMEDY}, new or empty."
        )
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise CodesignError(
            f"the output folder '{folder}' cannot be made ({error.strerror}); {REMEDY}."
        ) from error
    write_atomic(folder / ".writable", b"")
    (folder / ".writable").unlink()
    return folder


def owner(folder: Path):
    """Name of the study whose run ``folder`` holds, or None."""
    try:
        stored = json.loads((folder / "config.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return stored.get("study") if isinstance(stored, dict) else None


def _timed(parent: Path):
    name = datetime.now().astimezone().strftime("%Y-%m-%d_%H-%M-%S")
    folder = parent / name
    count = 2
    while folder.exists():
        folder = parent / f"{name}_{count}"
        count = count + 1
    return folder
