"""What does a robot's camera see when its mount, lens or sensor changes?

A window in the browser shows the world, the robot, its camera with rays through the lens, and
frame, events and flow of a short drive; sliders move the design, and a button certifies its
gradient. --open takes the design that a run of studies.codesign or studies.placement handed over.
--measure opens no window and says how many updates a second there are.
"""

import contextlib
import statistics
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

from codesign.checks import check_whole
from codesign.errors import DomainError
from scenes.robots.pairs import PAIRS
from studies.codesign.design import Space, Whole
from studies.frame.run import Run, StudyConfig, main
from studies.frame.show import tabulate
from studies.viewer.opened import opened
from studies.viewer.state import SLIDERS, Drive, Setting
from studies.viewer.window import Window

THIN = "thin"
MOVES = 12  # of a slider that is measured
HIGHEST_PORT = 65_535


@dataclass(frozen=True)
class Config(StudyConfig):
    QUICK: ClassVar = {"size": 48, "measure": True}
    pair: str = "outdoors"
    """Robot and world: outdoors, corridor or flight."""
    robot: Path | None = None
    """A robot of your own instead, described in a .yaml file (docs/robots_and_worlds.md)."""
    family: str = THIN
    """Family of traced lenses, such as retrofocus-4, or thin."""
    open: Path | None = None
    """Folder of a run of studies.codesign or studies.placement whose design is shown instead."""
    port: int = 8080
    """Where the window is served on this machine; 0 takes a free one."""
    size: int = 96
    """Pixels across the square film, a multiple of three."""
    frames: int = 5
    """Frames rendered of the drive, 3 to 9."""
    rays: int = 4
    """Rays per pixel."""
    measure: bool = False
    """Move every slider, and say how many updates a second there are."""


def study(run: Run[Config]) -> None:
    size = run.config
    check_whole(size.port, "port", 0, HIGHEST_PORT)
    whole = chosen(size)
    drive = Drive.of(whole.space, size.size, size.frames, size.seed, size.rays)
    window = Window(Setting.of(drive, whole), 0 if size.measure else size.port)
    try:
        if size.measure:
            measured(run, window)
        else:
            run.say(f"The viewer is at http://127.0.0.1:{window.port}; Ctrl-C ends it.")
            with contextlib.suppress(KeyboardInterrupt):
                window.serve()
    finally:
        window.server.stop()
    setting = window.setting
    run.record(**{name: setting.whole.numbers[name] for name in drive.names})
    run.text(f"{setting.whole}.")
    run.finish("The viewer's last setting", headline(setting.words(), window.update_s))


def headline(seen: str, update_s: list[float]) -> str:
    """One sentence: what was seen at the last setting, and how many updates a second there were.
    update_s: seconds of every update."""
    pace = "no slider was moved"
    if update_s:
        pace = f"{1 / statistics.median(update_s):.1f} updates a second (median of {len(update_s)})"
    return f"The camera sees {seen}; {pace}."


def chosen(size: Config) -> Whole:
    """The design that is shown first. Raises: DomainError for names that are not there."""
    if size.open is not None:
        return opened(size.open)
    if size.robot is None and size.pair not in PAIRS:
        raise DomainError(
            f"--pair {size.pair}: choose from {', '.join(PAIRS)}, or give --robot and a .yaml file."
        )
    family = None if size.family == THIN else size.family
    space = Space.of(str(size.robot) if size.robot else size.pair, family)
    return space.made(space.start)


def measured(run: Run[Any], window: Window) -> None:
    """Processor and wall time of an update by every slider: medians, the first left out."""
    rows = []
    with run.progress(len(window.sliders), "sliders") as bar:
        for name, slider in window.sliders.items():
            updates = []
            for k in range(MOVES):
                slider.value = slider.min + (0.5 + 0.3 * k / MOVES) * (slider.max - slider.min)
                began = time.perf_counter(), time.process_time()
                spent = window.update()
                wall_s, cpu_s = time.perf_counter() - began[0], time.process_time() - began[1]
                updates.append({**spent, "processor": cpu_s, "wall": wall_s})
            median = {k: statistics.median(u[k] for u in updates[1:]) for k in updates[0]}
            rows.append(
                {
                    "slider": SLIDERS[name],
                    "updates_per_cpu_s": 1 / median["processor"],
                    "updates_per_s": 1 / median["wall"],
                    **{f"{stage}_ms": 1e3 * seconds for stage, seconds in median.items()},
                }
            )
            bar.advance(updates_per_s=rows[-1]["updates_per_s"])
    for row in rows:
        run.say("  ".join(f"{k} {v:.1f}" if k != "slider" else v for k, v in row.items()))
    tabulate(run, "Updates of the window", rows, "slider")


if __name__ == "__main__":
    sys.exit(main(study, Config))
