"""Flow files: the bytes of both formats, round trips within half a quantum, other writers' PNGs,
and damaged files."""

import struct
import zlib

import numpy as np
import pytest
import torch

from codesign import backend
from codesign.errors import DomainError, FileFormatError
from codesign.flow.files import read_flow, write_flow
from tests import refusals
from tests.numbers import rand64, seeded

QUANTUM_PX = 1 / 128


@pytest.fixture
def field():
    generator = seeded(0)
    flow = (rand64(generator, 2, 37, 53) - 0.5) * 511.9
    return flow, torch.rand(37, 53, generator=generator) > 0.3


def png(width, height, raw, depth=16):
    def chunk(name, data):
        return (
            struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))
        )

    return (
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, depth, 2, 0, 0, 0))
        + chunk(b"tEXt", b"k\0v")
        + chunk(b"IDAT", zlib.compress(raw))
        + chunk(b"IEND", b"")
    )


@pytest.mark.parametrize(
    ("name", "tolerance"),
    # half a quantum; half a unit in the last place of float32
    [("a.png", QUANTUM_PX / 2), ("a.flo", 255 * 2**-24)],
)
def test_round_trips_keep_validity_exactly_and_flow_to_the_format(name, tolerance, field, tmp_path):
    flow, valid = field
    write_flow(tmp_path / name, flow, valid)
    back, seen = read_flow(tmp_path / name)
    assert torch.equal(seen, valid)
    assert back.dtype == torch.float32
    assert (back - flow).abs()[:, valid].max() <= tolerance
    assert not back[:, ~valid].any()
    write_flow(tmp_path / f"b{name}", back, seen)
    # reading and writing again changes nothing
    assert (tmp_path / f"b{name}").read_bytes() == (tmp_path / name).read_bytes()


def test_other_programs_read_the_png(field, tmp_path):
    flow, valid = field
    write_flow(tmp_path / "a.png", flow, valid)
    pixels = np.array(backend.mitsuba().Bitmap(str(tmp_path / "a.png")))  # libpng
    expected = np.where(valid, np.rint(flow.numpy() * 128) + 32768, 0)
    np.testing.assert_array_equal(pixels[..., :2].transpose(2, 0, 1), expected)
    np.testing.assert_array_equal(pixels[..., 2] == 1, valid)


def test_flo_holds_the_bytes_of_the_format(tmp_path):
    flow = torch.tensor([[[1.0, 2.0, 3.0]], [[-1.0, -2.0, -3.0]]])
    write_flow(tmp_path / "a.flo", flow, torch.tensor([[True, True, False]]))
    assert (tmp_path / "a.flo").read_bytes() == b"PIEH" + struct.pack(
        "<ii6f", 3, 1, 1, -1, 2, -2, 1e10, 1e10
    )


@pytest.mark.parametrize("value", [256.0, -256.01])
def test_flows_beyond_sixteen_bits_are_refused_not_clipped(value, tmp_path):
    flow = torch.zeros(2, 4, 5, dtype=torch.float64)
    flow[1, 2, 3] = value
    with pytest.raises(DomainError, match="column 3, row 2 does not fit 16 bits"):
        write_flow(tmp_path / "a.png", flow)
    valid = flow[1] == 0
    write_flow(tmp_path / "a.png", flow, valid)  # not valid: its value does not matter
    assert torch.equal(read_flow(tmp_path / "a.png")[1], valid)


@pytest.mark.parametrize("name", ["a.png", "a.flo"])
def test_files_cut_off_anywhere_are_refused_in_one_sentence(name, field, tmp_path):
    write_flow(tmp_path / name, *field)
    content = (tmp_path / name).read_bytes()
    for length in (0, 3, 8, 11, 20, 40, len(content) // 2, len(content) - 1):
        (tmp_path / name).write_bytes(content[:length])
        with pytest.raises(FileFormatError) as caught:
            read_flow(tmp_path / name)
        assert "\n" not in str(caught.value)
    with pytest.raises(FileFormatError, match="no file lies at"):
        read_flow(tmp_path / f"none-{name}")


def flo(*size):
    return b"PIEH" + struct.pack("<ii", *size) + b"\0" * 8 * 25


@refusals.table(__file__, "flow files")
def test_files_that_are_no_flow_are_refused(row, tmp_path):
    def read(name, content):
        (tmp_path / name).write_bytes(content)
        return read_flow(tmp_path / name)

    row.holds(globals() | {"read": read})
