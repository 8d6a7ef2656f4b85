"""Frames between frames, along the flow, before events are made of them."""
