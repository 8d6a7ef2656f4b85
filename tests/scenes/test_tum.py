"""TUM trajectory files: round trips, what is tolerated, what is refused; and the path between
recorded poses."""

import math
from functools import partial

import pytest
import torch

from codesign.errors import DomainError, FileFormatError, ShapeError
from codesign.pose import check_poses, inverse, se3_exp
from scenes.tum import Recorded, read_tum, write_tum
from tests import refusals
from tests.numbers import D, close, f64, rand64, randn64, seeded

LINE = "0.5 1 2 3 0 0 0 1"


def some_poses(count, size=1.0):
    """Random rigid motions, with half turns among them."""
    twists = randn64(seeded(0), count, 6) * size
    twists[0] = 0
    twists[1, 3:] = torch.tensor([math.pi, 0, 0])
    return se3_exp(twists)


def test_round_trip_keeps_every_digit(tmp_path):
    # epoch times
    t = torch.cumsum(rand64(seeded(1), 200) + 1e-3, 0) + 1.7e9
    poses = some_poses(200, 2.0)
    write_tum(tmp_path / "path.txt", t, poses)
    t_back, back = read_tum(tmp_path / "path.txt")
    assert torch.equal(t_back, t)
    assert torch.equal(back[:, :3, 3], poses[:, :3, 3])
    close(back, poses, atol=1e-12)


def test_the_quaternion_is_the_scalar_last_one_of_the_format(tmp_path):
    # a quarter turn to the left about z: (0, 0, sin 45, cos 45); x goes to y
    (tmp_path / "a.txt").write_text(f"1.0 4 5 6 0 0 {math.sqrt(0.5)!r} {math.sqrt(0.5)!r}\n")
    t, poses = read_tum(tmp_path / "a.txt")
    expected = f64([[[0, -1, 0, 4], [1, 0, 0, 5], [0, 0, 1, 6], [0, 0, 0, 1]]])
    assert t.tolist() == [1.0]
    close(poses, expected, atol=1e-15)


def test_comments_tabs_and_line_ends_do_not_matter(tmp_path):
    text = "\ufeff# ground truth\r\n\r\n  0.5\t1  2 3   0 0 0 1  \r\n# more\n1.5e0 -1. +2 .5 0 0 0 -1.0"
    (tmp_path / "a.txt").write_bytes(text.encode())
    t, poses = read_tum(tmp_path / "a.txt")
    assert t.tolist() == [0.5, 1.5]
    assert poses[:, :3, 3].tolist() == [[1, 2, 3], [-1, 2, 0.5]]
    close(poses[:, :3, :3], torch.eye(3, dtype=D).expand(2, 3, 3))


@pytest.mark.parametrize(
    "header",
    [
        "",
        "t_s,x,y,z,qx,qy,qz,qw\n",
        "timestamp, tx, ty, tz, qx, qy, qz, qw\r\n",
        "# timestamp tx ty tz qx qy qz qw (Hamilton, qx first)\n",
        "# converted from EuRoC, qw qx qy qz reordered to qx qy qz qw\n# times were [ns], now seconds\n",
    ],
)
def test_tables_with_commas_are_read_alike(header, tmp_path):
    rows = "0.5,1,2,3,0,0,0,1\n1.5, -1, 2.5e-1, 3, 0, 0, 1, 0\n"
    (tmp_path / "a.csv").write_text(header + rows)
    (tmp_path / "a.txt").write_text(rows.replace(",", " "))
    for found, expected in zip(
        read_tum(tmp_path / "a.csv"), read_tum(tmp_path / "a.txt"), strict=True
    ):
        assert torch.equal(found, expected)


def test_four_digit_quaternions_become_rotations(tmp_path):
    (tmp_path / "a.txt").write_text("0 0 0 0 0.1826 0.3651 0.5477 0.7303\n")
    check_poses(read_tum(tmp_path / "a.txt")[1])
    rotation = read_tum(tmp_path / "a.txt")[1][0, :3, :3]
    close(rotation @ rotation.mT, torch.eye(3, dtype=D), atol=1e-15)


@refusals.table(__file__, "tables of poses")
def test_hostile_files_are_refused_with_the_line(row, tmp_path):
    def read(text):
        (tmp_path / "a.txt").write_text(text)
        return read_tum(tmp_path / "a.txt")

    row.holds({"read": read, "LINE": LINE})


def test_other_files_are_refused(tmp_path, monkeypatch):
    with pytest.raises(FileFormatError, match="no file lies at"):
        read_tum(tmp_path / "none.txt")
    (tmp_path / "binary").write_bytes(b"\x89PNG\xff\xfe")
    with pytest.raises(FileFormatError, match="no text in UTF-8"):
        read_tum(tmp_path / "binary")
    monkeypatch.setattr("scenes.tum.MOST_BYTES", 50)
    (tmp_path / "large.txt").write_text(LINE + " " * 100)
    with pytest.raises(FileFormatError, match="more than the 50"):
        read_tum(tmp_path / "large.txt")
    monkeypatch.setattr("scenes.tum.MOST_POSES", 2)
    (tmp_path / "long.txt").write_text("".join(f"{k} 0 0 0 0 0 0 1\n" for k in range(3))[:50])
    with pytest.raises(FileFormatError, match="line 3: more than 2 poses"):
        read_tum(tmp_path / "long.txt")
    with pytest.raises(FileFormatError, match="existing, writable folder"):
        write_tum(tmp_path / "none" / "a.txt", torch.zeros(1), torch.eye(4)[None])


@refusals.table(__file__, "written poses")
def test_writing_refuses_what_is_no_trajectory(row, tmp_path):
    row.holds({"write": partial(write_tum, tmp_path / "a.txt"), "torch": torch})
    assert not list(tmp_path.iterdir())


def test_a_recorded_path_is_a_geodesic_through_its_poses():
    twist = f64([0.4, -0.2, 0.1, 0.5, 0.3, -0.8])
    start = some_poses(3)[2]

    def exact(t):
        return start @ se3_exp(t[:, None] * twist)

    knots = f64([0.0, 0.3, 1.0, 2.2])
    path = Recorded(knots, exact(knots))
    t = torch.linspace(0, 2.2, 45, dtype=D)
    # constant twist: the geodesic is the motion itself
    close(path(t), exact(t), atol=1e-13)
    close(path.velocity(t), twist.expand(45, 6), atol=1e-12)
    other = Recorded(torch.arange(5, dtype=D), some_poses(6, 0.8)[torch.tensor([0, 2, 3, 4, 5])])
    close(other(other.t_s), other.poses, atol=1e-13)
    step = inverse(other(f64([1.2]))) @ other(f64([1.7]))
    close(step, se3_exp(0.5 * other.velocity(f64([1.4]))), atol=1e-13)


def test_recorded_paths_refuse_times_outside_and_ambiguous_turns(tmp_path):
    poses = some_poses(2)
    with pytest.raises(DomainError, match=r"turns by 3\.14 rad"):
        Recorded([0.0, 1.0], poses)
    write_tum(tmp_path / "a.txt", [0.0, 1.0], poses[:1].expand(2, 4, 4))
    path = Recorded.read(tmp_path / "a.txt")
    # standing still
    close(path(torch.tensor([0.5])), poses[:1])
    with pytest.raises(DomainError, match="from 0 to 1 s"):
        path(torch.tensor([1.5]))
    with pytest.raises(ShapeError, match="at least 2"):
        Recorded([0.0], poses[:1])
