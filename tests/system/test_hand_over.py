"""A mount handed over is the same mount: transform by hand, bits by reading back, and faults of the
file by sentence."""

import math
from typing import Any

import numpy as np
import pytest
import torch

from codesign import events, lens, render
from codesign.errors import DomainError
from codesign.mount import Mount
from codesign.plain_yaml import load
from codesign.system import HandOver, load_hand_over, save_hand_over
from tests import refusals
from tests.numbers import D, close, f64, randn64


def found_mount(generator):
    mount = Mount((0.2, 0.0, 0.4), (0.1, 0.0, 0.2), yaw_rad=0.3, pitch_rad=1.0, roll_rad=-0.2)
    mount.numbers.detach().copy_(randn64(generator, 6))
    mount.variables(render.Camera(lens.Pinhole(3.4), 8, 8, 0.2, 1), 2.0)
    return mount


def behind(optic, **options):
    return render.Camera(optic, 32, 24, 0.1, 4, **options)


CAMERAS = {
    "pinhole": lambda: behind(lens.Pinhole(3.4), seed=3),
    "thin": lambda: behind(lens.ThinLens(8.0, 2.0).focus_at(1.3), falloff=True),
    "variables": lambda: varied(lens.ThinLens(8.0, 2.0)),
    "float32": lambda: behind(lens.load("cooke-triplet", torch.float32).scaled(0.3)),
    "in one colour": lambda: behind(
        lens.load("cooke-triplet").scaled(0.3),
        spectrum=lens.Spectrum((0.45, 0.5), (0.25, 0.75)),
    ).in_one_colour(),
    "windows": lambda: render.Camera(
        lens.load("double-gauss").scaled(0.2),
        8,
        8,
        0.05,
        3,
        film=render.Film(64, 48, 8, 8, 0.05, ((0, 0), (32, 40))),
        spectrum=lens.Spectrum.visible_FdC(),
        aim=True,
    ),
}


def varied(optic):
    (focus,) = optic.variables("focus", step_mm=0.01)
    focus.data += 1.7
    return render.Camera(optic, 16, 16, 0.1, 4)


@pytest.mark.bits
@pytest.mark.parametrize("kind", CAMERAS)
def test_it_loads_back_bit_for_bit(tmp_path, generator, kind):
    camera = CAMERAS[kind]()
    sensor = events.SensorModel(theta_on=0.13, theta_sigma=0.017, cutoff_hz=99.9, refractory_s=1e-5)
    handed = HandOver(
        found_mount(generator),
        camera,
        sensor,
        "base_footprint",
        "front_optical_frame",
        {"error_m_s": 0.1, "by": "me"},
    )
    save_hand_over(tmp_path / "mount.yaml", handed)
    back = load_hand_over(tmp_path / "mount.yaml")
    assert torch.equal(back.mount(), handed.mount())
    for name, value in handed.mount.state_dict().items():
        assert torch.equal(back.mount.state_dict()[name], value), name
    numbers = randn64(generator, 6)
    assert torch.equal(back.mount(numbers), handed.mount(numbers))  # the map, not just the pose
    assert back.mount.numbers.requires_grad
    assert back.camera.film == camera.film
    assert back.camera.colours == camera.colours
    mine, other = camera.rays(), back.camera.rays()
    for name in ("origin_m", "direction", "weight"):
        assert torch.equal(getattr(mine, name), getattr(other, name)), name
    assert (back.sensor, back.parent_frame, back.child_frame, back.notes) == (
        sensor,
        "base_footprint",
        "front_optical_frame",
        {"error_m_s": 0.1, "by": "me"},
    )
    before = (tmp_path / "mount.yaml").read_bytes()
    save_hand_over(tmp_path / "mount.yaml", back)
    assert (tmp_path / "mount.yaml").read_bytes() == before


def rotated(quaternion, vector):
    """q v q* written out by Hamilton's products."""
    x, y, z, w = quaternion
    u = f64([x, y, z])
    return 2 * (u @ vector) * u + (w * w - u @ u) * vector + 2 * w * torch.linalg.cross(u, vector)


def test_the_transform_is_the_mount_for_other_programs(tmp_path, generator):
    handed = HandOver(found_mount(generator), CAMERAS["pinhole"]())
    save_hand_over(tmp_path / "mount.yaml", handed)
    page = load((tmp_path / "mount.yaml").read_text())
    pose = handed.mount().detach()
    quaternion = [page["transform"]["rotation_quaternion"][axis] for axis in "xyzw"]
    point = randn64(generator, 3)
    there = rotated(quaternion, point) + f64(list(page["transform"]["translation_m"].values()))
    close(there, pose[:3, :3] @ point + pose[:3, 3], atol=1e-14)
    # URDF: fixed axes, roll about x first, then pitch about y, then yaw about z; then from link to
    # optical axes
    roll, pitch, yaw = page["urdf_origin"]["rpy_rad"]

    def about(axis, angle):
        turn = torch.zeros(3, 3, dtype=D)
        i, j = (axis + 1) % 3, (axis + 2) % 3
        turn[axis, axis] = 1
        turn[i, i] = turn[j, j] = math.cos(angle)
        turn[j, i], turn[i, j] = math.sin(angle), -math.sin(angle)
        return turn

    optical = f64([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
    close(about(2, yaw) @ about(1, pitch) @ about(0, roll) @ optical, pose[:3, :3], atol=1e-14)


def test_a_transform_alone_is_a_held_mount(tmp_path, generator):
    handed = HandOver(found_mount(generator), CAMERAS["pinhole"]())
    path = tmp_path / "mount.yaml"
    save_hand_over(path, handed)
    path.write_text(path.read_text().split("mount:\n")[0])
    back = load_hand_over(path)
    close(back.mount(), handed.mount(), atol=1e-14)
    assert torch.equal(back.mount.half_range_m, torch.zeros(3, dtype=D))


@refusals.table(__file__, "files of mounts")
def test_faults_of_the_file_get_a_sentence(row, tmp_path, generator):
    path = tmp_path / "mount.yaml"
    save_hand_over(
        path, HandOver(found_mount(generator), CAMERAS["windows"](), events.SensorModel())
    )

    def changed(old, new):
        text = path.read_text()
        assert old in text
        path.write_text(text.replace(old, new))
        return load_hand_over(path)

    row.holds({"changed": changed})


class Own:
    def camera_rays(self, *args: Any, **kwargs: Any) -> Any:
        raise NotImplementedError


class Fisheye(lens.ThinLens):
    pass


@refusals.table(__file__, "what is handed over")
def test_what_cannot_be_handed_over_gets_a_sentence(row, tmp_path, monkeypatch, generator):
    monkeypatch.chdir(tmp_path)
    made = {"MOUNT": found_mount(generator), "CAMERA": CAMERAS["pinhole"]()}
    row.holds(globals() | made)
    assert list(tmp_path.iterdir()) == []


def test_what_is_refused_leaves_what_was_handed_over_before(tmp_path, generator):
    mount, path = found_mount(generator), tmp_path / "mount.yaml"
    save_hand_over(path, HandOver(mount.float(), CAMERAS["windows"]()))
    notes = {"error": np.float32(0.1)}
    with pytest.raises(DomainError, match="float32 is not JSON"):
        save_hand_over(path, HandOver(mount, CAMERAS["float32"](), notes=notes))  # pyright: ignore[reportArgumentType]
    load_hand_over(path)
