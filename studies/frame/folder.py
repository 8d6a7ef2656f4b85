"""The folder of a run: made fresh, or found again; never a folder that holds anything else."""

import contextlib
import os
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path

from codesign.atomic import write_atomic
from codesign.errors import CodesignError, FileFormatError
from codesign.reading import read_json
from studies.frame.config import resume_command

try:
    import fcntl
# Windows has no such locks: two processes in one folder are not told apart there
except ImportError:
    fcntl = None

LOCK = ".lock"
REMEDY = "choose a folder you may write to with --out"


def fresh(study: str, out: Path | None):
    """Make and return the folder of a new run: ``out``, or runs/<study>/<time>.

    Raises: CodesignError when it cannot be made or written, or holds something already.
    """
    folder = out or _timed(Path("runs") / study)
    with _told(f"the output folder '{folder}' cannot be read"):
        found = folder.iterdir() if folder.exists() else ()
        holds = sorted(entry.name for entry in found if entry.name != LOCK)
    # a run that stopped at bad input leaves config.json alone, and nothing is lost by starting over
    # it
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
    with _told(f"the output folder '{folder}' cannot be made"):
        folder.mkdir(parents=True, exist_ok=True)
    write_atomic(folder / ".writable", b"")
    (folder / ".writable").unlink()
    return folder


def owner(folder: Path):
    """Name of the study whose run ``folder`` holds, or None."""
    try:
        stored = read_json(folder / "config.json")
    except FileFormatError:
        return None
    return stored.get("study") if isinstance(stored, dict) else None


@contextmanager
def held(folder: Path) -> Iterator[None]:
    """Hold a run's folder for this process: the lock ends with the process, however that ends.

    Raises: CodesignError when another process holds it.
    """
    path = folder / LOCK
    if fcntl is None:
        yield
        return
    while True:
        with _told(f"'{folder}' cannot be written"):
            handle = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
        try:
            # a record lock: workers that outlive a killed run do not inherit it
            fcntl.lockf(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            os.close(handle)
            raise CodesignError(
                f"another process works on the run in '{folder}'; wait for it, or stop it first."
            ) from error
        # removed by the one who held it: take the new one
        with contextlib.suppress(FileNotFoundError):
            if os.fstat(handle).st_ino == path.stat().st_ino:
                break
        os.close(handle)
    try:
        yield
    finally:
        path.unlink(missing_ok=True)
        os.close(handle)


@contextmanager
def _told(what):
    """An error of the system, said with its remedy."""
    try:
        yield
    except OSError as error:
        raise CodesignError(f"{what} ({error.strerror}); {REMEDY}.") from error


def _timed(parent: Path):
    name = datetime.now().astimezone().strftime("%Y-%m-%d_%H-%M-%S")
    folder = parent / name
    count = 2
    while folder.exists():
        folder = parent / f"{name}_{count}"
        count = count + 1
    return folder
