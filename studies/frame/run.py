"""The frame every study runs in: its command line, folder, progress, saved state, metrics and page.

A study is a function of a Run and a frozen dataclass:

    @dataclass(frozen=True)
    class Config(StudyConfig):
        QUICK: ClassVar = {"steps": 10}  # what --quick sets
        steps: int = 300
        '''Number of optimisation steps.'''

    def study(run: Run[Config]) -> None: ...

    if __name__ == "__main__":
        sys.exit(main(study, Config))
"""

import contextlib
import dataclasses
import errno
import hashlib
import inspect
import io
import json
import math
import os
import sys
import time
from collections.abc import Callable
from numbers import Integral, Real
from pathlib import Path
from typing import Any, Generic

import torch
import tyro
from rich.console import Console

from codesign import backend, shipped, state
from codesign.atomic import remove_unfinished, write_atomic
from codesign.errors import CodesignError, DomainError, FileFormatError, NonFiniteError
from codesign.interrupt import Interruption, written_out
from codesign.reading import read_json
from codesign.report import page, prose
from studies.frame import files, machine
from studies.frame import folder as folders
from studies.frame.config import (
    Config,
    StudyConfig,
    check_paths,
    read_config,
    resolved,
    resume_command,
    to_json,
)
from studies.frame.progress import Pace, StepProgress

__all__ = ["Run", "StudyConfig", "main", "open_run"]

FULL = (errno.ENOSPC, errno.EFBIG, errno.EDQUOT)
NO_ROOM = "No usable temporary directory"  # of Python's, on a full disk
RESERVED = ("versions", "hardware")
VERSION = 2  # of the frame's part of state.npz
STUDIES = Path(__file__).parents[1]
QUICK = "A quick run, which decides nothing."
TIMES = "times"  # of the frame itself, among the numbers of state.npz


