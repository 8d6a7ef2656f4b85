"""Recordings of the study of flow's quality: made streams against the geometry they were made with,
and the contrast maximisation against events placed by hand."""
# pyright: reportAssignmentType=false

import math
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import pytest
import torch

from codesign import events
from codesign.errors import DomainError
from codesign.events.stream import ordered
from codesign.flow import metrics
from codesign.flow.sources.packets import Packet
from codesign.types import FlowField
from scenes.windows import streams
from studies.flow_quality import recordings, sharpest
from studies.frame.run import StudyConfig, open_run

SIZE = (48, 64)


@dataclass(frozen=True)
class Config(StudyConfig):
    packet_events: tuple[int, ...] = (400,)
    packets: int = 2


Y, X = np.mgrid[: SIZE[0], : SIZE[1]] - (np.array(SIZE)[:, None, None] - 1) / 2


def packet(x, y, t_us, height=SIZE[0], width=SIZE[1]):
    inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
    t_us, x, y = (torch.from_numpy(values[inside].astype(np.int64)) for values in (t_us, x, y))
    return Packet(
        "by hand", ordered(t_us, x, y, torch.ones_like(x), height, width), 0, 10_000, None
    )


def dots(move, count=60):
    """Events of dots that move by move(x, y, time from 0 to 1), each at every millisecond."""
    draw = np.random.default_rng(0)
    x, y = draw.uniform(-40, 40, count), draw.uniform(-30, 30, count)
    t = np.linspace(0, 1, 21)
    px, py = np.stack([np.stack(move(x, y, each)) for each in t], 1)
    px, py = np.rint(px + (SIZE[1] - 1) / 2), np.rint(py + (SIZE[0] - 1) / 2)
    return packet(px.ravel(), py.ravel(), np.repeat(t * 10_000, count))


def turning(x, y, time, focal=60.0):
    rotation = streams.Rotation.from_rotvec(time * np.array([0.03, -0.06, 0.05])).as_matrix()
    seen = np.einsum("ij,j...->i...", rotation, np.stack([x / focal, y / focal, np.ones_like(x)]))
    return focal * seen[0] / seen[2], focal * seen[1] / seen[2]


@pytest.mark.parametrize(
    ("move", "found", "most_px"),
    [
        # exact pinhole geometry; the events' rounding to pixels is 0.3 px, over many dots
        (turning, lambda packet: sharpest.rotation(packet, 60.0), 0.25),
        # with a zoom of 0.12: at the end of the window a pixel of the start has moved by just that
        # share
        (
            lambda x, y, t: (x + t * (2.0 + 0.12 * x), y + t * (-1.5 + 0.12 * y)),
            sharpest.affine,
            0.35,
        ),
        # events of dots that move by 1.5 px stay on two or three pixels, and unmoved each lies on
        # one
        (lambda x, y, t: (x + 1.5 * t, y), lambda packet: sharpest.rotation(packet, 1e4), 0.35),
    ],
)
def test_the_sharpest_flow_is_the_motion_from_the_start(move, found, most_px):
    flow_px = found(dots(move, 90)).flow_px
    truth = np.stack(move(X, Y, 1.0)) - np.stack([X, Y])
    assert np.hypot(*truth).mean() > 1.4
    assert np.hypot(*(flow_px - truth)).mean() < most_px


def test_an_empty_packet_is_refused():
    nothing = np.zeros(0)
    with pytest.raises(DomainError, match="holds no event"):
        sharpest.affine(packet(nothing, nothing, nothing))


@pytest.fixture(scope="module")
def slid():
    return streams.sliding(0.03, SIZE, seed=1)


def test_the_flow_of_a_slider_is_inverse_to_depth(slid):
    flow = slid.truth(5_000, 25_000).flow_px
    assert float(flow[:, 1].abs().max()) < 1e-4
    speeds = sorted({round(float(value), 3) for value in flow[:, 0].unique()})
    allowed = [-streams.FOCAL_PX * streams.SLIDE_M_S * 0.02 / z for z in streams.DEPTHS_M]
    assert len(speeds) >= 2
    for speed in speeds:
        assert min(abs(speed - each) for each in allowed) < 2e-3


