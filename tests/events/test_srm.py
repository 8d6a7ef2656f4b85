"""The spike response layer against closed forms, finite kernels written out in torch, and independently
computed cases."""

import math
import warnings

import numpy as np
import pytest
import torch

from codesign.errors import DomainError, GradientError, NonFiniteError, ShapeError
from codesign.events.spiking.srm import alpha_response, drive_scale, srm
from codesign.events.spiking.srm_state import SrmState
from codesign.events.spiking.surrogate import FastSigmoid, Laplace, Triangular

F64 = torch.float64
KERNELS = {
    "slayer": lambda k, h: k * h * math.exp(1 - k * h),
    "thesis": lambda k, h: math.exp(1 - k * h),
    "exp": lambda k, h: math.exp(-(k - 1) * h),
    "step": lambda k, h: 1.0,
}


def noise(*shape, seed=0, dtype=F64):
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=dtype)


def leaf(value):
    return torch.tensor(value, dtype=F64, requires_grad=True)


@pytest.mark.parametrize("dtype", [torch.float32, F64])
def test_the_response_to_one_impulse_is_the_alpha_kernel(dtype):
    tau = torch.tensor([2.0, 10.0, 300.0], dtype=F64)
    drive = torch.zeros(4000, 3, dtype=dtype)
    drive[0] = 1
    response, _ = alpha_response(drive, tau_s=tau, dt=0.5)
    h = torch.arange(4000, dtype=F64)[:, None] * 0.5 / tau
    # k multiplications by the decay each round once: k eps <= 4000 * 1.1e-16 = 4.4e-13 relative of a value <=
    # 1; float32 rounds the result
    assert (response.to(F64) - h * (1 - h).exp()).abs().max() <= (4e-12 if dtype == F64 else 6e-8)


@pytest.mark.parametrize("kernel", KERNELS)
def test_one_spike_leaves_the_reset_kernel(kernel):
    drive = torch.zeros(30, 2, dtype=F64)
    drive[3] = 5.0
    theta = torch.tensor([0.5, 2.0])
    spikes, potential, _ = srm(drive, theta=theta, tau_r=3.0, dt=0.5, kernel=kernel, reset_scale=1.5)
    assert spikes.sum(0).tolist() == [1, 1]
    for pixel, theta in enumerate((0.5, 2.0)):
        truth = [-1.5 * theta * KERNELS[kernel](t - 3, 0.5 / 3) for t in range(4, 30)]
        assert (potential[4:, pixel] - torch.tensor(truth, dtype=F64)).abs().max() < 1e-13


def by_kernels(drive, theta, tau_s, tau_r, kernel, response):
    """Spikes and potentials of coupled polarities, from all steps so far; gradient through the reset
    "bounded"."""
    lags = torch.arange(1, len(drive) + 1, dtype=F64)
    nu = {
        "slayer": (lags / tau_r) * (1 - lags / tau_r).exp(),
        "thesis": (1 - lags / tau_r).exp(),
        "exp": (-(lags - 1) / tau_r).exp(),
        "step": torch.ones_like(lags),
    }[kernel] * (-2 * theta)
    eps = {"alpha": lags / tau_s * (1 - lags / tau_s).exp(), "step": torch.ones_like(lags)}.get(response)
    surrogate = Laplace.unit(float(theta.detach()))
    ends = 60 if kernel == "step" else 4000  # which never ends is summed over the call
    total = 2 * sum(
        2 * float(theta.detach()) * KERNELS[kernel](k, 1 / float(tau_r.detach())) for k in range(1, ends + 1)
    )
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
        twin = surrogate.torch_integral(x)
        hard = (x >= 0).to(F64)
        spikes.append(hard + twin - twin.detach())
        slope = surrogate.torch_density(x).clamp(max=0.9 / total).detach() * x
        past.append(hard + slope - slope.detach())
        potential.append(u)
    return torch.stack(spikes), torch.stack(potential)


