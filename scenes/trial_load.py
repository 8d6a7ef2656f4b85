"""What Mitsuba would read is read before it, and once in a process of its own: some of it would end
the process.

Mitsuba's readers in C++ meet a bitmap without a file, or damaged bytes, with more than an error.
"""

import json
import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from codesign.errors import FileFormatError
from codesign.reading import note, open_regular
from scenes import rgbe

LONGEST_S = 600.0
SURVIVED: set[tuple[Any, ...]] = set()  # what was tried, with size and time of every file
SOURCES = ("filename", "bitmap", "data")  # of which a bitmap has one
# errors end well: they come again, in words, where the scene is loaded for use
TRIAL = """import sys, json, drjit, mitsuba
drjit.set_thread_count(max(2, drjit.thread_count()))  # one alone waits for another to read OpenEXR
variant, file, parameters, named = json.loads(sys.argv[1])
mitsuba.set_variant(variant)
for kind, name in named:
    try:
        mitsuba.load_dict({"type": kind, "filename": name})
    except Exception:
        pass
try:
    file and mitsuba.load_file(file, **parameters)
except Exception:
    pass
print("ended well")"""


def check(
    mi: Any,
    state: Any,
    file: Path | None = None,
    parameters: Iterable[tuple[str, Any]] = (),
) -> None:
    """Refuse a parsed scene (mi.parser.ParserState) that Mitsuba would not survive.

    Args:
      file, parameters: where it was parsed from, if from a file; that is loaded as a whole, and
        what a dictionary names one by one.
    Raises: FileFormatError for a bitmap without a file, for a damaged .hdr, .exr or mesh that is
      named, and whatever else ends Mitsuba, or takes it more than LONGEST_S.
    """
    named = []
    for node in state.nodes:
        kind, values = node.props.plugin_name(), node.props
        if kind == "bitmap" and not any(key in values for key in SOURCES):
            raise FileFormatError(
                "a bitmap of the scene names no file; give its filename, or take it out."
            )
        name = values.get("filename", None)
        if isinstance(name, str):
            beside = [Path(str(each)).parent / name for each in state.files] or [Path(name)]
            named += [(kind, str(path)) for path in beside if path.is_file()][:1]
    texts = {name: str(value) for name, value in dict(parameters).items()}
    asked = json.dumps([mi.variant(), file and str(file), texts, [] if file else named])
    files = [Path(name) for _, name in named] + [Path(str(each)) for each in state.files]
    facts = [
        (str(each), each.stat().st_size, each.stat().st_mtime_ns)
        for each in files
        if each.is_file()
    ]
    tried = (TRIAL, asked, *facts)
    note(each for each in files if each.is_file())
    if (file is None and not named) or tried in SURVIVED:
        return
    for kind, name in named:
        with open_regular(name) as opened:
            begin = opened.read(2)
        # Mitsuba goes by the first bytes, not by the ending; a reader that writes past its end may
        # go on for a while, so a trial would not always tell
        if begin == b"#?" and kind in ("bitmap", "envmap"):
            rgbe.radiance(name)
    try:
        done = subprocess.run(
            [sys.executable, "-c", TRIAL, asked],
            capture_output=True,
            timeout=LONGEST_S,
            check=False,
        )
    except subprocess.TimeoutExpired:
        raise FileFormatError(
            f"Mitsuba does not load the scene within {LONGEST_S:g} s; make it smaller."
        ) from None
    if b"ended well" not in done.stdout:
        raise FileFormatError(
            "Mitsuba itself ends while it reads the scene, so something it names is damaged "
            f"({', '.join(name for _, name in named)[:200] or 'no file is named'}); export it anew."
        )
    SURVIVED.add(tried)
