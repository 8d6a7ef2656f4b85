"""A small residual network over event voxels: built from a seed, trained, and asked."""

import math

import torch
import torch.nn.functional as F
from torch import nn

from codesign.errors import DomainError, ShapeError
from studies.event_classes.pictures import CLASSES

WIDTH = 16
BATCH = 50
SHIFT_PX = 2  # recordings are learnt from at random places
# peak learning rate and weight decay of AdamW
RATE = 4e-3
DECAY = 1e-2


class Block(nn.Module):
    """Two 3x3 convolutions beside a shortcut; half the size, twice the channels."""

    def __init__(self, channels):
        super().__init__()
        wide = 2 * channels
        self.path = nn.Sequential(
            _conv(channels, wide, 3, 2),
            nn.BatchNorm2d(wide),
            nn.ReLU(),
            _conv(wide, wide, 3, 1),
            nn.BatchNorm2d(wide),
        )
        self.shortcut = nn.Sequential(_conv(channels, wide, 1, 2), nn.BatchNorm2d(wide))

    def forward(self, x):
        return torch.relu(self.path(x) + self.shortcut(x))


class Classifier(nn.Module):
    """Voxels [N, 2, bins, H, W] to scores [N, CLASSES]; 78 thousand weights for 6 bins.

    scale: every voxel is divided by this number, the root mean square of the voxels trained on. Nothing is
      normalised per recording: how many events there are is part of what is learnt, as it would be for a
      network that meets a real sensor.
    """

    def __init__(self, bins, scale, generator):
        super().__init__()
        self.scale = scale
        self.layers = nn.Sequential(
            _conv(2 * bins, WIDTH, 5, 2),
            nn.BatchNorm2d(WIDTH),
            nn.ReLU(),
            Block(WIDTH),
            Block(2 * WIDTH),
            nn.AdaptiveAvgPool2d(1),
            nn.Flatten(),
            nn.Linear(4 * WIDTH, CLASSES),
        )
        for (
            layer
        ) in self.modules():  # drawn again, from the seed: torch's own draw comes from the global generator
            if isinstance(layer, nn.Conv2d | nn.Linear):
                nn.init.kaiming_normal_(layer.weight, generator=generator)
                if layer.bias is not None:
                    nn.init.zeros_(layer.bias)

    def forward(self, voxels):
        return self.layers(
            (voxels.float() / self.scale).flatten(1, 2).contiguous(memory_format=torch.channels_last)
        )


def train(voxels, labels, epochs, seed, device="cpu"):
    """Train a fresh classifier.

    Args: voxels: [N, 2, bins, H, W], N >= 2. labels: [N] int64. epochs: >= 1. seed: of weights and order; the
      same seed gives the same network.
    Returns: the classifier, ready to be asked.
    Raises: ShapeError when labels do not fit; DomainError when there is no event at all or nothing to train
      with.
    """
    if voxels.ndim != 5 or len(voxels) < 2 or labels.shape != (len(voxels),):
        raise ShapeError(
            f"voxels {list(voxels.shape)} and labels {list(labels.shape)} given; [N, 2, bins, H, W] and [N] "
            "with N >= 2 are needed."
        )
    scale = float(voxels.float().square().mean().sqrt())
    if scale == 0 or epochs < 1:
        raise DomainError(
            f"{float(voxels.float().sum()):g} events and {epochs} epochs leave nothing to learn; give "
            "recordings with events, and at least one epoch."
        )
    generator = torch.Generator().manual_seed(seed)
    net = Classifier(voxels.shape[2], scale, generator).to(device, memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]
    optimiser = torch.optim.AdamW(net.parameters(), lr=RATE, weight_decay=DECAY)
    batches = math.ceil(len(voxels) / BATCH)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, RATE, total_steps=epochs * batches)
    for _ in range(epochs):
        for chosen in torch.randperm(len(voxels), generator=generator).tensor_split(batches):
            optimiser.zero_grad()
            F.cross_entropy(
                net(shifted(voxels[chosen].to(device), generator)), labels[chosen].to(device)
            ).backward()
            optimiser.step()
            schedule.step()
    return net.eval()


@torch.no_grad()
def predict(net, voxels, device="cpu"):
    """Most likely class of every recording, [N] int64."""
    return torch.cat([net(part.to(device)).argmax(1).cpu() for part in voxels.split(500)])


def shifted(voxels, generator):
    """A batch moved by the same random whole number of pixels, up to SHIFT_PX each way; what leaves is lost,
    what enters is empty."""
    row, column = torch.randint(2 * SHIFT_PX + 1, (2,), generator=generator).tolist()
    height, width = voxels.shape[-2:]
    return F.pad(voxels, (SHIFT_PX,) * 4)[..., row : row + height, column : column + width]


def _conv(inputs, outputs, size, stride):
    return nn.Conv2d(inputs, outputs, size, stride, size // 2, bias=False)
