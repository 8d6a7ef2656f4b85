"""The estimators that are judged: models of the closed form, and the network."""

from functools import partial

import torch

from codesign import flow


def estimators(network, models):
    """Name -> function from an EventVolume to a FlowField. models: of the closed form."""
    found = {
        f"closed_form_{model}": partial(flow.estimate_lk, model=model, clock="events") for model in models
    }
    found["refiner"] = network
    return {name: torch.no_grad()(estimate) for name, estimate in found.items()}
