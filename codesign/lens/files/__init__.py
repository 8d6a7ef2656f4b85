"""Lens files: the native JSON, .zmx, .seq, and the tables of three ray tracers. Files are parsed, never
executed."""

from codesign.lens.files.reading import load
from codesign.lens.files.writing import save

__all__ = ["load", "save"]
