"""A whole design in one vector: lens, mount, sensor and estimator of a robot's camera, as shares
0..1 of their bounds."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property, lru_cache, partial
from types import MappingProxyType
from typing import Any

import torch
from torch import Tensor, nn

from codesign import events, flow, lens, render
from codesign.errors import DomainError
from scenes.robots import pair as robot_pair
from scenes.robots.costs import Costs, Exposed
from scenes.robots.own import own_pair
from scenes.robots.pair import Design, RobotPair
from scenes.robots.pairs import PAIRS

BLOCKS: dict[str, tuple[str, ...]] = {
    "lens": ("efl_mm", "fno", "focus_per_m", "bending"),
    "mount": ("x_m", "z_m", "pitch_rad"),
    "sensor": ("theta", "cutoff_hz"),
    "network": ("prior_px",),
}
# what is designed in one go
PARTS = {
    "lens": BLOCKS["lens"],
    "mount": BLOCKS["mount"],
    "read-out": BLOCKS["sensor"] + BLOCKS["network"],
}
# of which equal steps are equal ratios
LOGARITHMIC = ("efl_mm", "fno", "theta", "cutoff_hz", "prior_px")
# where a pair says nothing, or holds what is free here
BOUNDS = {
    "efl_mm": (2.5, 12.0),
    "focus_per_m": (0.0, 8.0),
    "fno": (1.2, 8.0),
    "bending": (-1.0, 1.0),
    "theta": (0.08, 0.6),
    "cutoff_hz": (30.0, 1500.0),
    "prior_px": (1.0, 16.0),
}
DEFAULTS = {
    "theta": robot_pair.SENSOR.theta_on,
    "cutoff_hz": robot_pair.SENSOR.cutoff_hz,
    "prior_px": robot_pair.PRIOR_PX,
}
WINDOWS = len(robot_pair.LEFTS_PX) * len(robot_pair.TOPS_PX)
OF_SENSOR = (
    WINDOWS * robot_pair.WINDOW_PX**2 / math.prod(robot_pair.SENSOR_PX)
)  # share of its pixels in the windows


@dataclass(frozen=True)
class Space:
    """Whole designs of a robot's camera.

    pair: robot, worlds and drives, behind a thin lens or the traced ones of a family. costs: what a
      design pays.
    free: names of the numbers that shares are of, all of BLOCKS that its lens has and that have
      room when left out; the others are held as the pair's own design, or ``held``, has them.
      bounds: name -> (low, high), in place of those of the pair or of BOUNDS.
    Raises: DomainError for a name that is unknown or bounds that leave out the held design.

    >>> space = Space.of("outdoors", None)
    >>> round(space.numbers(space.start)["efl_mm"], 6)
    6.5
    """

    pair: RobotPair
    costs: Costs = field(default_factory=Costs)
    free: tuple[str, ...] = ()
    held: Mapping[str, float] = field(default_factory=dict)
    bounds: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    rays_per_px: int = robot_pair.RAYS_PER_PX

    def __post_init__(self) -> None:
        known = [name for names in BLOCKS.values() for name in names]
        if not self.free:
            own = [
                name
                for name in known
                if name not in self.held and (name != "bending" or self.pair.family)
            ]
            roomy = [name for name in own if name in self.bounds or self._has_room(name)]
            object.__setattr__(self, "free", tuple(roomy))
        if len(set(self.free)) < len(self.free):
            raise DomainError(f"free are {', '.join(self.free)}; give each number once.")
        for name in (*self.free, *self.held, *self.bounds):
            if name not in known:
                raise DomainError(f"a design has no number '{name}'; there are {', '.join(known)}.")
        if "bending" in (*self.free, *self.held) and not self.pair.family:
            raise DomainError(
                "a thin lens has no bending; give a family of traced lenses, or leave bending out."
            )
        for name, value in self.held.items():
            low, high = self.limits(name)
            if name in self.free or not low <= value <= high:
                raise DomainError(
                    f"{name} is to be held at {value:g}; give a value within {low:g} to {high:g} of a number that is not free."
                )
        for name in self.free:
            low, high = self.limits(name)
            if not low < high:
                raise DomainError(
                    f"{name} is free between {low:g} and {high:g}; give it room, or hold it."
                )
            if not low <= self.default[name] <= high:
                raise DomainError(
                    f"{name} starts at {self.default[name]:g}, outside its bounds, {low:g} to {high:g}."
                )

    @staticmethod
    def of(
        pair: str,
        family: str | None,
        light: float = 1.0,
        speed: float = 1.0,
        free: Sequence[str] = (),
        held: Mapping[str, float] = MappingProxyType({}),
    ) -> "Space":
        """By names: of one of the three pairs or of an own robot's page (.yaml), behind a thin lens
        for None, in a share of daylight, at a share of the drives' speed.

        Raises: DomainError for shares outside 0 to 1, and what Space refuses."""
        for name, share in (("light", light), ("speed", speed)):
            if not 0 < share <= 1:
                raise DomainError(f"{name} is {share:g}; a share above 0 and at most 1 is needed.")
        found = PAIRS[pair]() if pair in PAIRS else own_pair(pair)
        if speed != 1:
            found = robot_pair.slowed(found, speed)
        return Space(replace(found, family=family), Costs(light=light), tuple(free), held)

    @cached_property
    def default(self) -> dict[str, float]:
        """The pair's own design, as near as its family of lenses comes to it."""
        own = {**vars(self.pair.design), **DEFAULTS}
        for name, (low, high) in self._reach.items():
            own[name] = min(max(own[name], low), high)
        return {**own, **self.held}

    @cached_property
    def _reach(self):
        if not self.pair.family:
            return {}
        family = lens.family(self.pair.family)
        shortest, longest = family.efl_mm[[0, -1]].tolist()
        return {"efl_mm": (shortest, longest), "fno": family.fno}

    def limits(self, name: str) -> tuple[float, float]:
        """Bounds of a number; of a lens no wider than its family's."""
        if name in self.bounds:
            return self.bounds[name]
        low, high = (getattr(each, name, None) for each in (self.pair.low, self.pair.high))
        if name in BOUNDS and low == high:
            low, high = BOUNDS[name]
        reach = self._reach.get(name)
        return (max(low, reach[0]), min(high, reach[1])) if reach else (low, high)

    def part(self, name: str) -> list[int]:
        """Places of a part's numbers (PARTS) among those that are free."""
        return [self.free.index(each) for each in PARTS[name] if each in self.free]

    def _has_room(self, name):
        low, high = self.limits(name)
        return low < high

    def block(self, name: str) -> list[int]:
        """Places of a block's numbers among those that are free."""
        return [self.free.index(each) for each in BLOCKS[name] if each in self.free]

    def numbers(self, share: Tensor) -> dict[str, float]:
        """All numbers of a design by name, from the shares [V] of those that are free."""
        found = dict(self.default)
        for name, each in zip(self.free, share.tolist(), strict=True):
            low, high = self.limits(name)
            if name in LOGARITHMIC:
                found[name] = math.exp(math.log(low) + each * math.log(high / low))
            else:
                found[name] = low + each * (high - low)
        return found

    def share(self, **numbers: float) -> Tensor:
        """Shares [V] of a design; what is not given is as the pair has it. Raises: DomainError out
        of bounds."""
        every = {**self.default, **numbers}
        found = []
        for name in self.free:
            low, high = self.limits(name)
            value = every[name]
            if not low <= value <= high:
                raise DomainError(
                    f"{name} = {value:g} lies outside its bounds, {low:g} to {high:g}."
                )
            if name in LOGARITHMIC:
                found.append(math.log(value / low) / math.log(high / low))
            else:
                found.append((value - low) / (high - low))
        return torch.tensor(found, dtype=torch.float64)

    @property
    def start(self) -> Tensor:
        """Shares [V] of the pair's own design."""
        return self.share()

    def made(self, share: Tensor) -> "Whole":
        """The design of shares [V], ready to be put into a system."""
        return Whole(self, self.numbers(share.clamp(0, 1)))


