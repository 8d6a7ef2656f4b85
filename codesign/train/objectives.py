"""What a flow network is trained to make small: scalars of its predictions and the windows."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

from torch import Tensor, nn

from codesign.errors import DomainError, ShapeError
from codesign.flow.losses import (
    contrast_loss,
    laplace_loss,
    photometric_loss,
    relative_unit,
    smoothness_loss,
    supervised_loss,
)
from codesign.types import FlowField, FlowWindows

# an earlier prediction counts so much less than the next (Teed and Deng, RAFT, ECCV 2020, eq. 7)
GAMMA = 0.8


def flow_predictions(network: nn.Module, windows: FlowWindows) -> list[FlowField]:
    """All predictions of a flow network, the last one counting most; of a plain one, its one flow.
    A network that refines begins with the start of the windows where they have one.

    Raises: ShapeError for windows of other bins than the network's ``config`` has.
    """
    config, given = getattr(network, "config", None), windows.volume.counts.shape[2]
    own = config.get("bins", given) if isinstance(config, Mapping) else given
    if own != given:
        raise ShapeError(
            f"the windows have {given} time bins, the network {own}; give both the same number."
        )
    if windows.start is not None and hasattr(network, "refined"):
        return network.refined(windows.volume, windows.start, through=False)
    several = getattr(network, "predictions", None)
    return [network(windows.volume)] if several is None else several(windows.volume)


@dataclass(frozen=True)
class Supervised:
    """Distance to the true flow; and, where the network claims a covariance, the likelihood of the
    error under it, with long tails, which teaches the claim and leaves the flow alone.

    Args:
      unit: errors count in pixels, or as shares of the window's own root mean square flow.
      claim_weight: of the likelihood.
    """

    unit: Literal["px", "motion"] = "motion"
    claim_weight: float = 0.3

    def __call__(self, predictions: Sequence[FlowField], windows: FlowWindows) -> Tensor:
        """The loss, a scalar. Gradient: to flow and claim."""
        unit = 1.0 if self.unit == "px" else relative_unit(windows.truth)
        loss = supervised_loss(predictions, windows.truth, GAMMA, unit_per_px=unit)
        if self.claim_weight > 0 and all(
            field.covariance_px2 is not None or field.confidence is not None
            for field in predictions
        ):
            claims = [replace(field, flow_px=field.flow_px.detach()) for field in predictions]
            loss = loss + self.claim_weight * laplace_loss(claims, windows.truth, GAMMA)
        return loss

    def check(self, windows: FlowWindows) -> None:
        """Raise DomainError for windows without any true flow."""
        if not bool(windows.truth.valid.any()):
            raise DomainError(
                "the supervised loss needs true flow, and the windows looked at have none; choose the "
                "contrast loss, or check the data set."
            )


@dataclass(frozen=True)
class Contrast:
    """Blur of the events warped by the flow, and roughness of the flow; no truth is needed.

    smoothness: weight of the roughness.
    """

    smoothness: float = 0.1

    def __call__(self, predictions: Sequence[FlowField], windows: FlowWindows) -> Tensor:
        """The loss, a scalar. Gradient: to the flow."""

        def of_flow(flow):
            return contrast_loss(windows.volume, flow) + self.smoothness * smoothness_loss(flow)

        return _weighted(predictions, of_flow)

    def check(self, windows: FlowWindows) -> None:
        """Any windows will do."""


@dataclass(frozen=True)
class Photometric:
    """Difference of the frames at both ends, the later one read where the flow leads, and roughness
    of the flow; no truth is needed.

    smoothness: weight of the roughness.
    """

    smoothness: float = 0.1

    def __call__(self, predictions: Sequence[FlowField], windows: FlowWindows) -> Tensor:
        """The loss, a scalar. Gradient: to the flow."""
        self.check(windows)

        def of_flow(flow):
            return photometric_loss(windows.frames, flow) + self.smoothness * smoothness_loss(flow)

        return _weighted(predictions, of_flow)

    def check(self, windows: FlowWindows) -> None:
        """Raise DomainError for windows without frames."""
        if windows.frames is None:
            raise DomainError(
                "the photometric loss needs frames, and these windows have none; choose the supervised or "
                "the contrast loss."
            )


def _weighted(predictions: Sequence[FlowField], of_flow: Callable[[Tensor], Tensor]):
    """Mean of a loss over the predictions, later ones counting more."""
    total: Any = 0.0
    weights = 0.0
    for field in predictions:
        total = GAMMA * total + of_flow(field.flow_px)
        weights = GAMMA * weights + 1
    return total / weights
