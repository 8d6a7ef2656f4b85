"""Network files: every bit comes back, equal networks are equal files, and each kind of damage is
one clear error."""

import json
import sys

import pytest
import safetensors.torch
import torch
from torch import nn

from codesign.errors import DomainError, FileFormatError
from codesign.flow import checkpoint
from tests import refusals
from tests.numbers import f64


class Tiny(nn.Module):
    """Stands for a network; the tests look at its weights alone."""

    def __init__(self, bins=2, width=3):
        super().__init__()
        if width > 9:
            raise DomainError("width is at most 9")
        self.config = {"bins": bins, "width": width}
        self.layer = nn.Conv2d(2 * bins, width, 3)
        self.register_buffer("scale", f64(1 / 3))
        self.low = nn.Parameter(torch.tensor([1.5, -0.0], dtype=torch.bfloat16))


class Other(Tiny):
    """A network of the user's own."""


@pytest.fixture(autouse=True)
def named(monkeypatch):
    monkeypatch.setitem(sys.modules, "tiny_networks", sys.modules[__name__])
    monkeypatch.setattr(Tiny, "__module__", "tiny_networks")
    monkeypatch.setitem(checkpoint.NETWORKS, "tiny", "tiny_networks:Tiny")


@pytest.fixture
def path(tmp_path):
    checkpoint.save(Tiny(width=4), tmp_path / "tiny.safetensors", {"seed": 3, "note": "π"})
    return tmp_path / "tiny.safetensors"


def bits(network):
    return {
        name: (tensor.dtype, tensor.reshape(-1).view(torch.uint8).tolist())
        for name, tensor in network.state_dict().items()
    }


def test_every_bit_comes_back_and_equal_networks_are_equal_files(tmp_path):
    network = Tiny(bins=3, width=5).train()
    metadata = {"seed": 3, "loss": 0.1 + 0.2, "note": "π"}
    one, two = tmp_path / "a.safetensors", tmp_path / "b.safetensors"
    checkpoint.save(network, one, metadata)
    back = checkpoint.load(one)
    assert isinstance(back, Tiny)
    assert back.config == {"bins": 3, "width": 5}
    assert not back.training
    assert bits(back) == bits(network)
    assert checkpoint.read(one).metadata == metadata
    checkpoint.save(back, two, metadata)
    assert one.read_bytes() == two.read_bytes()
    with torch.no_grad():
        network.double().layer.weight += 1e-9
    checkpoint.save(network, two)
    assert bits(checkpoint.load(two)) == bits(network)


def test_a_network_of_ones_own_is_kept_and_needs_its_class(tmp_path):
    """A file says what it is, and imports nothing: the class is handed over."""
    network = Other(bins=3)
    checkpoint.save(network, tmp_path / "own.safetensors")
    back = checkpoint.load(tmp_path / "own.safetensors", Other)
    assert back.config == network.config
    assert torch.equal(back.get_parameter("layer.weight"), network.layer.weight)
    with pytest.raises(FileFormatError, match=r"Other' is a class of your own; hand it over"):
        checkpoint.load(tmp_path / "own.safetensors")
    with pytest.raises(FileFormatError, match=r"Other', not a Tiny"):
        checkpoint.load(tmp_path / "own.safetensors", Tiny)


def test_a_name_stands_for_the_delivered_file(monkeypatch, tmp_path, path):
    monkeypatch.setitem(checkpoint.DELIVERED, "refiner", path)
    assert bits(checkpoint.load("refiner")) == bits(checkpoint.load(path))
    monkeypatch.setitem(checkpoint.DELIVERED, "refiner", tmp_path / "gone.safetensors")
    with pytest.raises(FileFormatError, match="no file lies at"):
        checkpoint.load("refiner")
    with pytest.raises(FileFormatError, match="neither a delivered network"):
        checkpoint.load("refinerr")


def test_a_cut_or_changed_byte_is_never_unseen(path):
    whole = path.read_bytes()
    cuts = [whole[:length] for length in (0, 4, 8, 100, len(whole) // 2, len(whole) - 1)]
    places = range(0, len(whole), 61)  # header and tensors alike
    for content in cuts + [whole[:k] + bytes([whole[k] ^ 0x10]) + whole[k + 1 :] for k in places]:
        path.write_bytes(content)
        with pytest.raises(FileFormatError):
            checkpoint.load(path)


def test_pickles_are_never_opened(tmp_path):
    torch.save(Tiny().state_dict(), tmp_path / "a.safetensors")
    with pytest.raises(FileFormatError, match="damaged or not written by codesign"):
        checkpoint.load(tmp_path / "a.safetensors")
    safetensors.torch.save_file({"a": torch.zeros(2)}, tmp_path / "b.safetensors")
    with pytest.raises(FileFormatError, match="not written by codesign"):
        checkpoint.load(tmp_path / "b.safetensors")


def rewritten(path, weights=None, **changes):
    """The file with another content, its checksum right."""
    was = checkpoint.read(path)
    content = {"kind": "network", "network": was.network, "config": was.config, "metadata": {}}
    checkpoint.write_tensors(path, {**was.weights, **(weights or {})}, content | changes)
    return path


@refusals.table(__file__, "network files")
def test_what_does_not_fit_is_named(row, path):
    row.holds(globals() | {"load": lambda **changes: checkpoint.load(rewritten(path, **changes))})


def test_what_cannot_be_loaded_again_is_not_saved(tmp_path, path):
    before = path.read_bytes()
    with pytest.raises(DomainError, match="has no 'config'"):
        checkpoint.save(nn.Conv2d(2, 2, 1), path)
    bad = Tiny()
    nn.init.constant_(bad.layer.weight, torch.inf)
    with pytest.raises(DomainError, match=r"layer\.weight"):
        checkpoint.save(bad, path)
    with pytest.raises(DomainError, match="plain, finite JSON"):
        checkpoint.save(Tiny(), path, {"loss": float("nan")})
    assert path.read_bytes() == before
    with pytest.raises(FileFormatError, match="existing, writable folder"):
        checkpoint.save(Tiny(), tmp_path / "nowhere" / "a.safetensors")


def test_the_header_is_readable_by_other_tools(path):
    with safetensors.safe_open(str(path), framework="pt") as stored:
        content = json.loads(json.loads(stored.metadata()["codesign"])["content"])
    assert content["network"] == "tiny"
    assert content["config"] == {"bins": 2, "width": 4}
    assert content["metadata"]["seed"] == 3
