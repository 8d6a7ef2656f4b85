"""What one pass of a system leaves: objectives, and on request what stood at every junction."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from codesign.errors import DomainError, NonFiniteError, ShapeError
from codesign.system.contents import tensors_in
from codesign.types import EventVolume, FlowField, Rays

JUNCTIONS = ("lens", "pose", "rays", "frames", "events", "flow", "estimate")
"""From glass to answer; all but the first two can be replaced by a recording."""
RECORDABLE = JUNCTIONS[2:]
_LENS = (
    "curvature_per_mm",
    "thickness_mm",
    "conic",
    "asphere",
    "index_offset",
    "efl_mm",
    "image_distance_mm",
)


@dataclass(frozen=True)
class Result:
    """Objectives of one pass, and what they were made of.

    objectives: name -> tensor, as the objective returned it. field: what the flow stage returned.
      estimate: what the stage behind it returned; None without one. camera: with the lens as it
      was. T_world_cam: [..., T, 4, 4]. junctions: name -> tensors, whose .grad is kept; None unless
      the pass was probed. check_passes: time of ``check`` over that of its pass alone; None
      elsewhere.
    """

    objectives: dict[str, Tensor]
    field: Any
    estimate: Any
    camera: Any
    T_world_cam: Tensor | None
    junctions: dict[str, tuple[Tensor, ...]] | None
    check_passes: float | None = None

    def __repr__(self):
        told = ", ".join(
            f"{name}={value.item():.4g}" if value.numel() == 1 else f"{name}{list(value.shape)}"
            for name, value in self.objectives.items()
        )
        return f"Result({told})"

    @property
    def loss(self) -> Tensor:
        """The only objective. Raises: DomainError when there are several."""
        if len(self.objectives) != 1:
            raise DomainError(
                f"there are {len(self.objectives)} objectives: {', '.join(self.objectives)}; name one."
            )
        return next(iter(self.objectives.values()))

    def backward(self, weights: Mapping[str, float] | None = None) -> None:
        """Gradients of the weighted sum of objectives (all with weight 1 when none are given).

        Raises: DomainError for unknown names; NonFiniteError naming the first junction, from the
          loss back, whose gradient is not finite, when the pass was probed.
        """
        weights = dict.fromkeys(self.objectives, 1.0) if weights is None else weights
        unknown = [name for name in weights if name not in self.objectives]
        if unknown:
            raise DomainError(
                f"there is no objective '{unknown[0]}'; there are {', '.join(self.objectives)}."
            )
        if not weights:
            raise DomainError(
                f"no objective is given a weight; there are {', '.join(self.objectives)}."
            )
        for name in weights:
            if self.objectives[name].numel() != 1:
                raise ShapeError(
                    f"objective '{name}' has shape {tuple(self.objectives[name].shape)}; reduce it to one number, "
                    "for example by mean()."
                )
        parts = [weight * self.objectives[name].reshape(()) for name, weight in weights.items()]
        torch.stack(parts).sum().backward()
        for name in reversed(JUNCTIONS):
            grads = [t.grad for t in (self.junctions or {}).get(name, ()) if t.grad is not None]
            if any(not bool(g.isfinite().all()) for g in grads):
                raise NonFiniteError(
                    f"the gradient became infinite or NaN at junction '{name}'; the stage after it (towards "
                    "the loss) has the cause."
                )

    def table(self) -> list[dict[str, Any]]:
        """Per junction: norm of the values, norm of the gradient, share of gradient entries that
        are exactly 0.

        Raises: DomainError when the pass was not probed.
        """
        if self.junctions is None:
            raise DomainError(
                "this pass kept nothing; run system(batch, probe=True) to read its junctions."
            )
        return [_row(name, tensors) for name, tensors in self.junctions.items()]


def _row(name: str, tensors: tuple[Tensor, ...]) -> dict[str, Any]:
    grads = [t.grad for t in tensors if t.grad is not None]
    entries = sum(g.numel() for g in grads)
    zero = sum(int((g == 0).sum()) for g in grads) / entries if entries else 1.0
    return {
        "junction": name,
        "value_norm": _norm([t.detach() for t in tensors]),
        "gradient_norm": _norm(grads),
        "zero_share": zero,
    }


def _norm(tensors: list[Tensor]) -> float:
    return float(sum(float(t.double().square().sum()) for t in tensors) ** 0.5)


def tensors_of(junction: str, value: Any) -> tuple[Tensor, ...]:
    """The tensors that stand at a junction."""
    if junction == "lens":
        learnt = (
            [p for p in value.parameters() if p.requires_grad]
            if isinstance(value, nn.Module)
            else []
        )
        made = [getattr(value, name, None) for name in _LENS]
        return tuple(learnt or [t for t in made if torch.is_tensor(t) and t.requires_grad])
    if isinstance(value, Rays):
        return (value.origin_m, value.direction, value.weight)
    if isinstance(value, EventVolume):
        return (value.counts,)
    if isinstance(value, FlowField):
        return (value.flow_px,)
    return tuple(tensor for tensor in tensors_in(value) if tensor.is_floating_point())


def probe(junction: str, value: Any) -> tuple[Tensor, ...]:
    """The junction's tensors, with their gradients kept. Raises: NonFiniteError when one is not
    finite."""
    tensors = tensors_of(junction, value)
    for tensor in tensors:
        if not bool(tensor.detach().isfinite().all()):
            raise NonFiniteError(
                f"a value became infinite or NaN at junction '{junction}'; the stage that makes it has the cause."
            )
        if tensor.requires_grad:
            tensor.retain_grad()
    return tensors
