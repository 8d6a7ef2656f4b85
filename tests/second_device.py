"""A second device without one: tensors that nobody placed stand on a host of their own, and what a
GPU refuses to compute with them, or to hand to numpy, is refused here too.

    with second_device():
        run()      # inputs made before count as on the device; values are those of the processor

    python -m tests.second_device STUDY OPTIONS    # a whole study, its device the second one
"""

import importlib
import sys
from contextlib import ExitStack, contextmanager
from unittest import mock

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils._pytree import tree_leaves, tree_map_only

from codesign import backend
from studies.frame import run as frame

MAKERS = (
    *(torch.zeros, torch.ones, torch.empty, torch.full, torch.eye, torch.arange, torch.linspace),
    *(torch.tensor, torch.as_tensor, torch.rand, torch.randn, torch.randint),
    *(torch.randperm, torch.logspace, torch.tril_indices, torch.triu_indices, torch.hann_window),
    *(torch.empty_strided, torch.asarray, torch.frombuffer, torch.scalar_tensor, torch.normal),
)
MOVES = (Tensor.to, Tensor.type_as)
# take a tensor of the host beside one of the device: indices, and copies from one to the other
MIXES = (Tensor.__getitem__, Tensor.__setitem__, Tensor.copy_)
THERE = torch.device("cpu", 0)  # no tensor of the processor says so by itself
TO_NUMPY = (Tensor.numpy, Tensor.__array__)


class MixedDevices(RuntimeError):
    """What a GPU would refuse."""


class Host(Tensor):
    """A tensor that stands on the host."""


class _Second(TorchFunctionMode):
    def __torch_function__(self, func, types, args=(), kwargs=None):
        kwargs = dict(kwargs or {})
        given = tree_leaves((args, kwargs))
        hosts = [x for x in given if isinstance(x, Host)]
        there = [x for x in given if isinstance(x, Tensor) and not isinstance(x, Host)]
        named = [x for x in given if isinstance(x, torch.device | str)]
        named = [torch.device(x) for x in named if str(x).startswith("cpu")]
        name = getattr(func, "__name__", str(func))
        with torch._C.DisableTorchFunctionSubclass():
            found = func(*args, **kwargs)
        if func == Tensor.device.__get__:
            return torch.device("cpu") if hosts else THERE
        # a Module that moves has new Parameters here: classes do not change in place, as memory does
        if func is torch._has_compatible_shallow_copy_type:
            return False
        if func is torch.autograd.grad:  # a gradient stands where its tensor does
            with torch._C.DisableTorchFunctionSubclass():
                return tuple(
                    slope if slope is None else slope.as_subclass(type(leaf))
                    for slope, leaf in zip(found, tree_leaves(_leaves(args, kwargs)), strict=True)
                )
        if func is Tensor.__getitem__ and isinstance(args[0], Host) and there:
            raise MixedDevices("a tensor on the host at places on the device")
        if func in TO_NUMPY and there:
            raise MixedDevices(f"{name} of a tensor on the device; .cpu() comes first")
        if func is Tensor.cpu:
            on_host = True
        elif named:
            on_host = named[-1] != THERE
        elif func in MOVES:  # to a dtype, or to where another is
            on_host = isinstance(([x for x in args if isinstance(x, Tensor)])[-1], Host)
        elif func in MAKERS:  # one that is handed a tensor makes another beside it
            on_host = not (args and isinstance(args[0], Tensor) and there)
        else:
            if hosts and there and func not in MIXES and any(x.ndim for x in hosts):
                shapes = [tuple(x.shape) for x in hosts]
                raise MixedDevices(f"{name} of tensors of both devices, {shapes} on the host")
            on_host = bool(hosts) and not there
        kind = Host if on_host else Tensor
        if isinstance(found, torch.Size):
            return found
        with torch._C.DisableTorchFunctionSubclass():
            return tree_map_only(
                Tensor,
                lambda x: x if on_host == isinstance(x, Host) else x.as_subclass(kind),
                found,
            )


def _leaves(args, kwargs):
    return args[1] if len(args) > 1 else kwargs["inputs"]


@contextmanager
def second_device(kernels_on_host=False):
    """Everything made before counts as on the device. kernels_on_host: those of the host's tensors
    alone run, on the host."""
    load = backend.load

    def loaded(array, tensor):
        if isinstance(tensor, Host):
            raise MixedDevices(f"a kernel reads {tuple(tensor.shape)} from the host")
        return load(array, tensor)

    def applied(kernel, shapes, *inputs):
        if not (kernels_on_host and all(isinstance(tensor, Host) for tensor in inputs)):
            return apply(kernel, shapes, *inputs)
        found = apply(kernel, shapes, *(tensor.as_subclass(Tensor) for tensor in inputs))
        return tuple(tensor.as_subclass(Host) for tensor in found)

    from_numpy = torch.from_numpy  # asks no mode
    apply = backend._Kernel.apply
    made = mock.patch.object(torch, "from_numpy", lambda x: from_numpy(x).as_subclass(Host))
    with ExitStack() as patched:
        for module in [m for m in sys.modules.values() if getattr(m, "load", None) is load]:
            patched.enter_context(mock.patch.object(module, "load", loaded))
        patched.enter_context(made)
        patched.enter_context(mock.patch.object(backend._Kernel, "apply", applied))
        patched.enter_context(_Second())
        yield


def constants_on_host():
    """What modules hold from their import on is the host's."""
    for module in list(sys.modules.values()):
        if module.__name__.startswith(("codesign", "scenes", "studies")):
            for name, value in list(vars(module).items()):
                if type(value) is Tensor:
                    setattr(module, name, value.as_subclass(Host))


if __name__ == "__main__":
    study = importlib.import_module(f"studies.{sys.argv[1]}.__main__")
    constants_on_host()
    with (
        second_device(kernels_on_host=True),
        mock.patch.object(frame, "_device", return_value=THERE),
    ):
        sys.exit(frame.main(study.study, study.Config, sys.argv[2:]))
