"""Lens files: the native JSON, .zmx, .seq, and the tables of three ray tracers. Files are parsed,
never executed."""

from codesign.lens.files.load import load, save

__all__ = ["load", "save"]