@pytest.mark.bits
@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("response", ["none", "alpha", "step"])
def test_recursion_equals_the_finite_kernels_step_by_step(kernel, response):
    found = []
    for by_recursion in (True, False):
        drive, theta, tau_s, tau_r = inputs = [
            (noise(60, 2, 3) - 0.35).requires_grad_(),
            leaf(0.8),
            leaf(4.0),
            leaf(2.0),
        ]
        if by_recursion:
            options = {"kernel": kernel, "response": response, "coupled": True, "through_reset": "bounded"}
            spikes, potential, _ = srm(drive, theta=theta, tau_s=tau_s, tau_r=tau_r, **options)
        else:
            spikes, potential = by_kernels(*inputs, kernel, response)
        loss = (spikes * noise(60, 2, 3, seed=1)).sum() + (potential * noise(60, 2, 3, seed=2)).sum()
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
    drive = noise(6, 2, 1).requires_grad_()
    values = ((0.5, 1), (3.0, 2), (1.5, 3))
    theta, tau_s, tau_r = ((v + noise(2, 1, seed=s)).requires_grad_() for v, s in values)
    counts = {"alpha": 2, "step": 1, "none": 0}[response], {"slayer": 2}.get(kernel, 1)
    start = [noise(count, 2, 1, seed=5).requires_grad_() for count in counts]
    options = {
        "kernel": kernel,
        "response": response,
        "coupled": coupled,
        "surrogate": surrogate,
        "segment": 3,
    }

    def layer(drive, theta, tau_s, tau_r, *states):
        given = {"theta": theta, "tau_s": tau_s, "tau_r": tau_r, "state": SrmState(*states), **options}
        spikes, potential, state = srm(drive, **given, through_reset="full", smooth=True, reset_scale=1.2)
        return [x for x in (spikes, potential, state.response, state.reset) if x.numel()]

    assert torch.autograd.gradcheck(layer, (drive, theta, tau_s, tau_r, *start))


@pytest.mark.bits
@pytest.mark.parametrize("cuts", [[1] * 40, [13, 27]])
@pytest.mark.parametrize("dtype", [torch.float32, F64])
def test_chunks_give_the_whole_bit_for_bit_and_the_same_gradient(cuts, dtype):
    results = []
    for sizes in ([40], cuts):
        drive = noise(40, 2, 5, dtype=dtype).requires_grad_()
        theta, tau_r = leaf(0.9), leaf(2.0)
        options = {"theta": theta, "tau_s": 3.0, "tau_r": tau_r, "response": "alpha", "coupled": True}
        state = None
        parts = []
        for part in drive.split(sizes):
            *found, state = srm(
                part, state=state, through_reset="bounded", surrogate=Laplace(2.0, 1.0), **options
            )
            parts.append(found)
        spikes, potential = (torch.cat(x) for x in zip(*parts, strict=True))
        loss = (spikes * noise(40, 2, 5, seed=4, dtype=dtype)).sum() + potential.square().sum()
        results.append((spikes, potential, *torch.autograd.grad(loss, (drive, theta, tau_r))))
    assert torch.equal(results[0][0], results[1][0])
    assert torch.equal(results[0][1], results[1][1])
    for whole, parts in zip(results[0][2:], results[1][2:], strict=True):
        # the same sums; float32 rounds the drive's gradient alone
        assert (whole - parts).abs().max() <= (1e-13 if dtype == F64 else 1e-6) * (1 + whole.abs().max())


@pytest.mark.bits
def test_segments_change_no_gradient():
    found = []
    for segment in (None, 1, 7, 100):
        drive, theta, tau_s, tau_r = inputs = [
            noise(50, 2, 3).requires_grad_(),
            leaf(0.9),
            leaf(4.0),
            leaf(2.0),
        ]
        options = {"theta": theta, "tau_s": tau_s, "tau_r": tau_r, "response": "alpha", "coupled": True}
        spikes, potential, state = srm(drive, through_reset="bounded", segment=segment, **options)
        loss = (spikes * noise(50, 2, 3, seed=1)).sum() + potential.square().sum()
        loss = loss + state.response.sum() + state.reset.square().sum()
        found.append([spikes, *torch.autograd.grad(loss, inputs)])
    for other in found[1:]:
        assert all(torch.equal(a, b) for a, b in zip(found[0], other, strict=True))


