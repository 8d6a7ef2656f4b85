"""Frozen dataclasses that cross junctions: camera rays, event streams, event volumes, flow fields,
windows to learn flow from."""

from dataclasses import dataclass
from typing import Protocol

from torch import Tensor

from codesign.doors import explain


@dataclass(frozen=True)
class Rays:
    """Rays leaving a camera towards the scene, in camera axes (x right, y down, z forward).

    origin_m: [N, 3] metres, relative to the centre of the entrance pupil.
    direction: [N, 3] unit vectors.
    weight: [N] share of the light that passes all apertures, 0 to 1; 0 for a ray that failed.
    irradiance: [N] what an unvignetted ray adds to the irradiance of its image point, relative to
      the axis (for an ideal lens cos^4 of the angle at the film); None where nobody computed it.
    """

    origin_m: Tensor
    direction: Tensor
    weight: Tensor
    irradiance: Tensor | None = None


@dataclass(frozen=True)
class EventStream:
    """A list of events sorted by (t, y, x, p).

    t_us: [N] int64 microseconds. x, y: [N] int64 pixels (column, row). p: [N] int64, +1 ON or -1
      OFF.
    height_px, width_px: size of the sensor the events come from.
    """

    t_us: Tensor
    x: Tensor
    y: Tensor
    p: Tensor
    height_px: int
    width_px: int

    @property
    def in_order(self) -> bool:
        """Whether times never go back; looked at again only where torch has changed them."""
        version = None if self.t_us.is_inference() else self.t_us._version
        known, found = self.__dict__.get("_order", (None, False))
        if version is None or version != known:
            found = not bool((self.t_us[1:] < self.t_us[:-1]).any())
            self.__dict__["_order"] = version, found
        return found

    def __len__(self):
        return int(self.t_us.numel())

    def __repr__(self):
        lasts_ms = 1e-3 * int(self.t_us[-1] - self.t_us[0]) if len(self) else 0.0
        on = int((self.p > 0).sum())
        return f"EventStream({len(self):,} events, {on:,} of them ON, in {lasts_ms:.4g} ms, {self.width_px} x {self.height_px} px)"


@dataclass(frozen=True)
class EventVolume:
    """Event counts on a grid of time bins.

    counts: [B, 2, bins, H, W], ON first; counts per bin, fractional where events are shared between
      bins.
    centroid_s: [bins] mean time of what each bin collects, seconds from the start of the interval.
    collected_s: [bins] time that each bin collects (half a node spacing at the ends); their sum is
      the length of the interval.
    """

    counts: Tensor
    centroid_s: Tensor
    collected_s: Tensor

    def __repr__(self):
        events, lasts_ms = float(self.counts.sum()), 1e3 * float(self.collected_s.sum())
        return f"EventVolume({list(self.counts.shape)}, {events:,.0f} events in {lasts_ms:.4g} ms)"


@dataclass(frozen=True)
class FlowField:
    """Motion of every pixel over one interval.

    flow_px: [B, 2, H, W] pixels per interval, +x right, +y down: where the point seen at the start
      of the interval lies at its end.
    valid: [B, H, W] bool, False where the value means nothing (no ground truth, no events).
    interval_s: length of the interval, seconds.
    confidence: [B, H, W] in 0..1, 0 where nothing was seen, 1 for a flow known exactly; None where
      nobody estimated it.
    covariance_px2: [B, 3, H, W] of the error, px^2: xx, xy, yy; None where nobody estimated it.
    net_share: [B] displacement over the length of the way, 1 for motion that does not turn back,
      about 0 for one that ends where it began; None where nobody looked.
    """

    flow_px: Tensor
    valid: Tensor
    interval_s: float
    confidence: Tensor | None = None
    covariance_px2: Tensor | None = None
    net_share: Tensor | None = None

    def __repr__(self):
        lengths = self.flow_px.detach().norm(dim=1)[self.valid]
        median = f"{float(lengths.median()):.3g} px in the median, " if len(lengths) else ""
        share = float(self.valid.double().mean())
        return f"FlowField({list(self.flow_px.shape)}, {median}{share:.0%} valid, over {1e3 * self.interval_s:.4g} ms)"


@dataclass(frozen=True)
class FlowWindows:
    """A batch to learn flow from, or to judge it on.

    volume: EventVolume of B samples. truth: FlowField of the same interval, on the pixels of its
      start.
    frames: [B, 2, H, W] linear intensity at the start and at the end, 0..255 scale; None where
      there are none.
    start: FlowField with covariance that a network may begin with; None where it makes its own.
    """

    volume: EventVolume
    truth: FlowField
    frames: Tensor | None = None
    start: FlowField | None = None


class PixelGrid(Protocol):
    """The pixels of a film, as render.Film has them."""

    def pixels(self) -> Tensor:
        """Coordinates (x, y) of all pixel centres, [P, 2], in image order."""
        ...


class ChiefRayCamera(Protocol):
    """What placement needs of a camera, as render.Camera has it: pixels, and a ray through each."""

    @property
    def film(self) -> PixelGrid: ...

    def chief_rays(self, pixels: Tensor, /) -> Rays:
        """Rays through the pupil's centre for pixel coordinates [N, 2]: Rays, float64."""
        ...


explain(globals())
