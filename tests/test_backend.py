"""The torch-drjit bridge: right derivatives, the same at every pass, memory of its own, clear
refusals."""

import drjit as dr
import pytest
import torch

from codesign import backend
from codesign.errors import BackendError, DomainError, GradientError
from tests.numbers import D, close, randn64

N = 5


def smooth(arr, x, y, a):
    """Two smooth functions of x [N], y [N] and the scalar a, and one integer output."""
    import drjit as dr

    wide = backend.widen(arr, a, 1, N)[0]
    return dr.sin(x * wide) + y * y, dr.exp(wide * y) * x, arr.Int32(dr.round(x))


def call(x, y, a):
    return backend.run_kernel(smooth, (x, y, a), [(N,), (N, 1), (N,)])


def same_in_torch(x, y, a):
    return torch.sin(x * a) + y * y, (torch.exp(a * y) * x)[:, None], torch.round(x).to(torch.int32)


@pytest.fixture(params=[torch.float32, D], ids=str)
def inputs(request, generator):
    x, y = (
        torch.randn(N, dtype=request.param, generator=generator).requires_grad_() for _ in range(2)
    )
    return x, y, torch.tensor([0.7], dtype=request.param, requires_grad=True)


def test_values_and_dtype_follow_the_inputs(inputs):
    outputs = call(*inputs)
    expected = same_in_torch(*inputs)
    assert [o.dtype for o in outputs] == [inputs[0].dtype, inputs[0].dtype, torch.int32]
    assert [o.shape for o in outputs] == [e.shape for e in expected]
    # drjit's sin and exp are within 2 units in the last place; values here stay below 8
    for got, want in zip(outputs, expected, strict=True):
        close(
            got,
            want,
            rtol=4 * torch.finfo(inputs[0].dtype).eps,
            atol=8 * torch.finfo(inputs[0].dtype).eps,
        )


def test_gradcheck_in_double(generator):
    x, y = (randn64(generator, N).requires_grad_() for _ in range(2))
    a = torch.tensor([0.7], dtype=D, requires_grad=True)
    assert torch.autograd.gradcheck(lambda *v: call(*v)[:2], (x, y, a))


def test_gradient_equals_torch(inputs):
    seeds = [
        torch.linspace(-1, 1, N, dtype=inputs[0].dtype),
        torch.linspace(2, 3, N, dtype=inputs[0].dtype)[:, None],
    ]
    got = torch.autograd.grad(call(*inputs)[:2], inputs, seeds)
    want = torch.autograd.grad(same_in_torch(*inputs)[:2], inputs, seeds)
    for g, w in zip(got, want, strict=True):
        # sums of ten terms of order one
        close(g, w, rtol=20 * torch.finfo(w.dtype).eps, atol=20 * torch.finfo(w.dtype).eps)


@pytest.mark.bits
def test_second_backward_gives_the_same_numbers(inputs):
    outputs = call(*inputs)
    total = outputs[0].sum() + (outputs[1] ** 2).sum()
    first = torch.autograd.grad(total, inputs, retain_graph=True)
    copies = [g.clone() for g in first]
    for g in first:
        g.fill_(torch.nan)
    second = torch.autograd.grad(total, inputs)
    assert all(torch.equal(c, s) for c, s in zip(copies, second, strict=True))


def test_gradient_of_one_input_alone(inputs):
    x, y, a = inputs
    (only,) = torch.autograd.grad(call(x.detach(), y, a.detach())[1].sum(), [y])
    close(only, (a * torch.exp(a * y) * x).detach(), rtol=2e-6, atol=1e-6)


def test_an_output_owns_its_memory(inputs):
    kept = [v.detach().clone() for v in inputs]
    outputs = call(*inputs)
    expected = [o.detach().clone() for o in outputs]
    with torch.no_grad():
        for o in outputs:
            o.fill_(7)
    assert all(torch.equal(v, k) for v, k in zip(inputs, kept, strict=True))
    assert all(torch.equal(o, e) for o, e in zip(call(*inputs), expected, strict=True))


