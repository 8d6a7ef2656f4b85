"""The spike response model over time as one node of torch's graph: a symbolic drjit loop forward
and one backward, one lane per pixel (or pair of coupled polarities), in float64 whatever the drive.

Its kernels are linear recursions with one decay a, one amplitude m and at most two states; no sum
is cut:

    pair     q <- a (q + p), p <- a p, y = m q, p <- p + z    y_t = m sum_{k>=1} k a^k z_{t-k}
    early    y = m p, p <- a p + z                            y_t = m sum_{k>=1} a^{k-1} z_{t-k}
    sum      p <- p + z, y = p                                y_t = sum_{k>=0} z_{t-k}
    none     y = z

The adjoint is written by hand, since it needs no state of the layer, only its potential: letting
drjit differentiate one step after the other (``events.kernels.recursion``) keeps or computes again
the states of every step: 1.8 times as long, forward and backward, 2 x 128 x 128 pixels, T = 200.
"""

import math
from dataclasses import astuple, dataclass

import torch
from torch import Tensor
from torch.autograd import Function

from codesign.backend import arrays, first_only, load
from codesign.checks import check_finite
from codesign.errors import NonFiniteError
from codesign.events.kernels import Lanes
from codesign.events.spiking.surrogate import Operations, Surrogate
from codesign.exclusive import exclusive

STATES = {"pair": 2, "early": 1, "sum": 1, "none": 0}
RESPONSES = {"none": "none", "alpha": "pair", "step": "sum"}
RESETS = {"slayer": "pair", "thesis": "early", "exp": "early", "step": "early"}
# "bounded" keeps rho * sum|nu| at most this: the adjoint then shrinks by 10 % per pass through the
# reset
BOUND = 0.9


@dataclass(frozen=True)
class Coefficients:
    """Decay a and amplitude m per pixel, and their derivatives with respect to h = dt/tau; tensors
    of one shape."""

    a: Tensor
    m: Tensor
    a_h: Tensor
    m_h: Tensor


def response_coefficients(h: Tensor) -> Coefficients:
    """Alpha kernel (k h) exp(1 - k h), k >= 1."""
    a = (-h).exp()
    return Coefficients(a, math.e * h, -a, (0 * h) + math.e)


def reset_coefficients(kernel: str, h: Tensor, amplitude: Tensor) -> Coefficients:
    """Reset kernel of the given name, for k >= 1, with amplitude = -reset_scale * theta: slayer:
    amplitude k h exp(1 - k h); thesis: amplitude exp(1 - k h); exp: amplitude exp(-(k - 1) h);
    step: amplitude."""
    a = (-h).exp()
    zero = 0 * h
    if kernel == "slayer":
        return Coefficients(a, math.e * h * amplitude, -a, math.e * amplitude)
    if kernel == "thesis":
        first = math.e * amplitude * a
        return Coefficients(a, first, -a, -first)
    if kernel == "exp":
        return Coefficients(a, amplitude, -a, zero)
    return Coefficients(zero + 1, amplitude, zero, zero)


def advance(kind, states, a, m, z=None):
    """One step of the recursion up to its output y; returns y and the states, into whose first one
    the input z is still to be added (``sum`` and ``none`` take z in at once)."""
    if kind == "pair":
        p, q = states
        q = a * (q + p)
        return m * q, [a * p, q]
    if kind == "early":
        return m * states[0], [a * states[0]]
    if kind == "sum":
        return states[0] + z, [states[0] + z]
    return z, []


def retreat(kind, adjoint, a, m, y):
    """Adjoint of the states before a step, from the adjoint after it and the adjoint y of its
    output."""
    if kind == "pair":
        p = adjoint[0]
        q = adjoint[1] + m * y
        return [a * (p + q), a * q]
    if kind == "early":
        return [a * adjoint[0] + m * y]
    return [adjoint[0] + y] if kind == "sum" else []


def retreat_tangent(kind, tangent, adjoint, a, m, da, dm, y):
    """Derivative of ``retreat`` where a and m move by da and dm, y being held; da None stands for
    zero (``adjoint`` is then not needed)."""
    moved = retreat(kind, tangent, a, dm, y)
    if da is None:
        return moved
    if kind == "early":
        return [moved[0] + da * adjoint[0]]
    later = adjoint[1] + m * y
    return [moved[0] + da * (adjoint[0] + later), moved[1] + da * later]


@dataclass(frozen=True)
class Setup:
    """Everything about a call that is not a tensor. response: kind of recursion. kernel: name of
    the reset.
    channels: 2 where ON and OFF reset one another, else 1. shape: of the drive as the caller gave
      it."""

    response: str
    kernel: str
    channels: int
    reset_scale: float
    surrogate: Surrogate
    smooth: bool
    through_reset: str
    shape: tuple[int, ...]

    @property
    def reset(self):
        """Kind of the reset's recursion."""
        return RESETS[self.kernel]

    def reset_of(self, theta, h_reset):
        return reset_coefficients(self.kernel, h_reset, -self.reset_scale * theta)

    def reset_sum(self, theta: Tensor, h_reset: Tensor, steps: int) -> Tensor:
        """Sum of |nu| over all lags, of every pixel, doubled where a spike also lifts the other
        polarity; a kernel that does not decay is summed over ``steps`` lags."""
        k = self.reset_of(theta, h_reset)
        if self.reset == "pair":
            return self.channels * k.m.abs() * k.a / (1 - k.a) ** 2
        total = ((1 - k.a**steps) / (1 - k.a)).where(k.a < 1, float(steps))
        return self.channels * (k.m.abs() * total)


