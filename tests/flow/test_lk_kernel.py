"""The kernels of the closed form against the same written down in torch (lk_reference) and scipy, against
differences, and against a plane that moves."""

import gc
import sys

import drjit as dr
import numpy as np
import pytest
import torch
from scipy.ndimage import correlate1d

from codesign import flow
from codesign.errors import DomainError, GradientError, ShapeError
from codesign.exclusive import exclusive
from codesign.flow import lk_kernel, lk_warp_kernel
from codesign.flow.lk_lanes import Grid, recorded
from codesign.types import EventVolume
from tests.flow import lk_reference

D = torch.float64
FADE_PX = 2.3
# batch, bins, height, width, stride, cell; whole cells and cells cut off, one pair of bins, one row of samples
CASES = [
    (2, 3, 13, 9, 1, 4),
    (1, 2, 7, 22, 2, 3),
    (32, 8, 20, 20, 1, 8),
    (3, 5, 17, 19, 4, 1),
    (1, 3, 1, 6, 1, 2),
]


def times(bins):
    """Times, and shares of the bins in the mean and in the slope of a straight line."""
    time = torch.linspace(-0.45, 0.4, bins, dtype=D)
    off = time - time.mean()
    return time, torch.stack([torch.full_like(time, 1 / bins), off / off.square().sum()])


def drawn(case, generator, reach_px=4.0):
    """Bins and flow; with 4 px, a part of the samples reads beyond the border."""
    batch, bins, height, width, stride, cell = case
    grid = Grid(height, width, stride)
    rate = torch.randn(batch, bins, *grid.shape, generator=generator, dtype=D)
    flow = reach_px * torch.randn(batch, 2, *grid.shape, generator=generator, dtype=D)
    return grid, cell, rate, flow


def leaves(*tensors):
    return [x.detach().clone().requires_grad_() for x in tensors]


def both(form, grid, cell, rate, flow, density, weights):
    """Everything that one form gives: values, then gradients of their weighted sums."""
    time, contrast = (x.to(rate) for x in times(rate.shape[1]))
    rate, flow, density = leaves(rate, flow, density)
    read = form.moving(rate, flow, time, contrast, grid, FADE_PX)
    by_reading = torch.autograd.grad(
        sum((w * x).sum() for w, x in zip(weights, read, strict=True)), (rate, flow), retain_graph=True
    )
    sums = form.cell_sums(*read, density, grid, cell)
    pulls = torch.linspace(-1, 1, sums.numel(), dtype=D).to(sums).reshape(sums.shape)
    return *read, sums, *by_reading, *torch.autograd.grad((pulls * sums).sum(), (rate, flow, density))


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("dtype", [D, torch.float32])
def test_kernels_are_the_torch_form_and_its_gradients(case, dtype, generator):
    grid, cell, rate, flow = drawn(case, generator)
    density = torch.rand(rate[:, 0].shape, generator=generator, dtype=D)
    weights = torch.randn(3, *density.shape, generator=generator, dtype=D)
    given = [x.to(dtype) for x in (rate, flow, density, weights)]
    found = both(lk_kernel, grid, cell, *given)
    truth = both(lk_reference, grid, cell, *(x.to(D) for x in given))
    # a place 20 px away is rounded by 10 eps, neighbours differ by up to 6 and slopes enter twice; a sum over
    # cells takes 64 of them
    for one, other in zip(found, truth, strict=True):
        assert one.dtype == dtype
        off = (one.detach().to(D) - other.detach()).abs().max()
        assert float(off) <= 100 * torch.finfo(dtype).eps * float(other.detach().abs().max())


@pytest.mark.parametrize("case", [(1, 2, 4, 5, 1, 2), (2, 3, 6, 4, 2, 1)])
def test_gradients_are_those_of_differences(case, generator):
    grid, cell, rate, flow = drawn(case, generator, reach_px=2.0)
    time, contrast = times(rate.shape[1])
    assert torch.autograd.gradcheck(
        lambda rate, flow: lk_kernel.moving(rate, flow, time, contrast, grid, FADE_PX), leaves(rate, flow)
    )
    maps = torch.randn(4, *rate[:, 0].shape, generator=generator, dtype=D)
    assert torch.autograd.gradcheck(lambda *maps: lk_kernel.cell_sums(*maps, grid, cell), leaves(*maps))


