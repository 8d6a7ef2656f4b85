"""What a flow network is trained to make small."""

from dataclasses import replace

from codesign.errors import DomainError
from codesign.flow.losses import (
    contrast_loss,
    likelihood_loss,
    photometric_loss,
    relative_unit,
    smoothness_loss,
    supervised_loss,
)

GAMMA = 0.8  # an earlier prediction counts so much less than the next (Teed and Deng, RAFT, ECCV 2020, eq. 7)


def supervised(config):
    """Distance to the true flow; and, where the network claims a covariance, its likelihood, which teaches
    the claim and leaves the flow alone."""

    def objective(predictions, windows):
        unit = 1.0 if config.unit == "px" else relative_unit(windows.truth)
        loss = supervised_loss(predictions, windows.truth, GAMMA, unit_per_px=unit)
        if config.claim_weight > 0 and all(
            field.covariance_px2 is not None or field.confidence is not None for field in predictions
        ):
            claims = [replace(field, flow_px=field.flow_px.detach()) for field in predictions]
            loss = loss + config.claim_weight * likelihood_loss(claims, windows.truth, GAMMA)
        return loss

    return objective


def contrast(config):
    """Blur of the events warped by the flow, and roughness of the flow; no truth is needed."""
    return lambda predictions, windows: _weighted(
        predictions,
        lambda flow: contrast_loss(windows.volume, flow) + config.smoothness * smoothness_loss(flow),
    )


def photometric(config):
    """Difference of the frames at both ends, the later one read where the flow leads, and roughness of the
    flow; no truth is needed."""
    return lambda predictions, windows: _weighted(
        predictions,
        lambda flow: photometric_loss(windows.frames, flow) + config.smoothness * smoothness_loss(flow),
    )


LOSSES = {"supervised": supervised, "contrast": contrast, "photometric": photometric}
"""Name -> function of the configuration that gives the objective: (predictions, FlowWindows) -> scalar."""

NEEDS_FRAMES = ("photometric",)


def objective(config):
    """The objective that --loss names.

    Raises: DomainError for an unknown name.
    """
    if config.loss not in LOSSES:
        raise DomainError(f"--loss {config.loss} is unknown; choose one of {', '.join(LOSSES)}.")
    return LOSSES[config.loss](config)


def check_windows(name, windows):
    """Raise DomainError when these windows lack what the loss called ``name`` needs."""
    if name in NEEDS_FRAMES and windows.frames is None:
        raise DomainError(
            f"--loss {name} needs frames, and these windows have none; choose --loss supervised or contrast."
        )
    if name == "supervised" and not bool(windows.truth.valid.any()):
        raise DomainError(
            "--loss supervised needs true flow, and the windows looked at have none; choose --loss "
            "contrast, or check the data set."
        )


def _weighted(predictions, of_flow):
    """Mean of a loss over the predictions, later ones counting more."""
    total = weights = 0.0
    for field in predictions:
        total = GAMMA * total + of_flow(field.flow_px)
        weights = GAMMA * weights + 1
    return total / weights
