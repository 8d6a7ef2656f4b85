"""Stochastic descent for objectives whose gradients have heavy tails: clipped, averaged, with the best point
kept."""

from dataclasses import dataclass, field

import torch

# variables stay on a grid: parallel sums in the backward pass differ in their last bits, and a run must
# repeat to the same numbers
GRAIN = 256


@dataclass
class Descent:
    """Momentum steps on clipped sample gradients, scored now and then on fixed cases; a worse score goes back
    and halves the step.

    Straight-through gradients of a flow error are noisy: single samples point anywhere, and some are tens of
      times too long. Each
    sample is clipped to ``clip``, the mean enters a momentum average, and a weak pull towards 0 (the start)
    keeps the variables
    that the objective does not see from wandering. ``check`` keeps the best point on a fixed set.
    """

    variables: torch.Tensor
    step_size: float
    momentum: float = 0.9
    clip: float = 1.5
    pull: float = 0.02
    velocity: torch.Tensor = field(default_factory=lambda: torch.empty(0))
    best: torch.Tensor = field(default_factory=lambda: torch.empty(0))
    best_score: float = float("inf")

    def __post_init__(self):
        if not self.velocity.numel():
            self.velocity = torch.zeros_like(self.variables)
            self.best = self.variables.clone()

    def step(self, gradients):
        """One step from a list of sample gradients [V]. Returns their unclipped norms."""
        norms = [float(g.norm()) for g in gradients]
        mean = torch.stack(
            [g * min(1.0, self.clip / max(n, 1e-30)) for g, n in zip(gradients, norms, strict=True)]
        ).mean(0)
        self.velocity = self.momentum * self.velocity + (1 - self.momentum) * (
            mean + self.pull * self.variables
        )
        self.variables = ((self.variables - self.step_size * self.velocity) * GRAIN).round() / GRAIN
        return norms

    def check(self, score):
        """Keep the point when its score is the best so far; otherwise go back to the best and halve the step.
        Returns whether it was kept."""
        if score <= self.best_score:
            self.best = self.variables.clone()
            self.best_score = score
            return True
        self.variables = self.best.clone()
        self.velocity = torch.zeros_like(self.velocity)
        self.step_size = self.step_size / 2
        return False