def test_float32_spikes_equal_float64_over_1e5_steps():
    drive = (noise(100_000, 16, dtype=torch.float32) - 0.2) * 0.4
    for kernel, tau_s in (("slayer", 10.0), ("thesis", 50.0)):
        settings = {"theta": 0.7, "tau_s": tau_s, "tau_r": 5.0, "kernel": kernel, "response": "alpha"}
        single, potential, _ = srm(drive, **settings)
        truth, exact, _ = srm(drive.double(), **settings)
        # the recursion runs in float64 for both, so not one spike differs; the potential is rounded once, to
        # 2^-24
        assert torch.equal(single.double(), truth)
        assert bool(((potential.double() - exact).abs() <= exact.abs() * 2**-24 + 1e-40).all())
        assert 0.01 < float(truth.mean()) < 0.99


@pytest.mark.bits
def test_gradient_through_the_reset_explodes_in_full_and_not_when_bounded():
    drive = torch.full((200, 1), 1.0, dtype=F64, requires_grad=True)
    # rho hardly below 1 / 0.7 anywhere
    settings = {"theta": 1.0, "tau_r": 2.0, "reset_scale": 4.0, "surrogate": Laplace(0.7, 0.001)}
    # then the adjoint grows backwards by z with (1 - w)^2 = -c w, w = exp(-1/2) / z, c = 4 e / 2 / 0.7: z =
    # 3.4 per step
    with pytest.warns(RuntimeWarning, match="not below 1"):
        full = srm(drive, through_reset="full", **settings)[0]
    bounded = srm(drive, through_reset="bounded", **settings)[0]
    seed = torch.zeros(200, 1, dtype=F64)
    seed[-1] = 1
    (full,), (bounded,) = (torch.autograd.grad(s, drive, seed) for s in (full, bounded))
    assert 3.2**190 < full[:10].abs().max() < 3.5**199
    # each pass through the reset multiplies by at most 0.9, and the first gradient is at most 1/alpha
    assert float(bounded.abs().sum()) <= 1 / 0.7 / (1 - 0.9)
    # below the bound the two are one function: sum of |nu| is 4 e h a / (1 - a)^2 = 21.3 for h = 1/2
    settings["surrogate"] = Laplace(24.0, 0.3)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        both = [srm(drive, through_reset=name, **settings)[0] for name in ("full", "bounded")]
    both = [torch.autograd.grad(s, drive, seed)[0] for s in both]
    assert torch.equal(*both)


def test_a_tie_spikes():
    drive = torch.tensor([[0.5], [0.25], [0.0]], dtype=F64)
    below = torch.nextafter(drive, torch.zeros_like(drive))
    settings = {"theta": torch.tensor(0.5), "kernel": "step", "reset_scale": 0.0, "response": "step"}
    assert srm(drive, **settings)[0].flatten().tolist() == [1, 1, 1]
    # 0.5 - 1 ulp, then 0.75, then a sum that stays
    assert srm(below, **settings)[0].flatten().tolist() == [0, 1, 1]


def test_silent_and_saturating_input_keep_finite_gradients():
    silent = torch.zeros(50, 3, requires_grad=True)
    spikes, potential, _ = srm(silent, theta=1e-3, tau_r=1.0, tau_s=10.0, response="alpha")
    assert not spikes.any()
    assert not potential.any()
    spikes.sum().backward()
    # at rest rho(-theta) = exp(-1) / (2 theta) everywhere, summed over the alpha kernel's lags that are still
    # to come
    lags = torch.arange(50, dtype=F64) / 10
    still = [(lags[1 : 50 - t] * (1 - lags[1 : 50 - t]).exp()).sum() for t in range(50)]
    truth = math.exp(-1) / 2e-3 * torch.stack(still)
    assert silent.grad is not None
    assert (silent.grad[:, 0].double() - truth).abs().max() <= 1e-6 * truth.max()
    loud = torch.full((50, 1), 1e6, requires_grad=True)
    spikes, _, _ = srm(loud, theta=1e-3, tau_r=1.0)
    assert bool(spikes.all())
    assert float(torch.autograd.grad(spikes.sum(), loud)[0].abs().max()) == 0  # exp(-1e9) is 0, not NaN


