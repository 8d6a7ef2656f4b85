"""Differentiable co-design: lens, render, event camera, event flow."""
