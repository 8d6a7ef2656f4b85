"""Flow networks as programs that run without this package: torch.export (.pt2) and, where every
operation has a counterpart, ONNX (.onnx)."""

import contextlib
import io
import logging
import warnings
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.fx.experimental.proxy_tensor import make_fx

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
    with replacing(path) as temporary:  # where nothing can be written, nothing is traced
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
        # traced with values, since torch.export alone cannot follow a check for finite input or a
        # number computed from the bins' times
        graph = make_fx(program, tracing_mode="real", _error_on_data_dependent_ops=False)(counts)
        _tidy(graph)
        return torch.export.export(graph, (counts,), strict=False)


def _tidy(graph):
    """Drop what only looked at values while tracing; give every constant storage of its own, so
    that none is saved with a larger one it is a view of."""
    for looking in (
        torch.ops.aten._local_scalar_dense.default,
        torch.ops.aten._linalg_check_errors.default,
    ):
        for node in graph.graph.find_nodes(op="call_function", target=looking):
            if not node.users:
                graph.graph.erase_node(node)
    graph.graph.eliminate_dead_code()
    for name in {node.target for node in graph.graph.find_nodes(op="get_attr")}:
        value = getattr(graph, name).detach().clone()
        delattr(graph, name)
        setattr(graph, name, value)
    graph.recompile()


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
