"""The spike response layer against finite kernels written out in torch, and independently computed
cases."""

import warnings

import numpy as np
import pytest
import torch

from codesign.events.spiking.srm import SrmState, alpha_response, drive_scale, srm
from codesign.events.spiking.surrogate import FastSigmoid, Laplace, Triangular
from tests.numbers import D, close, f64, seeded

FADING = {"theta": 0.2, "kernel": "exp", "response": "alpha", "tau_s": 2.4, "tau_r": 1.2}
STEP = {"theta": 0.2, "kernel": "step", "response": "step", "reset_scale": 1.0, "coupled": True}
BOUNDED = {"coupled": True, "through_reset": "bounded", "surrogate": Laplace(2.0, 1.0)}


def noise(*shape, seed=0, dtype=D):
    return torch.rand(*shape, generator=seeded(seed), dtype=dtype)


def leaf(value):
    return torch.tensor(value, dtype=D, requires_grad=True)


def reset_shape(kernel, k, h):
    """The reset k >= 1 steps after a spike, of amplitude 1."""
    shapes = {
        "slayer": k * h * (1 - k * h).exp(),
        "thesis": (1 - k * h).exp(),
        "exp": (-(k - 1) * h).exp(),
        "step": torch.ones_like(k * h),
    }
    return shapes[kernel]


def by_kernels(drive, theta, tau_s, tau_r, kernel, response, dt, scale):
    """Spikes and potentials of coupled polarities from all steps so far; gradient through the reset
    "bounded"."""
    lags = torch.arange(1, len(drive) + 1, dtype=D)
    nu = -scale * theta * reset_shape(kernel, lags, dt / tau_r)
    # but for SLAYER's kernel, resets are summed over the call
    ends = torch.arange(1, 4001 if kernel == "slayer" else len(drive) + 1, dtype=D)
    total = 2 * scale * (theta * reset_shape(kernel, ends, dt / tau_r)).sum().detach()
    eps = lags * dt / tau_s * (1 - lags * dt / tau_s).exp()
    surrogate = Laplace.unit(theta.item())
    spikes, potential, past = [], [], []
    for t in range(len(drive)):
        u = drive[t]
        if response == "step":
            u = drive[: t + 1].sum(0)
        elif response == "alpha":
            u = torch.einsum("k,kpn->pn", eps[:t].flip(0), drive[:t])
        for k, s in enumerate(reversed(past)):
            u = u + nu[k] * (s - s.flip(0))
        x = u - theta
        hard = (x >= 0).to(D)
        integral = surrogate.torch_integral(x)
        spikes.append(hard + integral - integral.detach())
        slope = surrogate.torch_density(x).minimum(0.9 / total).detach() * x
        past.append(hard + slope - slope.detach())
        potential.append(u)
    return torch.stack(spikes), torch.stack(potential)


@pytest.mark.bits
@pytest.mark.parametrize("kernel", ["slayer", "thesis", "exp", "step"])
@pytest.mark.parametrize("response", ["none", "alpha", "step"])
def test_recursion_equals_the_finite_kernels_step_by_step(kernel, response):
    found = []
    for layer in (srm, by_kernels):
        drive = (noise(60, 2, 3) - 0.35).requires_grad_()
        given = {"theta": leaf(0.8), "tau_s": leaf(4.0), "tau_r": leaf(2.0)}
        options = {"kernel": kernel, "response": response, "dt": 0.5}
        if layer is srm:
            options |= {"reset_scale": 1.5, "coupled": True, "through_reset": "bounded"}
            spikes, potential, _ = srm(drive, **given, **options)
        else:
            spikes, potential = by_kernels(drive, **given, **options, scale=1.5)
        loss = (spikes * noise(60, 2, 3, seed=1) + potential * noise(60, 2, 3, seed=2)).sum()
        inputs = [drive, *given.values()]
        grads = torch.autograd.grad(loss, inputs, allow_unused=True, materialize_grads=True)
        found.append([spikes.round(), potential, *grads])
    assert torch.equal(found[0][0], found[1][0])
    for a, b in zip(found[0][1:], found[1][1:], strict=True):
        # 60 steps of rounding, two orders of operations
        assert (a - b).abs().max() <= 1e-11 * (1 + b.abs().max())


