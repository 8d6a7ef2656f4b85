"""Small whole files of flow, recordings, networks and data sets, and who reads each."""

import io
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from codesign.flow import checkpoint, files
from codesign.flow.sources import truth
from codesign.flow.sources.camera import read_calibration, read_gyroscope, read_poses
from codesign.flow.sources.packet import PacketOptions
from codesign.flow.sources.packets import read_packets
from tests.hostile.seeds_events import Seed, arrays, buffered, made
from tests.recording_case import ETH_CALIBRATION, eth_text
from tests.recording_case import made as recording

SIZE = (9, 12)
TIMES = {"t0": np.array(1.0), "t1": np.array(1.5)}
FLOW = np.random.default_rng(0).normal(size=(2, *SIZE)).astype(np.float32)


def flow(suffix: str) -> Callable[[], bytes]:
    """What ``write_flow`` writes."""
    name = f"flow{suffix}"
    values = torch.from_numpy(FLOW)
    return made(name, lambda folder: files.write_flow(folder / name, values, values[0] > -1))


def matlab(packed: bool) -> Callable[[], bytes]:
    """What SciPy writes."""

    def write(buffer):
        import scipy.io

        values = {"flow": FLOW, "t0": 1.0, "t1": 1.5, "who": "me"}
        scipy.io.savemat(buffer, values, do_compression=packed)

    return buffered(write)


def read_truth(path: Path):
    """The flows of a file for a small sensor."""
    return truth.read_truth(path, SIZE)


def table() -> Callable[[], bytes]:
    """``x y u v`` of every pixel."""
    y, x = np.mgrid[: SIZE[0], : SIZE[1]]
    rows = np.column_stack([x.ravel(), y.ravel(), *FLOW.reshape(2, -1)])
    return buffered(lambda buffer: np.savetxt(buffer, rows, header="x y u v", fmt="%.6g"))


def motion(columns: int) -> Callable[[], bytes]:
    """Lines of times and numbers: of a gyroscope (7) or of poses (8)."""
    rows = np.random.default_rng(1).normal(size=(12, columns))
    rows[:, 0] = np.arange(12) * 0.01
    if columns == 8:
        rows[:, 4:] /= np.linalg.norm(rows[:, 4:], axis=1, keepdims=True)
    return buffered(lambda buffer: np.savetxt(buffer, rows))


def turned(reader):
    """The turn and way over a part of what was recorded."""

    def read(path: Path):
        attitude = reader(path)
        if attitude.missing(attitude.t_s[0], attitude.t_s[-1]):
            return attitude.t_s
        ends = attitude.t_s[0], attitude.t_s[-1]
        return [attitude.turn(*ends), attitude.moved_m(*ends) or 0.0]

    return read


def archive(buffer: io.BytesIO) -> None:
    """A recording in a zip archive."""
    motion = "\n".join(f"{1 + k * 0.01:.3f} 0 0 9.8 0.1 0 0.2" for k in range(12))
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as packed:
        packed.writestr("shapes/events.txt", eth_text(recording(60, start_s=1.0)))
        packed.writestr("shapes/calib.txt", ETH_CALIBRATION)
        packed.writestr("shapes/imu.txt", motion)


def packets(path: Path):
    """One packet of a recording of the DAVIS."""
    return read_packets(path, options=PacketOptions(size_px=(180, 240), count=1))


def network(folder: Path) -> None:
    """Tensors and content with their checksum."""
    weights = {"a": torch.arange(6.0).reshape(2, 3), "b": torch.ones(2, dtype=torch.int64)}
    content = {"kind": "network", "network": "refiner", "config": {"bins": 3}}
    checkpoint.write_tensors(folder / "network.safetensors", weights, content)


def read_network(path: Path):
    """As ``load`` does."""
    return checkpoint.read(path).weights


SEEDS: dict[str, Seed] = {
    "flow.flo": (flow(".flo"), files.read_flow),
    "flow.png": (flow(".png"), files.read_flow),
    "truth.npy": (arrays(False, only=FLOW), read_truth),
    "truth.npz": (arrays(True, x_flow=FLOW[0], y_flow=FLOW[1], **TIMES), read_truth),
    "truth.mat": (matlab(True), read_truth),
    "open.mat": (matlab(False), read_truth),
    "truth.txt": (table(), read_truth),
    "imu.txt": (motion(7), turned(read_gyroscope)),
    "groundtruth.txt": (motion(8), turned(read_poses)),
    "calib.txt": (ETH_CALIBRATION.encode, read_calibration),
    "recording.zip": (buffered(archive), packets),
    "network.safetensors": (made("network.safetensors", network), read_network),
}
