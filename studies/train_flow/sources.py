"""What flow networks are trained on and judged on: mixes of windows made on the fly."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

from codesign.errors import DomainError
from scenes.flow_sensors import Sensors, SensorWindows
from scenes.flow_windows import Draws, RenderedWindows, planes

UNSEEN = 1_000_000  # added to the seed of what networks are judged on


@dataclass(frozen=True)
class Shape:
    """Size of a window."""

    height_px: int
    width_px: int
    bins: int

    def __call__(self, draws, seed, height_px=None, width_px=None):
        """Rendered windows of this size, or of another."""
        return RenderedWindows(
            draws,
            seed=seed,
            height_px=height_px or self.height_px,
            width_px=width_px or self.width_px,
            bins=self.bins,
        )

    def seen_by(self, sensors, draws, seed, side_px=None):
        """Windows of this size, or square ones of another, seen by sensors that all differ."""
        return SensorWindows(
            draws,
            sensors,
            seed=seed,
            height_px=side_px or self.height_px,
            width_px=side_px or self.width_px,
            bins=self.bins,
        )


DENSE = Draws(flow_px=(0.5, 7.0), contrast=(0.8, 1.8), theta=(0.08, 0.25))
FLAT = Draws(motion="similarity", layers=(0, 0), flow_px=(0.0, 7.0), contrast=(0.7, 1.6), theta=(0.08, 0.25))
WIDE = Draws(layers=(1, 4), flow_px=(1.0, 9.0), contrast=(0.8, 1.8), theta=(0.08, 0.25))

LENSES: dict[str, Any] = {"blur_px": (0.0, 1.2), "distortion": (-0.06, 0.06)}
SHORT = Draws(motion="similarity", layers=(0, 0), flow_px=(0.0, 2.5), **LENSES)
PLANES = Draws(motion="similarity", layers=(0, 0), flow_px=(1.0, 7.0), **LENSES)
DEPTHS = Draws(layers=(0, 3), flow_px=(0.5, 8.0), **LENSES)
SHORT_DEPTHS = Draws(layers=(1, 4), flow_px=(0.2, 3.0), **LENSES)
FAST_DEPTHS = Draws(layers=(0, 3), flow_px=(1.0, 10.0), **LENSES)
STIFF = Sensors()
BENDING = Sensors(bend=0.4)


def real(shape, seed):
    """Windows as real sensors give them: planes, layers that bend, short and long flows; and a third as ideal ones
    do."""
    return [
        (0.12, shape.seen_by(STIFF, SHORT, seed)),
        (0.08, shape.seen_by(STIFF, PLANES, seed + 1)),
        (0.22, shape.seen_by(BENDING, DEPTHS, seed + 2)),
        (0.08, shape.seen_by(BENDING, SHORT_DEPTHS, seed + 3)),
        (0.15, shape.seen_by(BENDING, FAST_DEPTHS, seed + 4, 96)),
        (0.2, shape(DENSE, seed + 5)),
        (0.1, shape(FLAT, seed + 6)),
        (0.05, shape(WIDE, seed + 7, 96, 96)),
    ]


TRAINING: dict[str, Callable[[Shape, int], list]] = {
    "delivered": lambda shape, seed: [
        (0.55, shape(DENSE, seed)),
        (0.25, shape(FLAT, seed + 1)),
        (0.2, shape(WIDE, seed + 2, 96, 96)),
    ],
    "real": real,
    "layers": lambda shape, seed: [(1.0, shape(Draws(), seed))],
    "planes": lambda shape, seed: [(1.0, shape(Draws(layers=(0, 0)), seed))],
}
"""Name -> function (shape, seed) -> list of (share of the batches, source)."""

VALIDATION: dict[str, Callable[[Shape, int], Any]] = {
    "fine_theta_0.1": lambda shape, seed: shape(planes("fine", 0.1), seed + UNSEEN),
    "fine_theta_0.2": lambda shape, seed: shape(planes("fine", 0.2), seed + UNSEEN),
    "mixed_theta_0.1": lambda shape, seed: shape(planes("mixed", 0.1), seed + UNSEEN),
    "mixed_theta_0.2": lambda shape, seed: shape(planes("mixed", 0.2), seed + UNSEEN),
    "layers": lambda shape, seed: shape(replace(DENSE, textures="mixed", layers=(1, 3)), seed + UNSEEN),
}
"""Name -> function (shape, seed) -> source; textures and seeds that no training mix uses."""


def training_parts(name, shape, seed):
    """The mix called ``name``.

    Raises: DomainError for an unknown name.
    """
    if name not in TRAINING:
        raise DomainError(f"--mix {name} is unknown; choose one of {', '.join(TRAINING)}.")
    return TRAINING[name](shape, seed)
