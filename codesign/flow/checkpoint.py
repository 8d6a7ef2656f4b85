"""Trained networks on disk: weights in safetensors, everything else as JSON in the file's header;
data only, never code.

A network file can be damaged, cut short, or written by another version; each of these ends in one
FileFormatError, before any number is computed.
"""

import hashlib
import importlib
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import safetensors.torch
import torch
from safetensors import safe_open
from torch import Tensor, nn

from codesign.atomic import replacing
from codesign.checks import check_choice, check_kind, check_path
from codesign.errors import DomainError, FileFormatError
from codesign.reading import building, check_regular, reading

if TYPE_CHECKING:
    from codesign.flow.baselines import FlowNetEvents, SpikeFlowNet
    from codesign.flow.refiner import Refiner

    Network = Refiner | FlowNetEvents | SpikeFlowNet  # the classes of NETWORKS

VERSION = 1
# name -> module:class, imported when asked for; a study adds its own
NETWORKS = {
    "refiner": "codesign.flow.refiner:Refiner",
    "flownet-events": "codesign.flow.baselines:FlowNetEvents",
    "spike-flownet": "codesign.flow.baselines:SpikeFlowNet",
}
DELIVERED = {"refiner": Path(__file__).with_name("refiner.safetensors")}


@dataclass(frozen=True)
class NetworkFile:
    """What a network file holds: name of the network, its constructor's arguments, weights, and
    what the writer added."""

    network: str
    config: dict[str, Any]
    weights: dict[str, Tensor]
    metadata: dict[str, Any]


def network_class(name: str) -> type[Any]:
    """Class of the network called ``name``.

    Raises: DomainError for a name that is not in NETWORKS, also for one of a class of the user's
      own: no file makes anything be imported.
    """
    if ":" in name:
        raise DomainError(
            f"'{name}' is a class of your own; hand it over: flow.load(path, kind=...)."
        )
    if name in ("ecn", "idnet") and name not in NETWORKS:
        raise DomainError(
            f"'{name}' stands with the study that races it: import studies.train_flow.peers first."
        )
    check_choice(name, "the network", sorted(NETWORKS))
    module, kind = NETWORKS[name].split(":")
    return getattr(importlib.import_module(module), kind)


def network_name(network: nn.Module) -> str:
    """The name under which a network's class stands in NETWORKS, or module:Class of one of the
    user's own.

    Raises: DomainError for a class that does not keep its constructor's arguments in ``config``.
    """
    kind = type(network)
    for name, place in NETWORKS.items():
        module, known = place.split(":")
        if known == kind.__qualname__ and (
            kind.__module__ == module or kind.__module__.startswith(f"{module}.")
        ):
            return name
    if not isinstance(getattr(network, "config", None), Mapping):
        raise DomainError(
            f"the network ({kind.__qualname__}) has no 'config'; keep its constructor's arguments there, as a dictionary."
        )
    return f"{kind.__module__}:{kind.__qualname__}"


def save(network: nn.Module, path: str | Path, metadata: Mapping[str, Any] | None = None) -> None:
    """Write a network to ``path`` (.safetensors), whole or not at all.

    Args:
      network: nn.Module with its constructor's arguments in ``config``.
      metadata: plain JSON values to keep with it (seed, steps, figures, command), or None.
    Raises: DomainError for a network without ``config``, weights that are not finite, and metadata
      that JSON cannot hold; FileFormatError when the file cannot be written.

    >>> network = load("refiner")
    >>> save(network, "again.safetensors", {"note": "as delivered"})
    >>> read("again.safetensors").metadata
    {'note': 'as delivered'}
    """
    path = check_path(path, "the path of a network file")
    if metadata is not None:
        check_kind(metadata, Mapping, "the metadata")
    weights = check_kind(network, nn.Module, "the network").state_dict()
    bad = [name for name, tensor in weights.items() if not bool(tensor.isfinite().all())]
    if bad:
        raise DomainError(
            f"weights {', '.join(bad[:3])} are NaN or infinite; such a network is not worth keeping."
        )
    content = {
        "kind": "network",
        "network": network_name(network),
        "config": dict(cast(Any, network).config),
        "metadata": metadata or {},
        "torch": torch.__version__,
    }
    try:
        json.dumps(content, allow_nan=False)
    except (TypeError, ValueError) as error:
        raise DomainError(
            f"configuration and metadata of a network must be plain, finite JSON values ({error})."
        ) from error
    write_tensors(path, weights, content)


def load(name_or_path: str | Path, kind: Callable[..., Any] | None = None) -> "Network":
    """A trained network, in evaluation mode, on the CPU.

    Args:
      name_or_path: "refiner", the one delivered with the package, or the path of a file that
        ``save`` wrote.
      kind: the class of a network of one's own, called with the stored ``config``.
    Returns: the network, of the precision it was saved in, a callable from EventVolume to FlowField. Its weights still take
      gradients; ``requires_grad_(False)`` saves their cost.
    Raises: FileFormatError when the file is missing, damaged, of another version, or does not fit
      its network.

    >>> from codesign.flow.export import evenly_timed
    >>> network = load("refiner")
    >>> network(evenly_timed(torch.zeros(1, 2, network.config["bins"], 64, 96))).flow_px.shape
    torch.Size([1, 2, 64, 96])
    """
    path = check_path(name_or_path, "the name or path of a network")
    if str(name_or_path) in DELIVERED:
        path = DELIVERED[str(name_or_path)]
    elif path.suffix != ".safetensors":
        raise FileFormatError(
            f"'{name_or_path}' is neither a delivered network ({', '.join(DELIVERED)}) nor a .safetensors "
            "file; give one of these."
        )
    return build(read(path), path, kind).eval()


