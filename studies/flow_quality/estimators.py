"""The estimators that are judged: models of the closed form, the network, a plain solve of the same
equations, and methods of frames on event images."""

from collections.abc import Callable
from functools import partial

import torch
from kornia.filters import gaussian_blur2d
from scipy.ndimage import gaussian_filter
from skimage.registration import optical_flow_ilk, optical_flow_tvl1
from torch.nn.functional import grid_sample

from codesign import flow
from codesign.flow.warp import pixel_grid
from codesign.types import EventVolume, FlowField

FRAME_METHODS = {"ilk_frames": optical_flow_ilk, "tvl1_frames": optical_flow_tvl1}
BLUR_PX = 1.0  # of the event images, which then reach up to 1
DAMPING = 1e-3  # of the plain solve, of the mean diagonal of the normal matrix
LEVELS_PX = (4.0, 2.0, 1.0)  # of the plain solve
STEPS = 3  # at each

Estimator = Callable[[EventVolume], FlowField]


def estimators(network, models, clock) -> dict[str, Estimator]:
    """By name. models, clock: of the closed form. All sensors here saw the scene before, so events
    can be the clock."""
    found: dict[str, Estimator] = {
        f"closed_form_{model}": partial(flow.estimate_lk, model=model, clock=clock)
        for model in models
    }
    found["estimate"] = flow.estimate
    refines = isinstance(network, flow.Refiner)
    found["refiner"] = partial(network, clock=clock) if refines else network
    found["plain"] = plain_lk
    found |= {name: partial(_between_images, method) for name, method in FRAME_METHODS.items()}
    return {name: torch.no_grad()(estimate) for name, estimate in found.items()}


def _between_images(method, volume):
    """Flow from the image of all events of the first half to that of the second, over the time
    between them."""
    half = volume.counts.shape[2] // 2
    when = [part.mean() for part in (volume.centroid_s[:half], volume.centroid_s[half:])]
    whole = float(volume.collected_s.sum() / (when[1] - when[0]))
    images = torch.stack(
        [part.sum((1, 2)) for part in volume.counts.tensor_split([half], 2)]
    ).double()
    images = gaussian_filter(images.numpy(), (0, 0, BLUR_PX, BLUR_PX))
    images /= images.max((0, 2, 3), keepdims=True) + 1e-12
    flows = [method(*pair) for pair in zip(*images, strict=True)]  # down, right
    flow_px = whole * torch.stack([torch.from_numpy(found[::-1].copy()) for found in flows])
    return _field(flow_px.to(volume.counts), volume)


def plain_lk(volume: EventVolume) -> FlowField:
    """Affine Gauss-Newton on the warped volume with a small fixed damping, no prior and no noise
    model; on the pixels of mid-interval, taken for those of the start."""
    counts = volume.counts
    batch, _, _, height, width = counts.shape
    span = volume.collected_s.sum()
    share = (volume.collected_s / span).to(counts)[:, None, None]
    time = (volume.centroid_s / span).to(counts)[:, None, None] - 0.5
    rate = (counts[:, 0] - counts[:, 1]) / share
    x, y = pixel_grid(height, width, counts)
    half = max(height, width) / 2
    across, down = (x - (width - 1) / 2) / half, (y - (height - 1) / 2) / half
    basis = torch.stack([torch.ones_like(x), across, down])
    parameters = torch.zeros(batch, 2, 3).to(counts)
    for sigma in LEVELS_PX:
        size = 2 * int(3 * sigma + 0.5) + 1
        blurred = gaussian_blur2d(rate, (size, size), (sigma, sigma))
        for _ in range(STEPS):
            u, v = torch.einsum("bck,khw->bchw", parameters, basis)[:, :, None].unbind(1)
            at = torch.stack(
                [(x + time * u) * (2 / (width - 1)) - 1, (y + time * v) * (2 / (height - 1)) - 1],
                -1,
            )
            inside = (at.abs() <= 1).all(-1).all(1)
            warped = grid_sample(
                blurred.flatten(0, 1)[:, None],
                at.flatten(0, 1),
                padding_mode="border",
                align_corners=True,
            ).reshape(blurred.shape)
            mean = (warped * share).sum(1)
            slope = (warped * share * time).sum(1) / (share * time.square()).sum()
            dy, dx = torch.gradient(mean, dim=(1, 2))
            design = torch.cat([dx[:, None] * basis, dy[:, None] * basis], 1).flatten(2)
            design = design * inside.flatten(1)[:, None]
            normal = design @ design.mT
            damping = DAMPING * normal.diagonal(dim1=1, dim2=2).mean(1)[:, None, None] + 1e-9
            right = -(design @ slope.flatten(1)[..., None])
            change = torch.linalg.solve(normal + damping * torch.eye(6), right)[..., 0]
            parameters = parameters + change.reshape(batch, 2, 3)
    return _field(torch.einsum("bck,khw->bchw", parameters, basis), volume)


def _field(flow_px, volume):
    valid = torch.ones_like(flow_px[:, 0], dtype=torch.bool)
    return FlowField(flow_px, valid, float(volume.collected_s.sum()))
