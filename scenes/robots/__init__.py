"""Robots that carry a camera: from URDF files (``from_urdf``), and as pairs of a robot and the
worlds it moves through (``pair``, by name in ``pairs``), your own too (``own``, from a page as
``page`` has it)."""

from codesign.doors import explain
from scenes.robots.urdf import ROVER, T_LINK_OPTICAL, Robot, from_urdf

__all__ = ["ROVER", "T_LINK_OPTICAL", "Robot", "from_urdf"]

explain(globals())
