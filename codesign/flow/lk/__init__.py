"""Event flow in closed form: coarse-to-fine Bayesian least squares on event volumes.

``estimate`` is what users call, and the place to read first. A window goes through ``path`` (the
way the scene goes within the window), ``level`` (hot pixels weighed down; one blur: what the events
say), ``polynomials`` and ``cells`` (the field and what it leaves; ``quadtree`` smooths the cells)
and ``start`` (the flow on the pixels of the window's start). What costs time runs as kernels, each
beside the same in plain torch: ``blur``, ``warp``, ``slopes``, ``quadtree``, ``start``; ``lanes``
is what they share.
"""

from codesign.flow.lk.estimate import estimate_lk

__all__ = ["estimate_lk"]
