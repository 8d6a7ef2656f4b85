"""Photographs moved along flow files: whole pixels, what hides what, and truth as the file has it."""

import pytest
import torch

from codesign.errors import FileFormatError
from codesign.flow import write_flow
from codesign.flow.warp import along_flow
from scenes.flow_files import FileWindows, moved


def test_an_even_motion_by_whole_pixels_shifts_the_picture():
    """At any place the shares of a point are alike after whole pixels, so the picture is the same, further on."""
    y, x = torch.meshgrid(torch.arange(40.0), torch.arange(48.0), indexing="ij")
    photo = 100 + 50 * torch.sin(x / 4) * torch.cos(y / 5)
    flow = torch.tensor([6.0, -4.0])[:, None, None].expand(2, 40, 48)
    still, half, whole = (moved(photo, flow, share) for share in (0.0, 0.5, 1.0))
    torch.testing.assert_close(whole[8:28, 14:40], still[12:32, 8:34], rtol=1e-5, atol=1e-3)
    torch.testing.assert_close(half[8:28, 14:40], still[10:30, 11:37], rtol=1e-5, atol=1e-3)
    # points are looked up and shared bilinearly: variances of at most 1/4 + 1/4 px^2 along each axis, which
    # take 1 - exp(-(1/16 + 1/25) / 4) = 2.5 % of the wave
    assert float((still - photo)[1:-1, 1:-1].abs().max()) < 0.025 * 50 * 1.1


def test_the_faster_hides_the_slower_and_uncovers_what_was_behind():
    photo = torch.full((40, 48), 50.0)
    photo[10:30, 10:20] = 200.0
    flow = torch.zeros(2, 40, 48)
    flow[0, 10:30, 10:20] = 12.0
    found = moved(photo, flow, 1.0)
    torch.testing.assert_close(found[12:28, 23:31], torch.full((16, 8), 200.0))
    torch.testing.assert_close(found[12:28, 34:], torch.full((16, 14), 50.0))
    torch.testing.assert_close(found[12:28, :9], torch.full((16, 9), 50.0))


def test_windows_have_the_flow_of_the_file(tmp_path):
    y, x = torch.meshgrid(torch.arange(60.0), torch.arange(70.0), indexing="ij")
    flow = torch.stack([2 + 0.02 * x, -1 - 0.01 * y])
    valid = torch.ones(60, 70, dtype=torch.bool)
    valid[:, 30:32] = False
    (tmp_path / "Scene").mkdir()
    write_flow(tmp_path / "Scene" / "flow10.flo", flow, valid=valid)
    once, thrice = (
        FileWindows(tmp_path, factor, seed=3, side_px=32, bins=4, intervals=12).batch([0, 1])
        for factor in (1.0, 3.0)
    )
    for k in range(2):
        u, v = once.truth.flow_px[k][:, once.truth.valid[k]].flatten(1)
        assert float(u.min()) >= 2.0
        assert float(v.max()) <= -1.0
        # linear in the pixel, as in the file
        across = once.truth.flow_px[k, 0].diff(dim=1)[
            once.truth.valid[k][:, 1:] & once.truth.valid[k][:, :-1]
        ]
        torch.testing.assert_close(across, torch.full_like(across, 0.02), rtol=0, atol=1e-5)
    torch.testing.assert_close(3 * once.truth.flow_px, thrice.truth.flow_px)
    assert torch.equal(once.truth.valid, thrice.truth.valid)
    assert float(thrice.volume.counts.sum()) > 1.5 * float(once.volume.counts.sum())


def test_the_end_frame_shows_the_start_along_the_flow(tmp_path):
    y, x = torch.meshgrid(torch.arange(60.0), torch.arange(70.0), indexing="ij")
    flow = torch.stack([2 + torch.sin(y / 9), torch.cos(x / 11)])
    write_flow(tmp_path / "a.flo", flow)
    windows = FileWindows(tmp_path, seed=1, side_px=40, bins=4, intervals=8).batch([0])
    assert windows.frames is not None
    first, last = windows.frames.clamp_min(1).log().unbind(1)
    brought = along_flow(last[:, None], windows.truth.flow_px, torch.ones(1))[:, 0]
    inner = (slice(None), slice(6, -6), slice(6, -6))
    assert float((brought - first)[inner].abs().mean()) < 0.35 * float((last - first)[inner].abs().mean())


def test_folders_without_flow_are_refused(tmp_path):
    with pytest.raises(FileFormatError, match=r"holds no \.flo file"):
        FileWindows(tmp_path)
    write_flow(tmp_path / "small.flo", torch.zeros(2, 20, 20))
    with pytest.raises(FileFormatError, match="20 x 20 pixels"):
        FileWindows(tmp_path, side_px=32).batch([0])
