"""The spiking network of the thesis: brightness steps, one 3x3 convolution per polarity, a spike
response threshold."""

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from codesign.checks import check_positive, check_seed, check_whole
from codesign.errors import ShapeError
from codesign.events.entry import check_chunk, check_frames, check_state
from codesign.events.spiking.spike_esim_parts import stepwise
from codesign.events.spiking.srm import SrmState, drive_scale, srm
from codesign.events.spiking.surrogate import Surrogate

MOST_CHANNELS = 1024


@dataclass(frozen=True)
class BranchState:
    """What the network carries over chunks. frame: [C, H, W] last frame; neurons: SrmState of the
    spike response layer."""

    frame: Tensor
    neurons: SrmState


class TwoBranchSpikes(nn.Module):
    """ON and OFF spikes of +dI and -dI, each through its own convolution and threshold: 9 weights
    per channel and branch, no bias, no shared weight.

    It has no memory of brightness: a change that is too slow to reach the threshold within the
    reset's time never gives an event.

    channels: 3 for RGB, 1 for monochrome frames. theta: threshold > 0. tau_r: time constant of the
      reset, in the unit of dt. dt: length of a step.
    kernel, surrogate, through_reset: as for ``events.srm``; the thesis's own reset is
      "thesis".
    seed: of the weights, uniform in 0 to 1 over their number, so that ON starts as brighter and OFF
      as darker.
    """

    def __init__(
        self,
        channels: int = 3,
        *,
        theta: Tensor | float = 1.0,
        tau_r: Tensor | float = 1.0,
        dt: float = 1.0,
        kernel: str = "slayer",
        surrogate: Surrogate | None = None,
        through_reset: str = "off",
        seed: int = 0,
    ):
        super().__init__()
        dt = check_positive(dt, "dt")
        for name, value in (("theta", theta), ("tau_r", tau_r)):
            if not isinstance(value, Tensor):
                check_positive(value, name)
        channels = check_whole(channels, "channels", 1, MOST_CHANNELS)
        seed = check_seed(seed, "seed")
        draw = torch.rand(2, channels, 3, 3, generator=torch.Generator().manual_seed(seed)) / (
            9 * channels
        )
        self.weight_on = nn.Parameter(draw[0])
        self.weight_off = nn.Parameter(draw[1])
        self.theta = theta
        self.dt = dt
        self._options = {
            "tau_r": tau_r,
            "kernel": kernel,
            "surrogate": surrogate,
            "through_reset": through_reset,
        }

    def forward(
        self,
        frames: Tensor,
        state: BranchState | None = None,
        *,
        theta: Tensor | float | None = None,
    ) -> tuple[Tensor, Tensor, BranchState]:
        """Spikes of the frames.

        Args:
          frames: [T, C, H, W], or [T, H, W] with one channel; linear intensity in any unit, finite.
          state: BranchState of the chunk before; then T frames give T steps. None: at rest, T
            frames give T-1 steps.
          theta: threshold for this call; None: the one of the network.
        Returns: spikes and potential [T-1, 2, H, W] ([T, 2, H, W] with a state), ON first;
          BranchState to carry on. Chunks equal the whole bit for bit on one machine with one number
          of threads.
        Gradient: weights and frames, by the surrogate.
        Raises: ShapeError for other shapes or too few frames; DomainError for NaN or infinity.
        """
        check_state(state, BranchState)
        drive, last = self._drive(frames, state)
        neurons = None if state is None else state.neurons
        spikes, potential, neurons = srm(
            drive,
            theta=self.theta if theta is None else theta,
            state=neurons,
            dt=self.dt,
            **self._options,
        )
        return spikes, potential, BranchState(last, neurons)

    @torch.no_grad()
    def wake(self, frames: Tensor, share: float = 0.05) -> None:
        """Scale the weights of either branch so that ``share`` of its potentials reaches the
        threshold on these frames: training never starts dead.

        Raises: DomainError when the frames are too silent for any scale (see
          ``events.drive_scale``).
        """
        drive, _ = self._drive(frames, None)
        for branch, weight in enumerate((self.weight_on, self.weight_off)):
            weight.mul_(drive_scale(drive[:, branch], theta=self.theta, share=share, dt=self.dt))

    def _drive(self, frames, state):
        check_frames(frames, 2 if state is None else 1, non_negative=False)
        channels = self.weight_on.shape[0]
        if frames.ndim == 3 and channels == 1:
            frames = frames[:, None]
        if frames.ndim != 4 or frames.shape[1] != channels:
            raise ShapeError(
                f"frames have shape {list(frames.shape)}; [T, {channels}, H, W] is needed "
                f"(channels={channels})."
            )
        if state is not None:
            check_chunk(frames, state.frame.shape, state.frame.dtype)
        steps = (frames if state is None else torch.cat((state.frame[None], frames))).diff(dim=0)
        weights = (self.weight_on, -self.weight_off)

        def convolved(pictures):
            return torch.cat(
                [torch.conv2d(pictures, w[None].to(pictures), padding=1) for w in weights], 1
            )

        return stepwise(convolved, steps[:, None])[:, 0], frames[-1].clone()
