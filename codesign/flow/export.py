"""Flow networks as programs that run without this package: torch.export (.pt2) and, where every
operation has a counterpart, ONNX (.onnx)."""

import contextlib
import gc
import io
import logging
import warnings
from collections import defaultdict
from functools import partial
from operator import getitem
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.fx import Graph
from torch.fx.node import map_aggregate
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves
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
    # where nothing can be written, nothing is traced
    with replacing(path) as temporary, _uncollected():
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


@contextlib.contextmanager
def _uncollected():
    """Without the search for garbage, which among the millions of parts of a program takes as long
    as writing it."""
    collects = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if collects:
            gc.enable()


def trace(
    network: nn.Module,
    height_px: int,
    width_px: int,
    batch: int = 1,
) -> torch.export.ExportedProgram:
    """torch.export's ExportedProgram of a network, in evaluation mode.

    What depends on the bins' times alone becomes a constant. The program looks at no value and so
    refuses
    none: counts that are not finite give a flow that is not.
    """

    def program(counts):
        field = network(evenly_timed(counts))
        return field.flow_px, field.valid.to(
            field.flow_px
        ) if field.confidence is None else field.confidence

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
        return _exported(recording, counts)


class _Recording(TorchDispatchMode):
    """Operations of a function with their values, since torch.export alone cannot follow a check
    for finite input or a number computed from the bins' times.

    shortens: what does not depend on the counts becomes a constant, and equal operations one, which
      is right as long as nothing writes into a tensor (``writes``).
    graph: with get_attr nodes for ``constants``. found: what the function returned.
    """

    def __init__(self, function, counts, shortens=True):
        super().__init__()
        self.shortens = shortens
        self.writes = False
        self.graph = Graph()
        self.constants = {}
        self.known = defaultdict(list)
        self.nodes = WeakTensorKeyDictionary()
        self.nodes[counts] = self.graph.placeholder("counts")
        with self:
            self.found = function(counts)
        self.graph.output(tuple(self.node(value) for value in self.found))
        self.graph.eliminate_dead_code()

    def __torch_dispatch__(self, operation, types, args=(), kwargs=None):
        kwargs = kwargs or {}
        drawn = torch.Tag.nondeterministic_seeded in operation.tags
        tensors = [value for value in tree_leaves((args, kwargs)) if isinstance(value, Tensor)]
        if self.shortens and not drawn and not any(value in self.nodes for value in tensors):
            return operation(*args, **kwargs)
        given = map_aggregate((args, kwargs), self.node)
        found = operation(*args, **kwargs)
        self.writes |= operation._schema.is_mutable
        if self.shortens and isinstance(found, Tensor) and _is(found, args[0]):
            self.nodes[found] = self.node(args[0])
        elif isinstance(found, Tensor | list | tuple):  # others only looked at values
            node = self.called(operation, *given, found, drawn)
            for number, part in enumerate([] if isinstance(found, Tensor) else found):
                self.nodes[part] = self.called(getitem, (node, number), {}, part)
            if isinstance(found, Tensor):
                self.nodes[found] = node
        return found

    def called(self, operation, args, kwargs, found, drawn=False):
        same = self.known[str((operation, args, kwargs))]
        if not same or drawn or not self.shortens:
            same[:] = [self.graph.call_function(operation, args, kwargs)]
            same[0].meta["val"] = map_aggregate(found, _like)
        return same[0]

    def node(self, value):
        """Of a tensor; other values as they are."""
        if not isinstance(value, Tensor):
            return value
        if value in self.nodes:
            return self.nodes[value]
        # of its own storage: a view would be saved with all that it is a view of
        constant = value.detach().clone()
        bits = constant.reshape(-1).view(torch.uint8)
        same = self.known[value.shape, value.stride(), value.dtype, value.device]
        for node, others in same if self.shortens else []:
            if torch.equal(bits, others):
                return node
        name = f"constant_{len(self.constants)}"
        self.constants[name] = constant
        node = self.graph.get_attr(name)
        same.append((node, bits))
        if not self.shortens:
            self.nodes[value] = node
        return node


def _is(found, given):
    """Whether what an operation found is its argument."""
    return isinstance(given, Tensor) and all(
        getattr(found, name)() == getattr(given, name)()
        for name in ("data_ptr", "type", "size", "stride", "is_conj", "is_neg")
    )


def _like(found):
    """Maker of tensors with the layout of one that was found."""
    if not isinstance(found, Tensor):
        return found
    return partial(
        torch.empty_strided, found.size(), found.stride(), dtype=found.dtype, device=found.device
    )


class _Frame(nn.Module):
    """Inputs, constants and outputs of a program, without what leads from one to the other."""

    def __init__(self, recording):
        super().__init__()
        for node in recording.graph.find_nodes(op="get_attr"):
            self.register_buffer(node.target, recording.constants[node.target])
        self.found = [_like(value) for value in recording.found]

    def forward(self, counts):
        return tuple(make().clone() for make in self.found)


def _exported(recording, counts):
    """ExportedProgram of a recording. torch.export would trace each operation again, which takes
    several times as long as all the rest: it traces a frame, which the operations are put into."""
    program = torch.export.export(_Frame(recording), (counts,), strict=False)
    graph = program.graph
    places = {node.name: node for node in graph.find_nodes(op="placeholder")}
    buffers = program.graph_signature.inputs_to_buffers
    values = {buffers.get(name, "counts"): node for name, node in places.items()}
    known = {node: values[node.target] for node in recording.graph.nodes if node.target in values}
    with values["counts"].meta["val"].fake_mode:
        for node in recording.graph.nodes:
            if node.op == "call_function":
                node.meta["val"] = map_aggregate(node.meta["val"], lambda make: make and make())
    ends = graph.output_node().args[0]
    with graph.inserting_before(ends[0]):
        found = graph.graph_copy(recording.graph, known)
    for end, node in zip(ends, found, strict=True):
        end.args = (node,)
    graph.eliminate_dead_code()
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
