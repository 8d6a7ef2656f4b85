"""Pictures, rates, figures and videos of events."""

import math
import re
import subprocess

import imageio.v3 as iio
import imageio_ffmpeg
import numpy as np
import pytest
import torch

from codesign.events import decay_video, gray_picture, picture, rates, write_video
from codesign.events.stream import ordered
from codesign.events.views.figures import rate_figure, sample, space_time_figure
from tests.event_streams import stream_of
from tests.numbers import f64

# [2, 1, 4]: four ON, four OFF, two of each, none
COUNTS = torch.tensor([[[4.0, 0, 2, 0]], [[0, 4, 2, 0]]])


def test_colours_say_polarity_and_strength():
    assert picture(COUNTS)[0].tolist() == [[255, 0, 0], [0, 0, 255], [191, 128, 191], [255] * 3]
    assert picture(COUNTS, full_scale=2)[0, 2].tolist() == [128, 0, 128]
    assert gray_picture(COUNTS)[0].tolist() == [255, 1, 128, 128]


def test_gif_shows_the_pictures_enlarged_and_even(tmp_path):
    counts = torch.stack((COUNTS, COUNTS.flip(0), COUNTS.flip(2)))
    pictures = picture(counts.repeat(1, 1, 3, 1)[..., :3])
    write_video(tmp_path / "e.gif", pictures, fps=10)
    back = iio.imread(tmp_path / "e.gif")
    assert back.shape == (3, 258, 258, 3)  # 3 x 3 by a factor of 86
    np.testing.assert_array_equal(back[:, 43::86, 43::86], pictures.numpy())


def test_mp4_holds_every_picture_at_its_rate_also_one_by_one(tmp_path):
    gray = torch.arange(12, dtype=torch.uint8) * 20
    pictures = gray[:, None, None].expand(12, 301, 299)
    write_video(tmp_path / "e.mp4", pictures, fps=30)
    write_video(tmp_path / "single.mp4", (each.numpy() for each in pictures), fps=30)
    assert (tmp_path / "e.mp4").read_bytes() == (tmp_path / "single.mp4").read_bytes()
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-i", str(tmp_path / "e.mp4")]
    command += ["-f", "rawvideo", "-pix_fmt", "gray", "-"]
    done = subprocess.run(command, capture_output=True, check=True)
    assert re.search(rb"h264.*300x302.* 30 fps", done.stderr)
    back = np.frombuffer(done.stdout, np.uint8).reshape(12, 302, 300)
    # flat gray survives lossy coding to a few levels
    assert np.abs(back.mean((1, 2)) - gray.numpy()).max() < 4


def test_decay_video_is_the_same_from_stream_and_counts(tmp_path):
    stream = stream_of((500, 0, 0, 1), (1500, 1, 0, -1), (1600, 1, 1, 1), height_px=2, width_px=2)
    counts = torch.zeros(2, 2, 2, 2)
    counts[0, 0, 0, 0] = counts[1, 1, 0, 1] = counts[1, 0, 1, 1] = 1
    for name, events in (("a.gif", stream), ("b.gif", counts)):
        decay_video(tmp_path / name, events, [0, 0.001, 0.002], tau_s=0.001)
    first, second = (iio.imread(tmp_path / name) for name in ("a.gif", "b.gif"))
    np.testing.assert_array_equal(first, second)
    faded = round(255 * (1 - math.exp(-1)))
    assert second[1, 0, 0].tolist() == [255, faded, faded]


def test_rates_are_events_per_second_and_drawn_in_their_units():
    counts = torch.zeros(2, 2, 3, 3)
    counts[0, 0], counts[1, 1, 0, 0] = 1, 500
    middle_s, rate_hz = rates(counts, [0.0, 0.5, 0.6])
    torch.testing.assert_close(middle_s, f64([0.25, 0.55]))
    torch.testing.assert_close(rate_hz, f64([[18, 0], [0, 5000]]))
    axis = rate_figure(middle_s, rate_hz).axes[0]
    assert (axis.get_xlabel(), axis.get_ylabel()) == ("time (ms)", "kevents per second")
    for line, values in zip(axis.lines, ([0.018, 0], [0, 5]), strict=True):
        np.testing.assert_allclose(np.asarray(line.get_xdata()), [250, 550])
        np.testing.assert_allclose(np.asarray(line.get_ydata()), values)


def test_the_figure_in_space_and_time_shows_as_many_events_as_it_says(generator):
    x, y, p = (torch.randint(0, high, (5000,), generator=generator) for high in (40, 30, 2))
    stream = ordered(torch.arange(5000) * 100 + 7, x, y, 2 * p - 1, 30, 40)
    figure = space_time_figure(stream, points=1000)
    shown = [np.asarray(one) for one in figure.axes[0].collections[0]._offsets3d]  # pyright: ignore
    assert "1,000 of 5,000 events" in figure.get_suptitle()
    index = np.rint(shown[0] * 10).astype(int)  # 0.1 ms apart
    assert len(index) == 1000
    np.testing.assert_array_equal(shown[1:], [stream.x[index], stream.y[index]])
    assert figure.axes[0].get_xlim() == pytest.approx((0, 499.9))
    assert "all 5,000 events" in space_time_figure(stream).get_suptitle()


@pytest.mark.parametrize("count", [30, 130])  # by permutation, and by drawing again
def test_a_sample_holds_every_event_equally_often(count, generator):
    hits = torch.zeros(count)
    for _ in range(2000):
        chosen = sample(count, 20, generator)
        assert len(set(chosen.tolist())) == 20
        hits[chosen] += 1
    expected = 2000 * 20 / count
    # binomial: five standard deviations
    assert (hits - expected).abs().max() < 5 * math.sqrt(expected * (1 - 20 / count))
    assert sample(7, 20, generator).tolist() == list(range(7))