@pytest.mark.parametrize(
    ("surrogate", "kernel", "response", "coupled"),
    [
        (Laplace(1.5, 0.9), "slayer", "alpha", False),
        (Laplace(1.5, 0.9), "thesis", "none", True),
        (FastSigmoid(1.5, 0.9), "exp", "alpha", True),
        (Triangular(1.5, 0.2), "step", "step", True),
    ],
)
@pytest.mark.filterwarnings("ignore:max rho:RuntimeWarning")
def test_the_smooth_twin_passes_gradcheck_in_every_input(surrogate, kernel, response, coupled):
    inputs = [noise(6, 2, 1), *(v + noise(2, 1, seed=s) for v, s in ((0.5, 1), (3.0, 2), (1.5, 3)))]
    counts = {"alpha": 2, "step": 1, "none": 0}[response], {"slayer": 2}.get(kernel, 1)
    inputs += [noise(count, 2, 1, seed=5) for count in counts]
    options = {"kernel": kernel, "response": response, "coupled": coupled, "surrogate": surrogate}
    options |= {"through_reset": "full", "smooth": True, "reset_scale": 1.2}

    def layer(drive, theta, tau_s, tau_r, *states):
        given = {"theta": theta, "tau_s": tau_s, "tau_r": tau_r, "state": SrmState(*states)}
        spikes, potential, state = srm(drive, **given, **options)
        return [x for x in (spikes, potential, state.response, state.reset) if x.numel()]

    assert torch.autograd.gradcheck(layer, [x.requires_grad_() for x in inputs])


MODES = {
    "surrogate": FADING | {"kernel": "slayer"} | BOUNDED,
    **{name: FADING | {"kernel": name, "gradient": "mean"} for name in ("slayer", "thesis", "exp")},
    "no response": FADING | {"response": "none", "gradient": "mean"},
    "summed": FADING | {"response": "step", "gradient": "mean"},
}


@pytest.mark.bits
@pytest.mark.parametrize("cuts", [[1] * 20, [7, 13]])
@pytest.mark.parametrize("mode", MODES)
def test_chunks_give_the_whole_and_its_gradient_and_spikes_are_those_without(mode, cuts):
    steps = 0.8 * noise(20, 5) - 0.4
    plain = {key: value for key, value in MODES[mode].items() if key != "gradient"}
    results = []
    for sizes, options in (([20], MODES[mode]), (cuts, MODES[mode]), ([20], plain)):
        step, theta = steps.clone().requires_grad_(), leaf(0.2)
        state, parts = None, []
        for part in torch.stack((step, -step), 1).split(sizes):
            *found, state = srm(part, **options | {"theta": theta}, state=state)
            parts.append(found)
        spikes, potential = (torch.cat(x) for x in zip(*parts, strict=True))
        loss = (spikes * noise(20, 2, 5, seed=4)).sum() + potential.square().sum()
        ends = (spikes, potential, state.response, state.reset)
        results.append((ends, torch.autograd.grad(loss, (step, theta))))
    (whole, slopes), (parts, slopes_of_parts), (without, slopes_without) = results
    assert whole[0].sum() > 5
    for a, b, c in zip(whole, parts, without, strict=True):
        assert torch.equal(a, b)
        assert torch.equal(a, c)
    close(slopes_of_parts, slopes, rtol=1e-9, atol=1e-12)
    if "surrogate" in mode:
        assert all(torch.equal(a, b) for a, b in zip(slopes, slopes_without, strict=True))


def test_float32_spikes_equal_float64_over_20000_steps():
    drive = (noise(20_000, 16, dtype=torch.float32) - 0.2) * 0.4
    settings = {"theta": 0.7, "tau_s": 10.0, "tau_r": 5.0, "response": "alpha"}
    single, potential, _ = srm(drive, **settings)
    truth, exact, _ = srm(drive.double(), **settings)
    # the recursion runs in float64 for both; the potential is rounded once, to 2^-24
    assert torch.equal(single.double(), truth)
    assert ((potential.double() - exact).abs() <= exact.abs() * 2**-24 + 1e-40).all()
    assert 0.01 < truth.mean() < 0.99


