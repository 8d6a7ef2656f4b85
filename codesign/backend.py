"""The only place that picks a Mitsuba variant, checks LLVM, and bridges drjit and torch."""

import hashlib
import json
import os
import platform
import subprocess
import sys
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from codesign.atomic import write_atomic
from codesign.doors import explain
from codesign.errors import BackendError, DomainError, FileFormatError, GradientError
from codesign.exclusive import exclusive
from codesign.waiting import threads_sleep

# 15 and 16 abort the process while compiling Mitsuba 3.9 kernels; 14 is refused; 19 and 22 work
MINIMUM_LLVM = 19
INSTALL_LLVM = {
    "Linux": "install LLVM 19 or newer: 'apt-get install libllvm19' (Debian, Ubuntu), 'dnf install llvm-libs' (Fedora) or 'conda install -c conda-forge libllvm19'",
    "Darwin": "install LLVM 19 or newer: 'brew install llvm', then set DRJIT_LIBLLVM_PATH=$(brew --prefix llvm)/lib/libLLVM.dylib",
    "Windows": "install LLVM 19 or newer from the LLVM project's Windows installer, then set DRJIT_LIBLLVM_PATH to LLVM-C.dll",
}
_TRIAL = """
import mitsuba as mi
mi.set_variant({variant!r})
import drjit as dr
scene = mi.load_dict({{'type': 'scene', 'e': {{'type': 'constant'}}, 'i': {{'type': 'path'}}, 's': {{'type': 'sphere', 'bsdf': {{'type': 'diffuse'}}}},
    'sensor': {{'type': 'perspective', 'to_world': mi.ScalarTransform4f().look_at([0, 0, 4], [0, 0, 0], [0, 1, 0]), 'film': {{'type': 'hdrfilm', 'width': 8, 'height': 8}}}}}})
image = mi.render(scene, spp=2)
dr.eval(image)
assert 0 < float(dr.mean(image.array)[0] if hasattr(dr.mean(image.array), '__len__') else dr.mean(image.array)) < 10
print('render ok')
"""


def install_hint() -> str:
    """One line that says how to get a good LLVM on this system."""
    return INSTALL_LLVM.get(platform.system(), INSTALL_LLVM["Linux"])


def llvm_version() -> tuple[int, int, int] | None:
    """Version of the LLVM that drjit found, as (major, minor, patch), or None when it found
    none."""
    import drjit as dr

    found = tuple(dr.detail.llvm_version())
    return None if found[0] < 0 else found


def device_name(device: Any) -> str:
    """ "cpu" or "cuda" for a device that kernels run on, also as torch.device; DomainError for any
    other."""
    found = str(device)
    if found not in ("cpu", "cuda", "cuda:0"):
        raise DomainError(
            f"device {found!r} is not known here; choose 'cpu' or 'cuda' (the first GPU that the process sees, "
            "which CUDA_VISIBLE_DEVICES chooses)."
        )
    return found.removesuffix(":0")


def check_version(device: str = "cpu") -> None:
    """Raise BackendError unless the compiler drjit needs for ``device`` is present and fit. Costs
    milliseconds. Also DomainError for an unknown device."""
    if device_name(device) == "cuda":
        if not torch.cuda.is_available():
            raise BackendError(
                "device 'cuda' was asked for but torch sees no CUDA device; use --device cpu, or install a "
                "CUDA build of torch and a driver."
            )
        return
    found = llvm_version()
    path = os.environ.get("DRJIT_LIBLLVM_PATH")
    where = f" (DRJIT_LIBLLVM_PATH={path})" if path else ""
    remedy = ("unset DRJIT_LIBLLVM_PATH, or " if path else "") + install_hint()
    if found is None:
        raise BackendError(f"no usable LLVM library was found{where}; {remedy}.")
    if found[0] < MINIMUM_LLVM:
        dotted = ".".join(map(str, found))
        raise BackendError(
            f"LLVM {dotted} was found{where}, but rendering needs {MINIMUM_LLVM} or newer (older ones abort "
            f"the process); {remedy}."
        )


def variant(device: str = "cpu") -> str:
    """Name of the Mitsuba variant used on ``device``: one radiance channel, because event sensors
    are monochrome."""
    return "cuda_ad_mono" if device_name(device) == "cuda" else "llvm_ad_mono"


