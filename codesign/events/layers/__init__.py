"""Differentiable event layers, from the sigmoid to the full sensor."""
