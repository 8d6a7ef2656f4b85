"""The spike response model over time as one node of torch's graph: a symbolic drjit loop forward and one
backward, one lane per pixel (or pair of coupled polarities), in float64 whatever the drive.

The adjoint is written by hand, since it needs no state of the layer, only its potential: letting drjit
differentiate one step after the other (``step_by_step``) keeps or computes again the states of every step:
1.8 times as long, forward and backward, 2 x 128 x 128 pixels, T = 200.
"""

from dataclasses import astuple, dataclass

import torch
from torch import Tensor
from torch.autograd import Function

from codesign.backend import NoSecondDerivative, arrays, load
from codesign.errors import NonFiniteError, check_finite
from codesign.events.spiking.srm_kernels import (
    STATES,
    advance,
    reset_coefficients,
    response_coefficients,
    retreat,
    retreat_tangent,
)
from codesign.events.spiking.surrogate import Operations, Surrogate
from codesign.exclusive import exclusive

FIRST_ONLY = (
    "events.srm gives first derivatives only, and a second one was asked for; use differences of gradients "
    "instead."
)
# "bounded" keeps rho * sum|nu| at most this: the adjoint then shrinks by 10 % per pass through the reset
BOUND = 0.9
# floats ahead of the potential: where potentials and their gradient share their place in a memory page,
# backward takes 1.4 times as long
STAGGER = 768


@dataclass(frozen=True)
class Setup:
    """Everything about a call that is not a tensor. response, reset: kinds of recursion. kernel: name of the
    reset.
    channels: 2 where ON and OFF reset one another, else 1. shape: of the drive as the caller gave it."""

    response: str
    reset: str
    kernel: str
    channels: int
    reset_scale: float
    surrogate: Surrogate
    smooth: bool
    through_reset: str
    zero_nonfinite: bool
    segment: int | None
    shape: tuple[int, ...]

    def reset_of(self, theta, h_reset):
        return reset_coefficients(self.kernel, h_reset, -self.reset_scale * theta)

    def reset_sum(self, theta: Tensor, h_reset: Tensor, steps: int) -> Tensor:
        """Sum of |nu| over all lags, of every pixel, doubled where a spike also lifts the other polarity; a
        kernel that does not decay is summed over ``steps`` lags."""
        k = self.reset_of(theta, h_reset)
        if self.reset == "pair":
            return self.channels * k.m.abs() * k.a / (1 - k.a) ** 2
        total = ((1 - k.a**steps) / (1 - k.a)).where(k.a < 1, float(steps))
        return self.channels * (k.m.abs() * (k.a * total if self.reset == "late" else total))


