"""The estimators that are judged: models of the closed form, and the network."""

from functools import partial

import torch

from codesign import flow


def estimators(network, models):
    """Name -> function from an EventVolume to a FlowField. models: of the closed form. Events are the clock, since all
    sensors here saw the scene before."""
    found = {
        f"closed_form_{model}": partial(flow.estimate_lk, model=model, clock="events") for model in models
    }
    found["estimate"] = flow.estimate
    refines = isinstance(network, flow.Refiner)
    found["refiner"] = partial(network, clock="events") if refines else network
    return {name: torch.no_grad()(estimate) for name, estimate in found.items()}