def test_a_plane_carried_back_along_its_flow_stands_still():
    grid = Grid(21, 33, 2)
    time, contrast = times(5)
    y, x = (2 * torch.arange(count, dtype=D) + 0.5 for count in grid.shape)
    shift = time[:, None, None] * torch.tensor([3.0, -2.0], dtype=D)
    bins = 0.7 * (x - shift[..., :1]) + 0.3 * (y[:, None] - shift[..., 1:])
    flow = torch.tensor([3.0, -2.0], dtype=D)[:, None, None].expand(2, *grid.shape)
    mean, slope, seen = lk_kernel.moving(bins[None], flow[None], time, contrast, grid, FADE_PX)
    inner = (0, slice(1, -1), slice(1, -1))  # the outermost samples read beyond the border
    torch.testing.assert_close(mean[inner], (0.7 * x + 0.3 * y[:, None])[1:-1, 1:-1])
    assert float(slope[inner].abs().max()) < 1e-13
    sums = lk_kernel.cell_sums(mean, slope, seen, 2 * seen, grid)[0, :, 2:-2, 2:-2]
    window = seen[0, 2:-2, 2:-2]
    squares = torch.tensor([0.49, 0.21, 0.09, 0, 0, 0, 1], dtype=D)[:, None, None] * window
    torch.testing.assert_close(sums, torch.cat([squares, 2 * window[None].square()]))


@pytest.mark.parametrize("dtype", [D, torch.float32])
@pytest.mark.parametrize(
    ("shape", "stride"), [((2, 3, 150, 21), 1), ((1, 2, 31, 42), 4), ((1, 2, 3, 2), 1), ((3, 1, 1, 5), 1)]
)
def test_the_blur_is_that_of_scipy_and_so_is_its_adjoint(shape, stride, dtype, generator):
    # more rows than a lane goes down; squares cut off; images smaller than the kernel
    taps = (0.4, 0.15, 0.1, 0.05)
    images, others = torch.randn(2, *shape, generator=generator, dtype=dtype).requires_grad_()
    grid = Grid(*shape[2:], stride)
    rows, columns = grid.shape

    def truth(images):
        cut = images.detach().double().numpy()[..., : rows * stride, : columns * stride]
        found = cut.reshape(*shape[:2], rows, stride, columns, stride).mean((3, 5))
        for axis in (2, 3):
            found = correlate1d(found, np.array([*taps[:0:-1], *taps]), axis, mode="mirror")
        return torch.from_numpy(found)

    found = lk_kernel.blurred(images, grid, taps)
    rounding = 20 * torch.finfo(dtype).eps  # seven products both ways, means of 16
    torch.testing.assert_close(found.double(), truth(images), rtol=0, atol=4 * rounding)
    seed = torch.randn(found.shape, generator=generator, dtype=dtype)
    (pull,) = torch.autograd.grad((found * seed).sum(), images)
    forward = (seed.double() * truth(others)).sum()
    backward = (pull.double() * others.double()).sum()
    size = seed.double().norm() * others.detach().double().norm()
    assert abs(float((forward - backward).detach())) <= rounding * float(size)


def test_bins_read_far_outside_are_the_border_and_pull_at_no_flow(generator):
    grid, _, rate, _ = drawn((1, 2, 6, 7, 1, 1), generator)
    time = torch.tensor([0.5, 1.0], dtype=D)
    contrast = torch.tensor([[1.0, 0.0], [0.0, 1.0]], dtype=D)
    (flow,) = leaves(torch.full((1, 2, 6, 7), 100.0, dtype=D))
    mean, slope, seen = lk_kernel.moving(rate, flow, time, contrast, grid, FADE_PX)
    assert torch.equal(mean, rate[:, 0, -1:, -1:].expand_as(mean))
    assert torch.equal(slope, rate[:, 1, -1:, -1:].expand_as(slope))
    assert not seen.any()
    (pull,) = torch.autograd.grad((mean + slope + seen).sum(), flow)
    assert not pull.any()


def test_groups_of_bins_give_the_gradient_of_all_at_once(generator, monkeypatch):
    grid, _, rate, flow = drawn((2, 5, 9, 8, 1, 1), generator)
    time, contrast = times(5)
    rate, flow = leaves(rate, flow)

    def gradients():
        read = lk_kernel.moving(rate, flow, time, contrast, grid, FADE_PX)
        return torch.autograd.grad(sum(x.square().sum() for x in read), (rate, flow))

    whole = gradients()
    monkeypatch.setattr(lk_warp_kernel, "MOST_VALUES", 2 * (4 * 2 * 10 * 9))  # two bins, two bins, one
    torch.testing.assert_close(gradients(), whole, rtol=1e-13, atol=1e-13)


