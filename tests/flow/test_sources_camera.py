"""Text events byte for byte, and the camera, its turn and its flow against closed forms and another
implementation."""
# pyright: reportOptionalMemberAccess=false

import math

import numpy as np
import pytest
import torch
from kornia.geometry.calibration import distort_points
from PIL import Image
from scipy.spatial.transform import Rotation

from codesign.errors import FileFormatError
from codesign.events.formats import text as text_events
from codesign.flow.files import write_flow
from codesign.flow.sources import PacketOptions, camera, read_packets, read_recording
from codesign.flow.sources.camera import (
    Calibration,
    read_calibration,
    read_gyroscope,
    read_poses,
)
from codesign.flow.sources.rendered import CameraFit
from tests import refusals
from tests.numbers import f64
from tests.recording_case import DAVIS, ETH_CALIBRATION, eth_text, gyroscope, made, poses, recording


@pytest.mark.parametrize(
    "form",
    [
        "{t:.9f} {x} {y} {p}\n",
        "{t:.6f},{x},{y},{p}\n",
        "{t_us} {x} {y} {sign}\n",
        "{t:.6f}\t{x}\t{y}\t{p}\r\n",
        "{x} {y} {t_us} {p}\n",
        "{t_us}.0 {x}.0 {y}.0 {p}.0\n",
    ],
)
def test_events_are_read_as_written_whatever_the_chunks(form, tmp_path, monkeypatch):
    columns = made()
    path = tmp_path / "events.txt"
    path.write_bytes(eth_text(columns, form).encode())
    for chunk in (text_events.CHUNK_BYTES, 997):  # borders fall anywhere within a line
        monkeypatch.setattr(text_events, "CHUNK_BYTES", chunk)
        found = read_recording(path)
        np.testing.assert_array_equal([found.t_us, found.x, found.y, found.on], columns)
        assert (found.height_px, found.width_px) == DAVIS


def test_the_sensor_is_the_one_told_or_the_smallest_that_holds_the_events(tmp_path):
    path = tmp_path / "events.txt"
    reaches = (10, 10, 180, 240), (345, 259, 260, 346), (346, 0, 480, 640), (1280, 4, 5, 1281)
    for x, y, *size in reaches:
        path.write_text(f"0.5 {x} {y} 1\n0.6 0 0 0\n")
        found = read_recording(path)
        assert [found.height_px, found.width_px] == size
    with pytest.raises(FileFormatError, match=r"line 1: .*x = 1280; the sensor has 1280 pixels"):
        read_recording(path, PacketOptions(size_px=(720, 1280)))
    (tmp_path / "images").mkdir()
    Image.new("L", (1281, 5)).save(tmp_path / "images" / "1.png")
    assert read_recording(path).size_from == "its frames"
    with pytest.raises(FileFormatError, match=r"height_px 5 by its frames, but 700 was asked for"):
        read_recording(path, PacketOptions(size_px=(700, 1300)))


# the camera and how it turns


@pytest.fixture
def lens(tmp_path):
    (tmp_path / "calib.txt").write_text(ETH_CALIBRATION)
    return read_calibration(tmp_path / "calib.txt")


def test_distortion_is_that_of_another_implementation_and_its_inverse_brings_pixels_back(lens):
    rays = lens.directions(*DAVIS)
    y, x = np.mgrid[0:180, 0:240]
    pixels = np.stack([x, y], -1)
    np.testing.assert_allclose(lens.project(rays), pixels, rtol=0, atol=1e-5)
    # kornia takes pixels of the undistorted picture
    matrix = torch.eye(3, dtype=torch.float64)
    matrix[:2, :2] = torch.diag(torch.tensor(lens.focal_px))
    matrix[:2, 2] = torch.tensor(lens.centre_px)
    flat = torch.from_numpy(rays[..., :2] * lens.focal_px + lens.centre_px).reshape(1, -1, 2)
    theirs = distort_points(flat, matrix[None], f64([lens.distortion]))
    np.testing.assert_allclose(theirs.reshape(180, 240, 2).numpy(), pixels, rtol=0, atol=1e-5)


def test_rotation_flow_in_closed_form():
    camera = Calibration((200.0, 200.0), (119.5, 89.5))
    angle = 0.03
    y, x = np.mgrid[0:180, 0:240]
    u = x - 119.5
    v = y - 89.5

    def flow(rotation):
        return camera.rotation_flow(Rotation.from_rotvec(rotation).inv().as_matrix(), *DAVIS)

    # the camera rolls clockwise (its x axis towards its y axis), so the picture turns the other way
    roll, valid = flow([0, 0, angle])
    assert valid.all()
    c, s = math.cos(angle), math.sin(angle)
    np.testing.assert_allclose(roll, [u * c + v * s - u, -u * s + v * c - v], rtol=0, atol=1e-9)
    # a pan to the right carries the picture to the left: along the middle row x = f tan(atan(u / f)
    # - angle)
    pan, _ = flow([0, angle, 0])
    np.testing.assert_allclose(
        pan[0], 200 * np.tan(np.arctan(u / 200) - angle) - u, rtol=0, atol=1e-9
    )
    # z' of the turned ray
    np.testing.assert_allclose(pan[1], v * (1 / (c + u / 200 * s) - 1), rtol=0, atol=1e-9)
    behind, seen = flow([0, math.pi / 2, 0])
    assert seen.sum() == 180 * 120  # the right half stays ahead of the camera
    assert not behind[:, ~seen].any()


