"""Networks as programs: the same numbers as the network, from torch.export and from ONNX."""

import importlib.util
import warnings

import pytest
import torch
from torch import nn

from codesign.errors import DomainError
from codesign.flow.export import eliminate, evenly_timed, export
from codesign.types import FlowField
from tests.numbers import randn64

needs_onnx = pytest.mark.skipif(
    importlib.util.find_spec("onnxscript") is None or importlib.util.find_spec("onnx") is None,
    reason="needs onnx and onnxscript",
)


class Small(nn.Module):
    """Every kind of step that flow networks have: a check of the values, numbers worked out from
    the bins' times, a solve, a branch, values written into one of two equal tensors."""

    def __init__(self, solves=True, writes=False):
        super().__init__()
        self.config = {"bins": 4}
        self.solves, self.writes = solves, writes
        self.layer = nn.Conv2d(8, 2, 3, padding=1)
        self.layer.weight.data = self.layer.weight.data.contiguous(
            memory_format=torch.channels_last
        )
        self.drop = nn.Dropout(0.5)

    def forward(self, volume):
        counts = volume.counts
        if not bool(counts.isfinite().all()):
            raise DomainError("not finite")
        span = float(volume.collected_s.sum())
        middle = float((volume.centroid_s * volume.collected_s).sum()) / span**2
        x = self.drop(self.layer(nn.functional.pad(counts.flatten(1, 2), (0, 1))))[..., :-1] * (
            1 + middle
        )
        if self.solves:
            cross = torch.einsum("bihw,bjhw->bij", x, x) + torch.diag(torch.tensor([1.0, 2.0]))
            solved = torch.linalg.solve(cross, torch.eye(2) + 0.5 * cross)
            x = torch.einsum("bij,bjhw->bihw", solved + torch.linalg.inv(cross), x)
        if self.writes:
            x = (2 * x).add_(1) - (2 * x).tanh()
        return FlowField(x, counts.sum((1, 2)) > 0, span)


def load(path, counts):
    """Outputs of a program file."""
    if path.suffix == ".pt2":
        return torch.export.load(path).module()(counts)
    from onnx.reference import ReferenceEvaluator

    program = ReferenceEvaluator(str(path))
    outputs = program.run(["flow_px", "confidence"], {"counts": counts.numpy()})
    return [torch.from_numpy(output) for output in outputs]


@pytest.mark.parametrize("name", ["a.pt2", "writes.pt2", pytest.param("a.onnx", marks=needs_onnx)])
def test_the_program_gives_the_numbers_of_the_network(tmp_path, generator, name):
    """torch.export runs the same operations; ONNX's own order of sums differs in the last bits of
    numbers of order 1."""
    network = Small(writes=name == "writes.pt2").train()
    network.drop.eval()
    with warnings.catch_warnings():
        # of the packages that write and read programs
        warnings.simplefilter("ignore", DeprecationWarning)
        export(network, tmp_path / name, 9, 12, batch=2)
        assert (network.training, network.drop.training) == (True, False), "left as it was"
        network.eval()
        counts = torch.rand(2, 2, 4, 9, 12, generator=generator)
        counts[0, :, :, :3] = 0
        flow, confidence = load(tmp_path / name, counts)
    expected = network(evenly_timed(counts))
    assert torch.allclose(flow, expected.flow_px, atol=0 if name.endswith("pt2") else 1e-5, rtol=0)
    assert torch.equal(confidence, expected.valid.float())
    assert flow.abs().max() > 0.1


def test_solving_by_elimination_is_solving(generator):
    """Positive definite matrices of condition below 100: float64 rounding stays below 1e-12."""
    root = randn64(generator, 3, 6, 6)
    matrix = root @ root.mT + torch.eye(6)
    right = randn64(generator, 3, 6, 4)
    truth = torch.linalg.solve(matrix, right)
    assert torch.allclose(eliminate(matrix, right), truth, rtol=1e-12, atol=1e-12)
