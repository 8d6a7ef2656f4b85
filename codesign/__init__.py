"""Differentiable co-design: lens, render, event camera, event flow."""

import os

# Torch's OpenMP threads would busy-wait after each operation on the core that drjit's thread pool needs (a
# render step took 2x the CPU).
os.environ.setdefault("OMP_WAIT_POLICY", "passive")
