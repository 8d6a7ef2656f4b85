"""Expected counts under threshold mismatch: smooth, without ghosts, and turning into hard counts as the
spread is annealed to zero."""

import math

import torch
from torch import Tensor

from codesign.errors import DomainError, as_number
from codesign.events.entry import check_level, check_per_pixel, check_positive, check_whole
from codesign.events.intensity import log_levels

# beyond a spread of so many events the sum over events equals its integral less a half, to exp(-2 pi^2 1.2^2)
# = 5e-13
SERIES_END = 1.2
LEAST_SPREAD = 0.01
MOST_SPREAD = 1.0


def expected(
    frames: Tensor,
    theta_on: Tensor | float,
    theta_off: Tensor | float,
    spread: Tensor | float,
    *,
    state: Tensor | None = None,
    log_input: bool = False,
) -> tuple[Tensor, Tensor]:
    """Mean counts of pixels whose thresholds scatter log-normally, with the mean memorised level carried on.

    With D = L - r, median threshold C and relative spread s: n = sum_k P(k theta <= |D|) = sum_k
    Phi(ln(|D|/(k C))/s), and r moves by the mean of theta times its count, sum_k C e^(s^2/2) Phi(ln(|D|/(k
    C))/s - s). A level at rest gives exactly nothing; s -> 0 gives the hard count.

    Args:
      frames: [T, ...] linear intensity on the 0-255 scale, or log levels with ``log_input``. theta_on,
        theta_off: median thresholds > 0, scalar or broadcasting over one frame. spread: s, relative standard
        deviation (sigma/theta), 0.01 to 1; see ``annealed``. state: [...] as for ``memory``.
    Returns: counts [T-1, 2, ...] >= 0 ([T, 2, ...] with a state), ON first; state [...].
    Gradient: frames, thetas, spread, state: exact, smooth for D other than 0, where all derivatives vanish.
    Raises: ShapeError, DomainError as ``memory``, and for a spread outside its range.
    """
    level = log_levels(frames, log_input, minimum=2 if state is None else 1)
    theta_on = check_per_pixel(theta_on, "theta_on", level)
    theta_off = check_per_pixel(theta_off, "theta_off", level)
    number = spread.detach() if isinstance(spread, Tensor) else spread
    if not LEAST_SPREAD <= as_number(number, "spread") <= MOST_SPREAD:
        raise DomainError(
            f"spread is {float(number)!r}; one relative standard deviation from {LEAST_SPREAD:g} to "
            f"{MOST_SPREAD:g} is needed (0.15 is typical)."
        )
    spread = torch.as_tensor(spread, dtype=level.dtype, device=level.device)
    reference = level[0] if state is None else check_level(state, level)
    counts = []
    for now in level[1:] if state is None else level:
        on, on_move = _mean_count((now - reference).clamp(min=0), theta_on, spread)
        off, off_move = _mean_count((reference - now).clamp(min=0), theta_off, spread)
        reference = reference + on_move - off_move
        counts.append(torch.stack((on, off)))
    return torch.stack(counts), reference


def annealed(step: int, steps: int, first: float = 0.5, last: float = 0.02) -> float:
    """Spread at a step of an optimisation, falling geometrically from ``first`` at step 0 to ``last`` at the
    end. Raises: DomainError for what is no finite number, or a spread that is not positive."""
    first, last = check_positive(first, "first"), check_positive(last, "last")
    step, steps = check_whole(step, "step"), check_whole(steps, "steps")
    return first * (last / first) ** (min(max(step, 0), steps) / max(steps, 1))


def _mean_count(distance, theta, spread):
    """Mean count and mean movement of the memorised level for a distance >= 0."""
    many = distance / theta
    far = many * spread > SERIES_END
    lift = torch.exp(spread**2 / 2)
    # where the series is not used its input is a harmless 1
    near = torch.where(far | (many <= 0), 1.0, many).log()
    count = torch.zeros_like(many)
    moved = torch.zeros_like(many)
    close = many.detach()[~far.detach()]
    last = (
        math.ceil(float(close.max()) * math.exp(6 * float(spread.detach()))) if close.numel() else 0
    )  # six deviations: what is left out is below 1e-9
    for k in range(1, last + 1):
        place = (near - math.log(k)) / spread
        count = count + torch.special.ndtr(place)
        moved = moved + torch.special.ndtr(place - spread)
    rest = many <= 0
    count = torch.where(far, many * lift - 0.5, torch.where(rest, 0.0, count))
    return count, theta * torch.where(far, many - lift / 2, torch.where(rest, 0.0, lift * moved))
