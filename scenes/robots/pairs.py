"""The robot and world pairs there are, by name."""

from collections.abc import Callable, Sequence

from codesign.errors import DomainError
from scenes.robots.corridor import corridor
from scenes.robots.flight import flight
from scenes.robots.outdoors import outdoors
from scenes.robots.pair import RobotPair

PAIRS: dict[str, Callable[[], RobotPair]] = {
    "outdoors": outdoors,
    "corridor": corridor,
    "flight": flight,
}


def check_pairs(names: Sequence[str]) -> None:
    """Raise DomainError unless there are names, all of them of PAIRS."""
    unknown = [name for name in names if name not in PAIRS]
    if unknown or not names:
        raise DomainError(f"--pair {' '.join(unknown)}: choose from {', '.join(PAIRS)}.")
