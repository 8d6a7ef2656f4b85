"""Trees as files tell them: pairs of a parent and its child."""

from collections import defaultdict
from collections.abc import Hashable, Iterable, Sequence
from typing import TypeVar

Name = TypeVar("Name", bound=Hashable)


def unreached(names: Sequence[Name], pairs: Iterable[tuple[Name, Name]]) -> list[Name]:
    """Names that no chain of pairs leads to from a name that is nobody's child: those of a loop,
    and below it.

    >>> unreached([0, 1, 2, 3], [(0, 1), (2, 3), (3, 2)])
    [2, 3]
    """
    children = defaultdict(list)
    for parent, child in pairs:
        children[parent].append(child)
    below = {child for each in children.values() for child in each}
    left = [name for name in names if name not in below]
    reached = set()
    while left:
        name = left.pop()
        if name not in reached:
            reached.add(name)
            left += children[name]
    return [name for name in names if name not in reached]
