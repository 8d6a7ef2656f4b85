"""The spike response model as one node of torch's graph: forward loop, adjoint loop, and segments that trade
time for memory."""

from dataclasses import astuple, dataclass

import torch
from torch.autograd import Function

from codesign.backend import NoSecondDerivative, arrays, load
from codesign.errors import NonFiniteError, check_finite
from codesign.events.spiking.srm_adjoint import Wanted, pack, scan_back, unpack
from codesign.events.spiking.srm_forward import Grid, Plan, scan
from codesign.events.spiking.srm_kernels import absolute_sum, reset_coefficients, response_coefficients
from codesign.events.spiking.surrogate import Surrogate
from codesign.exclusive import exclusive

FIRST_ONLY = "events.srm gives first derivatives only, and a second one was asked for; use differences of gradients instead."

# "bounded" keeps rho * sum|nu| at most this: the adjoint then shrinks by 10 % per pass through the reset
BOUND = 0.9
# floats ahead of the potential: where potentials and their gradient share their place in a memory page,
# backward takes 1.4 times as long
STAGGER = 768


@dataclass(frozen=True)
class Setup:
    """Everything about a call that is not a tensor."""

    plan: Plan
    kernel: str
    reset_scale: float
    surrogate: Surrogate
    segment: int | None
    shape: tuple[int, ...]  # of the drive as the caller gave it, for messages


def run(setup, drive, theta, h_response, h_reset, response, reset):
    """Spikes, potential and final states of the layer.

    Args:
      drive: [T, channels, lanes] float32 or float64.
      theta, h_response, h_reset: [channels, lanes] float64; h_response None without an alpha response.
      response, reset: [number of states, channels, lanes] float64.
    Returns: spikes and potential as ``drive``, states as ``response`` and ``reset``.
    """
    return _Srm.apply(setup, drive, theta, h_response, h_reset, response, reset)


def reset_sum(setup, theta, h_reset, steps):
    """Sum of |nu| over all lags [channels, lanes], doubled where a spike also lifts the other polarity."""
    k = reset_coefficients(setup.kernel, h_reset, -setup.reset_scale * theta)
    return setup.plan.channels * absolute_sum(setup.plan.reset, k.a, k.m, steps)


class _Srm(Function):
    @staticmethod
    @exclusive
    def forward(ctx, setup, drive, theta, h_response, h_reset, response, reset):
        import drjit as dr

        work = _Work(setup, drive, theta, h_response, h_reset)
        states = work.split(response, reset)
        spikes = dr.empty(work.single.Float, drive.numel())
        potential = dr.empty(work.single.Float, drive.numel() + STAGGER)
        segmented = setup.segment is not None and any(ctx.needs_input_grad)
        # states before every segment but the first, which are given
        checkpoints = []
        bad = dr.zeros(work.single.Bool, work.grid.lanes)
        for first, end in work.spans(setup.segment if segmented else None):
            if segmented and first > 0:
                checkpoints.append(states)
            states, found = work.forward(states, first, end, 0, spikes, potential, STAGGER)
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
        ctx.save_for_backward(
            drive, theta, h_response, h_reset, response, reset, spikes, None if segmented else potential
        )
        ctx.setup = setup
        ctx.checkpoints = checkpoints if segmented else None
        ctx.set_materialize_grads(False)
        return spikes, potential, *work.join(states)

    @staticmethod
    def backward(ctx, *grads):  # pyright: ignore[reportIncompatibleMethodOverride]
        saved = ctx.saved_tensors
        with torch.no_grad():
            result = _backward(ctx, saved, grads)
        if torch.is_grad_enabled():
            live = [g for g in result if g is not None]
            sealed = iter(
                NoSecondDerivative.apply(
                    FIRST_ONLY, len(live), *live, *[x for x in (*saved, *grads) if x is not None]
                )
            )
            result = [None if g is None else next(sealed) for g in result]
        return None, *result


@exclusive
def _backward(ctx, saved, grads):
    """Gradients of drive, theta, h_response, h_reset, response and reset."""
    import drjit as dr

    drive, theta, h_response, h_reset, response, reset, spikes, potential = saved
    need = ctx.needs_input_grad[1:]
    work = _Work(ctx.setup, drive, theta, h_response, h_reset)
    carried = ctx.setup.plan.through_reset != "off" or need[3] or need[5]
    wanted = Wanted(drive=need[0], theta=need[1], response=need[2], reset=need[3], through_reset=carried)
    numbers = work.adjoint_numbers()
    layout = wanted.layout(ctx.setup.plan)
    parts = unpack([None] * work.channels * sum(layout.values()), layout, work.channels)
    for k, part in enumerate(parts):
        for name, values in part.items():
            given = {"response": grads[2], "reset": grads[3]}.get(name)
            part[name] = [
                dr.zeros(work.double.Float, work.grid.lanes)
                if given is None
                else load(work.double.Float, given[j, k])
                for j in range(len(values))
            ]
    carried = pack(parts)
    flat = {
        "drive": work.drive,
        "spikes": work.flat(spikes),
        "grad_spikes": work.flat(grads[0]),
        "grad_potential": work.flat(grads[1]),
        "potential": work.flat(potential),
    }
    flat["grad_drive"] = dr.empty(work.single.Float, drive.numel()) if need[0] else None
    segmented = ctx.checkpoints is not None
    before = [work.split(response, reset), *(ctx.checkpoints or [])]
    spans = work.spans(ctx.setup.segment if segmented else None)
    for states, (first, end) in reversed(list(zip(before, spans, strict=True))):
        if segmented:
            flat["potential"] = dr.empty(work.single.Float, (end - first) * drive[0].numel())
            work.forward(states, first, end, first, None, flat["potential"], 0)
            dr.eval(flat["potential"])
        span = work.count(first), work.count(end)
        carried = scan_back(
            ctx.setup.plan,
            wanted,
            work.grid,
            numbers,
            work.opaque_surrogate(work.single),
            flat,
            carried,
            span,
            work.count(first if segmented else 0),
        )
        dr.eval(carried, *([flat["grad_drive"]] if need[0] else []))
    dr.sync_thread()
    return _collect(
        work,
        unpack(carried, layout, work.channels),
        flat["grad_drive"],
        (drive, theta, response, reset),
        wanted,
        need,
    )