@pytest.mark.bits
def test_gradient_through_the_reset_explodes_in_full_and_not_when_bounded():
    drive = torch.full((200, 1), 1.0, dtype=D, requires_grad=True)
    # rho hardly below 1 / 0.7 anywhere
    settings = {"theta": 1.0, "tau_r": 2.0, "reset_scale": 4.0, "surrogate": Laplace(0.7, 0.001)}

    def last(through_reset):
        spikes, _, _ = srm(drive, through_reset=through_reset, **settings)
        return torch.autograd.grad(spikes[-1].sum(), drive)[0]

    # the adjoint grows backwards by z with (1 - w)^2 = -c w, w = exp(-1/2) / z, c = 4 e / 2 / 0.7:
    # z = 3.4
    with pytest.warns(RuntimeWarning, match="not below 1"):
        assert 3.2**190 < last("full")[:10].abs().max() < 3.5**199
    # each pass through the reset multiplies by at most 0.9, and the first gradient is at most
    # 1/alpha
    assert last("bounded").abs().sum() <= 1 / 0.7 / (1 - 0.9)
    # below the bound the two are one function: sum of |nu| is 4 e h a / (1 - a)^2 = 21.3 for h =
    # 1/2
    settings["surrogate"] = Laplace(24.0, 0.3)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert torch.equal(last("full"), last("bounded"))


def test_ties_spike_and_one_pixel_needs_no_axis():
    drive = f64([0.5, 0.25, 0.0])
    settings = STEP | {"theta": torch.tensor(0.5), "reset_scale": 0.0, "coupled": False}
    assert srm(drive, **settings)[0].tolist() == [1, 1, 1]
    # 0.5 - 1 ulp, then 0.75, then a sum that stays
    below = torch.nextafter(drive, torch.zeros_like(drive))
    assert srm(below, **settings)[0].tolist() == [0, 1, 1]


@pytest.mark.parametrize(("response", "tau_s"), [("none", None), ("alpha", 5.0)])
def test_drive_scale_brings_the_asked_share_to_threshold(response, tau_s):
    drive = (noise(400, 30) - 0.3) * 1e-5
    factor = drive_scale(drive, theta=0.7, tau_s=tau_s, response=response, share=0.1)
    # without reset the share of spikes is the asked one, to one value in 12000 that may round to
    # either side
    options = STEP | {"theta": 0.7, "response": response, "reset_scale": 0.0, "coupled": False}
    free, *_ = srm(drive * factor, tau_s=tau_s, **options)
    assert abs(free.mean() - 0.1) <= 1.5 / 12_000


def test_outputs_own_their_memory():
    drive = noise(6, 4)
    before = drive.clone()
    spikes, potential, state = srm(drive, theta=1.0, tau_r=1.0)
    assert torch.equal(potential[0], before[0])
    for tensor in (spikes, potential, state.reset):
        tensor.fill_(7)
    assert torch.equal(drive, before)


def test_other_numbers_and_lengths_compile_no_new_kernel():
    import drjit as dr

    def step(steps, theta, tau, beta):
        drive = noise(steps, 2, 9, dtype=torch.float32).requires_grad_()
        options = {"through_reset": "bounded", "surrogate": Laplace(2.0, beta)}
        given = {"theta": leaf(theta), "tau_s": tau, "tau_r": tau / 2, "dt": theta}
        srm(drive, **given, **options, response="alpha")[0].sum().backward()

    step(12, 1.0, 5.0, 1.0)
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        step(31, 0.7, 8.0, 0.3)
        assert all(entry["cache_hit"] for entry in dr.kernel_history([dr.KernelType.JIT]))


