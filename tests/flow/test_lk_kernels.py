"""The kernels of the closed form against the same as operations of torch and against scipy; what a
recording of a kernel promises."""
# pyright: reportArgumentType=false, reportCallIssue=false, reportOptionalMemberAccess=false

import gc
import sys
from contextlib import nullcontext

import drjit as dr
import numpy as np
import pytest
import torch
from scipy.ndimage import correlate1d
from torch import nn

from codesign import flow
from codesign.errors import GradientError
from codesign.exclusive import exclusive
from codesign.flow.export import evenly_timed, trace
from codesign.flow.lk import warp
from codesign.flow.lk.blur import blurred
from codesign.flow.lk.cells import Cells
from codesign.flow.lk.lanes import Grid, plain_operations, recorded
from codesign.flow.lk.polynomials import Polynomials
from codesign.flow.lk.slopes import sums_along
from codesign.flow.lk.start import at_start
from codesign.flow.lk.warp import moving
from tests.numbers import D, close, f64, rand64, randn64

FADE_PX = 2.3
TAPS = (0.4, 0.2, 0.1)


def times(bins):
    """Times, and shares of the bins in the mean and in the slope of a straight line."""
    time = torch.linspace(-0.45, 0.4, bins, dtype=D)
    off = time - time.mean()
    return time, torch.stack([torch.full_like(time, 1 / bins), off / off.square().sum()])


def drawn(case, generator):
    """Grid, cell, bins, flow, density and weights; a part of the samples reads beyond the
    border."""
    batch, bins, height, width, stride, cell = case
    grid = Grid(height, width, stride)
    # batch first, then bins: two of flow, density, three of weights
    numbers = randn64(generator, bins + 6, batch, *grid.shape)
    rate, flow = numbers[:-6].transpose(0, 1), 4 * numbers[-6:-4].transpose(0, 1)
    return grid, cell, rate.contiguous(), flow.contiguous(), numbers[-4].abs(), numbers[-3:]


def leaves(*tensors):
    return [x.detach().clone().requires_grad_() for x in tensors]


def everything(form, grid, cell, rate, flow, density, weights):
    """What kernels or plain operations give: values, then gradients of their weighted sums."""
    time, contrast = (x.to(rate) for x in times(rate.shape[1]))
    images = rate.repeat_interleave(grid.stride, 2).repeat_interleave(grid.stride, 3)
    images = nn.functional.pad(images, (0, grid.width % grid.stride, 0, grid.height % grid.stride))
    gain = torch.linspace(0.5, 2, len(rate))
    images, flow, density, gain = leaves(images, flow, density, gain.to(rate))
    with form():
        rate = blurred(images, grid, TAPS)
        read = moving(rate, flow, time, contrast, grid, FADE_PX)
        total = sum((w * x).sum() for w, x in zip(weights, read, strict=True))
        by_reading = torch.autograd.grad(total, (images, flow), retain_graph=True)
        sums = sums_along(rate, flow, density, time, contrast, grid, FADE_PX, gain, cell)
        pulls = torch.linspace(-1, 1, sums.numel(), dtype=D).to(sums).reshape(sums.shape)
        by_sums = torch.autograd.grad((pulls * sums).sum(), (images, flow, density, gain))
    return rate, *read, sums, *by_reading, *by_sums


@pytest.mark.parametrize(
    "case",
    # batch, bins, height, width, stride, cell; whole cells and cells cut off, one pair of bins, one
    # row of samples
    [
        (2, 3, 13, 9, 1, 4),
        (1, 2, 7, 22, 2, 3),
        (32, 8, 20, 20, 1, 8),
        (3, 5, 17, 19, 4, 1),
        (1, 3, 1, 6, 1, 2),
        (2, 5, 3, 1, 1, 2),
    ],
)
@pytest.mark.parametrize("dtype", [D, torch.float32])
def test_kernels_are_the_plain_operations_and_their_gradients(case, dtype, generator):
    grid, cell, *given = drawn(case, generator)
    found = everything(nullcontext, grid, cell, *(x.to(dtype) for x in given))
    truth = everything(plain_operations, grid, cell, *(x.to(dtype).to(D) for x in given))
    # a place 20 px away is rounded by 10 eps, neighbours differ by up to 6 and slopes enter twice;
    # a sum over cells takes 64 of them
    for one, other in zip(found, truth, strict=True):
        assert one.dtype == dtype
        off = (one.detach().to(D) - other.detach()).abs().max()
        assert off <= 100 * torch.finfo(dtype).eps * other.detach().abs().max()


