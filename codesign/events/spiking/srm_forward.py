"""The spike response model forward in time: one symbolic drjit loop, one lane per pixel (or per pair of
coupled polarities)."""

from dataclasses import dataclass
from typing import Any

from codesign.events.spiking.srm_kernels import STATES, advance
from codesign.events.spiking.surrogate import Operations, Surrogate


@dataclass(frozen=True)
class Plan:
    """What decides the shape of the loop: a new plan is a new kernel, new numbers are not.

    response, reset: kinds of recursion (see srm_kernels). channels: 2 where ON and OFF reset one another,
      else 1. surrogate: its class.
    smooth: spikes are the surrogate's integral. through_reset: "off", "full" or "bounded". zero_nonfinite:
      take NaN and infinite drive as 0.
    """

    response: str
    reset: str
    channels: int
    surrogate: type[Surrogate]
    smooth: bool
    through_reset: str
    zero_nonfinite: bool

    @property
    def counts(self):
        """Number of states of the response and of the reset."""
        return STATES[self.response], STATES[self.reset]


@dataclass(frozen=True)
class Grid:
    """How lanes address arrays [T, channels, lanes]: drjit types of the drive and of float64, lane index per
    channel, values of one time step."""

    single: Any
    double: Any
    lanes: int
    index: tuple[Any, ...]
    row: Any

    @classmethod
    def make(cls, single, double, lanes, channels):
        import drjit as dr

        lane = dr.arange(single.UInt32, lanes)
        count = dr.opaque(single.UInt32, lanes)
        index = tuple(lane + k * count for k in range(channels))
        dr.eval(index)
        return cls(single, double, lanes, index, dr.opaque(single.UInt32, lanes * channels))

    def read(self, flat, step, channel):
        """The values of one channel at one step, in float64."""
        import drjit as dr

        return self.double.Float(dr.gather(self.single.Float, flat, step * self.row + self.index[channel]))

    def write(self, flat, value, step, channel, shift=0):
        import drjit as dr

        dr.scatter(flat, value, step * self.row + self.index[channel] + shift, mode=dr.ReduceMode.NoConflicts)


def operations():
    """The functions surrogates are written in, for drjit."""
    import drjit as dr

    return Operations(dr.exp2, dr.abs, dr.maximum, dr.select)


def scan(plan, grid, numbers, surrogate, drive, states, span, origin, spikes, potential, shift):
    """Run steps span[0] to span[1] - 1.

    Args:
      plan: Plan. grid: Grid.
      numbers: per channel, float64 drjit arrays [lanes] by name: theta, response_a, response_m, reset_a,
        reset_m. surrogate: its numbers, opaque.
      drive: flat [T * channels * lanes].
      states: drjit arrays [lanes], channel by channel, response before reset.
      span: first step and end, opaque. origin: the step that the first row of ``spikes`` and ``potential``
        belongs to, opaque.
      spikes, potential: flat arrays scattered into; None: not kept. shift: place of the first potential,
        opaque.
    Returns: the states after the last step, and per lane whether something became NaN or infinite.
    """
    import drjit as dr

    Double = grid.double.Float
    ops = operations()
    first, end = span

    def body(t, bad, *flat):
        values = iter(flat)
        parts = []
        responses = []
        resets = []
        for k, n in enumerate(numbers):
            response, reset = ([next(values) for _ in range(count)] for count in plan.counts)
            z = grid.read(drive, t, k)
            if plan.zero_nonfinite:
                z = dr.select(dr.isfinite(z), z, 0)
            y, response = advance(plan.response, response, n["response_a"], n["response_m"], z)
            r, reset = advance(plan.reset, reset, n["reset_a"], n["reset_m"])
            if plan.response == "pair":
                response[0] = response[0] + z
            parts.append((response, reset))
            responses.append(y)
            resets.append(r)
        after = []
        for k, (n, (response, reset)) in enumerate(zip(numbers, parts, strict=True)):
            u = responses[k] + (resets[k] if plan.channels == 1 else resets[k] - resets[1 - k])
            x = u - n["theta"]
            s = (
                plan.surrogate.integral(ops, x, *surrogate)
                if plan.smooth
                else dr.select(x >= 0, Double(1), Double(0))
            )
            reset[0] = reset[0] + s
            after += [*response, *reset]
            kept = grid.single.Float(u)
            bad |= ~dr.isfinite(kept)
            if spikes is not None:
                grid.write(spikes, grid.single.Float(s), t - origin, k)
            if potential is not None:
                grid.write(potential, kept, t - origin, k, shift)
        return t + 1, bad, *after

    start = first + dr.zeros(grid.single.UInt32, grid.lanes)
    healthy = dr.zeros(grid.single.Bool, grid.lanes)
    _, bad, *states = dr.while_loop(
        (start, healthy, *states), lambda t, *rest: t < end, body, mode="symbolic", label="srm forward"
    )
    return states, bad