@pytest.mark.parametrize(("response", "tau_s"), [("none", None), ("alpha", 5.0)])
def test_drive_scale_brings_the_asked_share_to_threshold(response, tau_s):
    drive = (noise(400, 30) - 0.3) * 1e-5
    assert not srm(drive, theta=0.7, tau_s=tau_s, tau_r=1.0, response=response)[0].any()  # dead
    factor = drive_scale(drive, theta=0.7, tau_s=tau_s, response=response, share=0.1)
    # without reset the share of spikes is the asked one, to one value in 12000 that may round to either side
    free = srm(drive * factor, theta=0.7, tau_s=tau_s, kernel="step", response=response, reset_scale=0.0)[0]
    assert abs(float(free.mean()) - 0.1) <= 1.5 / 12_000
    with pytest.raises(DomainError, match="silent"):
        drive_scale(torch.zeros(10, 2), theta=0.7, tau_s=tau_s, response=response)
    with pytest.raises(DomainError, match="share"):
        drive_scale(drive, theta=0.7, tau_s=tau_s, response=response, share=1.0)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_non_finite_drive_is_refused_or_taken_as_zero(bad):
    poisoned, cleaned = noise(20, 3, dtype=torch.float32), noise(20, 3, dtype=torch.float32)
    poisoned[4, 1], cleaned[4, 1] = bad, 0
    settings = {"theta": 1.0, "tau_r": 1.0, "tau_s": 3.0, "response": "alpha"}
    with pytest.raises(DomainError, match=r"drive: 1 of 60 .*\[4, 1\].*zero"):
        srm(poisoned, **settings)
    found = srm(poisoned.requires_grad_(), nonfinite="zero", **settings)
    truth = srm(cleaned.requires_grad_(), **settings)
    assert torch.equal(found[0], truth[0])
    assert torch.equal(found[1], truth[1])
    (found,), (truth,) = (
        torch.autograd.grad(s[0].sum(), x) for s, x in ((found, poisoned), (truth, cleaned))
    )
    truth[4, 1] = 0
    assert torch.equal(found, truth)


def test_an_overflow_is_an_error():
    with pytest.raises(NonFiniteError, match="overflows"):
        srm(torch.full((3, 1), 3e38), theta=1.0, kernel="step", response="step")


def state_of(reset):
    return SrmState(torch.zeros(0, 2, dtype=F64), reset)


@pytest.mark.parametrize(
    ("change", "error", "words"),
    [
        ({"drive": torch.zeros(0, 3)}, ShapeError, "hold 0 frame"),
        ({"drive": torch.zeros(3, 0)}, ShapeError, "no pixel"),
        ({"drive": torch.zeros(3, 2, dtype=torch.float16)}, DomainError, "float32 or float64"),
        ({"theta": 0.0}, DomainError, "theta spans"),
        ({"theta": torch.tensor([1.0, math.nan])}, DomainError, "theta spans"),
        ({"theta": torch.ones(4)}, ShapeError, "theta has shape"),
        ({"tau_r": -1.0}, DomainError, "tau_r spans"),
        ({"tau_r": None}, DomainError, "tau_r is None"),
        ({"tau_s": None, "response": "alpha"}, DomainError, "tau_s is None"),
        ({"dt": math.nan}, DomainError, "dt is"),
        ({"reset_scale": -1.0}, DomainError, "reset_scale"),
        ({"kernel": "alpha"}, DomainError, "kernel is 'alpha'"),
        ({"response": "exp"}, DomainError, "response is 'exp'"),
        ({"through_reset": "on"}, DomainError, "through_reset"),
        ({"nonfinite": "skip"}, DomainError, "nonfinite"),
        ({"segment": 0}, DomainError, "segment"),
        ({"surrogate": "laplace"}, DomainError, "surrogate"),
        ({"coupled": True, "drive": torch.zeros(3, 3)}, ShapeError, "coupled"),
        ({"state": torch.zeros(2, 2)}, DomainError, "SrmState"),
        ({"state": state_of(torch.zeros(1, 2, dtype=F64))}, ShapeError, "state.reset"),
        ({"state": state_of(torch.zeros(2, 2))}, ShapeError, "float32"),
        ({"state": state_of(torch.full((2, 2), math.nan, dtype=F64))}, DomainError, "state.reset"),
    ],
)
def test_bad_input_is_refused_with_a_sentence(change, error, words):
    settings = {"drive": torch.zeros(3, 2), "theta": 1.0, "tau_r": 1.0, **change}
    with pytest.raises(error, match=words):
        srm(settings.pop("drive"), **settings)


