"""Pictures, fading traces, rates and videos of events."""

import math
import re
import subprocess
from typing import Any

import imageio.v3 as iio
import imageio_ffmpeg
import numpy as np
import pytest
import torch

from codesign.errors import DomainError, ShapeError
from codesign.events import decay, decay_video, gray_picture, picture, rates, write_video
from codesign.events.stream import ordered
from codesign.events.views.figures import rate_figure, sample, space_time_figure

COUNTS = torch.tensor([[[4.0, 0, 2, 0]], [[0, 4, 2, 0]]])  # [2, 1, 4]: four ON, four OFF, two of each, none


def test_colours_say_polarity_and_strength():
    assert picture(COUNTS)[0].tolist() == [[255, 0, 0], [0, 0, 255], [191, 128, 191], [255, 255, 255]]
    assert picture(COUNTS, full_scale=2)[0].tolist() == [
        [255, 0, 0],
        [0, 0, 255],
        [128, 0, 128],
        [255, 255, 255],
    ]
    assert gray_picture(COUNTS)[0].tolist() == [255, 1, 128, 128]
    assert picture(torch.zeros(3, 2, 5, 6)).shape == (3, 5, 6, 3)


def test_traces_fade_exponentially():
    counts = torch.zeros(4, 2, 1, 1, dtype=torch.float64)
    counts[0, 0], counts[2, 0], counts[1, 1] = 3, 1, 2
    traces = decay(counts, [0.0, 0.01, 0.03, 0.04, 0.09], tau_s=0.02)[:, :, 0, 0]
    on = [3, 3 * math.exp(-1), 3 * math.exp(-1.5) + 1, (3 * math.exp(-1.5) + 1) * math.exp(-2.5)]
    off = [0, 2, 2 * math.exp(-0.5), 2 * math.exp(-3)]
    torch.testing.assert_close(traces, torch.tensor([on, off], dtype=torch.float64).T)


def test_rates_are_events_per_second():
    counts = torch.zeros(2, 2, 3, 3)
    counts[0, 0], counts[1, 1, 0, 0] = 1, 5
    middle_s, rate = rates(counts, [0.0, 0.5, 0.6])
    torch.testing.assert_close(middle_s, torch.tensor([0.25, 0.55], dtype=torch.float64))
    torch.testing.assert_close(rate, torch.tensor([[18, 0], [0, 50]], dtype=torch.float64))


def test_gif_shows_the_pictures_enlarged_and_even(tmp_path):
    pictures = picture(
        torch.stack((COUNTS, COUNTS.flip(0), COUNTS.flip(2))).repeat(1, 1, 3, 1)[..., :3]
    )  # 3 x 3
    write_video(tmp_path / "e.gif", pictures, fps=10)
    back = iio.imread(tmp_path / "e.gif")
    assert back.shape == (3, 258, 258, 3)  # factor 86
    np.testing.assert_array_equal(back[:, 43::86, 43::86], pictures.numpy())


def test_mp4_holds_every_picture_at_its_rate(tmp_path):
    pictures = (
        torch.full((12, 301, 299), 0, dtype=torch.uint8)
        + (torch.arange(12, dtype=torch.uint8) * 20)[:, None, None]
    )
    write_video(tmp_path / "e.mp4", pictures, fps=30)
    command = [
        imageio_ffmpeg.get_ffmpeg_exe(),
        "-i",
        str(tmp_path / "e.mp4"),
        "-f",
        "rawvideo",
        "-pix_fmt",
        "gray",
        "-",
    ]
    done = subprocess.run(command, capture_output=True, check=True)
    assert re.search(rb"h264.*300x302.* 30 fps", done.stderr)
    back = np.frombuffer(done.stdout, np.uint8).reshape(12, 302, 300)
    # flat gray survives lossy coding to a few levels
    assert np.abs(back.mean((1, 2)) - np.arange(12) * 20).max() < 4


