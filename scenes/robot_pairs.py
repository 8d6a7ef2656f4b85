"""The robot and world pairs there are, by name."""

from collections.abc import Callable, Sequence

from codesign.errors import DomainError
from scenes.robot_corridor import corridor
from scenes.robot_flight import flight
from scenes.robot_outdoors import outdoors
from scenes.robot_pair import RobotPair

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
