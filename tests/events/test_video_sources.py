"""Videos, folders and stacks against what was put into them, and against imageio's decoding."""

import subprocess

import imageio.v3 as iio
import imageio_ffmpeg
import numpy as np
import pytest
import tifffile
import torch

from codesign.errors import FileFormatError
from codesign.events.sources.folder import read_picture
from codesign.events.sources.opening import open_frames
from tests import refusals
from tests.numbers import f64
from tests.recording_case import put

# imageio leaves FFmpeg's pipes to the garbage collector
IMAGEIO_LEAKS = pytest.mark.filterwarnings(
    "ignore::pytest.PytestUnraisableExceptionWarning", "ignore::ResourceWarning"
)


def moving(count=12, height=48, width=64):
    """[T, H, W, 3] uint8: a coloured wave that moves."""
    t, y, x = np.ogrid[:count, :height, :width]
    waves = [128 + 100 * np.sin(0.3 * x + 0.2 * y - 0.9 * t + phase) for phase in (0, 1, 2)]
    return np.stack(np.broadcast_arrays(*waves), -1).astype(np.uint8)


def ffmpeg(*arguments, given=b""):
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-v", "error", "-y", *map(str, arguments)]
    subprocess.run(command, check=True, input=given)


@pytest.fixture(scope="module")
def clip(tmp_path_factory):
    path = tmp_path_factory.mktemp("clips") / "clip.mp4"
    raw = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", "64x48", "-r", "30", "-i", "-"]
    ffmpeg(*raw, "-c:v", "libx264", "-pix_fmt", "yuv420p", path, given=moving().tobytes())
    return path


def random_frames(kind, *shape):
    whole = np.random.default_rng(0).integers(0, 256, shape)
    return (whole * 257).astype(kind) if kind == np.uint16 else whole.astype(kind)


def check_frames(path, truth, white=None, t_s=None):
    """That a source gives these frames from any one on, and says their number, size, white and
    times."""
    source = open_frames(path)
    assert (source.count, source.height_px, source.width_px) == truth.shape[:3]
    assert source.white == (white or np.iinfo(truth.dtype).max)
    for first in (0, len(truth) - 2):
        found = np.stack(list(source.read(first)))
        assert found.dtype == truth.dtype
        np.testing.assert_array_equal(found, truth[first:])
    assert (source.t_s is None) == (t_s is None)
    if t_s is not None:
        assert source.t_s.tolist() == pytest.approx(list(t_s), rel=1e-15)


@IMAGEIO_LEAKS
def test_a_video_is_decoded_as_imageio_does_from_any_frame_on(clip, tmp_path):
    # the container counts in 1/15360 s, 512 of which are a frame
    check_frames(clip, iio.imread(clip, plugin="FFMPEG"), t_s=[k / 30 for k in range(12)])
    # cut without coding it again, it has the frames that are shown
    ffmpeg("-ss", "0.2", "-i", clip, "-c", "copy", tmp_path / "cut.mp4")
    truth = iio.imread(tmp_path / "cut.mp4", plugin="FFMPEG")
    assert len(truth) < 12
    np.testing.assert_array_equal(np.stack(list(open_frames(tmp_path / "cut.mp4").read(0))), truth)


def test_uneven_frames_keep_their_times(tmp_path):
    milliseconds = [20, 50, 30, 100, 40, 70]
    iio.imwrite(tmp_path / "e.gif", moving(6), plugin="pillow", duration=milliseconds, loop=0)
    source = open_frames(tmp_path / "e.gif")
    assert torch.equal(source.t_s, f64([0, 2, 7, 10, 20, 24]) / 100)
    assert np.stack(list(source.read(0))).shape == (6, 48, 64, 3)


def test_a_lossless_video_of_ten_bits_comes_back_with_all_of_them(tmp_path):
    gray = (np.arange(48 * 64).reshape(1, 48, 64) + 100 * np.arange(3)[:, None, None]) % 1024
    raw = ["-f", "rawvideo", "-pix_fmt", "gray10le", "-s", "64x48", "-r", "25", "-i", "-"]
    lossless = ["-c:v", "ffv1", "-pix_fmt", "gray10le", tmp_path / "ten.mkv"]
    ffmpeg(*raw, *lossless, given=gray.astype("<u2").tobytes())
    found = np.stack(list(open_frames(tmp_path / "ten.mkv").read(0)))
    assert found.dtype == np.uint16
    # full scale to full scale, to two steps of the ten bits: the converter works with tables of
    # limited precision
    truth = np.repeat(gray[..., None], 3, -1) / 1023
    np.testing.assert_allclose(found / 65535, truth, atol=2 / 1023)


@pytest.mark.parametrize(
    ("suffix", "kind", "colour"),
    [
        (".png", np.uint8, True),
        (".png", np.uint16, False),
        (".tif", np.uint8, False),
        (".tif", np.uint16, True),
        (".bmp", np.uint8, True),
    ],
)
def test_lossless_folders_come_back_bit_for_bit_in_natural_order(tmp_path, suffix, kind, colour):
    frames = random_frames(kind, 12, 5, 7, *[3] * colour)
    options = {"plugin": "tifffile", "photometric": "rgb"} if suffix == ".tif" and colour else {}
    for index, frame in enumerate(frames, start=1):
        iio.imwrite(tmp_path / f"frame{index}{suffix}", frame, **options)
    (tmp_path / "notes.txt").write_text("not a frame")
    check_frames(tmp_path, frames)


