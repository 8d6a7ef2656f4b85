"""The estimators that are judged: models of the closed form, the network, and methods of frames on event images."""

from functools import partial

import torch
from scipy.ndimage import gaussian_filter
from skimage.registration import optical_flow_ilk, optical_flow_tvl1

from codesign import flow
from codesign.types import FlowField

FRAME_METHODS = {"ilk_frames": optical_flow_ilk, "tvl1_frames": optical_flow_tvl1}
BLUR_PX = 1.0  # of the event images, which then reach up to 1


def estimators(network, models):
    """Name -> function from an EventVolume to a FlowField. models: of the closed form. Events are the clock, since all
    sensors here saw the scene before."""
    found = {
        f"closed_form_{model}": partial(flow.estimate_lk, model=model, clock="events") for model in models
    }
    found["estimate"] = flow.estimate
    refines = isinstance(network, flow.Refiner)
    found["refiner"] = partial(network, clock="events") if refines else network
    found |= {name: partial(_between_images, method) for name, method in FRAME_METHODS.items()}
    return {name: torch.no_grad()(estimate) for name, estimate in found.items()}


def _between_images(method, volume):
    """Flow from the image of all events of the first half to that of the second, over the time between them."""
    half = volume.counts.shape[2] // 2
    when = [part.mean() for part in (volume.centroid_s[:half], volume.centroid_s[half:])]
    whole = float(volume.collected_s.sum() / (when[1] - when[0]))
    images = torch.stack([part.sum((1, 2)) for part in volume.counts.tensor_split([half], 2)]).double()
    images = gaussian_filter(images.numpy(), (0, 0, BLUR_PX, BLUR_PX))
    images /= images.max((0, 2, 3), keepdims=True) + 1e-12
    flows = [method(*pair) for pair in zip(*images, strict=True)]  # down, right
    flow_px = whole * torch.stack([torch.from_numpy(found[::-1].copy()) for found in flows])
    valid = torch.ones_like(flow_px[:, 0], dtype=torch.bool)
    return FlowField(flow_px.to(volume.counts), valid, float(volume.collected_s.sum()))