def trial_render(device: str = "cpu", timeout_s: float = 180) -> tuple[bool, str]:
    """Render a tiny scene in a subprocess, since a bad LLVM aborts the process. Returns
    (worked, message)."""
    command = [sys.executable, "-c", _TRIAL.format(variant=variant(device))]
    try:
        done = subprocess.run(
            command, capture_output=True, text=True, timeout=timeout_s, check=False
        )
    except subprocess.TimeoutExpired:
        return False, f"the trial render did not end within {timeout_s} s"
    if done.returncode == 0 and "render ok" in done.stdout:
        return True, "ok"
    last = (done.stderr.strip().splitlines() or [""])[-1]
    return False, f"the trial render ended with code {done.returncode} ({last[:200]})"


def _memory_file():
    return (
        Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache"))
        / "codesign"
        / "trial_render.json"
    )


def _machine_key(device):
    facts = [
        variant(device),
        version("mitsuba"),
        version("drjit"),
        platform.platform(),
        sys.executable,
        str(llvm_version()),
        os.environ.get("DRJIT_LIBLLVM_PATH", ""),
    ]
    return hashlib.sha256("|".join(facts).encode()).hexdigest()


@lru_cache(maxsize=4)
def require_renderer(device: str = "cpu") -> None:
    """Check once that rendering works; raise BackendError with one sentence otherwise.

    The version check runs in every process; the trial render runs once per machine and set of
    versions, and is remembered.
    """
    check_version(device)
    key = _machine_key(device)
    memory = _memory_file()
    try:
        known = json.loads(memory.read_text())
    except (OSError, ValueError):
        known = {}
    if not (isinstance(known, dict) and known.get(key) == "ok"):
        worked, message = trial_render(device)
        if not worked:
            raise BackendError(
                f"{message}; {install_hint()}, then run 'python -m codesign doctor'."
            )
        try:
            memory.parent.mkdir(parents=True, exist_ok=True)
            write_atomic(memory, json.dumps({key: "ok"}).encode())
        except (OSError, FileFormatError):
            return  # an unwritable cache costs a trial render per process, nothing else


@exclusive
def mitsuba(device: str = "cpu") -> Any:
    """The Mitsuba module with the variant of ``device`` set, after the renderer check."""
    require_renderer(device)
    import mitsuba as mi

    if mi.variant() != variant(device):  # the user's own code may have chosen another meanwhile
        mi.set_variant(variant(device))
    return mi


_threads_lock = threading.Lock()
_threads_asked: list[tuple[int, int]] = []
_threads_own = [1]  # where nobody asks


@contextmanager
def threads(least: int = 1, most: int = 1 << 16) -> Iterator[None]:
    """drjit with so many threads. Python's threads may ask at once; who needs more prevails.

    One alone is quicker for many kernels of a few thousand lanes: others have no part in them, but
    busy-wait in between. With one Mitsuba waits without end for another where OpenEXR is read or
    written.
    """
    import drjit as dr

    def ask(change):
        with _threads_lock:
            if not _threads_asked:
                _threads_own[0] = dr.thread_count()
            change((least, most))
            lows, highs = zip((1, _threads_own[0]), *_threads_asked, strict=True)
            dr.set_thread_count(max(*lows, min(highs)))

    ask(_threads_asked.append)
    try:
        yield
    finally:
        ask(_threads_asked.remove)


@dataclass(frozen=True)
class Arrays:
    """The drjit array types of one device and precision."""

    Float: Any
    UInt32: Any
    Int32: Any
    Bool: Any
    Array3: Any
    Array4: Any
    ArrayX: Any


@lru_cache(maxsize=8)
def arrays(device: str = "cpu", dtype: torch.dtype = torch.float32) -> Arrays:
    """drjit types that match a torch device and dtype (float32 or float64)."""
    check_version(device)
    threads_sleep()
    if device_name(device) == "cuda":
        import drjit.cuda.ad as ad
    else:
        import drjit.llvm.ad as ad
    if dtype == torch.float32:
        return Arrays(ad.Float, ad.UInt32, ad.Int, ad.Bool, ad.Array3f, ad.Array4f, ad.ArrayXf)
    if dtype == torch.float64:
        return Arrays(
            ad.Float64, ad.UInt32, ad.Int, ad.Bool, ad.Array3f64, ad.Array4f64, ad.ArrayXf64
        )
    raise GradientError(
        f"kernels compute in float32 or float64, not {dtype}; convert the tensor first."
    )


