"""What a pair is asked before anything is optimised: numbers out of errors per sample."""

import itertools
import math
from dataclasses import dataclass, fields, replace

import torch
from torch import Tensor

from codesign.mount import scene_depth
from scenes.robot_pair import FRAMES, PITCH_MM, Design, Drives, RobotPair

VARIABLES = ("efl_mm", "focus_per_m", "z_m", "pitch_rad")
PLANES = tuple(itertools.combinations(VARIABLES, 2))
MARGIN = 0.05  # of its range that a default keeps from its bounds
LEAST_BLUR_PX = 4.0
LEAST_FACTOR = 1.5
APART = 0.1  # of two designs that have to be told from each other
PAIRED = (1.04, 1.25)  # ratio of errors of those whose differences are looked at
DRAWN = 96
LEAST_RIGHT = 0.95


def odds(mean: Tensor) -> Tensor:
    """The error, in units of the task, that all samples would have at a mean bounded one."""
    return (mean / (1 - mean)).sqrt()


def typical(bounded: Tensor) -> float:
    """The same of samples."""
    return float(odds(bounded.mean()))


def level(pair: RobotPair, name: str, share: float) -> float:
    """A value of a variable: from its lower bound at -1 over the default at 0 to its upper bound at 1; focal lengths
    by their logarithm."""
    low, start, high = (getattr(each, name) for each in (pair.low, pair.design, pair.high))
    end = high if share > 0 else low
    if name == "efl_mm":
        return start * (end / start) ** abs(share)
    return start + (end - start) * abs(share)


def shifted(pair: RobotPair, **shares: float) -> Design:
    """The default design with some variables moved, see ``level``."""
    return replace(pair.design, **{name: level(pair, name, share) for name, share in shares.items()})


def margin(pair: RobotPair) -> float:
    """Least distance of the default from its bounds, of their range; variables that are held are left out."""
    shares = []
    for field in fields(Design):
        low, start, high = (getattr(each, field.name) for each in (pair.low, pair.design, pair.high))
        if low < high:
            shares.append(min(start - low, high - start) / (high - low))
    return min(shares)


def blur_px(pair: RobotPair, batch: Drives) -> Tensor:
    """Diameters of the blur disc at the default design, px: [N, P] over every fourth pixel of every drive, NaN where
    nothing stands still. In closed form, of a thin lens."""
    camera = pair.design.camera()
    height, width = camera.film.shape[-2:]
    pixels = camera.film.pixels().reshape(-1, height, width, 2)[:, ::4, ::4].reshape(-1, 2)
    poses = batch.T_world_body[..., FRAMES // 2, :, :].flatten(0, 1) @ pair.design.mount()
    with torch.no_grad():
        depth_m = scene_depth(camera, pixels.expand(len(poses), -1, 2), poses, batch.scene)
        lens = camera.lens
        away = 1 - lens.image_distance_mm * (1 / lens.efl_mm - 1e-3 / depth_m)
        disc = lens.entrance_pupil_diameter_mm * away.abs() / PITCH_MM
    return torch.where(depth_m.isfinite(), disc, torch.nan)


@dataclass(frozen=True)
class Blur:
    """Diameters of blur discs over the view, px. smallest, largest: second and ninety-eighth percentile over all
    drives. frame: median over the drives of what they span within one frame."""

    smallest: float
    largest: float
    frame: float


def blur_over(discs: Tensor) -> Blur:
    """Summary of ``blur_px``."""
    levels = torch.tensor([0.02, 0.98], dtype=discs.dtype)
    smallest, largest = torch.nanquantile(discs, levels).tolist()
    ends = torch.nanquantile(discs, levels, dim=1)
    return Blur(smallest, largest, float((ends[1] - ends[0]).nanmedian()))


def farther(pair: RobotPair, name: str) -> float:
    """-1 or 1: the side of the default on which a variable has more room."""
    low, start, high = (level(pair, name, share) for share in (-1.0, 0.0, 1.0))
    return 1.0 if high - start > start - low else -1.0


def terms(at: Tensor) -> Tensor:
    """Terms [D, 1 + V + V (V + 1) / 2] of a second-order polynomial at [D, V]."""
    columns = [torch.ones_like(at[:, 0]), *at.T]
    columns += [at[:, i] * at[:, j] for i in range(at.shape[1]) for j in range(i, at.shape[1])]
    return torch.stack(columns, 1)


def fit(at: Tensor, errors: Tensor) -> Tensor:
    """Coefficients [terms, K] of the logarithms of errors [D, K] of designs at [D, V], by least squares."""
    return torch.linalg.lstsq(terms(at), errors.log()).solution


def surface(coefficients: Tensor, at: Tensor) -> Tensor:
    """Errors [D, K] by ``fit`` at [D, V]."""
    return (terms(at) @ coefficients).exp()


def plane(names: tuple[str, str], reach: float, count: int) -> Tensor:
    """Places [count^2, V] over two of VARIABLES, the first going slowest."""
    along = torch.linspace(-reach, reach, count, dtype=torch.float64)
    at = torch.zeros(count, count, len(VARIABLES), dtype=torch.float64)
    at[:, :, VARIABLES.index(names[0])] = along[:, None]
    at[:, :, VARIABLES.index(names[1])] = along
    return at.reshape(-1, len(VARIABLES))


def spread(errors: Tensor) -> Tensor:
    """Ninetieth over tenth percentile [K] of the errors [D, K] of a landscape."""
    low, high = torch.quantile(errors, torch.tensor([0.1, 0.9], dtype=errors.dtype), dim=0)
    return high / low


@dataclass(frozen=True)
class Ranking:
    """How surely samples rank two designs. ratio: of their errors. right: share of draws of DRAWN samples that rank
    them as all samples do. expected: the share for two designs APART that differ from sample to sample as these."""

    ratio: float
    right: float
    expected: float


def ranking(first: Tensor, second: Tensor, generator: torch.Generator, draws: int = 2000) -> Ranking:
    """Ranking of two designs by bounded errors [worlds, motions] of the same drives; worlds are drawn whole, since
    their drives are spread evenly over speeds and turns."""
    worlds, motions = first.shape
    count = max(1, round(DRAWN / motions))
    difference = (second - first).mean(1)
    picked = torch.randint(worlds, (draws, count), generator=generator)
    side = torch.sign(difference.mean())
    right = float((difference[picked].mean(1) * side > 0).double().mean())
    middle = (typical(first) * typical(second)) ** 0.5
    low, high = (middle * (1 + APART) ** half for half in (-0.5, 0.5))
    step = high**2 / (1 + high**2) - low**2 / (1 + low**2)
    deviation = float(difference.std()) / math.sqrt(DRAWN / motions)
    sure = step / deviation if deviation > 0 else math.inf
    expected = 0.5 * (1 + math.erf(sure / math.sqrt(2)))
    ratio = typical(second) / typical(first)
    return Ranking(max(ratio, 1 / ratio), right, expected)
