"""The chain of stages, with a probe at every junction."""

from dataclasses import dataclass

import torch
from torch import Tensor

from codesign.errors import DomainError, NonFiniteError

JUNCTIONS = ("lens", "rays", "frames", "events", "flow", "loss")


@dataclass(frozen=True)
class Result:
    """What one pass of a chain left at every junction.

    junctions: name -> tuple of tensors (their .grad is kept after backward). camera, field: the objects built on the way.
    """

    junctions: dict[str, tuple[Tensor, ...]]
    camera: object
    field: object

    @property
    def loss(self):
        return self.junctions["loss"][0]

    def backward(self):
        """Gradients at every junction; raises NonFiniteError naming the first junction (from the loss back) where one is not finite."""
        self.loss.backward()
        for name in reversed(JUNCTIONS):
            if any(t.grad is not None and not bool(t.grad.isfinite().all()) for t in self.junctions[name]):
                raise NonFiniteError(f"the gradient became infinite or NaN at junction '{name}'; the stage after it (towards the loss) has the cause.")

    def table(self):
        """Per junction: norm of the values, norm of the gradient, and share of gradient entries that are exactly 0."""
        rows = []
        for name, tensors in self.junctions.items():
            value = _norm([t.detach() for t in tensors])
            grads = [t.grad for t in tensors if t.grad is not None]
            entries = sum(g.numel() for g in grads)
            zero = sum(int((g == 0).sum()) for g in grads) / entries if entries else 1.0
            rows.append({"junction": name, "value_norm": value, "gradient_norm": _norm(grads), "zero_share": zero})
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
        self.lens, self.render, self.events, self.flow, self.objective = lens, render, events, flow, objective

    def __call__(self, design, recorded=None):
        """Run the chain. ``recorded`` replaces the tensor of the junctions 'frames' or 'loss' upstream stages would make.

        Raises: NonFiniteError naming the junction where a value first became infinite or NaN.
        """
        recorded = dict(recorded or {})
        if set(recorded) - {"frames"}:
            raise DomainError(f"recorded junctions {sorted(set(recorded) - {'frames'})} cannot be replaced; 'frames' can.")
        seen = {}
        camera = self.lens(design)
        numbers = [getattr(camera.lens, name) for name in ("curvature_per_mm", "thickness_mm", "efl_mm") if torch.is_tensor(getattr(camera.lens, name, None))]
        seen["lens"] = _probe("lens", numbers)
        if "frames" in recorded:
            seen["rays"], frames = (), recorded["frames"]
        else:
            rays = camera.rays()
            seen["rays"] = _probe("rays", (rays.origin_m, rays.direction, rays.weight))
            frames = self.render(rays, design)
        seen["frames"] = _probe("frames", (frames,))
        volume = self.events(frames, design)
        seen["events"] = _probe("events", (volume.counts,))
        field = self.flow(volume, design)
        seen["flow"] = _probe("flow", (field.flow_px,))
        seen["loss"] = _probe("loss", (self.objective(field, camera, design),))
        return Result(seen, camera, field)


def _probe(name, tensors):
    for tensor in tensors:
        if not bool(tensor.detach().isfinite().all()):
            raise NonFiniteError(f"a value became infinite or NaN at junction '{name}'; the stage that makes it has the cause.")
        if tensor.requires_grad:
            tensor.retain_grad()
    return tuple(tensors)
