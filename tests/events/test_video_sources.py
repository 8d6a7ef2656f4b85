"""Videos, folders and stacks against what was put into them, and against imageio's decoding."""

import subprocess

import imageio.v3 as iio
import imageio_ffmpeg
import numpy as np
import pytest
import torch

from codesign.errors import FileFormatError
from codesign.events.sources.opening import open_frames

# imageio leaves FFmpeg's pipes to the garbage collector
IMAGEIO_LEAKS = pytest.mark.filterwarnings(
    "ignore::pytest.PytestUnraisableExceptionWarning", "ignore::ResourceWarning"
)


def moving(count=12, height=48, width=64):
    """[T, H, W, 3] uint8: a coloured wave that moves."""
    t, y, x = np.ogrid[:count, :height, :width]
    waves = [128 + 100 * np.sin(0.3 * x + 0.2 * y - 0.9 * t + phase) for phase in (0, 1, 2)]
    return np.stack(np.broadcast_arrays(*waves), -1).astype(np.uint8)


def ffmpeg(*arguments):
    subprocess.run(
        [imageio_ffmpeg.get_ffmpeg_exe(), "-v", "error", "-y", *map(str, arguments)],
        check=True,
        stdin=subprocess.DEVNULL,
    )


@pytest.fixture(scope="module")
def clip(tmp_path_factory):
    path = tmp_path_factory.mktemp("clips") / "clip.mp4"
    writer = imageio_ffmpeg.write_frames(str(path), (64, 48), fps=30, codec="libx264", macro_block_size=2)
    writer.send(None)
    for frame in moving():
        writer.send(np.ascontiguousarray(frame))
    writer.close()
    return path


def frames_of(path, start=0):
    return np.stack(list(open_frames(path).read(start)))


@IMAGEIO_LEAKS
def test_a_video_is_decoded_as_imageio_does_from_any_frame_on(clip):
    truth = iio.imread(clip, plugin="FFMPEG")
    source = open_frames(clip)
    assert (source.count, source.height_px, source.width_px, source.white, source.complaint) == (
        12,
        48,
        64,
        255.0,
        "",
    )
    np.testing.assert_array_equal(frames_of(clip), truth)
    np.testing.assert_array_equal(frames_of(clip, 7), truth[7:])
    # the nearest floats to n/30: the container counts in 1/15360 s, 512 of which are a frame
    assert source.t_s is not None
    assert torch.equal(source.t_s, torch.arange(12, dtype=torch.float64) * 512 / 15360)


@IMAGEIO_LEAKS
def test_a_video_cut_without_coding_it_again_has_the_frames_that_are_shown(clip, tmp_path):
    ffmpeg("-ss", "0.2", "-i", clip, "-c", "copy", tmp_path / "cut.mp4")
    truth = iio.imread(tmp_path / "cut.mp4", plugin="FFMPEG")
    assert len(truth) < 12
    np.testing.assert_array_equal(frames_of(tmp_path / "cut.mp4"), truth)


def test_uneven_frames_keep_their_times(tmp_path):
    pictures = moving(6)
    hundredths = [2, 5, 3, 10, 4, 7]
    iio.imwrite(
        tmp_path / "e.gif", pictures, plugin="pillow", duration=[10 * each for each in hundredths], loop=0
    )
    source = open_frames(tmp_path / "e.gif")
    assert source.t_s is not None
    assert torch.equal(source.t_s, torch.tensor([0, 2, 7, 10, 20, 24], dtype=torch.float64) / 100)
    assert frames_of(tmp_path / "e.gif").shape == (6, 48, 64, 3)


def test_a_lossless_video_of_ten_bits_comes_back_with_all_of_them(tmp_path):
    gray = (
        np.arange(48 * 64, dtype=np.uint16).reshape(1, 48, 64)
        + 100 * np.arange(3, dtype=np.uint16)[:, None, None]
    ) % 1024
    (tmp_path / "raw").write_bytes(gray.astype("<u2").tobytes())
    raw = ["-f", "rawvideo", "-pix_fmt", "gray10le", "-s", "64x48", "-r", "25", "-i", tmp_path / "raw"]
    ffmpeg(*raw, "-c:v", "ffv1", "-pix_fmt", "gray10le", tmp_path / "ten.mkv")
    found = frames_of(tmp_path / "ten.mkv")
    assert found.dtype == np.uint16
    # full scale to full scale, to two steps of the ten bits: the converter works with tables of limited
    # precision
    np.testing.assert_allclose(found / 65535, np.repeat(gray[..., None], 3, -1) / 1023, atol=2 / 1023)