@pytest.mark.parametrize(
    ("shape", "stride"),
    [((2, 3, 150, 21), 1), ((1, 2, 31, 42), 4), ((1, 2, 3, 2), 1), ((3, 1, 1, 5), 1)],
)
def test_the_blur_is_that_of_scipy(shape, stride, generator):
    # more rows than a lane goes down; squares cut off; images smaller than the kernel
    taps = (0.4, 0.15, 0.1, 0.05)
    images = randn64(generator, shape)
    grid = Grid(*shape[2:], stride)
    rows, columns = grid.shape
    cut = images.numpy()[..., : rows * stride, : columns * stride]
    truth = cut.reshape(*shape[:2], rows, stride, columns, stride).mean((3, 5))
    for axis in (2, 3):
        truth = correlate1d(truth, np.array([*taps[:0:-1], *taps]), axis, mode="mirror")
    # seven products both ways, means of 16
    np.testing.assert_allclose(blurred(images, grid, taps).numpy(), truth, rtol=0, atol=2e-14)


def test_groups_of_bins_give_the_gradient_of_all_at_once(generator, monkeypatch):
    grid, _, *given = drawn((2, 5, 9, 8, 1, 1), generator)
    rate, flow = leaves(*given[:2])

    def gradients():
        read = moving(rate, flow, *times(5), grid, FADE_PX)
        return torch.autograd.grad(sum(x.square().sum() for x in read), (rate, flow))

    whole = gradients()
    monkeypatch.setattr(warp, "MOST_VALUES", 2 * (4 * 2 * 10 * 9))  # two bins, two bins, one
    close(gradients(), whole, rtol=1e-13, atol=1e-13)


def test_other_sizes_need_no_new_kernel_but_for_copies_to_scatter_into(generator):
    def kernels(case):
        given = drawn(case, generator)
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
            dr.kernel_history_clear()
            everything(nullcontext, *given)
            history = dr.kernel_history()
        return {entry["hash"] for entry in history if entry["type"] == dr.KernelType.JIT}

    first = kernels((1, 3, 8, 9, 2, 2))
    assert len(first) >= 7
    # several threads scatter into a copy each, whose size is part of the one kernel that does
    assert len(kernels((4, 3, 80, 25, 2, 5)) - first) <= (dr.thread_count() > 1)


def test_no_garbage_is_collected_in_a_recording():
    """A scene that is freed in one ends the process: the kernel makes more garbage than the
    collector waits for."""
    before = gc.get_threshold()
    recording = False
    collections = []

    def watch(phase, info):
        collections.append(recording)

    def kernel(added, numbers):
        nonlocal recording
        recording = True
        kept = [[] for _ in range(1000)]
        recording = False
        return numbers + added + 0 * len(kept)

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
    assert gc.isenabled()
    assert len(kept) == 1000
    assert collections
    assert not any(collections)


