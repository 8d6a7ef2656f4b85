"""Frames to make events of: a video, a folder of pictures, a stack of arrays, or a raw recording,
opened alike."""

from pathlib import Path

from codesign.checks import check_path
from codesign.errors import FileFormatError
from codesign.events.sources.frames import PICTURES, FrameSource

VIDEOS = (".mp4", ".avi", ".mov", ".mkv", ".webm", ".m4v", ".mpg", ".mpeg", ".wmv", ".gif")


def open_frames(path: str | Path) -> FrameSource:
    """Open a video file, a folder of pictures, a .npy or .npz stack, or a .mraw recording; frames
    are read when they are asked for.

    Args:
      path: .mp4, .avi, .mov, .mkv, .webm, .gif …; a folder of PNG, JPEG, TIFF or BMP of 8 or 16
        bits, taken in natural order (2 before 10); .npy [T, H, W] or [T, H, W, 3]; .npz with one
        such array (called ``frames`` if there are several) and, if wanted, its times as ``t_s`` or
        ``t_us``; .mraw with its .cihx or .cih beside it.
    Returns: FrameSource.
    Raises: FileFormatError when there is nothing at the path, or nothing that can be read as at
      least two frames of one size.
    """
    # readers are imported when they are asked for, with the decoders that they need
    from codesign.events.sources import folder, mraw, stack, video

    path = check_path(path)
    if path.is_dir():
        return folder.open_folder(path)
    if not path.is_file():
        raise FileFormatError(f"there is no file or folder at {path}; check the path.")
    suffix = path.suffix.lower()
    if suffix in (".npy", ".npz"):
        return stack.open_stack(path)
    if suffix == ".mraw":
        return mraw.open_mraw(path)
    if suffix in PICTURES:
        raise FileFormatError(
            f"{path} is a single picture; events need at least two: give the folder with all of them."
        )
    if suffix in VIDEOS:
        return video.open_video(path)
    raise FileFormatError(
        f"{path} ends in {path.suffix or 'nothing'!r}; frames come from a folder of pictures, .npy, .npz, "
        f".mraw, or a video: {', '.join(VIDEOS)}."
    )
