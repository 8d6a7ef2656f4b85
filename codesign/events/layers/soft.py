"""The layers beside ``memory``: the sigmoid per frame pair (the named baseline), a comparator that
looks once per frame, with a surrogate slope, and mean counts under threshold mismatch: smooth,
without ghosts, hard counts as the spread falls.
"""

import math

import torch
from torch import Tensor
from torch.autograd import Function

from codesign.backend import run_kernel
from codesign.checks import check_number, check_positive
from codesign.events.entry import check_level, check_per_pixel
from codesign.events.intensity import front_end_of, log_levels

# a pixel without change fires sigmoid(-5) = 0.67 % of an event per polarity and frame
GHOST_LOGIT = -5.0
# beyond a spread of so many events the sum over events equals its integral less a half: to exp(-2
# pi^2 1.2^2) = 5e-13 for small spreads, to 3e-7 for the largest, above which it no longer does
SERIES_END = 1.2
SERIES_SPREAD = 0.16
# of larger spreads so many events over the spread are summed, and the rest integrated, to 3e-7
SUMMED = 20.0
LEAST_SPREAD = 0.01
MOST_SPREAD = 1.0


def soft(
    frames: Tensor,
    theta: Tensor | float,
    theta_off: Tensor | float | None = None,
    *,
    sharpness: float | None = None,
    log_input: bool = False,
) -> Tensor:
    """Soft events of consecutive frames, without memory and capped at one per pixel, polarity and
    frame.

    Args:
      frames: [T, ...] linear intensity on the 0-255 scale (lin-log is applied here), any pixel
        shape; log intensity with ``log_input``.
      theta, theta_off: contrast thresholds > 0, natural log units, scalar or broadcasting over one
        frame; one for both polarities when None.
      sharpness: k > 0 in 1/log units; None: k = 5/theta.
    Returns: [T-1, 2, ...] ON = sigmoid(k (dL - theta)), OFF = sigmoid(k (-dL - theta_off)), between
      0 and 1, never 0.
    Gradient: frames and thetas, exact. Second derivatives raise.
    Raises: ShapeError for fewer than two frames; DomainError for theta or sharpness <= 0, NaN,
      infinite or negative input.

    Example:
    >>> from codesign import events
    >>> frames = torch.tensor([50.0, 100.0, 60.0]).reshape(3, 1, 1)
    >>> counts = events.soft(frames, theta=0.2)
    >>> [[round(count, 3) for count in step] for step in counts.flatten(1).tolist()]
    [[1.0, 0.0], [0.0, 1.0]]
    """
    front_end = front_end_of(frames, log_input, minimum=2)
    if sharpness is not None:
        check_positive(sharpness, "sharpness")
    before, after = frames[:-1], frames[1:]
    thetas = (
        check_per_pixel(each, "theta", frames)
        for each in (theta, theta if theta_off is None else theta_off)
    )
    thetas = [each if each.numel() == 1 else each.expand(after.shape) for each in thetas]

    def pair(arr, before, after, *thetas):
        import drjit as dr

        step = front_end.traced(dr, after)[0] - front_end.traced(dr, before)[0]
        return tuple(
            _sigmoid(dr, (sharpness or -GHOST_LOGIT / theta) * (way - theta))
            for way, theta in zip((step, -step), thetas, strict=True)
        )

    return torch.stack(run_kernel(pair, (before, after, *thetas), [after.shape] * 2), dim=1)


def _sigmoid(dr, value):
    """Without overflow."""
    above = value >= 0
    small = dr.exp(dr.select(above, -value, value))
    return dr.select(above, 1, small) * dr.rcp(1 + small)


def dense(
    frames: Tensor,
    theta_on: Tensor | float,
    theta_off: Tensor | float,
    *,
    sharpness: float = 5.0,
    state: Tensor | None = None,
    log_input: bool = False,
) -> tuple[Tensor, Tensor]:
    """Events of a comparator that looks once per frame; a pixel that fires memorises the level it
    sees.

    With u = (L - r)/theta_on - 1 an ON event is the step H(u), likewise OFF; then r := L where one
    fired. In the manner of SENPI: the physics of the pixel forward, a surrogate only for the step.

    Args:
      frames: [T, ...] linear intensity on the 0-255 scale, or log levels with ``log_input``.
        theta_on, theta_off: thresholds > 0, scalar or broadcasting over one frame. sharpness: b of
        the surrogate slope b/(1 + b |u|)^2, > 0. state: [...] memorised level of an earlier chunk.
    Returns: counts [T-1, 2, ...] of 0 and 1 ([T, 2, ...] with a state), ON first; state [...].
    Gradient: frames, thetas, state; surrogate slope at the step, exact elsewhere, through the
      memory.
    Raises: ShapeError, DomainError as ``memory``.
    Source: comparator surrogate: Zenke and Ganguli 2018 (fast sigmoid).
    """
    check_positive(sharpness, "sharpness")

    def step(difference, theta_on, theta_off):
        on = _Step.apply(difference / theta_on - 1, sharpness)
        off = _Step.apply(-difference / theta_off - 1, sharpness)
        return (on, off), (on + off) * difference

    return _memorised(frames, theta_on, theta_off, state, log_input, step)


