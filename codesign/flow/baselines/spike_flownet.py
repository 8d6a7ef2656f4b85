"""A network with a spiking encoder and an analogue decoder, in the form of Spike-FlowNet."""

import torch
from torch import Tensor, nn
from torch.nn.functional import conv_transpose2d, leaky_relu

from codesign.backend import NoSecondDerivative
from codesign.checks import check_positive
from codesign.events.spiking.surrogate import FastSigmoid, Surrogate
from codesign.flow.baselines.parts import Baseline, channels, rescale_flow, start
from codesign.types import EventVolume

_FIRST_ONLY = (
    "a surrogate stands for the first derivative of a spike only; a second one through integrate-and-fire neurons was "
    "asked for. Use differences of gradients instead."
)
LEAK = 0.1  # slope of the decoder's rectifiers for negative input


class SpikeFlowNet(Baseline):
    """Four strided layers of integrate-and-fire neurons, sums of what flowed into them, two
    residual blocks, a decoder with four flow scales that each add to the coarser one.

    Args:
      bins: bins of the volumes, even; half of them are the time steps of the encoder
        (10 as published).
      width: channels of the first layer, 64 as published; every layer takes the nearest multiple of
        4.
      hidden: channels inside the residual blocks; None for 8 times ``width``.
      threshold: potential at which a neuron fires, in normalised counts.
      surrogate_width: of the fast sigmoid that stands for the derivative of the step, in potential.
      seed: of the first weights.
    Gradient: counts and weights, through spikes by the surrogate. First derivatives only.
    Raises: ShapeError, DomainError.
    Source: Lee et al., Spike-FlowNet, ECCV 2020, sec. 3 and fig. 4.

    >>> from codesign.flow.export import evenly_timed
    >>> SpikeFlowNet(bins=4, width=4.0)(evenly_timed(torch.ones(1, 2, 4, 32, 48))).flow_px.shape
    torch.Size([1, 2, 32, 48])
    """

    def __init__(
        self,
        bins: int = 8,
        width: float = 64.0,
        hidden: int | None = None,
        threshold: float = 0.75,
        surrogate_width: float = 0.75,
        seed: int = 0,
    ) -> None:
        threshold = check_positive(threshold, "threshold")
        surrogate_width = check_positive(surrogate_width, "surrogate_width")
        own = {"threshold": threshold, "surrogate_width": surrogate_width, "seed": seed}
        super().__init__(bins, width, hidden, even=True, **own)
        self.surrogate = FastSigmoid.unit(surrogate_width)
        down = [channels(width, factor) for factor in (1, 2, 4, 8)]
        up = [channels(width, 2), channels(width), 4]
        self.neck = channels(width, 0.5)  # channels between a level and its flow
        levels = [down[3], up[0] + down[2] + 2, up[1] + down[1] + 2, up[2] + down[0] + 2]
        self.encoder = nn.ModuleList(
            nn.Conv2d(a, b, 3, 2, 1, bias=False) for a, b in zip([4, *down], down, strict=False)
        )
        self.residual = nn.ModuleList(
            nn.ModuleList(
                [
                    nn.Conv2d(down[3], self.inside, 3, 1, 1, bias=False),
                    nn.Conv2d(self.inside, down[3], 3, 1, 1, bias=False),
                ]
            )
            for _ in range(2)
        )
        self.decoder = nn.ModuleList(
            nn.ConvTranspose2d(a, b, 4, 2, 1, bias=False) for a, b in zip(levels, up, strict=False)
        )
        self.necks = nn.ModuleList(
            nn.ConvTranspose2d(a, self.neck, 4, 2, 1, bias=False) for a in levels
        )
        self.heads = nn.ModuleList(nn.Conv2d(self.neck, 2, 1, bias=False) for _ in levels)
        start(self, seed, 3.0, self.heads)
        self.to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]

    def levels(self, counts: Tensor, volume: EventVolume) -> list[Tensor]:
        halves = to_halves(counts.unflatten(1, (2, -1)))
        # rounding to half precision makes other neurons fire
        with torch.autocast(halves.device.type, enabled=False):
            sums = self.encode(halves)
        return self.decode(sums)

    def encode(self, halves: Tensor) -> list[Tensor]:
        """Sums over the steps of what flowed into each layer's neurons: [B, width, H/2, W/2] to
        [B, 8 width, H/16, W/16].

        Args:
          halves: [B, 4, H, W, steps], ON and OFF of the former half of the window, then of the
            latter; H and W multiples of 16.
        """
        steps = halves.shape[4]
        halves = halves.to(next(self.parameters()).dtype)
        x = (
            halves.permute(4, 0, 1, 2, 3)
            .flatten(0, 1)
            .contiguous(memory_format=torch.channels_last)
        )
        sums = []
        # every layer runs over all steps at once: nothing flows back, so this is the same as step
        # by step
        for layer in self.encoder:
            current = layer(x).permute(0, 2, 3, 1)
            # rows in the order of memory, which sums 15 times faster
            shape = current.shape
            current = current.reshape(steps, -1)
            sums.append(current.sum(0).reshape(-1, *shape[1:]).permute(0, 3, 1, 2))
            if len(sums) < len(self.encoder):
                x = (
                    integrate_and_fire(current, self.config["threshold"], self.surrogate)
                    .reshape(shape)
                    .permute(0, 3, 1, 2)
                )
        return sums

    def decode(self, sums: list[Tensor]) -> list[Tensor]:
        """Flow at 1/8, 1/4, 1/2 and all of the resolution, each in pixels of its own grid, from
        what ``encode`` returns."""
        x = sums[-1]
        flows = []
        for first, second in self.residual:  # pyright: ignore[reportGeneralTypeIssues]
            x = x + leaky_relu(second(leaky_relu(first(x), LEAK)), LEAK)
        for level in range(4):
            # neck and head are linear, one after the other: their product is one transposed
            # convolution to 2 channels
            head = torch.einsum(
                "on,inhw->iohw",
                self.heads[level].weight[:, :, 0, 0],  # pyright: ignore[reportIndexIssue, reportArgumentType]
                self.necks[level].weight,  # pyright: ignore[reportArgumentType]
            )
            change = conv_transpose2d(x, head, stride=2, padding=1)
            flows.append(rescale_flow(flows[-1], change.shape[2:]) + change if flows else change)
            if level < 3:
                x = torch.cat(
                    [sums[2 - level], leaky_relu(self.decoder[level](x), LEAK), flows[-1]], 1
                )
        return flows