def test_second_derivatives_are_refused():
    drive = noise(5, 2).requires_grad_()
    spikes, potential, _ = srm(drive, theta=1.0, tau_r=1.0)
    (first,) = torch.autograd.grad((spikes + potential.square()).sum(), drive, create_graph=True)
    with pytest.raises(GradientError, match="second"):
        first.sum().backward()


def test_outputs_own_their_memory():
    drive = noise(6, 4)
    before = drive.clone()
    for tensor in (found := srm(drive, theta=1.0, tau_r=1.0))[:2] + (found[2].reset,):
        tensor.fill_(7)
    assert torch.equal(drive, before)
    # at rest, the potential of the first step is the drive
    assert torch.equal(srm(drive, theta=1.0, tau_r=1.0)[1][0], before[0])


def test_one_value_alone_and_a_single_pixel():
    drive = torch.tensor([1.5, 1.5], dtype=F64)
    spikes, potential, state = srm(drive, theta=1.0, tau_r=1.0, kernel="exp", reset_scale=1.0)
    assert spikes.tolist() == [1, 0]
    assert potential.tolist() == [1.5, 0.5]
    assert state.reset.shape == (1,)


def test_other_numbers_and_lengths_compile_no_new_kernel():
    import drjit as dr

    def step(steps, theta, tau, beta, segment):
        drive = noise(steps, 2, 9, dtype=torch.float32).requires_grad_()
        theta = torch.tensor(theta, requires_grad=True)
        options = {"response": "alpha", "through_reset": "bounded", "surrogate": Laplace(2.0, beta)}
        times = {"tau_s": tau, "tau_r": tau / 2, "dt": theta.item()}
        spikes, _, _ = srm(drive, theta=theta, segment=segment, **times, **options)
        torch.autograd.grad(spikes.sum(), (drive, theta))

    step(12, 1.0, 5.0, 1.0, 5)
    step(12, 1.0, 5.0, 1.0, None)
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        step(31, 0.7, 8.0, 0.3, 7)
        step(17, 0.9, 3.0, 0.5, None)
        compiled = [entry for entry in dr.kernel_history([dr.KernelType.JIT]) if not entry["cache_hit"]]
    assert not compiled


@pytest.mark.parametrize("kind", [Laplace, FastSigmoid, Triangular])
def test_a_surrogate_is_a_density_of_its_height_and_its_integral_rises_from_zero_to_one(kind):
    surrogate = kind(alpha=1.4, beta=2.2)
    x = torch.linspace(-3, 3, 401, dtype=F64) + 1e-4  # off the kinks at 0 and +-1/beta
    step = 1e-6
    slope = (surrogate.torch_integral(x + step) - surrogate.torch_integral(x - step)) / (2 * step)
    # differences: rounding 1e-16 / 2e-6, curvature beyond 1e-11
    assert (slope - surrogate.torch_density(x)).abs().max() < 1e-9
    assert float(surrogate.torch_density(torch.zeros(1, dtype=F64))) == pytest.approx(1 / 1.4, rel=1e-15)
    ends = kind.unit(width=0.3).torch_integral(torch.tensor([-1e9, 0.0, 1e9], dtype=F64))
    assert ends.tolist() == pytest.approx([0, 0.5, 1], abs=1e-9)
    for alpha, beta, word in ((0.0, 1.0, "alpha"), (1.0, math.inf, "beta"), (math.nan, 1.0, "alpha")):
        with pytest.raises(DomainError, match=word):
            kind(alpha, beta)
    for function in (surrogate.torch_density, surrogate.torch_integral):
        with pytest.raises(DomainError, match="tensor of real numbers"):
            function(torch.ones(2, dtype=torch.int64))


