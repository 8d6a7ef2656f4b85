"""The chain of stages, with a probe at every junction."""

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from codesign.errors import DomainError, NonFiniteError

JUNCTIONS = ("lens", "rays", "frames", "events", "flow", "loss")


@dataclass(frozen=True)
class Result:
    """What one pass of a chain left at every junction.

    junctions: name -> tuple of tensors (their .grad is kept after backward). camera, field: the objects built
      on the way.
    """

    junctions: dict[str, tuple[Tensor, ...]]
    camera: Any
    field: Any

    @property
    def loss(self):
        return self.junctions["loss"][0]

    def backward(self):
        """Gradients at every junction; raises NonFiniteError naming the first junction (from the loss back)
        where one is not finite."""
        self.loss.backward()
        for name in reversed(JUNCTIONS):
            if any(
                t.grad is not None and not bool(t.grad.isfinite().all()) for t in self.junctions.get(name, ())
            ):
                raise NonFiniteError(
                    f"the gradient became infinite or NaN at junction '{name}'; the stage after it (towards "
                    "the loss) has the cause."
                )

    def table(self):
        """Per junction: norm of the values, norm of the gradient, and share of gradient entries that are
        exactly 0."""
        rows = []
        for name, tensors in self.junctions.items():
            value = _norm([t.detach() for t in tensors])
            grads = [t.grad for t in tensors if t.grad is not None]
            entries = sum(g.numel() for g in grads)
            zero = sum(int((g == 0).sum()) for g in grads) / entries if entries else 1.0
            rows.append(
                {"junction": name, "value_norm": value, "gradient_norm": _norm(grads), "zero_share": zero}
            )
        return rows


def _norm(tensors):
    return float(sum(float(t.double().square().sum()) for t in tensors) ** 0.5)


class Chain:
    """lens -> rays -> render -> events -> flow -> objective.

    Each stage is a function of what comes before and of the design:
      lens(design) -> Camera; render(rays, design) -> frames; events(frames, design) -> EventVolume;
      flow(volume, design) -> FlowField; objective(field, camera, design) -> scalar.
    """

    def __init__(self, *, lens, render, events, flow, objective):
        self.lens = lens
        self.render = render
        self.events = events
        self.flow = flow
        self.objective = objective

    def __call__(self, design, recorded=None):
        """Run the chain.

        Args: recorded: junction name ("rays", "frames", "events", "flow") -> the object to put there; the
          stages before it are not run.
        Returns: Result. Raises: NonFiniteError naming the junction where a value first became infinite or
          NaN; DomainError for other names.
        """
        recorded = dict(recorded or {})
        seen = {}
        if set(recorded) - set(_TENSORS):
            raise DomainError(
                f"junctions {sorted(set(recorded) - set(_TENSORS))} cannot be replaced; "
                f"{', '.join(_TENSORS)} can."
            )

        def at(name, make):
            value = recorded[name] if name in recorded else make()
            seen[name] = _probe(name, _TENSORS[name](value))
            return value

        camera = self.lens(design)
        seen["lens"] = _probe(
            "lens",
            [
                value
                for value in (
                    getattr(camera.lens, name, None)
                    for name in ("curvature_per_mm", "thickness_mm", "efl_mm")
                )
                if torch.is_tensor(value)
            ],
        )

        def rays():
            return at("rays", camera.rays)

        def frames():
            return at("frames", lambda: self.render(rays(), design))

        def volume():
            return at("events", lambda: self.events(frames(), design))

        field = at("flow", lambda: self.flow(volume(), design))
        seen["loss"] = _probe("loss", (self.objective(field, camera, design),))
        return Result(seen, camera, field)


_TENSORS = {
    "rays": lambda rays: (rays.origin_m, rays.direction, rays.weight),
    "frames": lambda frames: (frames,),
    "events": lambda volume: (volume.counts,),
    "flow": lambda field: (field.flow_px,),
}


def _probe(name, tensors):
    for tensor in tensors:
        if not bool(tensor.detach().isfinite().all()):
            raise NonFiniteError(
                f"a value became infinite or NaN at junction '{name}'; the stage that makes it has the cause."
            )
        if tensor.requires_grad:
            tensor.retain_grad()
    return tuple(tensors)
