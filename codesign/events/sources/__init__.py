"""Frames from videos, folders, array stacks and high-speed recordings."""