def test_tiffs_mean_what_their_tag_says(tmp_path):
    def stored(frame, **tags):
        tifffile.imwrite(tmp_path / "a.tif", frame, **tags)
        return read_picture(tmp_path / "a.tif")

    gray = random_frames(np.uint8, 4, 6)
    for frame in (gray, gray.astype(np.uint16) * 200):
        full = np.iinfo(frame.dtype).max
        np.testing.assert_array_equal(stored(full - frame, photometric="miniswhite"), frame)
    black = gray > 99
    for name, sign in (("minisblack", 1), ("miniswhite", -1)):
        found = stored(black if sign > 0 else ~black, photometric=name)
        np.testing.assert_array_equal(found, 255 * black)
    colours = random_frames(np.uint16, 3, 256)
    np.testing.assert_array_equal(
        stored(gray, photometric="palette", colormap=colours), colours.T[gray]
    )
    for tags in ({"photometric": "ycbcr"}, {"photometric": "rgb", "extratags": [(274, 3, 1, 6)]}):
        with pytest.raises(FileFormatError, match="save it upright as gray, palette or RGB"):
            stored(np.repeat(gray[..., None], 3, -1), **tags)


@pytest.mark.parametrize("kind", [np.uint8, np.uint16, np.float32, np.float64])
def test_stacks_come_back_bit_for_bit_with_their_times(tmp_path, kind):
    stack = random_frames(kind, 9, 4, 5)
    t_us = np.arange(9) * 700 + 1_700_000_000_000_000
    white = 65535.0 if kind == np.uint16 else 255.0
    np.save(tmp_path / "a.npy", stack)
    check_frames(tmp_path / "a.npy", stack, white)
    np.savez_compressed(tmp_path / "b.npz", frames=stack, t_us=t_us, other=stack[:, :2])
    check_frames(tmp_path / "b.npz", stack, white, t_us / 1e6)
    colour = np.repeat(stack[..., None], 3, -1)
    np.savez(tmp_path / "c.npz", only=colour, t_s=np.arange(9) / 3)
    check_frames(tmp_path / "c.npz", colour, white, np.arange(9) / 3)


CIH = """#Camera Information Header
Record Rate(fps) : 500
Total Frame : 3
Image Width : 6
Image Height : 4
Color Bit : 12
EffectiveBit Depth : 12
EffectiveBit Side : Lower
"""


def test_twelve_packed_bits_are_unpacked(tmp_path):
    path = tmp_path / "a.mraw"
    values = np.random.default_rng(0).integers(0, 4096, (3, 4, 6)).astype(np.uint16)
    # three hexadecimal digits a value
    packed = bytes.fromhex("".join(f"{value:03x}" for value in values.flatten()))
    path.write_bytes(packed)
    path.with_suffix(".cih").write_text(CIH)
    check_frames(path, values, 4095.0, [0, 1 / 500, 2 / 500])
    path.write_bytes(packed[:-1])
    with pytest.raises(FileFormatError, match=r"107 bytes.*are 108"):
        open_frames(path)
    path.with_suffix(".cih").unlink()
    with pytest.raises(FileFormatError, match="no description"):
        open_frames(path)


def test_a_real_recording_is_what_is_known_of_it(shared):
    ball = open_frames(shared("data/highspeed/ball_12bit.mraw"))
    frames = np.stack(list(ball.read(0)))
    assert frames.shape == (15, 384, 384)
    assert (frames.min(), frames.max(), ball.white) == (84, 4095, 4095.0)
    assert ball.t_s[1] == 1 / 30_000
    # the disc above the floor falls by a steady 2.65 pixels per frame
    rows = np.array([np.nonzero(frame[:280] < 1000)[0].mean() for frame in frames])
    np.testing.assert_allclose(np.diff(rows), 2.65, atol=0.1)


GRAY, COLOUR = np.zeros((4, 5), np.uint8), np.zeros((4, 5, 3), np.uint8)
CLEAR = np.zeros((4, 5, 4), np.uint8)
DEEP = b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR" + b"\0\0\0\1" * 2 + bytes([16, 2, 0, 0, 0]) + b"\0" * 20


@refusals.table(__file__, "no sources of frames")
def test_what_is_no_source_is_refused_with_a_reason(row, tmp_path):
    def frames(name, content):
        """Content: bytes, or an array; of a folder, name -> bytes or picture."""
        if content is not None:
            put(tmp_path / name, content)
        return list(open_frames(tmp_path / name).read(0))

    row.holds(globals() | {"frames": frames})


def test_a_cut_video_and_sound_alone_are_refused(clip, tmp_path):
    (tmp_path / "half.mp4").write_bytes(clip.read_bytes()[:-2000])
    ffmpeg("-f", "lavfi", "-i", "sine=duration=0.1", tmp_path / "sound.mkv")
    for name, words in (("half.mp4", "video|decoded"), ("sound.mkv", "as a video")):
        with pytest.raises(FileFormatError, match=words):
            list(open_frames(tmp_path / name).read(0))
