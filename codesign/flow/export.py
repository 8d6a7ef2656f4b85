"""Flow networks as programs that run without this package: torch.export (.pt2) and, where every
operation has a counterpart, ONNX (.onnx)."""

import contextlib
import gc
import io
import logging
import warnings
from operator import getitem
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch._subclasses import FakeTensorMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_any_only, tree_map_only
from torch.utils.weak import WeakTensorKeyDictionary

from codesign.atomic import replacing
from codesign.checks import check, check_kind, check_path, check_whole
from codesign.errors import DomainError
from codesign.flow.checks import MOST_SIDE_PX
from codesign.flow.entry import modes_kept
from codesign.flow.lk.lanes import plain_operations
from codesign.flow.sources.windows import bin_times
from codesign.optional import require
from codesign.types import EventVolume

# that give what they are given where it keeps its shape
SAME = "aten.alias.default", "aten.detach.default", "aten.expand.default", "aten.view.default"


def evenly_timed(counts: Tensor) -> EventVolume:
    """EventVolume of counts [B, 2, bins, H, W] whose bins are those of codesign.events.from_stream:
    equally spaced nodes, the two at the ends collecting half, in an interval of 1 s."""
    check(counts, "B>=0 2 bins>=2 H>=0 W>=0", "the counts")
    return EventVolume(counts, *bin_times(counts.shape[2], 1.0))


def export(
    network: nn.Module,
    path: str | Path,
    height_px: int,
    width_px: int,
    batch: int = 1,
) -> None:
    """Write a network as a program for one size of input.

    Args:
      network: flow network with ``config["bins"]``.
      path: .pt2 (torch.export) or .onnx.
      height_px, width_px, batch: of the counts [batch, 2, bins, H, W] that the program takes; it
        returns flow [batch, 2, H, W] and confidence [batch, H, W].
    Raises: MissingPackageError for ONNX without its packages; DomainError for another extension,
      and for a network with an operation that ONNX lacks; FileFormatError when the file cannot be
      written.

    Load .pt2 by ``torch.export.load(path).module()``, .onnx by any ONNX runtime (input "counts",
    outputs "flow_px", "confidence").

    >>> from codesign.flow import FlowNetEvents
    >>> export(FlowNetEvents(bins=2, width=4.0), "network.pt2", height_px=32, width_px=32)
    >>> flow_px, confidence = torch.export.load("network.pt2").module()(torch.ones(1, 2, 2, 32, 32))
    >>> flow_px.shape
    torch.Size([1, 2, 32, 32])
    """
    path = check_path(path, "the path of a program")
    if path.suffix not in (".pt2", ".onnx"):
        raise DomainError(
            f"'{path.name}' is no program file; give a name that ends in .pt2 (torch.export) or .onnx."
        )
    with replacing(path) as temporary, contextlib.ExitStack() as after:  # fails before tracing
        after.callback(gc.enable if gc.isenabled() else gc.disable)
        gc.disable()  # its search among the many parts of a program takes half of the time
        program = trace(network, height_px, width_px, batch)
        if path.suffix == ".pt2":
            buffer = io.BytesIO()
            with warnings.catch_warnings():
                # weights in channels-last order
                warnings.filterwarnings("ignore", message="No complete tensor")
                torch.export.save(program, buffer)
            temporary.write_bytes(buffer.getvalue())
        else:
            temporary.write_bytes(_onnx(program, type(network).__name__))


def trace(
    network: nn.Module,
    height_px: int,
    width_px: int,
    batch: int = 1,
) -> torch.export.ExportedProgram:
    """torch.export's ExportedProgram of a network, in evaluation mode.

    What depends on the bins' times alone becomes a constant. The program looks at no value and so
    refuses none: counts that are not finite give a flow that is not.
    """

    def program(counts):
        field = network(evenly_timed(counts))
        sure = field.valid.to(field.flow_px) if field.confidence is None else field.confidence
        return field.flow_px, sure

    height_px, width_px, batch = (
        check_whole(value, name, 1, MOST_SIDE_PX)
        for value, name in ((height_px, "height_px"), (width_px, "width_px"), (batch, "batch"))
    )
    config: dict[str, Any] = getattr(check_kind(network, nn.Module, "the network"), "config", {})
    if "bins" not in config:
        raise DomainError(
            f"a {type(network).__name__} has no config['bins'], so it is no flow network of this package."
        )
    device = next((weight.device for weight in network.parameters()), None)
    counts = torch.zeros(batch, 2, config["bins"], height_px, width_px, device=device)
    with modes_kept(network), torch.no_grad(), plain_operations():
        network.eval()
        recording = _Recording(program, counts)
        if recording.writes:
            recording = _Recording(program, counts, shortens=False)
        return recording.exported(counts)


