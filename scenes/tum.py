"""Trajectories as TUM text files: one pose per line, ``timestamp tx ty tz qx qy qz qw``; and a
trajectory through recorded poses.

Lines that begin with # and empty lines are skipped; numbers are separated by spaces or tabs, or by
commas (CSV), and the first line may be a header such as ``t_s,x,y,z,qx,qy,qz,qw``. Source: the file
formats of the TUM RGB-D benchmark (Sturm et al., A benchmark for the evaluation of RGB-D SLAM
systems, IROS 2012).
"""

import re
from pathlib import Path

import numpy as np
import scipy
import torch

from codesign.atomic import replacing
from codesign.checks import check_finite
from codesign.doors import explain
from codesign.errors import DomainError, FileFormatError, ShapeError
from codesign.pose import check_poses, inverse, se3_exp
from codesign.reading import read_text
from scenes.trajectories.trajectory import Trajectory

MOST_BYTES = 64_000_000
MOST_POSES = 1_000_000
LONGEST_LINE = 400
UNIT_TOLERANCE = 1e-3  # of a quaternion's length: files with four digits stay within 1e-4
NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d{1,4})?")
NAMES = re.compile(r"(timestamp|time|t)(_s)? t?x(_m)? t?y(_m)? t?z(_m)? qx qy qz qw")
# headers of EuRoC and TUM-VI: nanoseconds, w before x, y and z
TITLES = re.compile(r"#?\W*(timestamp|time|t)\b")
FOREIGN = re.compile(r"[\[(]n(s|ano\w*)[\])]|\b(q\w*)?w\W+(q\w*)?x\W+(q\w*)?y\W+(q\w*)?z\b")
LATEST_S = 1e10  # nanoseconds of a recording and milliseconds since 1970 are beyond
HEADER = "# timestamp tx ty tz qx qy qz qw"


def write_tum(path: str | Path, t_s: torch.Tensor, poses: torch.Tensor) -> None:
    """Write poses as text with all digits; the file appears whole or not at all.

    Args:
      t_s: [n] increasing seconds.
      poses: [n, 4, 4] rigid, for example T_world_cam.
    Raises: ShapeError, DomainError for anything else; FileFormatError when the folder is not
      writable.
    """
    t_s, poses = _checked(t_s, poses)
    turns = scipy.spatial.transform.Rotation.from_matrix(poses[:, :3, :3].numpy())
    turn = turns.as_quat(canonical=True)
    rows = np.concatenate([t_s.numpy()[:, None], poses[:, :3, 3].numpy(), turn], 1).tolist()
    with replacing(path) as temporary:
        temporary.write_text(
            "\n".join([HEADER, *(" ".join(map(repr, row)) for row in rows)]) + "\n",
            encoding="utf-8",
        )


def read_tum(path: str | Path) -> tuple[torch.Tensor, torch.Tensor]:
    """Read a trajectory.

    Returns: t_s [n] float64 seconds, poses [n, 4, 4] float64. Quaternions are normalised.
    Raises: FileFormatError, with the line, for anything but eight finite numbers, times that do not
      increase, or a quaternion whose length is not 1 to 0.001; for files that are missing, empty,
      or larger than 64 MB or a million poses.
    """
    path = Path(path)
    rows = []
    numbers = []
    for number, line in enumerate(read_text(path, MOST_BYTES).split("\n"), start=1):
        line = line.strip(" \t\r")
        if not line or line.startswith("#"):
            if not rows and TITLES.match(line) and FOREIGN.search(line):
                raise FileFormatError(
                    f"{path}, line {number}: {line[:60]!r} has nanoseconds or quaternions that begin with w; write "
                    "seconds, and qx qy qz qw."
                )
            continue
        words = _words(line) if len(line) <= LONGEST_LINE else []
        if not rows and NAMES.fullmatch(" ".join(words)):
            continue
        if len(words) != 8 or not all(NUMBER.fullmatch(word) for word in words):
            raise FileFormatError(
                f"{path}, line {number}: {line[:60]!r} is not 'timestamp tx ty tz qx qy qz qw', eight "
                "finite decimal numbers."
            )
        if len(rows) == MOST_POSES:
            raise FileFormatError(
                f"{path}, line {number}: more than {MOST_POSES} poses; split the file."
            )
        rows.append([float(word) for word in words])
        numbers.append(number)
    if not rows:
        raise FileFormatError(f"{path} holds no pose.")
    table = np.array(rows)
    with np.errstate(over="ignore"):
        length = np.linalg.norm(table[:, 4:], axis=1)
    for bad, reason in (
        (~np.isfinite(table).all(1), "a number is too large for 64 bits"),
        (
            ~(np.abs(length - 1) <= UNIT_TOLERANCE),
            f"the quaternion qx qy qz qw has not length 1 (to {UNIT_TOLERANCE:g}), so it is no rotation",
        ),
        (np.diff(table[:, 0], prepend=-np.inf) <= 0, "the timestamp is not after the one before"),
        (table[:, 0] > LATEST_S, "the timestamp is no time in seconds"),
    ):
        if bad.any():
            at = int(np.flatnonzero(bad)[0])
            raise FileFormatError(f"{path}, line {numbers[at]}: {reason}.")
    poses = torch.eye(4, dtype=torch.float64).repeat(len(table), 1, 1)
    turns = scipy.spatial.transform.Rotation.from_quat(table[:, 4:])
    poses[:, :3, :3] = torch.from_numpy(turns.as_matrix())
    poses[:, :3, 3] = torch.from_numpy(table[:, 1:4])
    return torch.from_numpy(table[:, 0].copy()), poses