KINDS = [(".png", np.uint8), (".png", np.uint16), (".tif", np.uint8), (".tif", np.uint16), (".bmp", np.uint8)]


@pytest.mark.parametrize(
    ("suffix", "kind", "colour"),
    [
        (*kind, colour)
        for kind in KINDS
        for colour in (False, True)
        if (*kind, colour) != (".png", np.uint16, True)
    ],
)
def test_lossless_folders_come_back_bit_for_bit_in_natural_order(tmp_path, suffix, kind, colour):
    frames = np.random.default_rng(0).integers(
        0, np.iinfo(kind).max, (12, 5, 7, *((3,) if colour else ())), dtype=kind, endpoint=True
    )
    for index, frame in enumerate(frames, start=1):
        options = (
            {"plugin": "tifffile", **({"photometric": "rgb"} if colour else {})}
            if suffix == ".tif"
            else {"plugin": "pillow"}
        )
        iio.imwrite(tmp_path / f"frame{index}{suffix}", frame, **options)
    (tmp_path / "notes.txt").write_text("not a frame")
    source = open_frames(tmp_path)
    assert (source.count, source.white, source.t_s) == (12, float(np.iinfo(kind).max), None)
    np.testing.assert_array_equal(frames_of(tmp_path), frames)
    np.testing.assert_array_equal(frames_of(tmp_path, 9), frames[9:])


@pytest.mark.parametrize("kind", [np.uint8, np.uint16, np.float32, np.float64])
def test_stacks_come_back_bit_for_bit_with_their_times(tmp_path, kind):
    stack = (np.random.default_rng(0).random((9, 4, 5)) * 255).astype(kind)
    t_us = np.arange(9) * 700 + 1_700_000_000_000_000
    np.save(tmp_path / "a.npy", stack)
    np.savez_compressed(tmp_path / "b.npz", frames=stack, t_us=t_us, other=stack[:, :2])
    np.savez(tmp_path / "c.npz", only=np.repeat(stack[..., None], 3, -1), t_s=np.arange(9) / 3)
    for name in ("a.npy", "b.npz"):
        np.testing.assert_array_equal(frames_of(tmp_path / name), stack)
        np.testing.assert_array_equal(frames_of(tmp_path / name, 4), stack[4:])
    np.testing.assert_array_equal(frames_of(tmp_path / "c.npz"), np.repeat(stack[..., None], 3, -1))
    b = open_frames(tmp_path / "b.npz").t_s
    c = open_frames(tmp_path / "c.npz").t_s
    assert b is not None
    assert (b * 1e6).round().long().tolist() == t_us.tolist()
    assert c is not None
    assert c.tolist() == (np.arange(9) / 3).tolist()


def test_twelve_packed_bits_are_unpacked(tmp_path):
    values = np.random.default_rng(0).integers(0, 4096, (3, 4, 6))
    packed = int("".join(f"{value:03x}" for value in values.flatten()), 16).to_bytes(
        values.size * 3 // 2, "big"
    )  # three hexadecimal digits a value
    (tmp_path / "a.mraw").write_bytes(packed)
    fields = {
        "Record Rate(fps)": 500,
        "Total Frame": 3,
        "Image Width": 6,
        "Image Height": 4,
        "Color Bit": 12,
        "EffectiveBit Depth": 12,
        "EffectiveBit Side": "Lower",
    }
    (tmp_path / "a.cih").write_text(
        "#Camera Information Header\n" + "".join(f"{name} : {value}\n" for name, value in fields.items())
    )
    source = open_frames(tmp_path / "a.mraw")
    assert source.t_s is not None
    assert (source.white, source.t_s.tolist()) == (4095.0, [0, 1 / 500, 2 / 500])
    np.testing.assert_array_equal(frames_of(tmp_path / "a.mraw"), values)
    (tmp_path / "a.mraw").write_bytes(packed[:-1])
    with pytest.raises(FileFormatError, match=r"107 bytes.*are 108"):
        open_frames(tmp_path / "a.mraw")
    (tmp_path / "a.cih").unlink()
    with pytest.raises(FileFormatError, match="no description"):
        open_frames(tmp_path / "a.mraw")