@pytest.mark.parametrize("kind", [Laplace, FastSigmoid, Triangular])
def test_a_surrogate_is_a_density_of_its_height_and_its_integral_rises_from_zero_to_one(kind):
    surrogate = kind(alpha=1.4, beta=2.2)
    x = torch.linspace(-3, 3, 401, dtype=D) + 1e-4  # off the kinks at 0 and +-1/beta
    step = 1e-6
    slope = (surrogate.torch_integral(x + step) - surrogate.torch_integral(x - step)) / (2 * step)
    # differences: rounding 1e-16 / 2e-6, curvature beyond 1e-11
    assert (slope - surrogate.torch_density(x)).abs().max() < 1e-9
    height = float(surrogate.torch_density(torch.zeros(1, dtype=D)))
    assert height == pytest.approx(1 / 1.4, rel=1e-15)
    ends = kind.unit(width=0.3).torch_integral(f64([-1e9, 0.0, 1e9]))
    assert ends.tolist() == pytest.approx([0, 0.5, 1], abs=1e-9)
    if kind is Laplace:  # as published
        torch.testing.assert_close(surrogate.torch_density(x), (-2.2 * x.abs()).exp() / 1.4)


def steps_first(array):
    return torch.from_numpy(np.moveaxis(array, -1, 0).astype(np.float64).copy())


@pytest.mark.bits
@pytest.mark.filterwarnings("ignore:max rho:RuntimeWarning")
@pytest.mark.parametrize(
    "case", ["a_slayer_vimeo", "b_thesis_vimeo", "d_half_ts", "g_silent", "h_saturating"]
)
def test_spikes_potentials_and_gradients_equal_the_reference(shared, case):
    data = np.load(shared(f"refs/srm/{case}.npz"))
    names = ("drive", "spikes", "u", "g", "spikes_nocarry", "psp")
    arrays = {name: steps_first(data[name]) for name in names}
    numbers = {"theta": "theta", "tau_r": "tau_r", "dt": "Ts", "reset_scale": "scale"}
    settings = {name: float(data[key]) for name, key in numbers.items()}
    settings["kernel"] = {"alpha": "slayer", "thesis": "thesis", "gehrig": "exp"}[str(data["kind"])]
    settings["surrogate"] = Laplace(float(data["alpha"]), float(data["beta"]))
    for convention, name in (("off", "grad_slayer"), ("full", "grad_bptt")):
        drive = arrays["drive"].clone().requires_grad_()
        spikes, potential, _ = srm(drive, through_reset=convention, **settings)
        assert torch.equal(spikes.detach(), arrays["spikes"])
        assert (potential.detach() - arrays["u"]).abs().max() <= 1e-12
        (found,) = torch.autograd.grad(spikes, drive, arrays["g"])
        assert (found - steps_first(data[name])).abs().max() <= 1e-9
    parts = arrays["drive"].split(int(data["chunk"]))
    forgetful = torch.cat([srm(part, **settings)[0] for part in parts])
    assert torch.equal(forgetful, arrays["spikes_nocarry"])
    times = {"tau_s": float(data["tau_s"]), "dt": float(data["Ts"])}
    response, state = alpha_response(arrays["spikes"], **times)
    assert (response - arrays["psp"]).abs().max() <= 1e-12
    # sums of up to 100 spikes
    assert (state.response - torch.from_numpy(data["psp_state"])).abs().max() <= 1e-11


@pytest.mark.parametrize("response", ["step", "none"])
def test_coupled_step_reset_is_the_memorised_reference_model(shared, response):
    data = np.load(shared("refs/srm/l_esim_limit.npz"))
    level = steps_first(data["L"])
    drive = torch.cat([level[:1], level.diff(dim=0)]) if response == "step" else level
    settings = STEP | {"response": response, "theta": float(data["C"])}
    spikes, _, _ = srm(torch.stack([drive, -drive], 1), **settings)
    truth = torch.stack([steps_first(data["P"]), steps_first(data["N"])], 1)
    # levels are multiples of 2^-9 and theta of 2^-3: no rounding anywhere
    assert torch.equal(spikes, truth)