def to_halves(counts: Tensor) -> Tensor:
    """Bins of a volume as Spike-FlowNet takes them.

    Args:
      counts: [B, 2, 2 k, H, W] events per bin, ON first.
    Returns: [B, 4, H, W, k] view: ON and OFF of the former half, ON and OFF of the latter; nothing
      is lost or added. The bins keep their shared borders, so an event that crosses one, also the
      middle of the window, changes the input continuously.
    Gradient: counts.
    Source: Lee et al., Spike-FlowNet, ECCV 2020, sec. 3.1.
    """
    bins = counts.shape[2]
    split = counts.unflatten(2, (2, bins // 2)).transpose(1, 2)  # [B, half, polarity, k, H, W]
    return split.flatten(1, 2).permute(0, 1, 3, 4, 2)


class _Fire(torch.autograd.Function):
    @staticmethod
    def forward(ctx, current, threshold, surrogate):
        ctx.threshold = threshold
        ctx.surrogate = surrogate
        # the potential is made again: it would weigh as much, and the current ties a second
        # derivative to its refusal
        ctx.save_for_backward(current)
        return _run(current, threshold, torch.empty_like(current[:1]))

    @staticmethod
    def backward(ctx, *grads):
        (current,) = ctx.saved_tensors
        with torch.no_grad():
            potential = torch.empty_like(current)
            spikes = _run(current, ctx.threshold, potential)
            result = grads[0] * ctx.surrogate.torch_density(potential.sub_(ctx.threshold))
            for t in range(len(result) - 2, -1, -1):
                result[t].add_(result[t + 1]).addcmul_(result[t + 1], spikes[t], value=-1)
        if torch.is_grad_enabled():
            (result,) = NoSecondDerivative.apply(_FIRST_ONLY, 1, result, current, *grads)  # pyright: ignore[reportGeneralTypeIssues]
        return result, None, None


def _run(current, threshold, potential):
    """Spikes [T, ...]; potentials before the reset are left in ``potential``, as far as it is long.
    Into buffers made once: fresh ones cost more than the arithmetic."""
    spikes = torch.empty_like(current)
    rest = torch.zeros_like(current[0])
    for t in range(len(current)):
        u = torch.add(rest, current[t], out=potential[t % len(potential)])
        torch.ge(u, threshold, out=spikes[t])
        torch.addcmul(u, u, spikes[t], value=-1, out=rest)
    return spikes


def integrate_and_fire(current: Tensor, threshold: float, surrogate: Surrogate) -> Tensor:
    """Spikes of neurons without leak that fall back to 0 when they fire: u_t = u_{t-1}
    (1 - s_{t-1}) + I_t, s_t = [u_t >= threshold].

    Args:
      current: [T, ...] input of every step, in units of the potential.
      threshold: > 0.
      surrogate: Surrogate, its density at u - threshold stands for the derivative of the step.
    Returns: [T, ...] spikes, 0 or 1.
    Gradient: current; lambda_t = g_t rho(u_t - threshold) + (1 - s_t) lambda_{t+1}, the reset taken
      as it happened. First derivatives only.
    Raises: GradientError for a second derivative.
    Source: Lee et al., Spike-FlowNet, ECCV 2020, eqs. 1 to 3, which lets rho be 1 / threshold above
      it and 0 below.
    """
    return _Fire.apply(current, threshold, surrogate)
