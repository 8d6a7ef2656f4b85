"""The process that reads mutants: ``python -m tests.hostile.reader MODULE NAME SEED FIRST COUNT``.

It says on stdout, a line of JSON each, which mutant comes next and what was found. A mutant may
take ten seconds of the processor and a gigabyte; it ends in one sentence of ours, or in a value
that has a meaning.
"""

import dataclasses
import faulthandler
import importlib
import json
import logging
import os
import signal
import sys
import tempfile
import traceback
import warnings
import zlib
from pathlib import Path

import numpy as np
import torch

from codesign.errors import CodesignError
from codesign.types import EventStream
from tests.hostile.mutate import mutant

SECONDS = 10
MOST_BYTES = 2**30
MOST_SENTENCE = 1000


class Slow(BaseException):
    """Raised by the alarm; no reader catches it."""


def limit():
    """A gigabyte more than what is mapped now."""
    try:
        import resource
    except ImportError:  # Windows: the parent ends what hangs
        return
    mapped = int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
    resource.setrlimit(resource.RLIMIT_AS, (mapped + MOST_BYTES, resource.RLIM_INFINITY))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))


def late(*_):
    """What the timer of the processor calls: a busy machine is no reader's doing. The parent ends
    what waits."""
    raise Slow


def meaningless(value, depth=0):
    """What is wrong with a value that was read, or "": numbers are finite, events an ordered stream
    of a sensor."""
    if isinstance(value, EventStream):
        from codesign.events.stream import check_stream

        try:
            check_stream(value)
        except CodesignError as error:
            return str(error)
        large = max(value.height_px, value.width_px) > 2**15
        return f"a sensor of {value.height_px} rows" if large else ""
    if isinstance(value, torch.nn.Module):
        value = value.state_dict()
    if isinstance(value, torch.Tensor):
        value = value.detach().cpu().numpy() if value.layout == torch.strided else None
    if isinstance(value, np.ndarray | np.generic | float | complex):
        array = np.asarray(value)
        wrong = array.dtype.kind in "fc" and not np.isfinite(array).all()
        return "a number that is not finite" if wrong else ""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        value = [getattr(value, field.name) for field in dataclasses.fields(value)]
    if isinstance(value, dict):
        value = list(value.values())
    if isinstance(value, list | tuple) and depth < 8:
        return next((found for part in value if (found := meaningless(part, depth + 1))), "")
    return ""


def judged(path, reader):
    """("", "") for a sentence or a value with a meaning; else (kind, what was found)."""
    try:
        signal.signal(signal.SIGPROF, late)
        signal.setitimer(signal.ITIMER_PROF, SECONDS)
        value = reader(path)
        found = meaningless(value)
        return ("meaning", found) if found else ("", "")
    except Slow:
        return "slow", f"more than {SECONDS} s"
    except CodesignError as error:
        cause = error
        while cause is not None:
            if isinstance(cause, MemoryError):
                return "memory", str(error)[:300]
            cause = cause.__cause__ or cause.__context__
        said = str(error)
        wrong = "\n" in said.strip() or not said.strip() or len(said) > MOST_SENTENCE
        return ("sentence", said[:300]) if wrong else ("", "")
    except BaseException as error:  # noqa: BLE001 - what is looked for
        where = traceback.extract_tb(error.__traceback__)[-1]
        place = f"{Path(where.filename).name}:{where.lineno}"
        return "foreign", f"{type(error).__name__}: {str(error)[:200]} ({place})"
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)


def seed_of(module, name):
    """(content, reader) of a seed."""
    maker, reader = importlib.import_module(module).SEEDS[name]
    return maker(), reader


def numbered(content, name, seed, index):
    """Mutant number ``index``; 0 is the file itself."""
    dice = np.random.default_rng([seed, zlib.crc32(name.encode()), index])
    return mutant(content, dice) if index else content


def main(module, name, seed, first, count):
    """Read mutants of one seed, or of every seed of the module where ``name`` is "all"."""
    faulthandler.enable()
    warnings.simplefilter("ignore")
    logging.disable()
    torch.set_num_threads(1)
    for each in importlib.import_module(module).SEEDS if name == "all" else [name]:
        content, reader = seed_of(module, each)
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / each
            path.write_bytes(content)
            value = reader(path)  # what it imports and compiles is no mutant's doing
            assert not meaningless(value), f"{each} itself: {meaningless(value)}"
            limit()
            for index in range(int(first), int(first) + int(count)):
                print(json.dumps({"next": index, "name": each}), flush=True)
                path.write_bytes(numbered(content, each, int(seed), index))
                kind, found = judged(path, reader)
                if kind:
                    told = {"index": index, "name": each, "kind": kind, "found": found}
                    print(json.dumps(told), flush=True)
    print(json.dumps({"done": True}), flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
