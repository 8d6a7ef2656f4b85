"""Text events byte for byte, and the camera's turn and its flow against closed forms and another
implementation."""

import math

import numpy as np
import pytest
import torch
from kornia.geometry.calibration import distort_points
from scipy.spatial.transform import Rotation

from codesign.errors import DomainError, FileFormatError
from codesign.events.formats import text as text_events
from codesign.flow.sources import read_text_events
from codesign.flow.sources.camera import (
    Calibration,
    read_calibration,
    read_gyroscope,
    read_poses,
    signed_axes,
)
from tests.recording_case import DAVIS, ETH_CALIBRATION, eth_text, made


def check_events(found, columns, size=DAVIS):
    np.testing.assert_array_equal(found.t_us, columns[0])
    np.testing.assert_array_equal(found.x, columns[1])
    np.testing.assert_array_equal(found.y, columns[2])
    np.testing.assert_array_equal(found.on, columns[3] == 1)
    assert (found.height_px, found.width_px) == size


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
    check_events(read_text_events(path), columns)
    monkeypatch.setattr(text_events, "CHUNK_BYTES", 997)  # borders fall anywhere within a line
    check_events(read_text_events(path), columns)


def test_the_sensor_is_the_one_told_or_the_smallest_that_holds_the_events(tmp_path):
    path = tmp_path / "events.txt"
    for reach, size in (
        ((10, 10), (180, 240)),
        ((240, 10), (260, 346)),
        ((345, 259), (260, 346)),
        ((346, 0), (480, 640)),
        ((1279, 719), (720, 1280)),
        ((1280, 4), (5, 1281)),
    ):
        path.write_text(f"0.5 {reach[0]} {reach[1]} 1\n0.6 0 0 0\n")
        found = read_text_events(path)
        assert (found.height_px, found.width_px) == size
    assert read_text_events(path, size=(700, 1300)).size_from == "the options"
    with pytest.raises(FileFormatError, match=r"line 1: .*x = 1280; the sensor has 1280 pixels"):
        read_text_events(path, size=(720, 1280))
    with pytest.raises(FileFormatError, match=r"height_px 5 by the frames, but 700 was asked for"):
        read_text_events(path, size=(700, 1300), told=(5, 1281), told_by="the frames")


# the camera and how it turns


def test_distortion_is_that_of_another_implementation_and_its_inverse_brings_pixels_back(tmp_path):
    (tmp_path / "calib.txt").write_text(ETH_CALIBRATION)
    camera = read_calibration(tmp_path / "calib.txt")
    rays = camera.directions(*DAVIS)
    y, x = np.mgrid[0:180, 0:240]
    np.testing.assert_allclose(camera.project(rays), np.stack([x, y], -1), rtol=0, atol=1e-5)
    # kornia takes pixels of the undistorted picture
    matrix = torch.tensor(
        [
            [camera.focal_px[0], 0, camera.centre_px[0]],
            [0, camera.focal_px[1], camera.centre_px[1]],
            [0, 0, 1],
        ],
        dtype=torch.float64,
    )
    flat = torch.from_numpy(rays[..., :2] * camera.focal_px + camera.centre_px).reshape(1, -1, 2)
    theirs = distort_points(
        flat, matrix[None], torch.tensor([camera.distortion], dtype=torch.float64)
    ).reshape(180, 240, 2)
    np.testing.assert_allclose(theirs.numpy(), np.stack([x, y], -1), rtol=0, atol=1e-5)


def test_rotation_flow_in_closed_form():
    camera = Calibration((200.0, 200.0), (119.5, 89.5))
    angle = 0.03
    y, x = np.mgrid[0:180, 0:240]
    u = x - 119.5
    v = y - 89.5
    # the camera rolls clockwise (its x axis towards its y axis), so the picture turns the other way
    roll, valid = camera.rotation_flow(Rotation.from_rotvec([0, 0, angle]).inv().as_matrix(), *DAVIS)
    assert valid.all()
    np.testing.assert_allclose(
        roll,
        [u * math.cos(angle) + v * math.sin(angle) - u, -u * math.sin(angle) + v * math.cos(angle) - v],
        rtol=0,
        atol=1e-9,
    )
    # a pan to the right carries the picture to the left: along the middle row x = f tan(atan(u / f) - angle)
    pan, _ = camera.rotation_flow(Rotation.from_rotvec([0, angle, 0]).inv().as_matrix(), *DAVIS)
    horizontal = 200 * np.tan(np.arctan(u / 200) - angle) - u
    np.testing.assert_allclose(pan[0], horizontal, rtol=0, atol=1e-9)
    np.testing.assert_allclose(
        pan[1], v * (1 / (math.cos(angle) + u / 200 * math.sin(angle)) - 1), rtol=0, atol=1e-9
    )  # z' of the turned ray
    behind, seen = camera.rotation_flow(Rotation.from_rotvec([0, math.pi / 2, 0]).inv().as_matrix(), *DAVIS)
    assert seen.sum() == 180 * 120  # the right half stays ahead of the camera
    assert not behind[:, ~seen].any()


