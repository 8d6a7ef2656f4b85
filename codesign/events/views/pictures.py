"""Events as pictures: red and blue, gray, rates over time, and videos of them, written one by
one."""

from collections.abc import Iterable
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from codesign.atomic import replacing
from codesign.checks import FLOATS, check, check_number, check_positive
from codesign.errors import FileFormatError, ShapeError
from codesign.events.entry import Times, check_counts, check_times
from codesign.events.stream import to_counts
from codesign.events.volumes.surface import decay
from codesign.optional import optional
from codesign.types import EventStream

iio = optional("imageio.v3", "video", "writing .gif")
imageio_ffmpeg = optional("imageio_ffmpeg", "video", "writing .mp4")
# small frames are enlarged until their shorter side reaches this, so that single pixels can be
# seen,
LEAST_SIDE_PX = 256
LARGEST_SIDE_PX = 1280  # unless the longer one would exceed this


def picture(counts: Tensor, full_scale: float | None = None) -> Tensor:
    """Event frames as colour pictures: white where nothing happened, red for ON, blue for OFF,
    purple for both.

    Args:
      counts: [..., 2, H, W] counts >= 0, ON first.
      full_scale: count of full colour, > 0; None: the largest count, at least 1.
    Returns: [..., H, W, 3] uint8.
    Raises: ShapeError for other axes; DomainError for counts that are negative or not finite.
    """
    on, off, full = _scaled(counts, full_scale)
    strength = torch.maximum(on, off).div(full).clamp(max=1)
    red = on / (on + off).clamp(min=torch.finfo(on.dtype).tiny)
    colour = torch.stack((red, torch.zeros_like(red), 1 - red), dim=-1)
    return (255 * (1 - strength[..., None] * (1 - colour))).round().to(torch.uint8)


def gray_picture(counts: Tensor, full_scale: float | None = None) -> Tensor:
    """Event frames as gray pictures: middle gray where ON and OFF balance, white for ON, black for
    OFF.

    Args: as for ``picture``.
    Returns: [..., H, W] uint8, 128 for no event.
    """
    on, off, full = _scaled(counts, full_scale)
    return (128 + 127 * ((on - off) / full).clamp(-1, 1)).round().to(torch.uint8)


def rates(counts: Tensor, t_s: Times) -> tuple[Tensor, Tensor]:
    """Event rate of the whole picture over time, per polarity.

    Args:
      counts: [T-1, 2, H, W].
      t_s: [T] seconds, strictly increasing.
    Returns: middle of each interval [T-1], seconds, and rate [T-1, 2], events per second, ON first.
    """
    check_counts(counts)
    times_s = check_times(t_s, len(counts) + 1)
    totals = counts.detach().flatten(2).sum(-1).cpu().double()
    return (times_s[1:] + times_s[:-1]) / 2, totals / times_s.diff()[:, None]


def _scaled(counts, full_scale):
    check(counts, "... 2 H W", "counts (ON first)", FLOATS, least=0.0, finite=True)
    counts = counts.detach()
    if full_scale is None:
        full_scale = max(1.0, float(counts.max()))
    else:
        full_scale = check_positive(full_scale, "full_scale")
    return counts[..., 0, :, :], counts[..., 1, :, :], full_scale


def write_video(path: str | Path, pictures: Iterable[Any], fps: float) -> None:
    """Write pictures as a video; small ones are enlarged by whole factors, odd sizes get one more
    row or column of their edge.

    Args:
      path: file ending in .mp4 (H.264) or .gif.
      pictures: [N, H, W, 3] or [N, H, W] uint8, N >= 1; or anything that yields such pictures one
        after the other (an MP4 then needs the memory of one).
      fps: pictures per second, > 0 (a GIF keeps hundredths of a second: at most 50).
    Raises: FileFormatError for another extension or a folder that is not writable; ShapeError,
      DomainError for anything but such pictures.
    """
    path = Path(path)
    check_number(fps, "fps", above=0.0, most=1000.0)
    if path.suffix.lower() not in (".mp4", ".gif"):
        raise FileFormatError(
            f"{path} ends in {path.suffix or 'nothing'!r}; videos end in .mp4 or .gif."
        )
    ready = _prepared(pictures)
    first = next(ready, None)
    if first is None:
        raise ShapeError("no picture given; a video needs at least one, uint8 [H, W, 3] or [H, W].")
    with replacing(path) as temporary:
        if path.suffix.lower() == ".mp4":
            size = (first.shape[1], first.shape[0])
            with closing(
                imageio_ffmpeg.write_frames(
                    str(temporary),
                    size,
                    fps=fps,  # pyright: ignore[reportArgumentType]  (it takes any number)
                    codec="libx264",
                    quality=8,
                    macro_block_size=2,
                )
            ) as file:
                file.send(None)
                file.send(np.ascontiguousarray(first))
                for each in ready:
                    file.send(np.ascontiguousarray(each))
        else:
            iio.imwrite(
                temporary, np.stack([first, *ready]), plugin="pillow", duration=1000 / fps, loop=0
            )


def decay_video(
    path: str | Path,
    events: EventStream | Tensor,
    t_s: Times,
    tau_s: float,
    *,
    fps: float = 25,
    full_scale: float | None = None,
) -> None:
    """Write the exponential-decay video of events: red ON and blue OFF traces that fade.

    Args:
      path: file ending in .mp4 or .gif.
      events: EventStream, or counts [T-1, 2, H, W] per interval.
      t_s: [T] seconds; one picture per interval.
      tau_s: fading time, seconds. fps: pictures per second of the video. full_scale: as for
        ``picture``.
    """
    counts = to_counts(events, t_s) if isinstance(events, EventStream) else events.detach()
    write_video(path, picture(decay(counts, t_s, tau_s), full_scale), fps)


def _prepared(pictures):
    """Colour pictures of even size, enlarged; each is checked as it comes."""
    size = None
    for index, given in enumerate(pictures):
        each = np.asarray(given.cpu() if hasattr(given, "cpu") else given)
        if (
            each.dtype != np.uint8
            or each.ndim not in (2, 3)
            or 0 in each.shape
            or (each.ndim == 3 and each.shape[-1] != 3)
        ):
            raise ShapeError(
                f"picture {index} is {each.dtype} {list(each.shape)}; uint8 [H, W, 3] or [H, W] is needed."
            )
        if size is not None and each.shape != size:
            raise ShapeError(
                f"picture {index} has shape {list(each.shape)}, those before {list(size)}; a video has one "
                "size."
            )
        size = each.shape
        colour = np.repeat(each[..., None], 3, axis=-1) if each.ndim == 2 else each
        factor = max(1, min(-(-LEAST_SIDE_PX // min(size[:2])), LARGEST_SIDE_PX // max(size[:2])))
        large = colour.repeat(factor, axis=0).repeat(factor, axis=1)
        yield np.pad(large, ((0, large.shape[0] % 2), (0, large.shape[1] % 2), (0, 0)), mode="edge")