class Srm(Function):
    """Spikes, potential and final states of the layer: ``Srm.apply(setup, drive, theta, h_response,
    h_reset, response, reset)``.

    drive: [T, channels, lanes] float32 or float64, as are spikes and potential. theta, h_response,
      h_reset:
    [channels, lanes] float64; h_response None without an alpha response. response, reset: [number
    of states, channels, lanes] float64.
    """

    @staticmethod
    @exclusive
    def forward(ctx, setup, drive, theta, h_response, h_reset, response, reset):
        loops = _Loops(setup, drive, theta, h_response, h_reset)
        dr = loops.dr
        spikes, potential = (dr.empty(loops.arr.Float, drive.numel()) for _ in range(2))
        states, bad = loops.forward(loops.split(response, reset), spikes, potential)
        dr.sync_thread()
        if bool(dr.any(bad, axis=None)):
            check_finite(
                drive.view(setup.shape),
                "drive",
                "remove or repair them, for example by torch.where",
            )
            raise NonFiniteError(
                "the potential of events.srm overflows; scale the drive down (events.drive_scale proposes a "
                "factor)."
            )
        spikes = spikes.torch().view(drive.shape)
        potential = potential.torch().view(drive.shape)
        ctx.save_for_backward(drive, theta, h_response, h_reset, response, reset, spikes, potential)
        ctx.setup = setup
        ctx.set_materialize_grads(False)
        return spikes, potential, *loops.join(states)

    @staticmethod
    def backward(ctx, *grads):  # pyright: ignore[reportIncompatibleMethodOverride]
        saved = ctx.saved_tensors
        with torch.no_grad():
            result = _backward(ctx.setup, saved, grads, ctx.needs_input_grad[1:])
        return None, *first_only(result, (*saved, *grads))


@exclusive
def _backward(setup, saved, grads, need):
    """Gradients of drive, theta, h_response, h_reset, response and reset; the initial states add
    their share to those of the parameters."""
    drive, theta, h_response, h_reset, response, reset, spikes, potential = saved
    loops = _Loops(setup, drive, theta, h_response, h_reset)
    dr = loops.dr
    given = {
        "spikes": spikes,
        "grad_spikes": grads[0],
        "grad_potential": grads[1],
        "potential": potential,
    }
    flat = {name: None if tensor is None else loops.load(tensor) for name, tensor in given.items()}
    flat["grad_drive"] = dr.empty(loops.arr.Float, drive.numel()) if need[0] else None
    carried = loops.backward(loops.after(need, grads[2], grads[3]), flat)
    dr.sync_thread()

    def rows(name):
        columns = [loops.rows_of(part[name]) for part in carried if part.get(name)]
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


