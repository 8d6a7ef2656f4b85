"""Lens files of every format that is read."""

from codesign import lens
from tests.hostile.seeds_events import Seed, made

SEQ = """RDM\nTITLE 'x'\nEPD 10\nDIM M\nWL 587.6\nYAN 0 5\nSO 0 1e13\nS 50 4 NBK7_SCHOTT\nSTO\nCIR 8\nASP
K -1\nA 1e-7\nS -100 60; CIR 7\nPIM\nSI 0 0\n"""
TXT = """x\ntype distance roc diameter material\nO 0 0 0 AIR\nS 0 50 12 N-BK7 0.1 1e-7\nS 4 -100 12 AIR\nI 60 0 9 AIR\n"""


def saved(ending):
    name = f"lens{ending}"
    return made(name, lambda folder: lens.save(lens.load("la1509"), folder / name))


def read(path):
    """Its numbers: none of them but a radius may be infinite."""
    return [surface.thickness_mm for surface in lens.load(path).to_surfaces()[:-1]]


SEEDS: dict[str, Seed] = {
    "lens.json": (saved(".json"), read),
    "lens.zmx": (saved(".zmx"), read),
    "lens.seq": (SEQ.encode, read),
    "lens.txt": (TXT.encode, read),
}
