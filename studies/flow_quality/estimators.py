"""The estimators that are judged: the closed form in all its models, the network, and the network's
corrections alone."""

from functools import partial

import torch

from codesign import flow
from codesign.flow import lk_field


def estimators(network):
    """Name -> function from an EventVolume to a FlowField. "corrections": what the network says before it is
    weighed against its start."""
    found = {f"closed_form_{model}": partial(flow.estimate_lk, model=model) for model in lk_field.TERMS}
    found["refiner"] = network
    if hasattr(network, "predictions"):
        found["corrections"] = partial(_corrections, network)
    return {name: torch.no_grad()(estimate) for name, estimate in found.items()}


def _corrections(network, volume):
    return network.predictions(volume)[-1]