@lru_cache(maxsize=1)
def memory_bytes() -> int:
    """Memory of this machine, bytes: 64 GiB where the system does not say."""
    try:
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, ValueError, OSError):
        return 2**36


def widen(arr: Arrays, parameters: Any, count: int, width: int) -> list[Any]:
    """The ``count`` scalars of a flat array, each gathered into a full-width array where its
    gradient is wanted.

    A scalar used by a million lanes would make one full recomputation per use in the backward pass;
    a gather makes one reduction. Without a gradient a gather per lane only costs time, and the
    scalars stay scalars (evaluated, so that other values need no new kernel).
    """
    import drjit as dr

    wanted = dr.grad_enabled(parameters)
    zero = dr.opaque(arr.UInt32, 0, width if wanted else 1)
    found = [dr.gather(arr.Float, parameters, zero + k) for k in range(count)]
    if not wanted:
        dr.eval(found)
    return found


def frames_per_kernel(pixels: int) -> int:
    """How many frames of so many pixels one loop over time should take: few frames read memory in
    few streams, which the processor fetches ahead; many save calls."""
    return max(32, (1 << 22) // pixels)


def run_kernel(
    kernel: Callable[..., tuple[Any, ...]],
    inputs: Iterable[Tensor],
    out_shapes: Iterable[Sequence[int]],
) -> tuple[Tensor, ...]:
    """Run a drjit kernel on torch tensors, with first derivatives.

    Args:
      kernel: callable (arrays, *flat) -> tuple of flat drjit arrays; must be a pure function of its
        inputs. Integer outputs carry no gradient.
      inputs: float tensors of one dtype and device; each is handed to the kernel flattened
        (row-major).
      out_shapes: shape of each output.
    Returns: tuple of tensors that own their memory (no aliasing with the inputs).
    Gradient: reverse mode, by running the kernel again in backward, so any number of backward
      passes give the same numbers.
    Raises: GradientError on mixed dtypes, and when a second derivative is asked for.
    """
    inputs = tuple(inputs)
    dtypes = {x.dtype for x in inputs}
    devices = {x.device for x in inputs}
    if len(dtypes) != 1 or len(devices) != 1:
        raise GradientError(
            f"a kernel takes tensors of one dtype and one device, got {sorted(map(str, dtypes))} on "
            f"{sorted(map(str, devices))}; convert them first."
        )
    return _Kernel.apply(kernel, tuple(map(tuple, out_shapes)), *inputs)


def load(array: Any, tensor: Tensor) -> Any:
    """A flat drjit array of that type, of the numbers of a tensor, without a copy where they are
    dense. It must not outlive the ``exclusive`` function that loads it."""
    if tensor.device.index:  # drjit knows one GPU, and takes memory of any other for its own
        device_name(tensor.device)
    return array(exclusive.keep(tensor.detach().contiguous().reshape(-1)))


def pull_back(
    function: Callable[..., Sequence[Any]],
    given: Sequence[Any],
    seeds: Sequence[Any],
    leaves: Sequence[Any] = (),
) -> list[Any]:
    """Gradients of the drjit arrays that a function is given, one step of a loop for example, from
    those of what it gives; then those of ``leaves``, which it may add its own to."""
    import drjit as dr

    with dr.resume_grad():
        given = [dr.detach(value) + 0 for value in given]
        dr.enable_grad(given)
        products = [
            value * dr.detach(seed) for value, seed in zip(function(*given), seeds, strict=True)
        ]
        dr.backward_from(sum(products[1:], products[0]))
        return [dr.grad(value) for value in (*given, *leaves)]


def _to_torch(value, shape, inputs):
    tensor = value.torch()
    shared = any(tensor.data_ptr() == x.data_ptr() for x in inputs)
    if tensor.numel() == 1 and torch.Size(shape).numel() != 1:
        return tensor.expand(torch.Size(shape).numel()).reshape(shape).clone()
    return (tensor.clone() if shared else tensor).reshape(shape)


class _Kernel(torch.autograd.Function):
    @staticmethod
    @exclusive
    def forward(ctx, kernel, out_shapes, *inputs):
        import drjit as dr

        ctx.kernel = kernel
        ctx.arrays = arrays(inputs[0].device.type, inputs[0].dtype)
        ctx.save_for_backward(*inputs)
        ctx.set_materialize_grads(False)
        with dr.suspend_grad():
            outputs = [
                dr.detach(o)
                for o in kernel(ctx.arrays, *[load(ctx.arrays.Float, x) for x in inputs])
            ]
            # memory that was there before may belong to something the kernel captured
            owned = [o.state != dr.VarState.Evaluated for o in outputs]
            dr.eval(outputs)
        dr.sync_thread()
        seen = list(inputs)
        tensors = []
        for value, shape, own in zip(outputs, out_shapes, owned, strict=True):
            tensor = _to_torch(value, shape, seen)
            tensors.append(tensor if own else tensor.clone())
            seen.append(tensors[-1])
        ctx.mark_non_differentiable(*[t for t in tensors if not t.is_floating_point()])
        return tuple(tensors)

    @staticmethod
    def backward(ctx, *grads):  # pyright: ignore[reportIncompatibleMethodOverride]
        inputs = ctx.saved_tensors  # read once: a checkpoint gives them no second time
        with torch.no_grad():
            result = _adjoint(ctx, inputs, grads)
        return (None, None, *first_only(result, (*inputs, *grads)))


@exclusive
def _adjoint(ctx, inputs, grads):
    """Gradients of the kernel's inputs, by re-running it with drjit's reverse mode."""
    import drjit as dr

    arr = ctx.arrays
    wanted = ctx.needs_input_grad[2:]
    flat = [load(arr.Float, x) for x in inputs]
    for value, want in zip(flat, wanted, strict=True):
        if want:
            dr.enable_grad(value)
    outputs = ctx.kernel(arr, *flat)
    for value, grad in zip(outputs, grads, strict=True):
        if grad is not None and dr.grad_enabled(value):
            seed = load(arr.Float, grad)
            dr.accum_grad(value, seed if dr.width(value) == dr.width(seed) else dr.sum(seed))
            dr.enqueue(dr.ADMode.Backward, value)
    dr.traverse(dr.ADMode.Backward)
    found = [dr.grad(value) if want else None for value, want in zip(flat, wanted, strict=True)]
    dr.eval(found)
    dr.sync_thread()
    return [
        None if g is None else _to_torch(g, x.shape, inputs)
        for g, x in zip(found, inputs, strict=True)
    ]


_FIRST_ONLY = "drjit kernels give first derivatives only; a second derivative was asked for. Use differences of gradients instead."


def first_only(
    found: Sequence[Tensor | None],
    sources: Iterable[Tensor | None],
    sentence: str = _FIRST_ONLY,
) -> Sequence[Tensor | None]:
    """Gradients that a kernel found, as they are; differentiating them to their sources raises
    GradientError with the sentence."""
    if not torch.is_grad_enabled():
        return found
    live = [g for g in found if g is not None]
    given = [source for source in sources if source is not None]
    sealed = iter(NoSecondDerivative.apply(sentence, len(live), *live, *given))  # pyright: ignore[reportArgumentType]
    return [None if g is None else next(sealed) for g in found]


def differentiable_once(found: Tensor, sentence: str) -> Tensor:
    """What was found, with its gradient; differentiating that again raises GradientError with the
    sentence."""
    return _Once.apply(sentence, found) if found.requires_grad else found  # pyright: ignore[reportReturnType]


class _Once(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, sentence: str, found: Tensor) -> Tensor:
        ctx.sentence = sentence
        ctx.save_for_backward(found)
        return found.view_as(found)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> Any:  # pyright: ignore[reportIncompatibleMethodOverride]
        return None, first_only([grad], ctx.saved_tensors, ctx.sentence)[0]


class NoSecondDerivative(torch.autograd.Function):
    """Passes the first ``count`` tensors, gradients, on unchanged; differentiating them again
    raises GradientError with ``sentence``."""

    @staticmethod
    def forward(ctx: Any, sentence: str, count: int, *tensors: Tensor) -> tuple[Tensor, ...]:
        ctx.sentence = sentence
        return tuple(t.clone() for t in tensors[:count])

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> Any:  # pyright: ignore[reportIncompatibleMethodOverride]
        raise GradientError(ctx.sentence)


explain(globals())
