"""``codesign.show`` draws what it is given: colours of pixels whose values are known."""

import re

import matplotlib.pyplot as plt
import numpy as np
import pytest
import torch

import codesign
from codesign import lens, render
from codesign.errors import DomainError
from codesign.system.result import Result
from codesign.types import EventStream, EventVolume, FlowField
from tests import refusals


def picture(axis):
    return np.asarray(axis.images[0].get_array(), dtype=float)


def test_flow_to_the_right_is_red_and_what_is_not_known_is_black():
    flow = torch.zeros(1, 2, 20, 30)
    flow[:, 0] = 5.0
    valid = torch.ones(1, 20, 30, dtype=torch.bool)
    flow[0, :, 4, 7], valid[0, 4, 7] = torch.nan, False
    axis = codesign.show(FlowField(flow, valid, 0.05)).axes[0]
    drawn = picture(axis)
    np.testing.assert_allclose(drawn[10, 10], (1, 0, 0), atol=1e-12)
    np.testing.assert_allclose(drawn[4, 7], (0, 0, 0), atol=1e-12)
    assert "5 px" in axis.texts[0].get_text()
    # of the wheel: up is image-down reversed, a quarter of the hues before red
    wheel = np.asarray(axis.child_axes[0].images[0].get_array())
    np.testing.assert_allclose(wheel[30, 60, :3], (1, 0, 0), atol=1e-12)
    np.testing.assert_allclose(wheel[60, 30, :3], (0.5, 1, 0), atol=1e-12)
    assert wheel[0, 0, 3] == 0


def test_events_are_red_on_and_blue_off_wherever_they_come_from():
    stream = EventStream(*torch.tensor([[1, 2, 3], [5, 5, 6], [2, 2, 3], [1, 1, -1]]), 8, 9)
    counts = torch.zeros(1, 2, 3, 8, 9)
    counts[0, 0, 0, 2, 5] = 2
    counts[0, 1, 2, 3, 6] = 1
    volume = EventVolume(counts, torch.arange(3.0), torch.ones(3))
    for shown in (codesign.show(stream), codesign.show(volume)):
        drawn = picture(shown.axes[0])
        assert drawn[2, 5].tolist() == [255, 0, 0]
        assert drawn[3, 6, 0] == drawn[3, 6, 1] < drawn[3, 6, 2] == 255
        assert (drawn[0] == 255).all()


def test_frames_are_picked_over_time_and_shown_with_a_gamma(tmp_path):
    frames = torch.arange(1, 8.0)[:, None, None].expand(7, 6, 8) * 10
    figure = codesign.show(frames, tmp_path / "frames.png")
    assert [axis.get_title() for axis in figure.axes] == [
        "frame 0",
        "frame 2",
        "frame 4",
        "frame 6",
    ]
    np.testing.assert_allclose(picture(figure.axes[2]), (50 / 70) ** (1 / 2.2), rtol=1e-6)
    assert (tmp_path / "frames.png").read_bytes().startswith(b"\x89PNG")
    with pytest.raises(DomainError, match="the kind of file must be one of 'eps'"):
        codesign.show(frames, tmp_path / "frames.docx")


def test_a_lens_is_drawn_with_rays_to_its_field_and_a_notebook_shows_it():
    geo = lens.load("cooke-triplet")
    figure = codesign.show(geo)
    # the film ends the axis of the drawing
    ends = max(line.get_xdata().max() for line in figure.axes[0].lines if len(line.get_xdata()) > 2)
    length = sum(surface.thickness_mm for surface in geo.to_surfaces())
    assert ends == pytest.approx(length, rel=1e-6)
    assert figure._repr_png_().startswith(b"\x89PNG")


def test_poses_are_a_path_from_above_with_headings():
    start = codesign.pose.look_at((1.0, -2.0, 0.5), (2.0, -2.0, 0.5))
    poses = start.repeat(5, 1, 1)
    poses[:, 0, 3] += torch.arange(5.0) / 10
    for given in (poses, poses.numpy()):
        axis = codesign.show(given).axes[0]
        np.testing.assert_allclose(axis.lines[0].get_xdata(), 1 + np.arange(5) / 10, rtol=1e-6)
        np.testing.assert_allclose(axis.lines[0].get_ydata(), -2, rtol=1e-6)
        (headings,) = axis.collections
        np.testing.assert_allclose((headings.U, headings.V), (np.ones(5), np.zeros(5)), atol=1e-6)
    far = poses.double()
    far[:, 1, 3] += 4_649_776.0  # metres north, as of UTM
    north = codesign.show(far.numpy()).axes[0].lines[0].get_ydata()
    np.testing.assert_allclose(north, 4_649_774.0, rtol=0, atol=1e-6)
    (one,) = codesign.show(start).axes[0].collections
    np.testing.assert_allclose((one.X, one.Y, one.U), ([1], [-2], [1]), atol=1e-6)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float64])
def test_arrays_are_drawn_as_tensors(dtype):
    frames = np.arange(4 * 6 * 8).reshape(4, 6, 8)
    given = codesign.show(frames.astype(dtype)).axes
    for axis, other in zip(given, codesign.show(torch.tensor(frames)).axes, strict=True):
        np.testing.assert_allclose(picture(axis), picture(other), rtol=1e-6)


def rays_drawn(figure):
    """[fields, rays, 3, 2]: the (z, y) of each ray before a thin lens, in it and on the film."""
    lines = [line.get_xydata() for line in figure.axes[0].lines if len(line.get_xdata()) == 3]
    return np.array(lines).reshape(3, -1, 3, 2)


