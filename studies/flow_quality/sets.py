"""The windows flow is judged on: seeds that guided no choice."""

from scenes.flow_files import FileWindows
from scenes.flow_harsh import HARSH
from scenes.flow_sets import SETS
from scenes.flow_worlds import ALL, WorldWindows
from studies.train_flow.sources import UNSEEN, VALIDATION, Shape

SEED = 77  # of what is judged here: windows that guided no choice


def judged(config, bins):
    """Name -> (source, number of windows)."""
    shape = Shape(64, 64, bins)
    seed = SEED + config.seed
    found = {
        name: (make(shape, seed), config.windows) for name, make in VALIDATION.items() if name != "worlds"
    }
    found["worlds"] = (WorldWindows(ALL, seed=UNSEEN + seed, bins=bins), config.world_windows)
    for name, make in (SETS | HARSH).items():
        found[name] = (make(UNSEEN + seed, bins), config.real_windows)
    if config.middlebury is not None:
        for factor in (1, 3):
            source = FileWindows(config.middlebury, factor, seed=UNSEEN + seed, bins=bins)
            found[f"middlebury_x{factor}"] = (source, config.real_windows)
    return found
