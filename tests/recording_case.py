"""Random events and a calibration in the layout of the Event-Camera Dataset, for tests of
recordings."""

import shutil

import numpy as np
from scipy.spatial.transform import Rotation

DAVIS = (180, 240)
ETH_CALIBRATION = "199.092366542 198.82882047 132.192071378 110.712660011 -0.368436311798 0.150947243557 -0.000296130534385 -0.000759431726241 0.0"


def made(count=500, seed=0, size=DAVIS, start_s=1468939993.067416, duration_s=0.05):
    """(t_us, x, y, on) of random events, times rising."""
    draw = np.random.default_rng(seed)
    t_us = np.sort(draw.integers(0, round(duration_s * 1e6), count)) + round(start_s * 1e6)
    return (
        t_us,
        draw.integers(0, size[1], count),
        draw.integers(0, size[0], count),
        draw.integers(0, 2, count),
    )


def eth_text(columns, form="{t:.9f} {x} {y} {p}\n"):
    return "".join(
        form.format(t=t * 1e-6, t_us=t, x=x, y=y, p=p, sign=2 * p - 1)
        for t, x, y, p in zip(*(c.tolist() for c in columns), strict=True)
    )


def recording(folder, columns, calibration=ETH_CALIBRATION):
    """A folder in the layout of the Event-Camera Dataset, without motion; its events."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "events.txt").write_text(eth_text(columns))
    (folder / "calib.txt").write_text(calibration)
    return columns


def gyroscope(folder, first_s, last_s, rate=(0.2, -0.3, 0.5)):
    t_s = np.arange(round(first_s * 1000), round(last_s * 1000) + 1) / 1000
    rows = np.column_stack([t_s, np.zeros((len(t_s), 3)), np.tile(rate, (len(t_s), 1))])
    np.savetxt(folder / "imu.txt", rows, fmt="%.9f")


def poses(folder, speed_m_s, rate_rad_s, start_s=99.9):
    t_s = start_s + np.arange(81) / 200
    turns = Rotation.from_rotvec(np.outer(t_s - t_s[0], rate_rad_s)).as_quat()
    rows = np.column_stack([t_s, np.outer(t_s, speed_m_s), turns])
    np.savetxt(folder / "groundtruth.txt", rows)


# damage


def gone(path):
    shutil.rmtree(path) if path.is_dir() else path.unlink()


def halved(path):
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2])


def stores(path, name, values):
    import h5py

    with h5py.File(path, "r+") as file:
        del file[name]
        file[name] = values


def rewritten(path, old, new):
    path.write_text(path.read_text().replace(old, new))


def put(path, content):
    """A file of bytes, text, an array or arrays by name, or a picture; a folder of such files."""
    if isinstance(content, bytes):
        path.write_bytes(content)
    elif isinstance(content, str):
        path.write_text(content)
    elif path.suffix == ".npy":
        np.save(path, content)
    elif path.suffix == ".npz":
        np.savez(path, **content)
    elif isinstance(content, dict):
        path.mkdir()
        for name, picture in content.items():
            put(path / name, picture)
    else:
        import imageio.v3 as iio

        iio.imwrite(path, content)