def test_changing_an_input_later_leaves_outputs_alone(inputs):
    outputs = call(*inputs)
    expected = [o.detach().clone() for o in outputs]
    with torch.no_grad():
        for v in inputs:
            v.mul_(3)
    assert all(torch.equal(o, e) for o, e in zip(outputs, expected, strict=True))
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        outputs[0].sum().backward()


def test_passing_an_input_through_still_copies(inputs):
    x = inputs[0]
    kept = x.detach().clone()
    out, again = backend.run_kernel(lambda arr, v: (v, v), (x,), [(N,), (N,)])
    with torch.no_grad():
        out.zero_()
    assert torch.equal(x, kept)
    assert torch.equal(again, kept)


def test_a_captured_array_is_copied_too():
    import drjit as dr

    constant = dr.arange(backend.arrays().Float, 4)
    dr.eval(constant)
    (out,) = backend.run_kernel(lambda arr, v: (constant,), (torch.zeros(4),), [(4,)])
    out.fill_(9)
    assert list(constant) == [0, 1, 2, 3]


def test_one_value_fills_a_wide_output_and_sums_in_backward(inputs):
    x = inputs[0]
    (out,) = backend.run_kernel(
        lambda arr, v: (arr.Float(3) * backend.widen(arr, v, 1, 1)[0],), (x,), [(2, 3)]
    )
    assert out.shape == (2, 3)
    (grad,) = torch.autograd.grad(out.sum(), x)
    assert torch.equal(grad, torch.tensor([18.0, 0, 0, 0, 0], dtype=x.dtype))


def test_a_frozen_input_asks_for_nothing(inputs):
    outputs = call(*(v.detach() for v in inputs))
    assert not any(o.requires_grad for o in outputs)


def test_integer_outputs_carry_no_gradient(inputs):
    assert [o.requires_grad for o in call(*inputs)] == [True, True, False]


def test_mixed_dtypes_are_refused():
    with pytest.raises(GradientError, match=r"float32.*float64"):
        backend.run_kernel(
            lambda arr, x, y: (x + y,), (torch.zeros(2), torch.zeros(2, dtype=D)), [(2,)]
        )
    with pytest.raises(GradientError, match="float16"):
        backend.run_kernel(lambda arr, x: (x,), (torch.zeros(2, dtype=torch.float16),), [(2,)])


def test_double_backward_is_refused(inputs):
    x = inputs[0]
    (grad,) = torch.autograd.grad(call(*inputs)[0].sum(), x, create_graph=True)
    with pytest.raises(GradientError, match="first derivatives only"):
        torch.autograd.grad(grad.sum(), x)


def test_cuda_without_a_device_is_refused(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(BackendError, match="no CUDA device"):
        backend.check_version("cuda")


def test_a_tensor_on_another_gpu_is_refused():
    class There:
        device = torch.device("cuda", 1)

    with pytest.raises(DomainError, match="CUDA_VISIBLE_DEVICES chooses"):
        backend.load(None, There())


def test_who_needs_more_threads_of_drjit_prevails_in_whatever_order_they_leave():
    dr.set_thread_count(2)
    one, two, other = (
        backend.threads(**asked) for asked in ({"most": 1}, {"least": 2}, {"most": 1})
    )
    one.__enter__()
    assert dr.thread_count() == 1
    two.__enter__()
    assert dr.thread_count() == 2
    other.__enter__()
    one.__exit__(None, None, None)
    assert dr.thread_count() == 2
    two.__exit__(None, None, None)
    assert dr.thread_count() == 1
    other.__exit__(None, None, None)
    assert dr.thread_count() == 2
    with pytest.raises(ZeroDivisionError), backend.threads(most=1):
        divmod(1, 0)
    assert dr.thread_count() == 2