class _Recording(TorchDispatchMode):
    """Operations of a function with their values: torch.export alone cannot follow a check for
    finite input or a number computed from the bins' times. Shortened, with constants for what does
    not depend on the counts and equal operations once, where none ``writes`` into a tensor."""

    def __init__(self, function, counts, shortens=True):
        super().__init__()
        self.shortens, self.writes = shortens, False
        self.graph, self.layouts, self.known = torch.fx.Graph(), FakeTensorMode(), {}
        self.nodes = WeakTensorKeyDictionary()
        self.nodes[counts] = self.graph.placeholder("counts")
        with self:
            found = function(counts)
        self.graph.output(tree_map_only(Tensor, self.node, found))
        self.graph.eliminate_dead_code()

    def __torch_dispatch__(self, operation, types, args=(), kwargs=None):
        given = args, kwargs or {}
        shortens = self.shortens and torch.Tag.nondeterministic_seeded not in operation.tags
        if shortens and not tree_any_only(Tensor, self.nodes.__contains__, given):
            return operation(*given[0], **given[1])
        nodes = tree_map_only(Tensor, self.node, given)
        found = operation(*given[0], **given[1])
        self.writes |= operation._schema.is_mutable
        if shortens and str(operation) in SAME and found.shape == args[0].shape:
            self.nodes[found] = nodes[0][0]
        elif isinstance(found, Tensor | list | tuple) or operation._schema.is_mutable:
            self.add(str((operation, nodes)) if shortens else object(), found, operation, *nodes)
        return found

    def add(self, key, found, operation, args, kwargs):
        if key not in self.known:
            self.known[key] = self.graph.call_function(operation, args, kwargs)
            self.known[key].meta["val"] = tree_map_only(Tensor, self.layout, found)
        if isinstance(found, Tensor):
            self.nodes[found] = self.known[key]
        elif isinstance(found, list | tuple):
            for number, part in enumerate(found):
                self.add((key, number), part, getitem, (self.known[key], number), {})

    def layout(self, x):
        with self.layouts:
            return torch.empty_strided(x.size(), x.stride(), dtype=x.dtype, device=x.device)

    def node(self, value):
        if value in self.nodes:
            return self.nodes[value]
        bits = value.detach().reshape(-1).view(torch.uint8).cpu().numpy().tobytes()
        place = self.shortens or value.data_ptr()
        key = value.size(), value.stride(), value.dtype, value.device, place, bits
        if key not in self.known:
            self.known[key] = self.graph.get_attr(f"constant_{len(self.known)}")
            self.known[key].meta["val"] = value.detach().clone()  # views take all of a storage
        return self.known[key]

    def exported(self, counts):
        """ExportedProgram. torch.export would trace each operation again, which takes longer than
        all the rest; it traces a frame for them: constants, input and outputs."""
        places = [*self.graph.find_nodes(op="get_attr"), *self.graph.find_nodes(op="placeholder")]
        frame = nn.Module()
        frame.forward = lambda counts: (counts.clone(), counts.clone())
        for place in places[:-1]:
            frame.register_buffer(place.target, place.meta["val"])
        program = torch.export.export(frame, (counts,), strict=False)
        known = dict(zip(places, program.graph.find_nodes(op="placeholder"), strict=True))
        ends: Any = program.graph.output_node().args[0]
        with program.graph.inserting_before(ends[0]):
            found: Any = program.graph.graph_copy(self.graph, known)
        for end, node in zip(ends, found, strict=True):
            end.args, end.meta["val"] = (node,), node.meta["val"]
        program.graph_module.recompile()
        return program


def eliminate(matrix: Tensor, right: Tensor) -> Tensor:
    """Solution [..., n, m] of positive definite systems [..., n, n] by Gauss-Jordan elimination,
    which needs no exchange of rows there: plain operations alone."""
    size = matrix.shape[-1]
    unit = torch.eye(size, dtype=matrix.dtype, device=matrix.device)
    rows = torch.cat([matrix, right], -1)
    for k in range(size):
        pivot = rows[..., k : k + 1, :] / rows[..., k : k + 1, k : k + 1]
        rows = rows - (rows[..., :, k : k + 1] - unit[:, k : k + 1]) * pivot
    return rows[..., size:]


def _solve_ex(matrix, right, *, left=True, check_errors=False):
    column = right.ndim == matrix.ndim - 1
    found = eliminate(matrix, right[..., None] if column else right)
    # factors and flags: never used
    return (
        found[..., 0] if column else found,
        matrix,
        matrix[..., 0, :].to(torch.int32),
        matrix[..., 0, 0].to(torch.int32),
    )


def _inverse_ex(matrix, *, check_errors=False):
    unit = torch.eye(matrix.shape[-1], dtype=matrix.dtype, device=matrix.device)
    return eliminate(matrix, unit.expand_as(matrix)), matrix[..., 0, 0].to(torch.int32)


# ONNX has neither
PLAIN = {
    torch.ops.aten._linalg_solve_ex.default: _solve_ex,
    torch.ops.aten.linalg_inv_ex.default: _inverse_ex,
}


def _onnx(program, name):
    """Bytes of an ONNX model with its weights inside. The small systems that flow networks solve
    are positive definite."""
    for module in ("onnx", "onnxscript"):
        require(module, "export", "writing .onnx (.pt2 needs nothing more)")
    log = logging.getLogger("torch.onnx")
    level = log.level
    # the exporter's own progress and deprecations
    with (
        contextlib.redirect_stdout(io.StringIO()),
        warnings.catch_warnings(),
    ):
        warnings.simplefilter("ignore")
        log.setLevel(logging.ERROR)
        try:
            model = torch.onnx.export(
                program.run_decompositions(PLAIN),
                (),
                dynamo=True,
                optimize=False,
                input_names=["counts"],
                output_names=["flow_px", "confidence"],
                verbose=False,
            )
        except torch.onnx.OnnxExporterError as error:
            missing = next(
                (line for line in str(error).splitlines() if "No ONNX function found" in line),
                "see the error before",
            )
            raise DomainError(
                f"{name} has an operation that ONNX lacks ({missing.strip()[:200]}); give a name that ends "
                "in .pt2 for torch.export."
            ) from error
        finally:
            log.setLevel(level)
    assert model is not None
    return model.model_proto.SerializeToString()
