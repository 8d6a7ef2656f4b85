"""What flow's own covariance does not know: noise events, the photoreceptor's lag, and flow beyond
reach; fitted to hard errors of designs all over the bounds, so that expected errors rank designs as
hard ones do."""

import math
from collections.abc import Sequence
from dataclasses import astuple, dataclass
from typing import Any

import scipy
import torch
from torch import Tensor

from codesign.events import SensorModel
from codesign.mount import FlowErrors

# what a photoreceptor sees in the dark, and in full light (v2e)
DIM, LIT = 20.0, 275.0
SHOTS = 0.6  # of the noise rate in the dark, in the light of the worlds
LEAST_EVENTS = 1e-3  # per pixel
LOOKS = 120  # at all designs, in a fit
TIED = 1e-3  # to where a fit begins: weight of the squared logarithm
FIRST = 0.6  # of its steps, in logarithms
GOOD = 3.0  # weight of the better half of the designs


@dataclass(frozen=True)
class Conditions:
    """Under which flow was read. noise: noise events as a share of all. lag: of the photoreceptor,
    as a share of the interval. prior_px: of the flow's estimator."""

    noise: float
    lag: float
    prior_px: float

    @staticmethod
    def of(
        sensor: SensorModel, per_px: float, level: float, interval_s: float, prior_px: float
    ) -> "Conditions":
        """Of a sensor that gives ``per_px`` events per pixel in an interval, at a mean intensity
        (0 to 255)."""
        noise = SHOTS * sensor.shot_rate_hz * interval_s
        lag_s = LIT / (2 * math.pi * sensor.cutoff_hz * (level + DIM))
        return Conditions(noise / max(per_px, LEAST_EVENTS), lag_s / interval_s, prior_px)


@dataclass(frozen=True)
class Calibration:
    """claimed: factor on the claimed variance. noise: what it grows by, per share of noise events.
    share: deviation in shares of the flow's length; lag: what adds to it (in squares), per share of
    the interval. reach_px: flow that is lost half of the time, however wide the prior; priors: the
    same, in units of the prior.

    The numbers are those of docs/joint_race.md.
    """

    claimed: float = 0.425
    noise: float = 0.396
    share: float = 0.026
    lag: float = 0.536
    reach_px: float = 19.4
    priors: float = 13.8

    def errors(self, at: Conditions) -> FlowErrors:
        """Of flow under some conditions."""
        return FlowErrors(
            claimed=math.sqrt(self.claimed + self.noise * at.noise),
            share=math.hypot(self.share, self.lag * at.lag),
            reach_px=(self.reach_px**-2 + (self.priors * at.prior_px) ** -2) ** -0.5,
        )


@torch.no_grad()
def fitted(
    expected: Any,
    conditions: Sequence[Conditions],
    hard: Tensor,
    first: Calibration = Calibration(),
) -> Calibration:
    """The calibration by which the logarithms of expected errors are nearest to those of hard ones,
    in the mean square; the better half of the designs counts threefold.

    Args:
      expected: (number of a design, FlowErrors) -> its mean expected error.
      conditions: of the designs.
      hard: [designs] mean hard errors > 0.
    """
    weight = torch.where(hard <= hard.quantile(0.5), GOOD, 1.0)
    start = torch.tensor(astuple(first), dtype=torch.float64).log()

    def loss(logs):
        tried = Calibration(*torch.as_tensor(logs).exp().tolist())
        found = [expected(k, tried.errors(at)) for k, at in enumerate(conditions)]
        miss = torch.tensor(found, dtype=torch.float64).log() - hard.log()
        tied = TIED * (torch.as_tensor(logs) - start).square().sum()
        return float((weight * miss.square()).mean() + tied)

    corners = torch.cat([start[None], start + FIRST * torch.eye(len(start), dtype=torch.float64)])
    options = {"maxfev": LOOKS, "initial_simplex": corners.numpy()}
    found = scipy.optimize.minimize(loss, start.numpy(), method="Nelder-Mead", options=options)
    return Calibration(*torch.as_tensor(found.x).exp().tolist())