def test_gyroscope_and_poses_give_the_turn(tmp_path):
    rate = np.array([0.4, -0.9, 0.6])
    t_s = 5.0 + np.arange(101) / 100
    turns = Rotation.from_rotvec(rate * (t_s - 5.0)[:, None])
    np.savetxt(tmp_path / "imu.txt", np.column_stack([t_s, np.zeros((101, 3)), np.tile(rate, (101, 1))]))
    np.savetxt(
        tmp_path / "groundtruth.txt",
        np.column_stack([t_s, np.outer(t_s - 5, [0.3, 0.4, 0.0]), turns.as_quat()]),
    )
    truth = Rotation.from_rotvec(
        -rate * 0.0137
    ).as_matrix()  # world directions turn the other way in the camera's axes
    gyroscope = read_gyroscope(tmp_path / "imu.txt")
    poses = read_poses(tmp_path / "groundtruth.txt")
    for attitude in (gyroscope, poses):
        np.testing.assert_allclose(attitude.turn(5.1042, 5.1179), truth, rtol=0, atol=1e-9)
        with pytest.raises(FileFormatError, match="not the window"):
            attitude.turn(5.99, 6.01)
    assert gyroscope.moved_m(5.1, 5.2) is None
    assert poses.moved_m(5.1, 5.2) == pytest.approx(0.05)
    axes = signed_axes("-y+xz")
    np.testing.assert_allclose(
        read_gyroscope(tmp_path / "imu.txt", axes).turn(5.1, 5.2),
        Rotation.from_rotvec([-0.09, -0.04, -0.06]).as_matrix(),
        rtol=0,
        atol=1e-9,
    )
    np.savetxt(
        tmp_path / "imu.txt",
        np.column_stack([t_s, np.zeros((101, 3)), np.tile(rate, (101, 1))])[np.abs(t_s - 5.5) > 0.07],
    )
    with pytest.raises(FileFormatError, match=r"no sample for 0.1\d* s"):
        read_gyroscope(tmp_path / "imu.txt").turn(5.45, 5.55)
    with pytest.raises(DomainError, match="name each of x, y, z once"):
        signed_axes("xxz")


def test_a_rate_that_changes_linearly_is_integrated_exactly_about_a_fixed_axis(tmp_path):
    t_s = np.arange(51) / 50
    np.savetxt(
        tmp_path / "imu.txt", np.column_stack([t_s, np.zeros((51, 5)), 3 * t_s])
    )  # rate 3 t about z: angle 1.5 t^2
    # within a sample of 20 ms the rate is held at its mean: at the sample times the angle is exact
    np.testing.assert_allclose(
        read_gyroscope(tmp_path / "imu.txt").turn(0.2, 0.6),
        Rotation.from_rotvec([0, 0, -1.5 * (0.36 - 0.04)]).as_matrix(),
        rtol=0,
        atol=1e-12,
    )


@pytest.mark.parametrize(
    ("name", "content", "reason"),
    [
        ("imu.txt", "1 2 3\n", "rows of 3 numbers"),
        ("imu.txt", "a b c\n", "cannot be read"),
        ("imu.txt", "2 0 0 0 0 0 0\n1 0 0 0 0 0 0\n", "row 2 lies before"),
        ("groundtruth.txt", "0 0 0 0 0 0 0 2\n1 0 0 0 0 0 0 1\n", "length 2"),
        ("calib.txt", "1 2 3\n", "3 numbers"),
        ("calib.txt", "-1 2 3 4\n", "above 0"),
        ("calib.txt", "x\n", "in pixels is needed"),
    ],
)
def test_damaged_side_files(name, content, reason, tmp_path):
    (tmp_path / name).write_text(content)
    read = {"imu.txt": read_gyroscope, "groundtruth.txt": read_poses, "calib.txt": read_calibration}[name]
    with pytest.raises(FileFormatError, match=reason):
        read(tmp_path / name)
