"""The estimators that are judged: models of the closed form, the network, and the network's
corrections alone."""

from functools import partial

import torch

from codesign import flow


def estimators(network, models):
    """Name -> function from an EventVolume to a FlowField. models: of the closed form. "corrections": what the
    network says before it is weighed against its start."""
    found = {
        f"closed_form_{model}": partial(flow.estimate_lk, model=model, clock="events") for model in models
    }
    found["refiner"] = network
    if hasattr(network, "predictions"):
        found["corrections"] = partial(_corrections, network)
    return {name: torch.no_grad()(estimate) for name, estimate in found.items()}


def _corrections(network, volume):
    return network.predictions(volume)[-1]