def _words(line):
    return [word.strip() for word in line.split(",")] if "," in line else line.split()


class Recorded(Trajectory):
    """A trajectory through poses at times: between two of them the constant twist that leads from
    one to the next (a geodesic of SE(3)).

    Continuous, with a velocity that jumps at the recorded times; there the segment behind counts.

    Args:
      t_s: [n >= 2] increasing seconds.
      poses: [n, 4, 4] rigid.
    Raises: ShapeError; DomainError, also when the body turns by more than 3 rad between two poses,
      where the way is not clear.
    """

    def __init__(self, t_s, poses):
        from kornia.geometry.liegroup import Se3, So3

        self.t_s, self.poses = _checked(t_s, poses)
        if len(self.t_s) < 2:
            raise ShapeError("a recorded trajectory needs at least 2 poses.")
        self.span_s = (float(self.t_s[0]), float(self.t_s[-1]))
        step = inverse(self.poses[:-1]) @ self.poses[1:]
        turn = torch.from_numpy(
            scipy.spatial.transform.Rotation.from_matrix(step[:, :3, :3].numpy())
            .as_quat(canonical=True)[:, [3, 0, 1, 2]]
            .copy()
        )
        twist = Se3(So3.from_wxyz(turn), step[:, :3, 3]).log().detach()
        if twist[:, 3:].norm(dim=1).max() > 3:
            at = int(twist[:, 3:].norm(dim=1).argmax())
            raise DomainError(
                f"the body turns by {twist[at, 3:].norm():.3g} rad between {self.t_s[at]:g} "
                f"and {self.t_s[at + 1]:g} s; give poses closer together (at most 3 rad apart)."
            )
        self.twist_per_s = twist / self.t_s.diff()[:, None]

    @staticmethod
    def read(path):
        """The trajectory in a TUM file."""
        return Recorded(*read_tum(path))

    def velocity(self, t_s):
        return self.twist_per_s[self._segment(self._times(t_s))]

    def _segment(self, t_s):
        return (torch.searchsorted(self.t_s, t_s, right=True) - 1).clamp(0, len(self.t_s) - 2)

    def _pose(self, t_s):
        at = self._segment(t_s)
        return self.poses[at] @ se3_exp(self.twist_per_s[at] * (t_s - self.t_s[at])[:, None])


def _checked(t_s, poses):
    t_s = torch.as_tensor(t_s, dtype=torch.float64).detach().cpu()
    poses = torch.as_tensor(poses).detach().double().cpu()
    check_poses(poses)
    if t_s.shape != poses.shape[:1]:
        raise ShapeError(
            f"{tuple(t_s.shape)} times were given for {poses.shape[0]} poses; give one per pose."
        )
    check_finite(t_s, "times of poses")
    if (t_s.diff() <= 0).any():
        raise DomainError("the times of poses must increase strictly; sort them and drop doubles.")
    return t_s, poses


explain(globals())