def read(path: str | Path) -> NetworkFile:
    """NetworkFile of a file that ``save`` wrote.

    Raises: FileFormatError when it is missing, damaged, of another version or another kind.
    """
    weights, content = read_tensors(path)
    if (
        content.get("kind") != "network"
        or not isinstance(content.get("network"), str)
        or not isinstance(content.get("config"), dict)
    ):
        raise FileFormatError(
            f"'{path}' holds no network; give the file network.safetensors of a training run."
        )
    return NetworkFile(content["network"], content["config"], weights, content.get("metadata", {}))


def build(
    stored: NetworkFile,
    path: str | Path,
    kind: Callable[..., Any] | None = None,
) -> "Network":
    """The network of a NetworkFile; ``path`` is named in errors, ``kind`` as in ``load``.

    Raises: FileFormatError when class, configuration and weights do not fit each other.
    """
    own = getattr(kind, "__qualname__", None)
    if kind is not None and own != stored.network.partition(":")[2]:
        raise FileFormatError(
            f"'{path}' holds a network '{stored.network}', not a {own}; give its class."
        )
    with building(
        f"'{path}'", f"it was written by another version of the network '{stored.network}'"
    ):
        network = (kind or network_class(stored.network))(**stored.config)
    kinds = {each.dtype for each in stored.weights.values() if each.is_floating_point()}
    if len(kinds) == 1:  # of several the constructor knows
        network.to(kinds.pop())
    fill(network, stored.weights, path)
    return network


def fill(network: nn.Module, weights: Mapping[str, Tensor], path: str | Path) -> None:
    """Copy weights into a network of the same form.

    Raises: FileFormatError naming the first weight that is missing, unknown, of another shape, or
      not finite.
    """
    own = network.state_dict()
    for name in sorted(own.keys() | weights.keys()):
        if name not in own or name not in weights:
            raise FileFormatError(
                f"'{path}' {'has a weight' if name in weights else 'lacks the weight'} '{name}' that this "
                f"network {'lacks' if name in weights else 'has'}; it is of another network."
            )
        if own[name].shape != weights[name].shape:
            raise FileFormatError(
                f"'{path}': weight '{name}' is {list(weights[name].shape)}, the network's is "
                f"{list(own[name].shape)}; it is of another network."
            )
        if not bool(weights[name].isfinite().all()):
            raise FileFormatError(
                f"'{path}': weight '{name}' is NaN or infinite; the file is of no use."
            )
    network.load_state_dict(weights)


def write_tensors(
    path: str | Path,
    tensors: Mapping[str, Tensor],
    content: Mapping[str, Any],
) -> None:
    """Write tensors and a JSON dictionary with a checksum over both, whole or not at all.

    Raises: FileFormatError when the file cannot be written.
    """
    plain = {name: tensor.detach().cpu().contiguous().clone() for name, tensor in tensors.items()}
    text = json.dumps({"version": VERSION, **content}, allow_nan=False)
    # one key: safetensors writes several in no fixed order, and equal networks shall be equal files
    header = {"codesign": json.dumps({"sha256": _digest(plain, text), "content": text})}
    with replacing(path) as temporary:
        temporary.write_bytes(safetensors.torch.save(plain, header))


def read_tensors(path: str | Path) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Tensors and content that ``write_tensors`` stored.

    Raises: FileFormatError when the file is missing, cut short, changed, or of another version.
    """
    path = check_path(path, "the path of a network file")
    check_regular(path)
    with (
        reading(f"'{path}'", "it is damaged or not written by codesign; train or copy it again"),
        safe_open(str(path), framework="pt") as stored,
    ):
        header = json.loads((stored.metadata() or {})["codesign"])
        tensors = {name: stored.get_tensor(name) for name in stored.keys()}  # noqa: SIM118  no mapping
        digest = header["sha256"]
        text = header["content"]
        content = json.loads(text)
        version = content["version"]
    if version != VERSION:
        raise FileFormatError(
            f"'{path}' has format version {version}, this codesign reads version {VERSION}; train it again, "
            "or use the codesign that wrote it."
        )
    if digest != _digest(tensors, text):
        raise FileFormatError(
            f"'{path}' is damaged (its checksum does not fit its content); train or copy it again."
        )
    return tensors, content


def _digest(tensors, text):
    total = hashlib.sha256(text.encode())
    for name in sorted(tensors):
        tensor = tensors[name]
        total.update(f"\0{name} {tensor.dtype} {list(tensor.shape)}\0".encode())
        total.update(tensor.contiguous().reshape(-1).view(torch.uint8).numpy().tobytes())
    return total.hexdigest()
