"""How a head is trained on samples, and what its errors are."""

import math

import torch
from torch import Tensor

from codesign import task, train
from studies.velocity_head.samples import Samples

CLAIM = 0.05  # weight of the likelihood beside the bounded error
TAILS = 5.0  # degrees of freedom of Student's t, which forgives lost samples
RATE = 3e-3
DECAY = 1e-3


def bounded(velocity: Tensor, samples: Samples) -> Tensor:
    """[N]: the error of the task, q / (1 + q)."""
    axes = list(samples.axes)
    return task.velocity_errors(velocity[:, axes], samples.twist, axes).bounded()


def typical(mean: Tensor) -> Tensor:
    """The error, in units of the task, that all samples would have at a mean bounded one."""
    return (mean / (1 - mean)).sqrt()


def distance(velocity: Tensor, covariance: Tensor, samples: Samples) -> Tensor:
    """[N]: squared error of the velocities that count in units of their covariance."""
    axes = list(samples.axes)
    miss = (velocity - samples.twist)[:, axes]
    return (torch.linalg.solve(covariance[:, axes][:, :, axes], miss[..., None])[..., 0] * miss).sum(1)


def unlikelihood(velocity: Tensor, covariance: Tensor, samples: Samples) -> Tensor:
    """[N]: negative logarithm of the likelihood under Student's t, up to a constant."""
    axes = list(samples.axes)
    spread = torch.logdet(covariance[:, axes][:, :, axes]) / 2
    tails = torch.log1p(distance(velocity, covariance, samples) / TAILS)
    return spread + (TAILS + len(axes)) / 2 * tails


def lesson(predictions: list[tuple[Tensor, ...]], batch: list[Samples]) -> Tensor:
    """Loss: bounded error and likelihood, a mean over pairs."""
    losses = [
        bounded(velocity, samples).mean() + CLAIM * unlikelihood(velocity, covariance, samples).mean()
        for (velocity, covariance, _), samples in zip(predictions, batch, strict=True)
    ]
    return torch.stack(losses).mean()


def judged(head: task.VelocityHead, batch: list[Samples]) -> list[tuple[Tensor, ...]]:
    """What a head says of samples of each pair."""
    return [head.judged(samples.seen) for samples in batch]


def trained(
    head: task.VelocityHead,
    lessons: list[Samples],
    judge: list[Samples],
    steps: int,
    batch: int,
    seed: int,
    rate: float = RATE,
) -> task.VelocityHead:
    """The head, trained on samples of each pair in equal shares; of the weights on its way those that judge best.

    Args: lessons, judge: samples to train on and to choose by, for each pair.
    """
    generator = torch.Generator().manual_seed(seed)

    def draw(step):
        each = max(1, batch // len(lessons))
        picked = [torch.randint(len(part.twist), (each,), generator=generator) for part in lessons]
        return [part[which] for part, which in zip(lessons, picked, strict=True)]

    def score(network):
        return float(lesson(judged(network, judge), judge))

    train.fit(
        head,
        draw,
        steps=steps,
        loss=lesson,
        predict=judged,
        optimiser=torch.optim.AdamW(head.parameters(), rate, weight_decay=DECAY),
        clip=1.0,
        validate=score,
        validate_every=max(1, math.ceil(steps / 12)),
        seed=seed,
    )
    return head.eval()
