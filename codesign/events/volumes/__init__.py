"""Events on grids: volumes, time surfaces, fading traces, spike tensors."""