def test_laplace_is_the_published_formula():
    x = torch.tensor([-0.7, 0.2], dtype=F64)
    assert torch.allclose(Laplace(1.4, 1 / 0.7).torch_density(x), (-x.abs() / 0.7).exp() / 1.4, rtol=1e-14)


def reference(path):
    """Arrays of an independently computed case, and the layer's settings."""
    data = np.load(path)
    kernel = {"alpha": "slayer", "thesis": "thesis", "gehrig": "exp"}[str(data["kind"])]
    numbers = {
        name: float(data[key])
        for name, key in (("theta", "theta"), ("tau_r", "tau_r"), ("dt", "Ts"), ("reset_scale", "scale"))
    }
    return data, {
        **numbers,
        "kernel": kernel,
        "surrogate": Laplace(float(data["alpha"]), float(data["beta"])),
    }


def steps_first(array):
    return torch.from_numpy(np.moveaxis(array, -1, 0).astype(np.float64).copy())


@pytest.mark.bits
@pytest.mark.filterwarnings("ignore:max rho:RuntimeWarning")
@pytest.mark.parametrize(
    "case", ["a_slayer_vimeo", "b_thesis_vimeo", "d_half_ts", "g_silent", "h_saturating"]
)
def test_spikes_potentials_and_gradients_equal_the_reference(shared, case):
    data, settings = reference(shared(f"refs/srm/{case}.npz"))
    for convention, name in (("off", "grad_slayer"), ("full", "grad_bptt")):
        drive = steps_first(data["drive"]).requires_grad_()
        spikes, potential, _ = srm(drive, through_reset=convention, **settings)
        assert torch.equal(spikes.detach(), steps_first(data["spikes"]))
        assert (potential.detach() - steps_first(data["u"])).abs().max() <= 1e-12
        (found,) = torch.autograd.grad(spikes, drive, steps_first(data["g"]))
        assert (found - steps_first(data[name])).abs().max() <= 1e-9
    parts = steps_first(data["drive"]).split(int(data["chunk"]))
    forgetful = torch.cat([srm(part, **settings)[0] for part in parts])
    assert torch.equal(forgetful, steps_first(data["spikes_nocarry"]))
    times = {"tau_s": float(data["tau_s"]), "dt": float(data["Ts"])}
    response, state = alpha_response(steps_first(data["spikes"]), **times)
    assert (response - steps_first(data["psp"])).abs().max() <= 1e-12
    # sums of up to 100 spikes
    assert (state.response - torch.from_numpy(data["psp_state"])).abs().max() <= 1e-11


@pytest.mark.parametrize("response", ["step", "none"])
def test_coupled_step_reset_is_the_memorised_reference_model(shared, response):
    data = np.load(shared("refs/srm/l_esim_limit.npz"))
    level = steps_first(data["L"])
    drive = torch.cat([level[:1], level.diff(dim=0)]) if response == "step" else level
    settings = {"kernel": "step", "response": response, "reset_scale": 1.0, "coupled": True}
    spikes, _, _ = srm(torch.stack([drive, -drive], 1), theta=float(data["C"]), **settings)
    truth = torch.stack([steps_first(data["P"]), steps_first(data["N"])], 1)
    assert torch.equal(spikes, truth)  # levels are multiples of 2^-9 and theta of 2^-3: no rounding anywhere