def test_light_through_a_thin_lens_meets_where_geometry_has_it():
    """Parallel light meets a focal length behind the lens, f tan(field) off the axis; on a film
    beyond it fills the pupil's shadow, D (d / f - 1). The ray through the middle goes straight."""
    efl_mm, wide_mm = 8.0, 4.0
    corner_mm = 0.05 * np.hypot(60, 80) / 2
    heights_mm = np.array([0, 0.7, 1])
    sharp = rays_drawn(codesign.show(lens.ThinLens(efl_mm, wide_mm)))
    slopes = np.tan(np.radians(10 * heights_mm))
    assert np.ptp(sharp[:, :, 1, 1], axis=1) == pytest.approx(wide_mm)
    assert sharp[:, :, 2] == pytest.approx(
        np.broadcast_to(np.stack([0 * slopes + efl_mm, efl_mm * slopes], 1)[:, None], (3, 5, 2)),
        abs=1e-12,
    )
    away = lens.ThinLens(efl_mm, wide_mm, 10.0)
    blurred = rays_drawn(codesign.show(render.Camera(away, 60, 80, 0.05)))
    assert np.ptp(blurred[:, :, 2, 1], axis=1) == pytest.approx(wide_mm * (10.0 / efl_mm - 1))
    pinhole = render.Camera(lens.Pinhole(efl_mm), 60, 80, 0.05)
    for middle, film_mm in (
        (blurred[:, 2], 10.0),
        (rays_drawn(codesign.show(pinhole))[:, 0], efl_mm),
    ):
        assert middle[:, 1] == pytest.approx(0 * middle[:, 1])
        assert middle[-1, 2] == pytest.approx([film_mm, corner_mm])
        before, behind = np.diff(middle, axis=1).transpose(1, 2, 0)
        assert before[1] / before[0] == pytest.approx(behind[1] / behind[0])


@refusals.table(__file__, "drawings")
def test_what_cannot_be_drawn_is_refused_in_a_sentence(row):
    row.holds(globals())


def test_results_are_printed_in_a_line_each():
    stamps = torch.tensor([1_000, 2_000, 6_000])
    stream = EventStream(stamps, stamps * 0, stamps * 0, torch.tensor([1, -1, 1]), 180, 240)
    assert repr(stream) == "EventStream(3 events, 2 of them ON, in 5 ms, 240 x 180 px)"
    counts = torch.zeros(1, 2, 2, 4, 6)
    counts[0, 0, 1, 2, 3] = 1500
    volume = EventVolume(counts, torch.tensor([0.01, 0.03]), torch.tensor([0.02, 0.02]))
    assert repr(volume) == "EventVolume([1, 2, 2, 4, 6], 1,500 events in 40 ms)"
    flow_px = torch.zeros(1, 2, 4, 4)
    flow_px[:, 0], flow_px[:, 1] = 3, 4
    valid = torch.ones(1, 4, 4, dtype=torch.bool)
    valid[:, :, :1] = False
    field = FlowField(flow_px, valid, 0.05)
    assert repr(field) == "FlowField([1, 2, 4, 4], 5 px in the median, 75% valid, over 50 ms)"
    valid[:] = False
    assert repr(field) == "FlowField([1, 2, 4, 4], 0% valid, over 50 ms)"
    camera = render.Camera(lens.Pinhole(4.0), 8, 6, 0.1, samples_per_pixel=4)
    assert repr(camera).endswith(", 6 x 8 pixels of 0.1 mm, 4 rays each)")
    assert (
        repr(Result({"error": torch.tensor(0.25)}, None, None, None, None, None))
        == "Result(error=0.25)"
    )


@pytest.mark.parametrize("width_in", [2, 3.5, 7.16])
def test_a_figure_of_a_paper_has_its_width(width_in, tmp_path):
    """150 pixels to the inch of a .png, 72 points to that of a .pdf; nothing is cut off above or below."""
    frames = torch.rand(3, 12, 16, generator=torch.Generator().manual_seed(0))
    figure = codesign.show(frames, tmp_path / "a.png", width_in=width_in)
    width, height = figure.get_size_inches()
    drawn = figure.get_tightbbox()
    assert width == width_in
    assert drawn.y0 > 0
    assert drawn.height < height == pytest.approx(drawn.height + 0.1, abs=0.02)
    drawn = plt.imread(tmp_path / "a.png")
    assert drawn.shape[1] == pytest.approx(150 * width_in, abs=1)
    codesign.show(lens.load("cooke-triplet"), tmp_path / "a.pdf", width_in=width_in)
    written = (tmp_path / "a.pdf").read_bytes()
    box = re.search(rb"MediaBox \[ 0 0 ([0-9.]+) ", written)
    assert box is not None
    assert b"/Type3" not in written, "journals refuse such fonts"
    assert float(box[1]) == pytest.approx(72 * width_in, abs=0.01)


def test_the_wheel_of_a_sparse_field_is_of_what_moves():
    flow, valid = torch.zeros(1, 2, 40, 50), torch.zeros(1, 40, 50, dtype=torch.bool)
    flow[0, 0, 3, :20], valid[0, 3, :20] = 3.0, True
    assert "rim 3 px" in codesign.show(FlowField(flow, valid, 0.05)).axes[0].texts[0].get_text()