class Run(Generic[Config]):
    """What a study works with: configuration, folder, device, and the ways to keep and show
    results.

    config: the study's dataclass. folder: where everything is written. device: torch.device with
      "auto" resolved.
    resumed: True when this session goes on with an earlier one.
    """

    def __init__(
        self,
        study: str,
        config: Config,
        folder: Path,
        device: torch.device,
        resumed: bool,
        interruption: Interruption | None = None,
    ):
        self.study = study
        self.config = config
        self.folder = folder
        self.device = device
        self.resumed = resumed
        self.metrics: dict[str, float | int] = {}
        self._console = Console(highlight=False)
        self._interruption = interruption or Interruption()
        self._machine = {"versions": machine.versions(), "hardware": machine.hardware()}
        self._identity = {
            "version": VERSION,
            "study": study,
            "configuration": _digest(study, config),
        }
        self._cards: list[page.Card] = []
        self._sections = [page.Section("")]
        self._paces: dict[str, Pace] = {}
        self._began = time.monotonic()
        self._earlier_s = 0.0
        stored = self._stored() if resumed else None
        # read by none of the study's code: of an earlier version, which kept its progress there
        self.state_unread = stored is not None
        if stored is not None:
            times = stored.numbers[TIMES]
            self._earlier_s = times["seconds"]
            self._paces = {name: Pace(**pace) for name, pace in times["loops"].items()}
            self._continue_from(times.get("commit", "unknown"))
        if resumed and (folder / "metrics.json").exists():
            self.metrics = _read_metrics(folder / "metrics.json")

    def _continue_from(self, commit):
        """Say, here and among the versions, that other code than this made a part of the
        results."""
        versions = self._machine["versions"]
        now = versions["commit"]
        if commit.split(", ")[-1] == now:
            versions["commit"] = commit
            return
        self.say(f"This run was made so far by commit {commit}, and goes on with {now}.")
        versions["commit"] = f"{commit}, {now}"

    def say(self, text: str):
        """Print a line, above the progress bar when there is one."""
        self._console.print(text, markup=False, soft_wrap=True)

    def progress(self, total: int, description: str, done: int = 0):
        """Context manager around a loop of ``total`` steps; call its ``advance(loss=…)`` after each
        whole step.

        Args:
          total: number of steps, those of earlier sessions included. done: how many earlier
            sessions made.
        Returns: StepProgress, with ``seconds_per_step``, which counts the steps of earlier sessions
          too.
        """
        pace = self._paces.setdefault(description, Pace())
        return StepProgress(self._console, total, description, done, self._interruption, pace)

    @property
    def seconds(self):
        """Wall-clock seconds of this session, and of the earlier ones up to their last stored
        state."""
        return self._earlier_s + time.monotonic() - self._began

    def on_interrupt(self, save: Callable[[], object]):
        """Call ``save`` when Ctrl-C was pressed, at the next ``advance``, where a step is whole.
        The last one given counts."""
        self._interruption.save = save

    def save_state(self, tensors: dict[str, torch.Tensor], numbers: dict[str, Any]):
        """Store what is needed to go on, exactly, in one atomic write (see
        codesign.state.write_state), with the times of the loops and of the run."""
        times = {
            "seconds": self.seconds,
            "loops": {name: vars(pace) for name, pace in self._paces.items()},
            "commit": self._machine["versions"]["commit"],
        }
        state.write_state(
            self.folder / "state.npz", tensors, {"numbers": numbers, TIMES: times, **self._identity}
        )

    def load_state(self):
        """State(tensors, numbers) stored by an earlier session, on the CPU; None for a fresh run.

        Raises: FileFormatError when the file is damaged.
        """
        stored = self._stored()
        self.state_unread = False
        return stored and state.State(stored.tensors, stored.numbers["numbers"])

    def record(self, **numbers: float):
        """Add to metrics.json, written at once: flat names with their unit, finite numbers
        (0-d tensors too).

        Raises: NonFiniteError on NaN or infinity, DomainError on anything that is not a number;
          nothing is written then.
        """
        self.metrics.update({name: _metric(name, value) for name, value in numbers.items()})
        text = json.dumps({**self.metrics, **self._machine}, indent=2, allow_nan=False)
        write_atomic(self.folder / "metrics.json", text.encode())

    def section(self, title: str, text: str = ""):
        """Begin a section of the page; what follows is shown in it."""
        self._sections.append(page.Section(title))
        if text:
            self.text(text)

    def card(self, label: str, value: str, note: str = ""):
        """Add a headline figure at the top of the page, for example ("RMS spot", "12.3 µm",
        "detuned: 41 µm")."""
        self._cards.append(page.Card(label, value, note))

    def text(self, text: str):
        """Add paragraphs, lists, **bold**, *emphasis* and `code` (see codesign.report.prose)."""
        self._show("prose", prose.to_html(text))

    def table(self, title: str, columns, rows, caption: str = ""):
        """Add a table; columns of numbers are right-aligned, None shows as a dash."""
        self._show("table", page.table(title, columns, rows, caption))

    def figure(self, figure, name: str, caption: str, dpi: int = 160):
        """Save a matplotlib figure as <name>.png, show it on the page, and close it. Returns the
        path."""
        import matplotlib.pyplot as plt

        path = self.path(f"{name}.png")
        png = io.BytesIO()
        figure.savefig(png, format="png", dpi=dpi, bbox_inches="tight", facecolor="white")
        plt.close(figure)
        write_atomic(path, png.getvalue())
        self._show("picture", page.picture(path, caption))
        return path

    def video(self, path: str | Path, caption: str):
        """Show an MP4, GIF, WebP or PNG file; a relative path is taken inside the run's folder."""
        self._show("picture", page.picture(self.folder / path, caption))

    def path(self, name: str):
        """Path of a file inside the run's folder.

        Raises: DomainError when the name leads out of it.
        """
        path = self.folder / name
        if not path.resolve().is_relative_to(self.folder.resolve()):
            raise DomainError(
                f"the file name '{name}' leads out of the run's folder; use a plain name."
            )
        return path

    def finish(self, title: str, lead: str):
        """Write metrics.json and report.html. Returns the path of the page.

        lead: answers the study's question in its first sentence; a quick run says before it that it
          decides nothing.
        """
        if self.config.quick:
            lead = f"{QUICK} {lead}"
        self.record()
        facts = {"Configuration": json.loads(to_json(self.study, self.config))}
        facts |= {name.capitalize(): found for name, found in self._machine.items()}
        facts["Metrics"] = self.metrics
        html = page.render_page(title, lead, self._cards, self._sections, facts)
        path = self.folder / "report.html"
        write_atomic(path, html.encode())
        self.say(f"Done: {path}")
        return path

    def _stored(self):
        path = self.folder / "state.npz"
        stored = state.read_state(path)
        if stored is None:
            return None
        made_by = {name: stored.numbers.get(name) for name in self._identity}
        if made_by != self._identity or stored.numbers.keys() != {"numbers", TIMES, *made_by}:
            other = next(
                (name for name in made_by if made_by[name] != self._identity[name]), "version"
            )
            raise FileFormatError(
                f"'{path}' was written by another {other} ({made_by[other]}, not "
                f"{self._identity[other]}); start a new run."
            )
        return stored

    def _show(self, kind, block):
        self._sections[-1].blocks.append((kind, block))


