"""The spike response model backward in time: one symbolic drjit loop that carries the adjoint of every state
and, where asked, its parameter derivatives."""

from dataclasses import dataclass

from codesign.events.spiking.srm_forward import operations
from codesign.events.spiking.srm_kernels import inflow, retreat, retreat_tangent


@dataclass(frozen=True)
class Wanted:
    """Which gradients the loop computes: of the drive, of theta, of h = dt/tau of the response and of the
    reset.

    through_reset: whether the adjoint of the reset states is carried (for the spikes before, for h of the
      reset, or for the initial state).
    """

    drive: bool
    theta: bool
    response: bool
    reset: bool
    through_reset: bool

    def layout(self, plan):
        """Number of loop variables of one channel, by what they hold, in their order.

        response, reset: adjoints of the states. *_tangent: derivatives of those by h, or by theta. *_sum:
          gradients gathered so far.
        """
        response, reset = plan.counts
        return {
            "response": response,
            "reset": reset * self.through_reset,
            "response_tangent": response * self.response,
            "reset_tangent": reset * self.reset,
            "theta_tangent": reset * self.theta,
            "theta_sum": int(self.theta),
            "response_sum": int(self.response),
            "reset_sum": int(self.reset),
        }


def unpack(flat, layout, channels):
    """Loop variables as one dictionary of lists per channel."""
    values = iter(flat)
    return [
        {name: [next(values) for _ in range(count)] for name, count in layout.items()}
        for _ in range(channels)
    ]


def pack(parts):
    """The inverse of ``unpack``."""
    return [value for part in parts for values in part.values() for value in values]


def scan_back(plan, wanted, grid, numbers, surrogate, arrays, carried, span, origin):
    """Run steps span[1] - 1 down to span[0].

    Args:
      plan, grid: as in ``scan``. surrogate: its numbers, opaque, of the drive's precision.
      numbers: per channel, by name: as in ``scan``, and response_a_h, response_m_h, reset_a_h, reset_m_h,
        reset_m_theta, limit.
      arrays: flat arrays by name: drive, grad_spikes, grad_potential, grad_drive (scattered into) and spikes
        hold all steps; potential begins at step ``origin`` (opaque). None: no such gradient.
      carried: loop variables after the last step.
      span: first step and end, opaque.
    Returns: loop variables before the first step.
    """
    import drjit as dr

    Double = grid.double.Float
    ops = operations()
    layout = wanted.layout(plan)
    first, end = span

    def through_threshold(t, k, n, part):
        """Gradient of the potential of one channel, and its share that came through the spike."""
        x = grid.single.Float(grid.read(arrays["potential"], t - origin, k) - n["theta"])
        rho = Double(plan.surrogate.density(ops, x, *surrogate))  # no better known than the stored potential
        spiking = Double(0) if arrays["grad_spikes"] is None else rho * grid.read(arrays["grad_spikes"], t, k)
        if plan.through_reset != "off":  # part["reset"][0]: what this spike does to all later potentials
            spiking = (
                spiking
                + (rho if plan.through_reset == "full" else dr.minimum(rho, n["limit"])) * part["reset"][0]
            )
        return (
            spiking
            if arrays["grad_potential"] is None
            else spiking + grid.read(arrays["grad_potential"], t, k)
        ), spiking

    def respond(t, k, n, part, y):
        """Through the response kernel to the drive, and one step back."""
        z = usable = None
        if wanted.response or plan.zero_nonfinite:
            z = grid.read(arrays["drive"], t, k)
            if plan.zero_nonfinite:
                usable = dr.isfinite(z)
                z = dr.select(usable, z, 0)
        if wanted.response:
            part["response_sum"][0] = part["response_sum"][0] + z * part["response_tangent"][0]
            moved = n["response_a_h"], n["response_m_h"]
            part["response_tangent"] = retreat_tangent(
                plan.response,
                part["response_tangent"],
                part["response"],
                n["response_a"],
                n["response_m"],
                *moved,
                y,
            )
        if wanted.drive:
            of_drive = inflow(plan.response, part["response"], y)
            grid.write(
                arrays["grad_drive"],
                grid.single.Float(of_drive if usable is None else dr.select(usable, of_drive, 0)),
                t,
                k,
            )
        part["response"] = retreat(plan.response, part["response"], n["response_a"], n["response_m"], y)

    def reset(t, k, n, part, y):
        """Through the reset kernel to the spikes, and one step back."""
        s = grid.read(arrays["spikes"], t, k) if wanted.reset or wanted.theta else None
        coefficients = n["reset_a"], n["reset_m"]
        for name, moved in (
            ("reset", (n["reset_a_h"], n["reset_m_h"])),
            ("theta", (None, n["reset_m_theta"])),
        ):
            if getattr(wanted, name):
                part[f"{name}_sum"][0] = part[f"{name}_sum"][0] + s * part[f"{name}_tangent"][0]
                part[f"{name}_tangent"] = retreat_tangent(
                    plan.reset, part[f"{name}_tangent"], part["reset"], *coefficients, *moved, y
                )
        if wanted.through_reset:
            part["reset"] = retreat(plan.reset, part["reset"], *coefficients, y)

    def body(t, *flat):
        t = t - 1
        parts = unpack(flat, layout, plan.channels)
        found = [
            through_threshold(t, k, n, part) for k, (n, part) in enumerate(zip(numbers, parts, strict=True))
        ]
        for k, (n, part) in enumerate(zip(numbers, parts, strict=True)):
            y, spiking = found[k]
            if wanted.theta:
                part["theta_sum"][0] = part["theta_sum"][0] - spiking
            respond(t, k, n, part, y)
            reset(t, k, n, part, y if plan.channels == 1 else y - found[1 - k][0])
        return t, *pack(parts)

    last = end + dr.zeros(grid.single.UInt32, grid.lanes)
    return dr.while_loop(
        (last, *carried), lambda t, *rest: t > first, body, mode="symbolic", label="srm adjoint"
    )[1:]