def test_the_flow_of_a_turn_is_that_of_its_rays():
    """Rays of start and end pixels differ by one rotation."""
    made = streams.turning(0.02, SIZE, seed=1)
    flow = made.truth(2_000, 18_000).flow_px[0].double().numpy()
    assert np.hypot(*flow).mean() > 0.3
    focal = np.full_like(X, made.focal_px)
    rays = [
        np.stack([x, y, focal]).reshape(3, -1).T for x, y in ((X, Y), (X + flow[0], Y + flow[1]))
    ]
    before, after = (each / np.linalg.norm(each, axis=1, keepdims=True) for each in rays)
    turn, _ = streams.Rotation.align_vectors(after, before)
    np.testing.assert_allclose(turn.apply(before), after, rtol=0, atol=3e-7)


def test_events_of_a_made_recording_follow_its_flow(slid):
    """Warped by the true flow the events are sharper than as they came, and than by the reversed
    flow."""
    stream = slid.stream
    t0_us, t1_us = 0, 30_000
    true_px = slid.truth(t0_us, t1_us).flow_px
    right, wrong = (metrics.fwl(stream, sign * true_px, t0_us, t1_us) for sign in (1.0, -1.0))
    assert right > 1.02
    assert right > 1.05 * wrong


def test_packets_of_a_recording(slid, tmp_path):
    """Packets hold the events asked for, and what is recorded are means and extremes over them."""
    first, second = recordings.cut(slid, 400, 2)
    assert len(first.stream) == len(second.stream) == 400
    assert first.t1_us <= second.t0_us
    case = recordings.Case(
        "slid", first, partial(recordings.in_context, slid, first, False), "affine"
    )

    def nothing_moves(volume):
        shape = (1, 2, *volume.counts.shape[3:])
        return FlowField(torch.zeros(shape), torch.ones(1, *shape[2:], dtype=torch.bool), 1.0)

    rows = recordings.measured(case, {"refiner": nothing_moves}, 4)
    still = rows["refiner"]
    assert still["fwl"] == 1.0
    assert rows["zero_flow"] == {"fwl": 1.0, "aee_px": still["aee_px"]}
    assert rows["contrast_maximisation"]["fwl"] > 1 < rows["true_flow"]["fwl"]
    volume = events.from_stream(first.stream, first.t0_us, first.t1_us, 4)
    mask = metrics.event_mask(volume)[0]
    assert first.truth is not None
    assert still["aee_px"] == pytest.approx(
        float(first.truth.flow_px[0].norm(dim=0)[mask].mean()), rel=1e-5
    )
    packets = [
        {"refiner": {**still, "fwl": value}, "closed_form_quadratic": still} for value in (1.0, 2.0)
    ]
    run = open_run("flow_quality", Config(out=tmp_path))
    recordings.record(run, "slid", packets)
    assert run.metrics["slid_refiner_fwl"] == 1.5
    assert run.metrics["slid_refiner_fwl_least"] == 1.0
    assert run.metrics["slid_refiner_distance_over_closed_form_largest"] == 1.0
    assert math.isclose(run.metrics["slid_refiner_aee_px_largest"], still["aee_px"])


def test_rotation_alone_is_no_truth_of_a_camera_that_slides():
    made = dots(lambda x, y, time: (x + 3 * time, y))
    flow_px = torch.full((1, 2, *SIZE), 3.5)
    truth = FlowField(torch.zeros(1, 2, *SIZE), torch.ones(1, *SIZE, dtype=torch.bool), 0.01)
    mask = torch.ones(1, *SIZE, dtype=torch.bool)
    for neglected_px, figures in ((5.0, {"fwl"}), (0.0, {"fwl", "aee_px"})):
        slid = replace(made, truth=truth, rotation_only=True, neglected_px=neglected_px)
        assert recordings.judged(slid, mask, flow_px).keys() == figures


def test_recordings_of_one_name_stay_apart(tmp_path):
    names = ("a/events.txt", "b/events.txt", "a/rec.h5", "b/rec.h5", "c/rec_h5_2", "c/rec-h5")
    found = recordings.named([tmp_path / name for name in names])
    assert found == ["a", "b", "rec_h5", "rec_h5_2", "rec_h5_2_2", "rec_h5_3"]
