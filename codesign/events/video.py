"""Pictures to MP4 or GIF, and the exponential-decay video of events."""

from pathlib import Path

import imageio.v3 as iio
import numpy as np
import torch

from codesign.atomic import replacing
from codesign.errors import DomainError, FileFormatError, ShapeError
from codesign.events.stream import to_counts
from codesign.events.view import decay, picture
from codesign.types import EventStream

LEAST_SIDE_PX = 256  # small frames are enlarged until their shorter side reaches this, so that single pixels can be seen


def write_video(path, pictures, fps):
    """Write pictures as a video; small ones are enlarged by whole factors, odd sizes get one more row or column of their edge.

    Args:
      path: file ending in .mp4 (H.264) or .gif.
      pictures: [N, H, W, 3] or [N, H, W] uint8.
      fps: pictures per second, > 0 (a GIF keeps hundredths of a second: at most 50).
    Raises: FileFormatError for another extension or a folder that is not writable; ShapeError, DomainError for anything but such pictures.
    """
    path = Path(path)
    pictures = np.asarray(torch.as_tensor(pictures).cpu())
    if pictures.dtype != np.uint8 or pictures.ndim not in (3, 4) or 0 in pictures.shape or (pictures.ndim == 4 and pictures.shape[-1] != 3):
        raise ShapeError(f"pictures are {pictures.dtype} {list(pictures.shape)}; uint8 [N, H, W, 3] or [N, H, W] is needed.")
    if not 0 < fps <= 1000:
        raise DomainError(f"fps is {fps!r}; pictures per second, above 0 and up to 1000, are needed.")
    if path.suffix.lower() not in (".mp4", ".gif"):
        raise FileFormatError(f"{path} ends in {path.suffix or 'nothing'!r}; videos end in .mp4 or .gif.")
    if pictures.ndim == 3:
        pictures = np.repeat(pictures[..., None], 3, axis=-1)
    factor = max(1, -(-LEAST_SIDE_PX // min(pictures.shape[1:3])))
    pictures = pictures.repeat(factor, axis=1).repeat(factor, axis=2)
    pictures = np.pad(pictures, ((0, 0), (0, pictures.shape[1] % 2), (0, pictures.shape[2] % 2), (0, 0)), mode="edge")
    with replacing(path) as temporary:
        if path.suffix.lower() == ".mp4":
            iio.imwrite(temporary, pictures, plugin="FFMPEG", fps=fps, codec="libx264", quality=8, macro_block_size=2)
        else:
            iio.imwrite(temporary, pictures, plugin="pillow", duration=1000 / fps, loop=0)


def decay_video(path, events, t_s, tau_s, *, fps=25, full_scale=None):
    """Write the exponential-decay video of events: red ON and blue OFF traces that fade.

    Args:
      path: file ending in .mp4 or .gif.
      events: EventStream, or counts [T-1, 2, H, W] per interval.
      t_s: [T] seconds; one picture per interval.
      tau_s: fading time, seconds. fps: pictures per second of the video. full_scale: as for ``picture``.
    """
    counts = to_counts(events, t_s) if isinstance(events, EventStream) else events.detach()
    write_video(path, picture(decay(counts, t_s, tau_s), full_scale), fps)
