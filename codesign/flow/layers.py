"""The layer that the convolutional networks are made of."""

from torch import Tensor, nn
from torch.nn.functional import silu

GROUPS = 4


class Layer(nn.Module):
    """3 x 3 convolution, group normalisation, SiLU; ``active=False`` leaves the last out."""

    def __init__(self, inputs: int, outputs: int, stride: int = 1, active: bool = True) -> None:
        super().__init__()
        self.convolution = nn.Conv2d(inputs, outputs, 3, stride, 1, bias=False)
        self.norm = nn.GroupNorm(GROUPS, outputs)
        self.active = active

    def forward(self, x: Tensor) -> Tensor:
        x = self.norm(self.convolution(x))
        return silu(x) if self.active else x
