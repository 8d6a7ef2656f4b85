"""Public functions say the type of every parameter and of what they return; pyright holds them to
it."""

import ast
import importlib
import inspect
import textwrap
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
# a room or package that is done is added by one line
# rooms of codesign where this holds in every file
WHOLE = (
    *("atomic", "backend", "errors", "fidelity", "flow", "grad", "lens", "optimise", "mount"),
    *("plain_yaml", "pose", "report", "state", "system", "train", "types"),
)
# packages where it holds of what their __all__ names
EXPORTED = ("codesign.events", "codesign.render")
CALLED = ("__init__", "__call__")  # the special methods a user calls


def missing(source):
    """ "function.parameter" for every parameter of a public function or method without a type, and
    "function.return"."""
    found = set()

    def look(body, prefix):
        for node in body:
            name = getattr(node, "name", "_")
            public = not name.startswith("_") or name in CALLED
            if isinstance(node, ast.ClassDef) and public:
                look(node.body, f"{prefix}{name}.")
            elif isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)) and public:
                a = node.args
                given = [*a.posonlyargs, *a.args, *a.kwonlyargs, *filter(None, (a.vararg, a.kwarg))]
                bare = [
                    x.arg for x in given if x.annotation is None and x.arg not in ("self", "cls")
                ]
                bare += ["return"] if node.returns is None and name != "__init__" else []
                found.update(f"{prefix}{name}.{x}" for x in bare)

    look(ast.parse(source).body, "")
    return found


@pytest.mark.parametrize("room", WHOLE)
def test_rooms_are_annotated(room):
    files = sorted((ROOT / "codesign" / room).rglob("*.py")) or [ROOT / "codesign" / f"{room}.py"]
    assert {path.name: bare for path in files if (bare := missing(path.read_text()))} == {}


@pytest.mark.parametrize("package", EXPORTED)
def test_what_packages_export_is_annotated(package):
    module = importlib.import_module(package)
    named = [getattr(module, name) for name in module.__all__]
    ours = [v for v in named if inspect.isroutine(v) or inspect.isclass(v)]
    assert ours
    assert (
        set().union(*(missing(textwrap.dedent(inspect.getsource(value))) for value in ours))
        == set()
    )


def test_what_is_missing_is_found():
    source = (
        "def f(a, b: int, *c, d=1, **e) -> int: ...\n"
        "def g(a: int): ...\n"
        "def _h(a): ...\n"
        "class K:\n"
        "    def __init__(self, x): ...\n"
        "    def __len__(self): ...\n"
        "    @classmethod\n"
        "    def make(cls, y: int) -> 'K': ...\n"
        "class _P:\n"
        "    def m(self, x): ...\n"
    )
    assert missing(source) == {"f.a", "f.c", "f.d", "f.e", "g.return", "K.__init__.x"}