def run(
    setup: Setup,
    drive: Tensor,
    theta: Tensor,
    h_response: Tensor | None,
    h_reset: Tensor,
    response: Tensor,
    reset: Tensor,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Spikes, potential and final states of the layer.

    Args:
      drive: [T, channels, lanes] float32 or float64.
      theta, h_response, h_reset: [channels, lanes] float64; h_response None without an alpha response.
      response, reset: [number of states, channels, lanes] float64.
    Returns: spikes and potential as ``drive``, states as ``response`` and ``reset``.
    """
    return _Srm.apply(setup, drive, theta, h_response, h_reset, response, reset)


class _Srm(Function):
    @staticmethod
    @exclusive
    def forward(ctx, setup, drive, theta, h_response, h_reset, response, reset):
        import drjit as dr

        loops = _Loops(setup, drive, theta, h_response, h_reset)
        states = loops.split(response, reset)
        spikes = dr.empty(loops.single.Float, drive.numel())
        potential = dr.empty(loops.single.Float, drive.numel() + STAGGER)
        segment = setup.segment if any(ctx.needs_input_grad) else None
        before = []
        bad = dr.zeros(loops.single.Bool, loops.lanes)
        for span in loops.spans(segment):
            before.append(states)
            states, found = loops.forward(states, span, 0, spikes, potential, STAGGER)
            bad |= found
            dr.eval(spikes, potential, states, bad)
        dr.sync_thread()
        if bool(dr.any(bad)):
            check_finite(drive.view(setup.shape), "drive", 'remove or repair them, or pass nonfinite="zero"')
            raise NonFiniteError(
                "the potential of events.srm overflows; scale the drive down (events.drive_scale proposes a "
                "factor)."
            )
        spikes = spikes.torch().view(drive.shape)
        potential = potential.torch()[STAGGER:].view(drive.shape)
        kept = None if segment else potential
        ctx.save_for_backward(drive, theta, h_response, h_reset, response, reset, spikes, kept)
        ctx.setup = setup
        ctx.segment = segment
        ctx.before = before[1:]  # the first ones are given
        ctx.set_materialize_grads(False)
        return spikes, potential, *loops.join(states)

    @staticmethod
    def backward(ctx, *grads):  # pyright: ignore[reportIncompatibleMethodOverride]
        saved = ctx.saved_tensors
        with torch.no_grad():
            result = _backward(ctx, saved, grads)
        if torch.is_grad_enabled():
            live = [g for g in result if g is not None]
            given = [x for x in (*saved, *grads) if x is not None]
            sealed = iter(NoSecondDerivative.apply(FIRST_ONLY, len(live), *live, *given))
            result = [None if g is None else next(sealed) for g in result]
        return None, *result


@exclusive
def _backward(ctx, saved, grads):
    """Gradients of drive, theta, h_response, h_reset, response and reset; the initial states add their share
    to those of the parameters."""
    import drjit as dr

    drive, theta, h_response, h_reset, response, reset, spikes, potential = saved
    need = ctx.needs_input_grad[1:]
    setup = ctx.setup
    loops = _Loops(setup, drive, theta, h_response, h_reset)
    flat = {
        "spikes": loops.flat(spikes),
        "grad_spikes": loops.flat(grads[0]),
        "grad_potential": loops.flat(grads[1]),
        "potential": loops.flat(potential),
        "grad_drive": dr.empty(loops.single.Float, drive.numel()) if need[0] else None,
    }
    carried = loops.after(need, grads[2], grads[3])
    spans = loops.spans(ctx.segment)
    for states, span in reversed(list(zip([loops.split(response, reset), *ctx.before], spans, strict=True))):
        if ctx.segment:
            flat["potential"] = dr.empty(loops.single.Float, (span[1] - span[0]) * drive[0].numel())
            loops.forward(states, span, span[0], None, flat["potential"], 0)
            dr.eval(flat["potential"])
        carried = loops.backward(carried, span, span[0] if ctx.segment else 0, flat)
        dr.eval(carried, flat["grad_drive"])
    dr.sync_thread()

    def rows(name):
        columns = [torch.stack([x.torch() for x in part[name]]) for part in carried if part.get(name)]
        return torch.stack(columns, 1) if columns else theta.new_zeros(0, *theta.shape)

    def parameter(name, initial):
        return rows(f"{name}_sum")[0] + (initial * rows(f"{name}_tangent")).sum(0)

    return [
        flat["grad_drive"].torch().view(drive.shape) if need[0] else None,
        parameter("theta", reset) if need[1] else None,
        parameter("response", response) if need[2] else None,
        parameter("reset", reset) if need[3] else None,
        rows("response") if need[4] else None,
        rows("reset") if need[5] else None,
    ]


class _Loops:
    """The drjit side of one call: per-pixel numbers of every channel, and the loops. Numbers are evaluated
    or opaque, so that no call compiles anew."""

    def __init__(self, setup, drive, theta, h_response, h_reset):
        import drjit as dr

        self.dr = dr
        self.setup = setup
        self.single = arrays(drive.device.type, drive.dtype)
        self.double = arrays(drive.device.type, torch.float64)
        self.steps, self.channels, self.lanes = drive.shape
        self.drive = self.flat(drive)
        lane = dr.arange(self.single.UInt32, self.lanes)
        count = dr.opaque(self.single.UInt32, self.lanes)
        self.index = [lane + k * count for k in range(self.channels)]
        dr.eval(self.index)
        self.row = dr.opaque(self.single.UInt32, self.lanes * self.channels)
        self.reset = setup.reset_of(theta, h_reset)
        self.response = h_response if h_response is None else response_coefficients(h_response)
        self.theta = theta
        self.h_reset = h_reset

    def flat(self, tensor):
        return None if tensor is None else load(self.single.Float, tensor)

    def count(self, value):
        return self.dr.opaque(self.single.UInt32, value)

    def surrogate(self, types):
        """The surrogate's numbers, and the functions it is written in."""
        dr = self.dr
        numbers = [dr.opaque(types.Float, value) for value in astuple(self.setup.surrogate)]
        return Operations(dr.exp2, dr.abs, dr.maximum, dr.select), numbers

    def spans(self, segment):
        """First step and end of every segment."""
        length = segment or self.steps
        return [(first, min(first + length, self.steps)) for first in range(0, self.steps, length)]

    def read(self, flat, step, channel):
        """The values of one channel at one step, in float64."""
        place = step * self.row + self.index[channel]
        return self.double.Float(self.dr.gather(self.single.Float, flat, place))

    def write(self, flat, value, step, channel, shift=0):
        place = step * self.row + self.index[channel] + shift
        self.dr.scatter(flat, value, place, mode=self.dr.ReduceMode.NoConflicts)

    def numbers(self, more=None):
        """Per channel, thresholds, decays and amplitudes [lanes] by name; ``more``: columns [channels,
        lanes] besides."""
        columns = {"theta": self.theta, "reset_a": self.reset.a, "reset_m": self.reset.m, **(more or {})}
        if self.response:
            columns |= {"response_a": self.response.a, "response_m": self.response.m}
        return [
            {"response_a": None, "response_m": None}
            | {name: load(self.double.Float, column[k]) for name, column in columns.items()}
            for k in range(self.channels)
        ]

    def split(self, response, reset):
        """Per channel, the states of response and reset [states, channels, lanes] as drjit arrays [lanes]."""
        return [
            [[load(self.double.Float, row[k]) for row in rows] for rows in (response, reset)]
            for k in range(self.channels)
        ]

    def join(self, states):
        """The inverse of ``split``."""
        empty = self.theta.new_zeros(0, *self.theta.shape)
        parts = [
            [torch.stack([x.torch() for x in rows]) if rows else empty[:, 0] for rows in part]
            for part in states
        ]
        return [torch.stack(rows, 1) for rows in zip(*parts, strict=True)]

    def forward(self, states, span, origin, spikes, potential, shift):
        """Run steps span[0] to span[1] - 1.

        Args: states: per channel, of response and reset. origin: the step that the first row of ``spikes``
          and ``potential`` belongs to, flat arrays scattered into, or None: not kept. shift: place of the
          first potential.
        Returns: the states after the last step, and per lane whether something became NaN or infinite.
        """
        dr, setup, single = self.dr, self.setup, self.single
        Double = self.double.Float
        numbers = self.numbers()
        operations, surrogate = self.surrogate(self.double)
        end, origin, shift = self.count(span[1]), self.count(origin), self.count(shift)

        def body(t, bad, states):
            responses, resets, moved = [], [], []
            for k, (n, (response, reset)) in enumerate(zip(numbers, states, strict=True)):
                z = self.read(self.drive, t, k)
                if setup.zero_nonfinite:
                    z = dr.select(dr.isfinite(z), z, 0)
                y, response = advance(setup.response, response, n["response_a"], n["response_m"], z)
                r, reset = advance(setup.reset, reset, n["reset_a"], n["reset_m"])
                if setup.response == "pair":
                    response[0] = response[0] + z
                responses.append(y)
                resets.append(r)
                moved.append([response, reset])
            for k, (n, (_, reset)) in enumerate(zip(numbers, moved, strict=True)):
                u = responses[k] + (resets[k] if self.channels == 1 else resets[k] - resets[1 - k])
                x = u - n["theta"]
                if setup.smooth:
                    s = setup.surrogate.integral(operations, x, *surrogate)
                else:
                    s = dr.select(x >= 0, Double(1), Double(0))
                reset[0] = reset[0] + s
                kept = single.Float(u)
                bad |= ~dr.isfinite(kept)
                if spikes is not None:
                    self.write(spikes, single.Float(s), t - origin, k)
                if potential is not None:
                    self.write(potential, kept, t - origin, k, shift)
            return t + 1, bad, moved

        start = self.count(span[0]) + dr.zeros(single.UInt32, self.lanes)
        healthy = dr.zeros(single.Bool, self.lanes)
        _, bad, states = dr.while_loop(
            (start, healthy, states), lambda t, *_: t < end, body, mode="symbolic", label="srm forward"
        )
        return states, bad

    def after(self, need, grad_response, grad_reset):
        """Per channel, what the loop backward carries, after the last step, by name: adjoints of the states
        of response and reset; where wanted, derivatives of those by h or theta (tangents), and gradients
        gathered so far (sums)."""
        dr = self.dr
        setup = self.setup
        _, theta, response, reset, _, reset_state = need
        through = setup.through_reset != "off" or reset or reset_state
        counts = {"response": STATES[setup.response], "reset": through * STATES[setup.reset]}
        for name, wanted, states in (
            ("response", response, STATES[setup.response]),
            ("reset", reset, STATES[setup.reset]),
            ("theta", theta, STATES[setup.reset]),
        ):
            if wanted:
                counts |= {f"{name}_tangent": states, f"{name}_sum": 1}
        given = {"response": grad_response, "reset": grad_reset}

        def begun(name, j, k):
            if given.get(name) is None:
                return dr.zeros(self.double.Float, self.lanes)
            return load(self.double.Float, given[name][j, k])

        return [
            {name: [begun(name, j, k) for j in range(count)] for name, count in counts.items()}
            for k in range(self.channels)
        ]

    def backward(self, carried, span, origin, flat):
        """Run steps span[1] - 1 down to span[0].

        Args: carried: loop variables after the last step. origin: the step at which the potential begins.
          flat: arrays by name; spikes, grad_spikes, grad_potential and grad_drive (scattered into) hold all
          steps. None: no such gradient.
        Returns: loop variables before the first step.
        """
        dr, setup, single = self.dr, self.setup, self.single
        Double = self.double.Float
        reset, response = self.reset, self.response
        moved = {
            "reset_a_h": reset.a_h,
            "reset_m_h": reset.m_h,
            "reset_m_theta": reset.m / self.theta,
            "limit": BOUND / setup.reset_sum(self.theta, self.h_reset, self.steps),
        }
        if response:
            moved |= {"response_a_h": response.a_h, "response_m_h": response.m_h}
        numbers = self.numbers(moved)
        operations, surrogate = self.surrogate(single)
        first, origin = self.count(span[0]), self.count(origin)

        def through_threshold(t, k, n, part):
            """Gradient of the potential of one channel, and its share that came through the spike."""
            x = single.Float(self.read(flat["potential"], t - origin, k) - n["theta"])
            # no better known than the stored potential
            rho = Double(setup.surrogate.density(operations, x, *surrogate))
            seeded = flat["grad_spikes"] is not None
            spiking = rho * self.read(flat["grad_spikes"], t, k) if seeded else Double(0)
            if setup.through_reset != "off":
                # part["reset"][0]: what this spike does to all later potentials
                slope = rho if setup.through_reset == "full" else dr.minimum(rho, n["limit"])
                spiking = spiking + slope * part["reset"][0]
            if flat["grad_potential"] is None:
                return spiking, spiking
            return spiking + self.read(flat["grad_potential"], t, k), spiking

        def respond(t, k, n, part, y):
            """Through the response kernel to the drive, and one step back."""
            kind, adjoint = setup.response, part["response"]
            coefficients = n["response_a"], n["response_m"]
            z = self.read(self.drive, t, k)
            usable = dr.isfinite(z) if setup.zero_nonfinite else True
            after = {"response": retreat(kind, adjoint, *coefficients, y)}
            if "response_sum" in part:
                tangent, total = part["response_tangent"], part["response_sum"][0]
                after["response_sum"] = [total + dr.select(usable, z, 0) * tangent[0]]
                by_h = n["response_a_h"], n["response_m_h"]
                after["response_tangent"] = retreat_tangent(kind, tangent, adjoint, *coefficients, *by_h, y)
            if flat["grad_drive"] is not None:
                of_drive = {"none": lambda: y, "sum": lambda: adjoint[0] + y}.get(kind, lambda: adjoint[0])()
                of_drive = single.Float(of_drive)
                self.write(flat["grad_drive"], dr.select(usable, of_drive, 0), t, k)
            return after

        def through_reset(t, k, n, part, y, spiking):
            """Through the reset kernel to the spikes, and one step back."""
            coefficients = n["reset_a"], n["reset_m"]
            after = {}
            if part["reset"]:
                after["reset"] = retreat(setup.reset, part["reset"], *coefficients, y)
            for name, direct, by in (
                ("reset", 0, (n["reset_a_h"], n["reset_m_h"])),
                ("theta", spiking, (None, n["reset_m_theta"])),
            ):
                if f"{name}_sum" in part:
                    s = self.read(flat["spikes"], t, k)
                    tangent, total = part[f"{name}_tangent"], part[f"{name}_sum"][0]
                    after[f"{name}_sum"] = [total - direct + s * tangent[0]]
                    after[f"{name}_tangent"] = retreat_tangent(
                        setup.reset, tangent, part["reset"], *coefficients, *by, y
                    )
            return after

        def body(t, carried):
            t = t - 1
            channels = list(enumerate(zip(numbers, carried, strict=True)))
            found = [through_threshold(t, k, n, part) for k, (n, part) in channels]
            before = []
            for k, (n, part) in channels:
                y, spiking = found[k]
                of_reset = y if self.channels == 1 else y - found[1 - k][0]
                moved = respond(t, k, n, part, y) | through_reset(t, k, n, part, of_reset, spiking)
                before.append({name: moved.get(name, []) for name in part})
            return t, before

        last = self.count(span[1]) + dr.zeros(single.UInt32, self.lanes)
        return dr.while_loop(
            (last, carried), lambda t, *_: t > first, body, mode="symbolic", label="srm adjoint"
        )[1]
