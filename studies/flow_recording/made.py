"""A recording to run on where there is none: a camera that turns before a photograph, written in
the layout of the Event-Camera Dataset (events.txt, imu.txt, groundtruth.txt, calib.txt)."""

import numpy as np
from scipy.spatial.transform import Rotation

from codesign.atomic import replacing, write_atomic
from scenes.windows.streams import turning

IMU_HZ = 1000.0
POSES_HZ = 200.0
STEP_S = 1e-5  # of the differences that rates of turn are
START_S = 100.0  # recordings do not begin at zero


def make(folder, duration_s=0.2, size_px=(180, 240), seed=0):
    """Make and write a recording. size_px: (height, width); the focal length is 200 px at any size.

    Returns: its Recording (scenes.windows.streams), whose clock begins at 0.
    """
    made = turning(duration_s, size_px, seed)
    height, width = size_px
    lens = np.diag([made.focal_px, made.focal_px, 1.0])

    def attitude(t_s):
        """R_world_camera."""
        return Rotation.from_matrix(np.linalg.inv(lens) @ made.layers[0].motion(t_s) @ lens).inv()

    def times(rate_hz):
        return np.arange(round(duration_s * rate_hz) + 1) / rate_hz

    folder.mkdir(parents=True, exist_ok=True)
    stream = made.stream
    rows = [stream.t_us.numpy() * 1e-6 + START_S, stream.x, stream.y, stream.p > 0]
    imu_s, pose_s = times(IMU_HZ), times(POSES_HZ)
    turned = attitude(imu_s - STEP_S).inv() * attitude(imu_s + STEP_S)
    gravity = np.tile([0.0, 9.81, 0.0], (len(imu_s), 1))
    tables = {
        "events.txt": (rows, "%.6f %d %d %d"),
        "imu.txt": ([imu_s + START_S, gravity, turned.as_rotvec() / (2 * STEP_S)], "%.9f"),
        "groundtruth.txt": (
            [pose_s + START_S, np.zeros((len(pose_s), 3)), attitude(pose_s).as_quat()],
            "%.9f",
        ),
    }
    for name, (columns, form) in tables.items():
        with replacing(folder / name) as temporary:
            np.savetxt(temporary, np.column_stack(columns), fmt=form)
    calibration = (
        f"{made.focal_px} {made.focal_px} {(width - 1) / 2} {(height - 1) / 2} 0 0 0 0 0\n"
    )
    write_atomic(folder / "calib.txt", calibration.encode())
    return made
