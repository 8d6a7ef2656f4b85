"""The robot and world pairs there are, by name."""

from collections.abc import Callable

from scenes.robot_corridor import corridor
from scenes.robot_flight import flight
from scenes.robot_outdoors import outdoors
from scenes.robot_pair import RobotPair

PAIRS: dict[str, Callable[[], RobotPair]] = {
    "outdoors": outdoors,
    "corridor": corridor,
    "flight": flight,
}