def _memorised(frames, theta_on, theta_off, state, log_input, step):
    """Counts and the memorised level after them; step(way from the memorised level, theta_on,
    theta_off) gives both counts and what the memorised level moves by."""
    level = log_levels(frames, log_input, minimum=2 if state is None else 1)
    theta_on = check_per_pixel(theta_on, "theta_on", level)
    theta_off = check_per_pixel(theta_off, "theta_off", level)
    reference = level[0] if state is None else check_level(state, level)
    counts = []
    for now in level[1:] if state is None else level:
        pair, moved = step(now - reference, theta_on, theta_off)
        reference = reference + moved
        counts.append(torch.stack(pair))
    return torch.stack(counts), reference


class _Step(Function):
    @staticmethod
    def forward(ctx, value, sharpness):
        ctx.save_for_backward(value)
        ctx.sharpness = sharpness
        return (value >= 0).to(value)

    @staticmethod
    def backward(ctx, grad):  # pyright: ignore[reportIncompatibleMethodOverride]
        (value,) = ctx.saved_tensors
        return grad * ctx.sharpness / (1 + ctx.sharpness * value.abs()) ** 2, None


def expected(
    frames: Tensor,
    theta_on: Tensor | float,
    theta_off: Tensor | float,
    spread: Tensor | float,
    *,
    state: Tensor | None = None,
    log_input: bool = False,
) -> tuple[Tensor, Tensor]:
    """Mean counts of pixels whose thresholds scatter log-normally, with the mean memorised level
    carried on.

    With D = L - r, median threshold C and relative spread s: n = sum_k P(k theta <= |D|) = sum_k
    Phi(ln(|D|/(k C))/s), and r moves by the mean of theta times its count, sum_k C e^(s^2/2)
    Phi(ln(|D|/(k C))/s - s). A level at rest gives exactly nothing; s -> 0 gives the hard count.

    Args:
      frames: [T, ...] linear intensity on the 0-255 scale, or log levels with ``log_input``.
        theta_on, theta_off: median thresholds > 0, scalar or broadcasting over one frame. spread:
        s, relative standard deviation (sigma/theta), 0.01 to 1. state: [...] as for ``memory``.
    Returns: counts [T-1, 2, ...] >= 0 ([T, 2, ...] with a state), ON first; state [...].
    Gradient: frames, thetas, spread, state: exact, smooth for D other than 0, where all derivatives
      vanish.
    Raises: ShapeError, DomainError as ``memory``, and for a spread outside its range.
    """
    check_number(spread, "spread", LEAST_SPREAD, MOST_SPREAD, remedy="0.15 is typical")

    def step(difference, theta_on, theta_off):
        scatter = torch.as_tensor(spread, dtype=difference.dtype, device=difference.device)
        on, rise = _mean_count(difference.clamp(min=0), theta_on, scatter)
        off, fall = _mean_count((-difference).clamp(min=0), theta_off, scatter)
        return (on, off), rise - fall

    return _memorised(frames, theta_on, theta_off, state, log_input, step)


def _mean_count(distance, theta, spread):
    """Mean count and mean movement of the memorised level for a distance >= 0."""
    many = distance / theta
    wide = float(spread.detach())
    far = many * spread > (SERIES_END if wide <= SERIES_SPREAD else math.inf)
    lift = torch.exp(spread**2 / 2)
    # where the series is not used its input is a harmless 1
    near = torch.where(far | (many <= 0), 1.0, many).log()
    count = torch.zeros_like(many)
    moved = torch.zeros_like(many)
    close = many.detach()[~far.detach()]
    # six deviations: what is left out is below 1e-9
    last = math.ceil(float(close.max()) * math.exp(6 * wide)) if close.numel() else 0
    most = math.ceil(SUMMED / wide)
    for k in range(1, min(last, most) + 1):
        place = (near - math.log(k)) / spread
        count = count + torch.special.ndtr(place)
        moved = moved + torch.special.ndtr(place - spread)
    if last > most:
        edge = most + 0.5
        place = (near - math.log(edge)) / spread
        count = count + _integral(many * lift, place, edge, spread)
        moved = moved + _integral(many / lift, place - spread, edge, spread)
    rest = many <= 0
    count = torch.where(far, many * lift - 0.5, torch.where(rest, 0.0, count))
    return count, theta * torch.where(far, many - lift / 2, torch.where(rest, 0.0, lift * moved))


def _integral(mean, place, edge, spread):
    """The sum over k > ``edge`` of P(X > k) as an integral with its first correction, for a log-normal
    X of that mean and P(X > edge) = Phi(place)."""
    slope = torch.exp(-(place**2) / 2) / (math.sqrt(2 * math.pi) * spread * edge)
    return mean * torch.special.ndtr(place + spread) - edge * torch.special.ndtr(place) - slope / 24
