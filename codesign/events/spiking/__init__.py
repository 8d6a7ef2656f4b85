"""Spiking event generators: the two-branch network of the thesis, Spike-ESIM, and the losses they
are trained with."""