def test_flow_of_undistorted_pixels_is_carried_to_raw_ones(lens, tmp_path):
    turn = Rotation.from_rotvec([0.02, -0.03, 0.05]).as_matrix()
    flat, _ = Calibration(lens.focal_px, lens.centre_px).rotation_flow(turn, *DAVIS)
    right, valid = lens.rotation_flow(turn, *DAVIS)
    recording(tmp_path / "a", made(100, start_s=100.0, duration_s=0.03))
    write_flow(tmp_path / "flow.flo", torch.from_numpy(flat))

    def read(**options):
        options |= {"window_s": 0.02, "start_s": 0.0, "truth_interval_s": 0.02, "size_px": DAVIS}
        return read_packets(tmp_path / "a", tmp_path / "flow.flo", PacketOptions(**options))[0]

    carried = read(truth_pixels="undistorted")
    both = carried.truth.valid[0].numpy() & valid
    # barrel distortion: the corners of the raw picture lie beside the undistorted one
    assert both.mean() > 0.75
    # read between pixels, linearly: an eighth of the field's second derivative, (0.06 rad / 200 px)
    np.testing.assert_allclose(
        carried.truth.flow_px[0].numpy()[:, both], right[:, both], rtol=0, atol=2e-4
    )
    assert carried.undistorted_px == 0
    doubted = read()
    assert doubted.undistorted_px == pytest.approx(np.hypot(*(right - flat))[both].mean(), rel=1e-3)
    assert any("the camera has distortion" in note for note in doubted.notes)
    for folder in (tmp_path, tmp_path / "a"):
        (folder / "calib.txt").unlink()
    with pytest.raises(FileFormatError, match=r"undistorted pixels, and no calib\.txt"):
        read(truth_pixels="undistorted")


def test_gyroscope_and_poses_give_the_turn(tmp_path):
    rate = np.array([0.4, -0.9, 0.6])
    gyroscope(tmp_path, 5.0, 5.4, rate)
    poses(tmp_path, (0.3, 0.4, 0.0), rate, start_s=5.0)
    # world directions turn the other way in the camera's axes
    truth = Rotation.from_rotvec(-rate * 0.0137).as_matrix()
    by_rate = read_gyroscope(tmp_path / "imu.txt")
    by_place = read_poses(tmp_path / "groundtruth.txt")
    for attitude in (by_rate, by_place):
        np.testing.assert_allclose(attitude.turn(5.1042, 5.1179), truth, rtol=0, atol=1e-9)
        with pytest.raises(FileFormatError, match="not the window"):
            attitude.turn(5.39, 5.41)
    assert by_rate.moved_m(5.1, 5.2) is None
    assert by_place.moved_m(5.1, 5.2) == pytest.approx(0.05)
    turned = read_gyroscope(tmp_path / "imu.txt", "-y+xz").turn(5.1, 5.2)
    right = Rotation.from_rotvec([-0.09, -0.04, -0.06]).as_matrix()
    np.testing.assert_allclose(turned, right, rtol=0, atol=1e-9)
    lines = (tmp_path / "imu.txt").read_text().splitlines()
    (tmp_path / "imu.txt").write_text("\n".join(lines[:100] + lines[250:]))
    with pytest.raises(FileFormatError, match=r"no sample for 0.1\d* s"):
        read_gyroscope(tmp_path / "imu.txt").turn(5.05, 5.3)


def test_a_rate_that_changes_linearly_is_integrated_exactly_about_a_fixed_axis(tmp_path):
    t_s = np.arange(51) / 50
    # rate 3 t about z: angle 1.5 t^2
    np.savetxt(tmp_path / "imu.txt", np.column_stack([t_s, np.zeros((51, 5)), 3 * t_s]))
    # within a sample of 20 ms the rate is held at its mean: at the sample times the angle is exact
    found = read_gyroscope(tmp_path / "imu.txt").turn(0.2, 0.6)
    right = Rotation.from_rotvec([0, 0, -1.5 * (0.36 - 0.04)]).as_matrix()
    np.testing.assert_allclose(found, right, rtol=0, atol=1e-12)


@refusals.table(__file__, "side files")
def test_damaged_side_files(row, tmp_path):
    def side(content):
        (tmp_path / "side.txt").write_text(content)
        return tmp_path / "side.txt"

    row.holds(vars(camera) | {"side": side})


def test_the_camera_fit_projects_as_the_camera():
    lens = Calibration((30.0, 31.0), (20.2, 14.7), (-0.2, 0.06, 1e-3, -5e-4, 0.0))
    rays = lens.directions(30, 40)

    def entrance(rays):
        """The pupil moves along the axis with the field."""
        return np.stack([0 * rays[..., 0], 0 * rays[..., 0], 1e-3 * rays[..., 0] ** 2], -1)

    fit = CameraFit(rays, entrance(rays))
    assert fit.error_px < 1e-3
    inner = rays[3:-3:2, 4:-4:2] * 0.97 * np.array([1, 1, 1 / 0.97])  # between pixels
    for depth in (0.1, 2.0):
        found = fit.project((entrance(inner) + depth * inner).reshape(-1, 3))
        np.testing.assert_allclose(found, lens.project(inner).reshape(-1, 2), rtol=0, atol=1e-3)
    assert np.isnan(fit.project(np.array([[0.0, 0.0, -1.0]]))).all()
    with pytest.raises(FileFormatError, match="finite and forward"):
        CameraFit(-rays, entrance(rays))
    y, x = np.mgrid[0:30, 0:40]
    with pytest.raises(FileFormatError, match="fitted to"):
        CameraFit(rays + np.array([0.01, 0, 0]) * ((x + y) % 2)[..., None], entrance(rays))