def open_run(
    study: str,
    config: Config,
    interruption: Interruption | None = None,
    held: contextlib.ExitStack | None = None,
) -> Run[Config]:
    """Make the folder of a new run and write its config.json, or find the run that
    ``config.resume`` names, which goes on with its stored configuration; what a killed session left
    half written is removed there. Files that its options name have to be those it was begun with. No
    other process may work in the folder until ``held`` ends.

    Raises: CodesignError with one sentence when the folder, the stored configuration or the device
      is unfit.
    """
    if config.resume is not None:
        stored = read_config(config.resume / "config.json", study, type(config))
        stored = dataclasses.replace(
            stored, **{name: getattr(config, name) for name in config.ANEW}
        )
        _hold(config.resume, held)
        remove_unfinished(config.resume)
        begun = config.resume / "files.json"
        if begun.exists():
            files.check_same(read_json(begun), files.digests(files.given(stored), config.resume))
        # earlier versions stored what "auto" found, whether the study used it or not
        if stored.GPU and stored.device == "cuda" and not torch.cuda.is_available():
            raise DomainError(
                "the run to resume was begun on a GPU; go on on a machine that has one, or start a new run."
            )
        device = _device(stored) if stored.GPU else torch.device("cpu")
        return Run(study, stored, config.resume, device, True, interruption)
    device = _device(config)
    # the same device when the run is resumed
    config = dataclasses.replace(config, device=device.type)
    text = to_json(study, config)
    folder = folders.fresh(study, config.out)
    _hold(folder, held)
    write_atomic(folder / "config.json", text.encode())
    if begun := files.digests(files.given(config), folder):
        write_atomic(folder / "files.json", json.dumps(begun, indent=2).encode())
    return Run(study, config, folder, device, False, interruption)


def main(
    study: Callable[[Run[Config]], None],
    kind: type[Config],
    arguments: list[str] | None = None,
) -> int:
    """Run a study from its command line.

    Returns: exit code: 0 done, 2 bad input (one clear line on stderr), 130 interrupted, 143 ended
      by SIGTERM (both with the line to go on).
    Raises: SystemExit from the command line itself (0 for --help, 2 for a wrong option).
    """
    name = _name(kind)

    def parse(default):
        return tyro.cli(
            kind,
            default=default,
            prog=shipped.command(name),
            description=sys.modules[study.__module__].__doc__,
            args=arguments,
        )

    shipped.end_imports()
    os.environ["MPLBACKEND"] = "Agg"  # figures go to files; no screen is needed
    if "matplotlib" in sys.modules:
        sys.modules["matplotlib"].use("Agg")
    torch.set_num_threads(
        1
        # the heavy work is in drjit's own thread pool, which torch's waiting threads only slow down
        # (measured: 2x)
    )
    run = None
    interruption = Interruption()
    try:
        with written_out(), interruption:
            check_paths(kind, sys.argv[1:] if arguments is None else arguments)
            config = resolved(name, kind, parse)
            with contextlib.ExitStack() as held:
                run = open_run(name, config, interruption, held)
                study(run)
    except CodesignError as error:
        print(f"error: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    except (Exception, KeyboardInterrupt) as error:
        full = isinstance(error, OSError) and (error.errno in FULL or NO_ROOM in str(error))
        broken_off = isinstance(error, ImportError | NameError) and interruption.raised
        if not (full or broken_off or isinstance(error, KeyboardInterrupt)):
            raise
        again = f"; go on with: {resume_command(name, run.folder)}" if run else ""
        # what a signal breaks off while a library loads is an error of that library's
        print(f"error: the disk is full{again}" if full else f"interrupted{again}", file=sys.stderr)
        return 2 if full else interruption.exit_code
    return 0


def _hold(folder, held):
    if held is not None:
        held.enter_context(folders.held(folder))


def _digest(study, config):
    """Of what a state belongs to, but for the place of its folder and how it was computed."""
    stored = json.loads(to_json(study, dataclasses.replace(config, out=None, resume=None)))
    stored = {name: value for name, value in stored.items() if name not in config.ANEW}
    return hashlib.sha256(json.dumps(stored, sort_keys=True).encode()).hexdigest()[:16]


def _name(kind):
    path = Path(inspect.getfile(kind))
    shared = path.parent != STUDIES and (path.parent / "__main__.py").exists()
    return path.parent.name if shared else path.stem


def _device(config):
    wanted = config.device
    if wanted == "cuda" and not config.GPU:
        raise DomainError("this study computes on the processor; leave --device out.")
    if wanted == "auto":
        wanted = "cuda" if config.GPU and torch.cuda.is_available() else "cpu"
    if wanted == "cuda":
        backend.check_version("cuda")
    return torch.device(wanted)


def _metric(name, value):
    if name in RESERVED:
        raise DomainError(
            f"a metric cannot be named '{name}', which metrics.json uses itself; choose another name."
        )
    if isinstance(value, torch.Tensor) and value.numel() == 1:
        value = value.item()
    if not isinstance(value, Real):
        raise DomainError(
            f"metric {name} is a {type(value).__name__}, not a number; record one number per name."
        )
    if not math.isfinite(value):
        raise NonFiniteError(
            f"metric {name} is {value}; metrics are finite numbers, so leave out what has none, and look "
            "for where it appeared."
        )
    return int(value) if isinstance(value, Integral) else float(value)


def _read_metrics(path):
    stored = read_json(path)
    if isinstance(stored, dict):
        numbers = {name: value for name, value in stored.items() if name not in RESERVED}
        if all(type(value) in (int, float) for value in numbers.values()):
            return numbers
    raise FileFormatError(f"'{path}' is damaged; remove it to go on with this run.")