def test_other_sizes_need_no_new_kernel_but_for_copies_to_scatter_into(generator):
    def kernels(case):
        grid, cell, rate, flow = drawn(case, generator)
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
            dr.kernel_history_clear()
            both(lk_kernel, grid, cell, rate, flow, rate[:, 0], rate[:, :3].unbind(1))
            (images,) = leaves(torch.rand(*case[:2], grid.height, grid.width, dtype=D))
            torch.autograd.grad(lk_kernel.blurred(images, grid, (0.5, 0.25)).sum(), images)
            history = dr.kernel_history()
        return {entry["hash"] for entry in history if entry["type"] == dr.KernelType.JIT}

    first = kernels((1, 3, 8, 9, 2, 2))
    assert len(first) >= 9
    # several threads scatter into a copy each, whose size is part of the one kernel that does
    assert len(kernels((4, 3, 80, 21, 4, 5)) - first) <= (dr.thread_count() > 1)


def test_no_garbage_is_collected_in_a_recording():
    """A scene that is freed in one ends the process: the kernel makes more garbage than the collector waits for."""
    before = gc.get_threshold()
    collections = []

    def watch(phase, info):
        collections.append(recording[0])

    def kernel(added, numbers):
        recording[0] = True
        kept = [[] for _ in range(1000)]
        recording[0] = False
        return numbers + added + 0 * len(kept)

    recording = [False]
    gc.callbacks.append(watch)
    gc.set_threshold(50)
    try:
        with exclusive:
            found = recorded(kernel)(2.0, dr.llvm.ad.Float64([1, 2]))
        kept = [[] for _ in range(1000)]
    finally:
        gc.set_threshold(*before)
        gc.callbacks.remove(watch)
    assert found.numpy().tolist() == [3, 4]
    assert len(kept) == 1000
    assert gc.isenabled()
    assert collections
    assert not any(collections)


def test_replaying_runs_no_python_while_drjit_holds_its_lock(generator):
    """Another thread that got Python's lock meanwhile would wait for drjit's, and this one for Python's, for ever."""
    (counts,) = leaves(torch.rand(2, 2, 5, 32, 32, dtype=D, generator=generator))
    times_s = torch.linspace(0, 0.02, 5, dtype=D)

    def passes():
        found = flow.estimate_lk(EventVolume(counts, times_s, torch.full((5,), 0.004, dtype=D)))
        torch.autograd.grad(found.flow_px.sum() + found.covariance_px2.sum(), counts)

    passes()
    replays, called = [], []

    def watch(frame, event, arg):
        outer = frame.f_back.f_code if frame.f_back else None
        if event == "call" and outer and outer.co_filename == dr.__file__ and outer.co_name == "__call__":
            (replays if frame.f_code.co_name == "capture_closure" else called).append(frame.f_code.co_name)

    sys.setprofile(watch)
    passes()
    sys.setprofile(None)
    assert len(replays) > 10
    assert called == []


def test_a_second_derivative_is_refused(generator):
    grid, _, rate, flow = drawn((1, 2, 4, 5, 1, 1), generator)
    time, contrast = times(2)
    rate, flow = leaves(rate, flow)
    read = lk_kernel.moving(rate, flow, time, contrast, grid, FADE_PX)
    for output, given in ((read[0].sum(), rate), (lk_kernel.cell_sums(*read, read[0], grid).sum(), flow)):
        (first,) = torch.autograd.grad(output, given, create_graph=True)
        with pytest.raises(GradientError, match="second derivative through event flow"):
            torch.autograd.grad(first.sum(), flow)


def test_what_does_not_fit_is_named(generator):
    grid, _, rate, flow = drawn((1, 3, 4, 5, 1, 1), generator)
    time, contrast = times(3)
    with pytest.raises(ShapeError, match="their flow is"):
        lk_kernel.moving(rate, flow[..., 1:], time, contrast, grid, FADE_PX)
    with pytest.raises(ShapeError, match="3 bins have times"):
        lk_kernel.moving(rate, flow, time[1:], contrast, grid, FADE_PX)
    with pytest.raises(ShapeError, match="mean, slope, seen and density"):
        lk_kernel.cell_sums(rate[:, 0], rate[:, 0], rate[:, 0], rate, grid)
    with pytest.raises(ShapeError, match="the grid has 4 x 5 pixels and 2 x 2 samples"):
        lk_kernel.blurred(rate[..., 1:], Grid(4, 5, 2), (0.5, 0.25))
    with pytest.raises(DomainError, match="cell is 0"):
        lk_kernel.cell_sums(*[rate[:, 0]] * 4, grid, 0)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_a_gpu_gives_what_the_processor_gives(generator):
    grid, cell, rate, flow = drawn((2, 4, 33, 40, 1, 8), generator)
    given = rate, flow, rate[:, 0].square(), rate[:, :3].unbind(1)
    on_gpu = [x.cuda() if torch.is_tensor(x) else [y.cuda() for y in x] for x in given]
    found = both(lk_kernel, grid, cell, *on_gpu)
    for one, other in zip(found, both(lk_kernel, grid, cell, *given), strict=True):
        torch.testing.assert_close(one.cpu(), other, rtol=1e-11, atol=1e-11)