@dataclass(frozen=True)
class Whole:
    """One whole design: camera, pose on the body, event stage and estimator."""

    space: Space
    numbers: Mapping[str, float]

    @cached_property
    def camera(self) -> render.Camera:
        """Nine windows behind its lens; a traced one's image is darker towards the corners."""
        made = self.space.pair.camera(self.design)
        size, rays = robot_pair.WINDOW_PX, self.space.rays_per_px
        dark = self.space.pair.family is not None
        return render.Camera(
            made.lens, size, size, robot_pair.PITCH_MM, rays, 0, robot_pair.FILM, falloff=dark
        )

    @cached_property
    def design(self) -> Design:
        """Lens and mount, as the pair says them."""
        return Design(**{each.name: self.numbers[each.name] for each in fields(Design)})

    @cached_property
    def T_body_cam(self) -> Tensor:
        """[4, 4]."""
        return self.design.mount()

    @cached_property
    def sensor(self) -> events.SensorModel:
        """At its threshold and bandwidth, with the noise that they bring."""
        return self.space.costs.sensor(
            robot_pair.SENSOR, self.numbers["theta"], self.numbers["cutoff_hz"]
        )

    def events(self, kind: str, bins: int = robot_pair.BINS) -> nn.Module:
        """Event stage: "memory" (hard counts) or "sensor" (single events, in so many bins)."""
        costs = self.space.costs
        if kind == "sensor":
            stage: nn.Module = events.HardSensor(self.sensor, bins, robot_pair.LEAD_S)
        else:
            stage = _memory(self.sensor)
        most = costs.bus_hz * robot_pair.DURATION_S * OF_SENSOR
        return Exposed(stage, costs.gain(self.numbers["fno"]), most, WINDOWS)

    @property
    def flow(self) -> Callable[..., Any]:
        """Affine flow of each window by its prior."""
        return partial(flow.estimate_lk, model="affine", prior_px=self.numbers["prior_px"])

    def with_numbers(self, **numbers: float) -> "Whole":
        """The same design with other numbers, bounds or not."""
        other = replace(self, numbers={**self.numbers, **numbers})
        for block, made in (("lens", "camera"), ("mount", "T_body_cam")):
            if not set(numbers) & set(BLOCKS[block]):
                vars(other)[made] = getattr(self, made)  # as cached there
        return other

    def __str__(self) -> str:
        of = self.numbers
        return (
            f"{of['efl_mm']:.2f} mm f/{of['fno']:.2f} focused at {of['focus_per_m']:.2f} / m, x {of['x_m']:.3f} z "
            f"{of['z_m']:.3f} m pitch {math.degrees(of['pitch_rad']):.1f} deg, theta {of['theta']:.3f}, "
            f"{of['cutoff_hz']:.0f} Hz, prior {of['prior_px']:.1f} px"
        )


@lru_cache(maxsize=4)
def _memory(sensor):
    """One stage for all designs of a sensor: it remembers the noise that it drew last."""
    return events.Settled(events.layer("memory", sensor, learn=()), robot_pair.LEAD_S)
