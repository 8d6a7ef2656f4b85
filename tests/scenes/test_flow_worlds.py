"""Windows out of the 3-D worlds: their flow against the rendered pictures, their length, their noise."""

import pytest
import torch

from codesign.errors import DomainError
from codesign.flow.warp import along_flow
from scenes.flow_worlds import WorldWindows


@pytest.fixture(scope="module")
def windows():
    return WorldWindows(
        ("room", "tabletop"), seed=4, size_px=48, intervals=16, flow_px=(2.0, 3.0), samples=4
    ).batch([0, 1])


def test_the_flow_leads_to_the_same_radiance(windows):
    """The end frame at q + flow(q) shows what the first frame shows at q, up to pixels of four rays each;
    along the reversed flow, or in place, it does not."""
    first, last = windows.frames.clamp_min(1).log().unbind(1)

    def misfit(flow_px):
        inside = along_flow(torch.ones_like(last[:, None]), flow_px, torch.ones(1))[:, 0] > 0.999
        brought = along_flow(last[:, None], flow_px, torch.ones(1))[:, 0]
        return torch.stack([(brought - first).abs()[k][inside[k]].mean() for k in range(2)])

    right, still, wrong = (misfit(factor * windows.truth.flow_px) for factor in (1.0, 0.0, -1.0))
    assert (right < 0.5 * still).all()
    assert (right < 0.35 * wrong).all()


def test_a_window_lasts_until_the_flow_is_as_long_as_asked(windows):
    """The speed is measured at the start of the window and changes little within it."""
    length = torch.stack(
        [
            flow.square().sum(0)[seen].mean().sqrt()
            for flow, seen in zip(windows.truth.flow_px, windows.truth.valid, strict=True)
        ]
    )
    assert (length > 1.5).all()
    assert (length < 3.8).all()


def test_events_are_counted_by_their_time(windows):
    assert windows.volume.counts.shape == (2, 2, 8, 48, 48)
    assert abs(float(windows.volume.collected_s.sum()) - 1.0) < 1e-12
    whole = windows.volume.counts.sum((1, 2, 3, 4))
    torch.testing.assert_close(whole, whole.round(), rtol=1e-5, atol=0)  # shares of an event add up to one


@pytest.mark.bits
def test_a_sample_does_not_depend_on_its_batch():
    source = WorldWindows(("room",), seed=4, size_px=32, intervals=8, samples=1)
    assert torch.equal(source.batch([1, 2]).volume.counts[1], source.batch([2]).volume.counts[0])
    with pytest.raises(DomainError, match=r"worlds \['moon'\] are unknown"):
        WorldWindows(("moon",))