class _Loops(Lanes):
    """The drjit side of one call: per-pixel numbers of every channel, and the loops. Numbers are
    evaluated or opaque, so that no call compiles anew."""

    def __init__(self, setup, drive, theta, h_response, h_reset):
        self.steps, self.channels, lanes = drive.shape
        # alone, rows a power of two apart share their places in what remembers pages: four times as
        # long
        super().__init__(drive, lanes, packs=2)
        self.setup = setup
        self.flat = arrays(drive.device.type, torch.float64).Float
        self.Double = self.of_lanes(self.flat)
        self.drive = self.load(drive)
        self.reset = setup.reset_of(theta, h_reset)
        self.response = h_response if h_response is None else response_coefficients(h_response)
        self.theta = theta
        self.h_reset = h_reset

    def surrogate(self, kind):
        """The functions that the surrogate is written in, and its numbers."""
        dr = self.dr
        # one for each neighbour: a quotient by one alone would be a rounded product
        numbers = [dr.opaque(kind, x, (self.extent[0], 1)) for x in astuple(self.setup.surrogate)]
        return Operations(dr.exp2, dr.abs, dr.maximum, dr.select), *numbers

    def read(self, flat, step, channel):
        """The values of one channel at one step, in float64."""
        return self.Double(self.at(flat, step * self.channels + channel))

    def numbers(self, **more):
        """Per channel, thresholds, decays and amplitudes [lanes] by name; ``more``: columns
        [channels, lanes] besides."""
        columns = {"theta": self.theta, "reset_a": self.reset.a, "reset_m": self.reset.m, **more}
        if self.response:
            columns |= {"response_a": self.response.a, "response_m": self.response.m}
        return [
            {"response_a": None, "response_m": None}
            | {name: self.lanes_of(column[k]) for name, column in columns.items()}
            for k in range(self.channels)
        ]

    def lanes_of(self, numbers):
        return self.at(load(self.flat, numbers), 0)

    def split(self, response, reset):
        """Per channel, the states of response and reset [states, channels, lanes] as drjit arrays
        [lanes]."""
        return [
            [[self.lanes_of(row[k]) for row in rows] for rows in (response, reset)]
            for k in range(self.channels)
        ]

    def join(self, states):
        """The inverse of ``split``."""
        parts = [[self.rows_of(rows) for rows in part] for part in states]
        return [torch.stack(rows, 1) for rows in zip(*parts, strict=True)]

    def rows_of(self, values):
        return self.stack(values, self.theta.shape[1:], self.flat)

    def forward(self, states, spikes, potential):
        """Run all steps, which fill flat arrays of spikes and potentials.

        Args:
          states: per channel, of response and reset.
        Returns: the states after the last step, and per lane whether something became NaN or
          infinite.
        """
        dr, setup = self.dr, self.setup
        Single, Double = self.of_lanes(self.arr.Float), self.Double
        numbers = self.numbers()
        surrogate = self.surrogate(Double)
        one = self.full(1, self.flat)

        def body(t, bad, states):
            responses, resets, moved = [], [], []
            for k, (n, (response, reset)) in enumerate(zip(numbers, states, strict=True)):
                z = self.read(self.drive, t, k)
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
                    s = setup.surrogate.integral(surrogate[0], x, *surrogate[1:])
                else:
                    s = dr.select(x >= 0, one, 0)
                reset[0] = reset[0] + s
                kept = Single(u)
                bad |= ~dr.isfinite(kept)
                self.put(spikes, Single(s), t * self.channels + k)
                self.put(potential, kept, t * self.channels + k)
            return bad, moved

        bad = self.full(False, self.arr.Bool)
        bad, states = self.loop(0, self.opaque(self.steps), body, bad, states)
        dr.eval(spikes, potential, states, bad)
        return states, bad

    def after(self, need, grad_response, grad_reset):
        """Per channel, what the loop backward carries, after the last step, by name: adjoints of
        the states of response and reset; where wanted, derivatives of those by h or theta
        (tangents), and gradients gathered so far (sums)."""
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
                return self.full(0, self.flat)
            return self.lanes_of(given[name][j, k])

        return [
            {name: [begun(name, j, k) for j in range(count)] for name, count in counts.items()}
            for k in range(self.channels)
        ]

    def backward(self, carried, flat):
        """Run all steps, the last one first.

        Args:
          carried: loop variables after the last step.
          flat: arrays by name; grad_drive is filled. None: no such gradient.
        Returns: loop variables before the first step.
        """
        dr, setup = self.dr, self.setup
        Single, Double = self.of_lanes(self.arr.Float), self.Double
        reset, response = self.reset, self.response
        by_h = {"response_a_h": response.a_h, "response_m_h": response.m_h} if response else {}
        if setup.through_reset == "bounded":
            by_h["limit"] = BOUND / setup.reset_sum(self.theta, self.h_reset, self.steps)
        numbers = self.numbers(
            reset_a_h=reset.a_h,
            reset_m_h=reset.m_h,
            reset_m_theta=reset.m / self.theta,
            **by_h,
        )
        surrogate = self.surrogate(Single)

        def through_threshold(t, k, n, part):
            """Gradient of the potential of one channel, and its share that came through the
            spike."""
            x = Single(self.read(flat["potential"], t, k) - n["theta"])
            # no better known than the stored potential
            rho = Double(setup.surrogate.density(surrogate[0], x, *surrogate[1:]))
            seeded = flat["grad_spikes"] is not None
            spiking = (
                rho * self.read(flat["grad_spikes"], t, k) if seeded else self.full(0, self.flat)
            )
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
            after = {"response": retreat(kind, adjoint, *coefficients, y)}
            if "response_sum" in part:
                tangent, total = part["response_tangent"], part["response_sum"][0]
                after["response_sum"] = [total + self.read(self.drive, t, k) * tangent[0]]
                by_h = n["response_a_h"], n["response_m_h"]
                after["response_tangent"] = retreat_tangent(
                    kind, tangent, adjoint, *coefficients, *by_h, y
                )
            if flat["grad_drive"] is not None:
                # what a response takes in at once reaches its output in the same step
                of_drive = (
                    y if kind == "none" else after["response"][0] if kind == "sum" else adjoint[0]
                )
                self.put(flat["grad_drive"], Single(of_drive), t * self.channels + k)
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
            channels = list(enumerate(zip(numbers, carried, strict=True)))
            found = [through_threshold(t, k, n, part) for k, (n, part) in channels]
            before = []
            for k, (n, part) in channels:
                y, spiking = found[k]
                of_reset = y if self.channels == 1 else y - found[1 - k][0]
                moved = respond(t, k, n, part, y) | through_reset(t, k, n, part, of_reset, spiking)
                before.append({name: moved.get(name, []) for name in part})
            return (before,)

        (carried,) = self.loop_back(0, self.opaque(self.steps), body, carried)
        dr.eval(carried, flat["grad_drive"])
        return carried
