"""Frames between the frames of a video, where --upsample asks for them, in the memory of one interval."""

import torch

from codesign.events.upsampling.upsample import upsample_stream


def pieces(max_displacement_px, before, before_s, seen, t_s):
    """What the sensor sees of a chunk: frames [n, H, W] and their times, piece by piece.

    Args:
      max_displacement_px: see ``codesign.events.upsampling.upsample``; None: the frames as they are, in one
        piece.
      before, before_s: last frame [H, W] of the chunk before and its time; None for the first chunk.
      seen: [N, H, W] frames of the chunk. t_s: [N] seconds.
    The pieces of all chunks together do not depend on where the chunks begin.
    """
    if max_displacement_px is None:
        yield seen, t_s
        return
    given = [*seen] if before is None else [before.to(seen), *seen]
    times = t_s.tolist() if before is None else [before_s, *t_s.tolist()]
    kept_frames = []
    kept_s = []
    for number, (frames, times_s) in enumerate(
        upsample_stream(given, times, max_displacement_px=max_displacement_px)
    ):
        if before is not None and number == 0:
            continue  # the sensor has seen it
        if before is None and number == 0:
            # a sensor wants two frames at first
            kept_frames = [frames]
            kept_s = [times_s]
            continue
        yield torch.cat([*kept_frames, frames]), torch.cat([*kept_s, times_s])
        kept_frames = []
        kept_s = []