def _collect(work, parts, grad_drive, inputs, wanted, need):
    """Torch gradients from the loop variables before the first step; the initial states add their share to
    those of the parameters."""
    drive, theta, response, reset = inputs

    def rows(name, count):
        return (
            torch.stack([torch.stack([part[name][j].torch() for part in parts]) for j in range(count)])
            if count
            else torch.zeros(0, *theta.shape, dtype=theta.dtype, device=theta.device)
        )

    def parameter(name, tangent, initial):
        return (
            rows(f"{name}_sum", 1)[0] + (initial * rows(tangent, initial.shape[0])).sum(0)
            if getattr(wanted, name)
            else None
        )

    return [
        grad_drive.torch().view(drive.shape) if need[0] else None,
        parameter("theta", "theta_tangent", reset),
        parameter("response", "response_tangent", response),
        parameter("reset", "reset_tangent", reset),
        rows("response", response.shape[0]) if need[4] else None,
        rows("reset", reset.shape[0]) if need[5] else None,
    ]


class _Work:
    """The drjit side of one call: types, lanes, per-pixel numbers and the drive. Numbers are evaluated or
    opaque, so that no call compiles anew."""

    def __init__(self, setup, drive, theta, h_response, h_reset):
        device = drive.device.type
        self.setup = setup
        self.theta = theta
        self.h_response = h_response
        self.h_reset = h_reset
        self.single = arrays(device, drive.dtype)
        self.double = arrays(device, torch.float64)
        self.steps = drive.shape[0]
        self.channels = drive.shape[1]
        self.grid = Grid.make(self.single, self.double, drive.shape[2], self.channels)
        self.drive = self.flat(drive)
        reset = reset_coefficients(setup.kernel, h_reset, -setup.reset_scale * theta)
        response = None if h_response is None else response_coefficients(h_response)
        self.columns = {"theta": theta, "reset": reset, "response": response}

    def flat(self, tensor):
        return None if tensor is None else load(self.single.Float, tensor)

    def opaque_surrogate(self, types):
        """The surrogate's numbers in one precision."""
        import drjit as dr

        return tuple(dr.opaque(types.Float, value) for value in astuple(self.setup.surrogate))

    def count(self, value):
        import drjit as dr

        return dr.opaque(self.single.UInt32, value)

    def spans(self, segment):
        """First step and end of every segment."""
        length = segment or self.steps
        return [(first, min(first + length, self.steps)) for first in range(0, self.steps, length)]

    def per_channel(self, columns):
        """Per channel, a dictionary of drjit arrays [lanes] from tensors [channels, lanes]."""
        return [
            {
                name: None if column is None else load(self.double.Float, column[k])
                for name, column in columns.items()
            }
            for k in range(self.channels)
        ]

    def numbers(self):
        response = self.columns["response"]
        reset = self.columns["reset"]
        found = {"theta": self.theta, "reset_a": reset.a, "reset_m": reset.m}
        return {**found, "response_a": response and response.a, "response_m": response and response.m}

    def adjoint_numbers(self):
        response = self.columns["response"]
        reset = self.columns["reset"]
        largest = reset_sum(self.setup, self.theta, self.h_reset, self.steps)
        moved = {
            "reset_a_h": reset.a_h,
            "reset_m_h": reset.m_h,
            "reset_m_theta": reset.m / self.theta,
            "limit": BOUND / largest,
        }
        return self.per_channel(
            {
                **self.numbers(),
                **moved,
                "response_a_h": response and response.a_h,
                "response_m_h": response and response.m_h,
            }
        )

    def forward(self, states, first, end, origin, spikes, potential, shift):
        span = (self.count(first), self.count(end))
        numbers = self.per_channel(self.numbers())
        return scan(
            self.setup.plan,
            self.grid,
            numbers,
            self.opaque_surrogate(self.double),
            self.drive,
            states,
            span,
            self.count(origin),
            spikes,
            potential,
            self.count(shift),
        )

    def split(self, response, reset):
        """States as drjit arrays [lanes], channel by channel, response before reset."""
        return [
            load(self.double.Float, rows[j, k])
            for k in range(self.channels)
            for rows in (response, reset)
            for j in range(rows.shape[0])
        ]

    def join(self, states):
        """The inverse of ``split``."""
        values = iter([state.torch() for state in states])
        counts = self.setup.plan.counts
        parts = [[[next(values) for _ in range(count)] for count in counts] for _ in range(self.channels)]
        empty = torch.zeros(0, self.channels, self.grid.lanes, dtype=torch.float64, device=self.theta.device)
        return [
            torch.stack([torch.stack([part[which][j] for part in parts]) for j in range(count)])
            if count
            else empty
            for which, count in enumerate(counts)
        ]