def test_replaying_runs_no_python_while_drjit_holds_its_lock(generator):
    """Another thread that got Python's lock meanwhile would wait for drjit's, and this one for
    Python's, for ever."""
    (counts,) = leaves(rand64(generator, 2, 2, 5, 32, 32))

    def passes():
        found = flow.estimate_lk(evenly_timed(counts))
        torch.autograd.grad(found.flow_px.sum() + found.covariance_px2.sum(), counts)

    passes()
    replays, called = [], []

    def watch(frame, event, arg):
        outer = frame.f_back.f_code if frame.f_back else None
        if (
            event == "call"
            and outer
            and outer.co_filename == dr.__file__
            and outer.co_name == "__call__"
        ):
            (replays if frame.f_code.co_name == "capture_closure" else called).append(
                frame.f_code.co_name
            )

    sys.setprofile(watch)
    passes()
    sys.setprofile(None)
    assert len(replays) > 10
    assert called == []


def test_a_second_derivative_is_refused(generator):
    grid, _, *given = drawn((1, 2, 4, 5, 1, 1), generator)
    rate, flow = leaves(*given[:2])
    bins = *times(2), grid, FADE_PX
    mean, *_ = moving(rate, flow, *bins)
    sums = sums_along(rate, flow, mean, *bins)
    for output, source in ((mean, rate), (sums, flow)):
        (first,) = torch.autograd.grad(output.sum(), source, create_graph=True)
        with pytest.raises(GradientError, match="second derivative through event flow"):
            torch.autograd.grad(first.sum(), flow)


@pytest.mark.cuda
def test_a_gpu_gives_what_the_processor_gives(generator):
    grid, cell, *given = drawn((2, 4, 33, 40, 1, 8), generator)
    found = everything(nullcontext, grid, cell, *(x.cuda() for x in given))
    for one, other in zip(found, everything(nullcontext, grid, cell, *given), strict=True):
        close(one.cpu(), other, rtol=1e-11, atol=1e-11)


@pytest.mark.parametrize("joined", [False, True])
@pytest.mark.parametrize(
    ("model", "height", "width"), [("constant", 7, 12), ("affine", 20, 9), ("quadratic", 70, 17)]
)
def test_the_step_to_the_start_is_that_of_plain_operations(model, height, width, joined, generator):
    """Flows lead beyond the border, cells differ by pixels."""
    shape = Polynomials(model, height, width, 3.0)
    cells = Cells(2, height, width, 3.0, torch.device("cpu"))

    def draw(*shape):
        return randn64(generator, *shape)

    half = 0.3 * draw(2, 2 * shape.terms, 2 * shape.terms)
    value, covariance = draw(*cells.value.shape), draw(*cells.covariance.shape)
    start = f64([-0.5, -0.4])
    given = leaves(1.5 * draw(2, 2 * shape.terms), half @ half.mT, value, covariance, start)
    weights = [draw(2, count, height, width) for count in (2, 3)]

    def run(form):
        parameters, spread, cells.value, cells.covariance, start = given
        with form():
            found = at_start(shape, parameters, spread, cells, joined, start)
        total = (found[0] * weights[0]).sum()
        pulls = []
        # the flow alone has an adjoint of its own
        for wanted in (total, total + (found[1] * weights[1]).sum() + found[2].square().sum()):
            options = {"retain_graph": True, "allow_unused": True, "materialize_grads": True}
            pulls += torch.autograd.grad(wanted, given, **options)
        return *found, *pulls

    close(run(nullcontext), run(plain_operations), rtol=1e-10, atol=1e-10)


class Closed(nn.Module):
    """The closed form as a network, at one blur."""

    def __init__(self):
        super().__init__()
        self.config = {"bins": 2}

    def forward(self, volume):
        return flow.estimate_lk(volume, levels_px=(2.0,), steps=1)


def test_a_program_follows_the_counts_it_is_given(generator):
    """A kernel that the recording does not see would be a constant: the flow of the empty volume
    that was recorded. The same sums in another order: 1e-4 px of flows of a pixel in single
    precision."""
    counts = torch.poisson(torch.full((1, 2, 2, 16, 20), 2.0), generator=generator)
    expected = Closed()(evenly_timed(counts))
    assert expected.flow_px.abs().max() > 0.01
    found = trace(Closed(), 16, 20).module()(counts)
    close(found, (expected.flow_px, expected.confidence), atol=1e-4)
