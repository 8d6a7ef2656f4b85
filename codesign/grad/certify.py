"""The certificate of a gradient: autograd against central differences with common random numbers."""

from dataclasses import dataclass

import torch

from codesign.errors import DomainError, GradientError
from codesign.grad.differences import plateau

DEFAULT_LADDER = tuple(10.0**-k for k in (2, 2.5, 3, 3.5, 4, 4.5, 5))


@dataclass(frozen=True)
class Row:
    """The certificate of one group of parameters.

    autograd, difference: one number per parameter (or per random direction). relative_error: L2 of their
      difference over L2 of the differences.
    cosine: of the two vectors. signed_bias: (autograd . difference) / |difference|^2 - 1; negative means too
      small.
    noise_floor: L2 of the differences' own noise, relative like the error. step_plateau: step found, per
      parameter.
    verdict: "pass" (error within tolerance), "noise" (error within three noise floors, so the differences
      cannot judge), or "fail".
    """

    name: str
    autograd: tuple[float, ...]
    difference: tuple[float, ...]
    relative_error: float
    cosine: float
    signed_bias: float
    noise_floor: float
    step_plateau: tuple[float, ...]
    verdict: str


def certify(
    fn,
    params,
    *,
    scales=None,
    ladder=DEFAULT_LADDER,
    tolerance=0.01,
    directions=None,
    generator=None,
    difference_fn=None,
):
    """Compare autograd of a scalar function with differences, group by group.

    Args:
      fn: function of a dict of tensors -> scalar tensor; the same random numbers at every call.
      params: name -> tensor (the point where the gradient is checked).
      scales: name -> step unit (number or tensor like the parameter); 1 where left out. A ladder rung h moves
        a parameter by h * scale.
      ladder: relative steps, large to small. tolerance: relative error that passes.
      directions: None checks every component; a number checks that many random unit directions per group
        (many parameters), drawn with ``generator``.
      difference_fn: function whose differences judge, when it is not ``fn`` itself (a hard loss beside its
        smooth gradient).
    Returns: list of Row, one per group.
    Raises: GradientError when the loss does not depend on a group through autograd at all.
    """
    judge = difference_fn or fn
    leaves = {name: value.detach().clone().requires_grad_(True) for name, value in params.items()}
    loss = fn(leaves)
    if loss.numel() != 1:
        raise DomainError(
            f"certify needs a scalar function, got shape {tuple(loss.shape)}; reduce it to one number."
        )
    grads = torch.autograd.grad(loss, list(leaves.values()), allow_unused=True)
    rows = []
    for (name, value), grad in zip(params.items(), grads, strict=True):
        if grad is None:
            raise GradientError(
                f"the function does not depend on '{name}' through autograd; the graph is cut somewhere "
                "before it."
            )
        unit = (scales or {}).get(name, 1.0) * torch.ones_like(value)
        others = {k: v.detach() for k, v in params.items()}

        def alone(x, name=name, others=others):
            return judge({**others, name: x})

        found = []
        analytic = []
        for direction in _directions(value, directions, generator):
            step = direction * unit
            found.append(plateau(alone, value.detach(), step, ladder))
            analytic.append(float((grad * step).sum()))
        rows.append(_row(name, analytic, found, tolerance))
    return rows


def _directions(value, count, generator):
    if count is None:
        return torch.eye(value.numel(), dtype=value.dtype).reshape(-1, *value.shape)
    drawn = torch.randn(count, value.numel(), generator=generator, dtype=value.dtype)
    return torch.nn.functional.normalize(drawn, dim=1).reshape(count, *value.shape)


def _row(name, analytic, found, tolerance):
    a = torch.tensor(analytic, dtype=torch.float64)
    d = torch.tensor([f.value for f in found], dtype=torch.float64)
    noise = torch.tensor([f.noise for f in found], dtype=torch.float64).norm()
    size = max(float(d.norm()), 1e-300)
    error = float((a - d).norm()) / size
    floor = float(noise) / size
    cosine = float(a @ d) / max(float(a.norm()) * size, 1e-300)
    verdict = "pass" if error <= tolerance else "noise" if error <= 3 * floor else "fail"
    return Row(
        name,
        tuple(analytic),
        tuple(d.tolist()),
        error,
        cosine,
        float(a @ d) / size**2 - 1,
        floor,
        tuple(f.step for f in found),
        verdict,
    )


def worst(rows):
    """Largest relative error and smallest cosine over rows."""
    return max(r.relative_error for r in rows), min(r.cosine for r in rows)