def test_decay_video_is_the_same_from_stream_and_counts(tmp_path):
    t_us, x, y, p = (torch.tensor(column) for column in ([500, 1500, 1600], [0, 1, 1], [0, 0, 1], [1, -1, 1]))
    stream = ordered(t_us, x, y, p, 2, 2)
    counts = torch.zeros(2, 2, 2, 2)
    counts[0, 0, 0, 0] = counts[1, 1, 0, 1] = counts[1, 0, 1, 1] = 1
    for name, events in (("a.gif", stream), ("b.gif", counts)):
        decay_video(tmp_path / name, events, [0, 0.001, 0.002], tau_s=0.001)
    first, second = (iio.imread(tmp_path / name) for name in ("a.gif", "b.gif"))
    np.testing.assert_array_equal(first, second)
    faded = round(255 * (1 - math.exp(-1)))
    assert second[1, 0, 0].tolist() == [255, faded, faded]


def test_pictures_may_come_one_by_one(tmp_path):
    pictures = picture(torch.rand(5, 2, 20, 30, generator=torch.Generator().manual_seed(0)))
    write_video(tmp_path / "whole.mp4", pictures, fps=20)
    write_video(tmp_path / "single.mp4", (each.numpy() for each in pictures), fps=20)
    assert (tmp_path / "whole.mp4").read_bytes() == (tmp_path / "single.mp4").read_bytes()
    for bad, words in ((iter(()), "at least one"), (iter([pictures[0], pictures[0, :10]]), "one size")):
        with pytest.raises(ShapeError, match=words):
            write_video(tmp_path / "bad.mp4", bad, fps=20)
    assert not (tmp_path / "bad.mp4").exists()


def test_the_figure_of_rates_draws_the_rates_in_its_units():
    middle_s = torch.tensor([0.1, 0.2, 0.3], dtype=torch.float64)
    rate_hz = torch.tensor([[1000.0, 0], [5000, 2500], [0, 10]], dtype=torch.float64)
    axis = rate_figure(middle_s, rate_hz).axes[0]
    on, off = axis.lines
    assert axis.get_xlabel() == "time (ms)"
    assert axis.get_ylabel() == "kevents per second"
    np.testing.assert_allclose(np.asarray(on.get_xdata()), [100, 200, 300])
    np.testing.assert_allclose(np.asarray(on.get_ydata()), [1, 5, 0])
    np.testing.assert_allclose(np.asarray(off.get_ydata()), [0, 2.5, 0.01])
    with pytest.raises(ShapeError, match=r"\[K, 2\]"):
        rate_figure(middle_s, rate_hz[:2])


def test_the_figure_in_space_and_time_shows_as_many_events_as_it_says():
    count = 5000
    generator = torch.Generator().manual_seed(0)
    x, y, p = (torch.randint(0, high, (count,), generator=generator) for high in (40, 30, 2))
    stream = ordered(torch.arange(count) * 100 + 7, x, y, 2 * p - 1, 30, 40)
    figure = space_time_figure(stream, points=1000)
    points: Any = figure.axes[0].collections[0]
    shown = points._offsets3d
    assert [len(column) for column in shown] == [1000] * 3
    assert "1,000 of 5,000 events" in figure.get_suptitle()
    index = np.rint(np.asarray(shown[0]) * 10).astype(int)  # 0.1 ms apart
    np.testing.assert_array_equal(np.asarray(shown[1]), stream.x[index])
    np.testing.assert_array_equal(np.asarray(shown[2]), stream.y[index])
    assert "all 5,000 events" in space_time_figure(stream).get_suptitle()
    with pytest.raises(DomainError, match="points"):
        space_time_figure(stream, points=0)
    none = torch.zeros(0, dtype=torch.int64)
    with pytest.raises(ShapeError, match="no event"):
        space_time_figure(ordered(none, none, none, none, 3, 3))


@pytest.mark.parametrize("count", [30, 130])  # by permutation, and by drawing again
def test_a_sample_holds_every_event_equally_often(count):
    generator = torch.Generator().manual_seed(0)
    hits = torch.zeros(count)
    for _ in range(2000):
        chosen = sample(count, 20, generator)
        assert len(set(chosen.tolist())) == 20
        hits[chosen] += 1
    expected = 2000 * 20 / count
    # binomial: five standard deviations
    assert float((hits - expected).abs().max()) < 5 * math.sqrt(expected * (1 - 20 / count))
    assert sample(7, 20, generator).tolist() == list(range(7))
