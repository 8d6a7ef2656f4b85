"""Accuracy over seeds: means, intervals, differences, confusions."""

import math
from dataclasses import dataclass

import torch
from scipy.stats import t as student
from torch import Tensor

from codesign.errors import ShapeError

CONFIDENCE = 0.95


@dataclass(frozen=True)
class Found:
    """What one generator reached. accuracy: [seeds] float64. confusion: [classes, classes] share of each true
    class (row) that was taken for each other."""

    accuracy: Tensor
    confusion: Tensor


@dataclass(frozen=True)
class Interval:
    """Mean and its 95 % interval."""

    mean: float
    low: float
    high: float

    def __str__(self):
        return f"{100 * self.mean:.1f} ({100 * self.low:.1f} to {100 * self.high:.1f})"


def by_seed(predictions, labels):
    """Found of predictions, a list over seeds of [N] int64, and labels [N] int64."""
    if not predictions or any(p.shape != labels.shape for p in predictions):
        raise ShapeError(
            f"{len(predictions)} sets of predictions for labels {list(labels.shape)}; each must have their "
            "shape."
        )
    classes = int(labels.max()) + 1
    cells = torch.stack(
        [
            torch.bincount(labels * classes + p, minlength=classes**2).reshape(classes, classes)
            for p in predictions
        ]
    ).double()
    total = cells.sum(0)
    return Found(
        torch.stack([(p == labels).double().mean() for p in predictions]), total / total.sum(1, keepdim=True)
    )


def interval(values):
    """Student's interval of the mean of [n] independent values, n >= 2."""
    half = (
        float(values.std())
        / math.sqrt(len(values))
        * float(student.ppf((1 + CONFIDENCE) / 2, len(values) - 1))
    )
    mean = float(values.mean())
    return Interval(mean, mean - half, mean + half)