def test_real_recordings_are_what_is_known_of_them(shared):
    ball = open_frames(shared("data/highspeed/ball_12bit.mraw"))
    frames = np.stack(list(ball.read(0)))
    assert frames.shape == (15, 384, 384)
    assert (frames.min(), frames.max(), ball.white) == (84, 4095, 4095.0)
    assert ball.t_s is not None
    assert float(ball.t_s[1]) == 1 / 30_000
    # the disc above the floor falls by a steady 2.65 pixels per frame
    rows = np.array([np.nonzero(frame[:280] < 1000)[0].mean() for frame in frames])
    np.testing.assert_allclose(np.diff(rows), 2.65, atol=0.1)
    beam = open_frames(shared("data/highspeed/data_showcase.mraw"))
    assert (beam.count, beam.height_px, beam.width_px, beam.white) == (75, 40, 640, 255.0)


def test_what_is_no_source_is_refused_with_a_reason(clip, tmp_path):
    def folder(name, **pictures):
        (tmp_path / name).mkdir()
        for file, picture in pictures.items():
            iio.imwrite(tmp_path / name / f"{file}.png", picture)
        return tmp_path / name

    small = np.zeros((4, 5, 3), np.uint8)
    large = np.zeros((5, 5, 3), np.uint8)
    gray = np.zeros((4, 5), np.uint8)
    (tmp_path / "text.mp4").write_text("this is no video")
    (tmp_path / "half.mp4").write_bytes(clip.read_bytes()[:-2000])
    (tmp_path / "half.npy").write_bytes(b"\x93NUMPY\x01\x00")
    ffmpeg("-f", "lavfi", "-i", "sine=duration=0.1", tmp_path / "sound.mkv")
    np.save(tmp_path / "flat.npy", np.zeros((5, 5)))
    np.save(tmp_path / "complex.npy", np.zeros((3, 5, 5), complex))
    np.savez(tmp_path / "two.npz", a=np.zeros((3, 4, 5)), b=np.zeros((3, 4, 5)))
    np.savez(tmp_path / "times.npz", frames=np.zeros((3, 4, 5)), t_s=np.arange(4))
    torn = folder("torn", a=np.random.default_rng(0).integers(0, 255, (40, 50), dtype=np.uint8))
    (torn / "b.png").write_bytes((torn / "a.png").read_bytes()[:900])
    deep = folder("deep", a=gray, b=gray)
    (deep / "a.png").write_bytes(
        b"\x89PNG\r\n\x1a\n" + b"\0\0\0\rIHDR" + b"\0\0\0\1" * 2 + bytes([16, 2, 0, 0, 0]) + b"\0" * 20
    )
    clear = folder("clear", a=np.zeros((4, 5, 4), np.uint8), b=np.zeros((4, 5, 4), np.uint8))
    mixed = folder("mixed", a=gray, b=gray)
    iio.imwrite(mixed / "c.jpg", gray)
    for path, words in [
        (tmp_path / "none", "no file or folder"),
        (tmp_path / "text.mp4", "as a video"),
        (tmp_path / "half.mp4", "video|decoded"),
        (tmp_path / "sound.mkv", "as a video"),
        (clip.parent, "0 picture"),
        (folder("one", a=gray), "1 picture"),
        (folder("sizes", a=small, b=large), "frame 1.*5 x 5 pixels.*5 x 4"),
        (folder("kinds", a=small, b=gray), "frame 1"),
        (folder("depths", a=gray, b=gray.astype(np.uint16)), "16 bits"),
        (torn, "cannot be read"),
        (deep, "16 bits"),
        (clear, "transparent"),
        (mixed, "several kinds"),
        (tmp_path / "one" / "a.png", "single picture"),
        (tmp_path / "half.npy", "whole .npy"),
        (tmp_path / "flat.npy", "at least two"),
        (tmp_path / "complex.npy", "complex128"),
        (tmp_path / "two.npz", "called frames"),
        (tmp_path / "times.npz", "one time per frame"),
    ]:
        with pytest.raises(FileFormatError, match=words):
            list(open_frames(path).read(0))
