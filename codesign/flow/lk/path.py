"""How far along its way the scene is in each bin: events are the clock.

Moving texture gives events by the way it goes, not by the time it takes, so a bin's share of the
events is its share of the path. Where the motion turns back, what was ON becomes OFF in the same
place: the signed counts of nearby bins are alike while the direction holds, and opposite across a
turn. Turns are looked for only where events become rare, since speed passes through zero there.

Events are a false clock where a bin has few of them for another reason: a sensor that begins with
the window has all its pixels in the middle of their thresholds, light that changes makes events of
its own. Then time is the clock.
"""

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

FEW_EVENTS = 200.0  # worth of even speed that the shares of the bins start from
UNEVEN = 0.02  # mean square of speed over its mean, less 1, from which on it counts
NEAR = 3  # bins that far apart are compared
SHORT = 1e-3  # share of the energy of all bins below which a bin says little
TINY = 2.0**-100
# correlation of the bins before and after a turn, sign turned, from which on it is one
MIRRORED = 0.35
SHARP = 6.0  # of the choice between ways, per unit of correlation
POOL = 4  # pixels a side over which counts are compared


@dataclass(frozen=True)
class Path:
    """The way of each sample, its whole length 1.

    counts: [B, n, H, W] ON less OFF, in bins evenly spaced on the path as the volume's are in time,
      events on the way back with their sign turned. net: [B] displacement over the way, 1 for
      motion that never turns. start: [B] place of the beginning; 0 is the mean place of the events.
      spread: [B] mean square place of the events.
    place: [B, n] of the volume's bins on the way. direction: [B, n] of the motion in them, 1
      forwards, -1 on the way back.
    """

    counts: Tensor
    net: Tensor
    start: Tensor
    spread: Tensor
    place: Tensor
    direction: Tensor


def path(
    signed: Tensor,
    events: Tensor,
    weight: Tensor,
    time: Tensor,
    mirrored: bool = False,
) -> Path:
    """The way of each sample.

    Args:
      signed: [B, n, H, W] ON less OFF per bin.
      events: [B, n] of both signs.
      weight, time: [n] share of the interval that each bin collects, and its mean time, in
        intervals.
    Gradient: signed, events.
    """
    weight = weight.double()
    time = time.double()
    speed = (events.double() + FEW_EVENTS * weight) / (
        events.double().sum(1, keepdim=True) + FEW_EVENTS
    )
    speed = speed / weight
    uneven = (weight * (speed - 1).square()).sum(1, keepdim=True)
    speed = 1 + (speed - 1) * uneven / (uneven + UNEVEN)
    direction = _mirror(signed, weight) if mirrored else _directions(signed, speed, weight)
    return _along(signed, speed, direction, weight, time)


def even(signed: Tensor, weight: Tensor, time: Tensor) -> Path:
    """The way of motion of even speed: time itself. Args: as of ``path``."""
    weight = weight.double()
    mean = weight @ time.double()
    spread = weight @ (time.double() - mean).square()
    ones = torch.ones(len(signed), dtype=torch.float64, device=signed.device)
    place = (time.double() - mean).expand(len(signed), -1)
    return Path(signed, ones, -(0.5 + mean) * ones, spread * ones, place, torch.ones_like(place))


def _along(signed, speed, direction, weight, time):
    share = speed * weight
    edge = (direction * share).cumsum(1)
    off_middle = time - (weight.cumsum(0) - weight / 2 - 0.5)
    place = edge - direction * share / 2 + direction * speed * off_middle
    mean = (share * place).sum(1, keepdim=True)
    place = place - mean
    moved = direction[:, :, None] * _shared(place, time - weight @ time)
    counts = (moved.mT.to(signed) @ signed.flatten(2)).unflatten(2, signed.shape[2:])
    return Path(counts, edge[:, -1], -mean[:, 0], (share * place.square()).sum(1), place, direction)


def _shared(place, nodes):
    """[B, n, m] shares of bins at ``place`` [B, n] in the two nearest of the nodes [m], which keep
    their mean place; beyond the last nodes they are continued."""
    upper = torch.searchsorted(nodes, place.detach()).clamp(1, len(nodes) - 1)
    share = (place - nodes[upper - 1]) / (nodes[upper] - nodes[upper - 1])
    found = place.new_zeros(*place.shape, len(nodes))
    return found.scatter(2, torch.stack([upper - 1, upper], 2), torch.stack([1 - share, share], 2))


def _mirror(signed, weight):
    """[B, n] in -1..1: one turn, or none. Bins as far before it as after it have seen the same
    places, with the opposite sign, whatever the texture, the speed and the direction."""
    bins = len(weight)
    side = min(POOL, *signed.shape[2:])
    images = avg_pool2d(signed.detach(), side).flatten(2).double()
    products = images @ images.mT
    sizes = (products.diagonal(dim1=1, dim2=2) + TINY).sqrt()
    sizes = sizes[:, :, None] * sizes[:, None]
    at = torch.arange(bins, device=signed.device)
    # place of the turn: two pairs of bins at least
    twice = torch.arange(3, max(3, 2 * bins - 4), device=signed.device)
    if not len(twice):
        return torch.ones_like(products[:, 0])
    pairs = (at[:, None] + at == twice[:, None, None]) & (at[:, None] != at)
    alike = [(pairs * matrix[:, None]).sum((2, 3)) for matrix in (-products, sizes)]
    most, which = (alike[0] / alike[1]).max(1)
    back = (twice[which, None] / 2 - at).clamp(-1, 1).to(weight)
    back = torch.where((back @ weight < 0)[:, None], -back, back)
    return torch.where((most > MIRRORED)[:, None], back, 1.0)


def _directions(signed, speed, weight):
    """[B, n] in -1..1: the mean of the ways with at most two turns, by how well the signed counts
    agree."""
    bins = len(weight)
    side = min(POOL, *signed.shape[2:])
    images = avg_pool2d(signed, side).flatten(2).double()
    energy = images.square().sum((1, 2), keepdim=True)
    images = images / (energy + TINY).sqrt()
    alike = images @ images.mT
    size = (alike.diagonal(dim1=1, dim2=2) + SHORT).sqrt()
    alike = alike / (size[:, :, None] * size[:, None])
    ways = _ways(weight)
    score = speed.new_zeros(len(speed), len(ways))
    slowest = speed
    for apart in range(1, min(NEAR, bins - 1) + 1):
        # over all bins from one to the other
        slowest = torch.minimum(slowest[:, :-1], speed[:, apart:])
        pairs = alike.diagonal(apart, 1, 2) + slowest
        score = score + pairs @ (ways[:, apart:] * ways[:, :-apart]).T
    return (SHARP * score).softmax(1) @ ways


def _ways(weight):
    """[m, n] of 1 and -1: every way with no, one or two turns; the longer part leads forwards."""
    bins = len(weight)
    at = torch.arange(bins, device=weight.device)
    ways = [torch.ones_like(weight)]
    for turn in range(1, bins):
        for back in range(turn + 1, bins + 1):
            ways.append(1 - 2 * ((at >= turn) & (at < back)).to(weight))
    found = torch.stack(ways)
    return found * torch.where(found @ weight < 0, -1, 1)[:, None]
