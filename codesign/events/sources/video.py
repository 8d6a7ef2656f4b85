"""Frames of a video file, decoded by FFmpeg one after the other, with the times that the container
gives them."""

import re
import subprocess
import tempfile
from contextlib import closing

import numpy as np
import torch

from codesign.errors import FileFormatError
from codesign.events.sources.frames import FrameSource, same_size
from codesign.optional import optional

imageio_ffmpeg = optional("imageio_ffmpeg", "video", "reading videos")
# what FFmpeg is asked for: the times of all frames, and their pictures
TIMES = "-vf scale=2:2:flags=neighbor -fps_mode passthrough -enc_time_base demux -c:v rawvideo -f framecrc -"
PICTURES = "-fps_mode passthrough -noautoscale -c:v ppm -f image2pipe -"


def open_video(path):
    """Open a video: it is decoded once to count its frames and read their times; the pictures
    themselves are decoded again when they are asked for.

    Times are exact multiples of the container's time base, also where the frame rate varies. Frames
    are those that FFmpeg decodes, in colour of 8 bits, or of 16 for videos of more than 8; none is
    repeated or left out to reach an even rate.
    Raises: FileFormatError when FFmpeg finds no video in the file, or fewer than two frames.
    """
    t_s, complaint = _times(path)
    if len(t_s) < 2:
        raise FileFormatError(f"{path} holds {len(t_s)} video frame(s); events need at least two.")
    with closing(_decode(path, 0)) as frames:
        first = next(frames)
    height, width = first.shape[:2]
    white = 255.0 if first.dtype == np.uint8 else 65535.0
    even = bool((np.diff(t_s) > 0).all())
    clock = (
        f"{path.suffix[1:].upper()} container, {(len(t_s) - 1) / t_s[-1]:.6g} frames per second on average"
        if even
        else ""
    )

    def read(start):
        yield from same_size(enumerate(_decode(path, start), start), path, first.shape, len(t_s))

    return FrameSource(
        path,
        len(t_s),
        height,
        width,
        white,
        torch.from_numpy(t_s) if even else None,
        clock,
        read,
        complaint,
    )


def _times(path):
    """[T] seconds of every frame since the first, and what the decoder complained about.

    Packets alone would be quicker to list, but a video that was cut without coding it again holds
    packets that are not shown.
    """
    command = [*_ffmpeg(path), *TIMES.split()]
    done = subprocess.run(
        command, capture_output=True, check=False, stdin=subprocess.DEVNULL, start_new_session=True
    )
    base = re.search(rb"#tb 0: (\d+)/(\d+)", done.stdout)
    ticks = np.array(
        [
            int(line.split(b",")[2])
            for line in done.stdout.splitlines()
            if not line.startswith(b"#")
        ],
        dtype=np.int64,
    )
    if done.returncode or base is None or not len(ticks):
        raise FileFormatError(
            f"{path} cannot be read as a video ({_reason(done.stderr, path)}); is it one, and whole?"
        )
    complaint = _reason(done.stderr, path) if done.stderr.strip() else ""
    # the quotient of two integers below 2^53 is rounded once: 1/3 s is the float nearest to it
    return (ticks - ticks[0]) * int(base[1]) / int(base[2]), complaint


def _decode(path, start):
    """Frames from number ``start`` on; each comes with its own header, so that its size and depth
    are known and not assumed."""
    # autoscale off: a video that changes its size is not brought to one in silence; passthrough: no
    # frame is repeated or dropped
    chosen = ["-vf", rf"select=gte(n\,{start})"] if start else []
    command = [*_ffmpeg(path), *chosen, *PICTURES.split()]
    with tempfile.TemporaryFile() as notes:
        # a group of its own: Ctrl-C then ends the run between two steps, not the decoder in the
        # middle of one
        with subprocess.Popen(
            command,
            stdout=subprocess.PIPE,
            stderr=notes,
            stdin=subprocess.DEVNULL,
            start_new_session=True,
        ) as process:
            try:
                assert process.stdout is not None
                while (frame := _picture(process.stdout)) is not None:
                    yield frame
                if process.wait():
                    notes.seek(0)
                    raise FileFormatError(
                        f"{path} cannot be decoded further ({_reason(notes.read(), path)}); use a whole "
                        "copy, or stop earlier."
                    )
            finally:
                process.kill()


def _picture(pipe):
    """The next PPM picture [H, W, 3] of a pipe, uint8 or uint16; None at its end."""
    if pipe.readline() != b"P6\n":
        return None
    width, height = map(int, pipe.readline().split())
    kind = np.dtype(np.uint8) if int(pipe.readline()) < 256 else np.dtype(">u2")
    data = pipe.read(width * height * 3 * kind.itemsize)
    if len(data) < width * height * 3 * kind.itemsize:
        return None
    return (
        np.frombuffer(data, kind)
        .reshape(height, width, 3)
        .astype(kind.newbyteorder("="), copy=False)
    )


def _ffmpeg(path):
    # "file:" keeps a name with a colon from being taken for a protocol, and the list keeps
    # playlists inside the machine
    quiet = "-v error -nostdin -protocol_whitelist file,pipe -i"
    return [imageio_ffmpeg.get_ffmpeg_exe(), *quiet.split(), f"file:{path}", "-map", "0:v:0"]


def _reason(notes, path):
    lines = [line.strip() for line in notes.decode(errors="replace").splitlines() if line.strip()]
    return (
        re.sub(r"\[[^]]*\]\s*", "", lines[0]).replace(f"file:{path}", "the file").rstrip(".")
        if lines
        else "no picture found"
    )
