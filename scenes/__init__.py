"""Worlds and trajectories, as plain builders; no training code."""
