"""Imports run one way: every room of the toolkit imports the floors below it alone, and no files go
in a circle."""

import ast
from functools import cache

import pytest

from tests.processes import ROOT, python

FLOORS = (
    {"errors", "former", "shipped", "waiting"},
    {"doors", "checks"},
    {"types", "optional", "reading", "exclusive", "atomic"},
    {"pose", "arrays", "backend", "plain_yaml", "interrupt", "grad"},
    {"state"},
    {"lens", "render", "events"},  # none imports another: what one needs is passed in
    {"flow"},
    {"mount"},
    {"place", "task"},
    {"system"},
    {"fidelity"},
    {"report"},
    {"optimise"},
    {"train"},
    {"doctor"},
    {"__main__"},
)
FLOOR = {room: number for number, rooms in enumerate(FLOORS) for room in rooms}
COMMANDS = ("codesign", "__main__")  # the command line, which starts the studies too
DOOR = "codesign"  # the package itself, which names its rooms and imports them when asked
MITSUBA = {
    "codesign.render": "makes pictures with it",
    "scenes": "describe worlds to it",
    "studies.speed_error.growth": "times worlds of as many objects and faces as it wants",
    "studies.stability.render_cases": "mirrors shapes by its transforms",
}


parsed = cache(ast.parse)


def modules():
    """Dictionary name -> source of every module."""
    found = {}
    for top in ("codesign", "scenes", "studies"):
        for path in sorted((ROOT / top).rglob("*.py")):
            parts = path.relative_to(ROOT).with_suffix("").parts
            found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path.read_text()
    return found


def imports(sources):
    """Dictionary name -> set of (module imported, line), at the top or inside a function; of a name
    imported from a package, the module it is, where it is one."""
    found = {}
    for name, source in sources.items():
        found[name] = set()
        for node in ast.walk(parsed(source)):
            if isinstance(node, ast.Import):
                found[name] |= {(alias.name, node.lineno) for alias in node.names}
            elif isinstance(node, ast.ImportFrom):
                assert node.level == 0, f"{name}:{node.lineno}: give the full name"
                for alias in node.names:
                    full = f"{node.module}.{alias.name}"
                    found[name].add((full if full in sources else node.module, node.lineno))
    return found


def room(module):
    """("codesign", room), ("scenes", "") or ("studies", study) of a module; ("", "") for other
    people's."""
    top, *rest = module.split(".")
    if top not in ("codesign", "scenes", "studies"):
        return "", ""
    return top, rest[0] if rest and top != "scenes" else ""


def allowed(importer, imported):
    """Whether a room may import another."""
    if importer == imported:
        return True
    if importer == COMMANDS:
        return True
    (top, name), (other_top, other) = importer, imported
    if top == "studies":
        return other_top != "studies" or name != "frame"
    if top == "scenes":
        return other_top == "codesign"
    return other_top == "codesign" and FLOOR[other or "__main__"] < FLOOR[name]


def wrong_ways(sources):
    """Sentences about the imports that go another way."""
    found = []
    for name, targets in imports(sources).items():
        for target, line in sorted(targets):
            if name != DOOR and room(target)[0] and not allowed(room(name), room(target)):
                found.append(f"{name}:{line} imports {target}")
    return found


def circles(sources):
    """Sets of modules that import each other in a circle."""
    graph = {
        name: {target for target, _ in targets if target in sources} - {name}
        for name, targets in imports(sources).items()
        if name != DOOR
    }
    reach = {name: set(targets) for name, targets in graph.items()}
    changed = True
    while changed:
        changed = False
        for seen in reach.values():
            more = set().union(*(reach.get(target, set()) for target in seen)) - seen
            seen |= more
            changed = changed or bool(more)
    return {
        frozenset(other for other in reach[name] if name in reach.get(other, ()))
        for name in reach
        if name in reach[name]
    }


def test_every_room_has_a_floor():
    rooms = {room(name)[1] for name in modules() if name.startswith("codesign.")}
    assert rooms <= set(FLOOR), "say in FLOORS where the new room stands"


def test_imports_go_down():
    assert wrong_ways(modules()) == []


def test_no_files_import_each_other_in_a_circle():
    assert circles(modules()) == set()


def test_mitsuba_is_for_pictures_and_worlds():
    """`import mitsuba` stands in codesign.backend alone, which hands it out after checking what is
    installed; these ask for it."""
    importers = []
    askers = set()
    for name, source in modules().items():
        importers += [
            name for target, _ in imports({name: source})[name] if target.split(".")[0] == "mitsuba"
        ]
        for node in ast.walk(parsed(source)):
            if isinstance(node, ast.Attribute) and node.attr == "mitsuba":
                askers.add(name)
    assert importers == ["codesign.backend"]
    assert [name for name in sorted(askers) if not name.startswith(tuple(MITSUBA))] == []


def test_studies_start_without_what_their_first_frame_does_not_need():
    names = ("lens_opt", "codesign", "placement", "gradient_flow", "make_dataset", "chain_picture")
    late = {"matplotlib", "kornia", "scipy._lib._util", "sympy", "torch._dynamo"}
    script = "import sys\nfrom importlib import import_module\n"
    script += f"for name in {names}: import_module(f'studies.{{name}}.__main__')\n"
    script += "assert 'skimage' not in sys.modules\n"
    script += "from scenes.robots.pairs import PAIRS\npair = PAIRS['outdoors']()\n"
    script += "made = pair.requirements(), pair.world(0)\n"
    done = python("-c", f"{script}print({late} & sys.modules.keys())")
    assert done.stdout == "set()\n", done.stderr


@pytest.mark.parametrize(
    ("importer", "line", "right"),
    [
        ("codesign.lens.a", "from codesign.errors import DomainError", True),
        ("codesign.lens.a", "from codesign.lens import glass", True),
        ("codesign.lens.a", "from codesign import render", False),
        ("codesign.lens.a", "import codesign.flow.lk", False),
        ("codesign.events.a", "def f():\n    from codesign.mount import Mount", False),
        ("codesign.flow.a", "from codesign.events import memory", True),
        ("codesign.train.a", "import scenes.worlds", False),
        ("codesign.types", "from codesign.pose import inverse", False),
        ("scenes.a", "from codesign import train", True),
        ("scenes.a", "from studies.frame.run import Run", False),
        ("studies.a", "from studies.b import c", True),
        ("studies.frame.a", "from studies.b import c", False),
        ("studies.frame.a", "from codesign import report", True),
        ("codesign.lens.a", "import numpy", True),
    ],
)
def test_the_rule_tells_right_from_wrong(importer, line, right):
    known = dict.fromkeys(("codesign.lens.glass", "codesign.render", "codesign.train"), "")
    assert (wrong_ways({**known, importer: line}) == []) is right


def test_circles_are_found_inside_functions_too():
    sources = {
        "codesign.lens.a": "from codesign.lens import b",
        "codesign.lens.b": "def f():\n    from codesign.lens.c import g",
        "codesign.lens.c": "import codesign.lens.a",
        "codesign.lens.d": "from codesign.lens import a",
    }
    assert circles(sources) == {
        frozenset({"codesign.lens.a", "codesign.lens.b", "codesign.lens.c"})
    }
