"""Images of warped events: each event moves along the flow to one time, and a flow that is right
makes the image sharp.

Time runs from 0 at the start of the window to 1 at its end. An event at pixel x and time tau lies
at x + (at
- tau) flow at time ``at``. Its flow is that of its own pixel (``carry_steps=0``, what the
literature does), or, since a FlowField lives on the pixels of the window's start, that of the pixel
it came from: x0 = x - tau flow(x0), by fixed-point steps from x0 = x, bilinear between pixels. Each
step leaves an error one order higher in the slope of the flow.
"""

import itertools
import math
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import conv2d

from codesign.checks import check, check_kind, check_number, check_whole
from codesign.errors import DomainError, ShapeError
from codesign.events.stream import check_stream
from codesign.flow.checks import MOST_SIDE_PX, MOST_STEPS, check_flow, check_volume
from codesign.flow.warp import pixel_grid, read_at
from codesign.types import EventStream, EventVolume

LATEST_US = 2**60


@dataclass(frozen=True)
class EventTracks:
    """Events (or contents of bins) with the straight lines they move along.

    x_px, y_px: [N] pixel where each was seen. time: [N] when, as a share of the window. count:
      [B, 2, N] how many, ON first.
    flow_px: [B, 2, N] pixels per window. height_px, width_px: size of the sensor.
    """

    x_px: Tensor
    y_px: Tensor
    time: Tensor
    count: Tensor
    flow_px: Tensor
    height_px: int
    width_px: int

    def __post_init__(self) -> None:
        """Raises: DomainError, ShapeError unless the parts fit each other."""
        for name in ("height_px", "width_px"):
            check_whole(check_kind(getattr(self, name), int, name), name, 1, MOST_SIDE_PX)
        sizes: dict[str, int] = {}
        for name in ("flow_px", "count"):
            check(getattr(self, name), "B 2 N", f"{name} of the tracks", sizes=sizes)
        for name in ("x_px", "y_px", "time"):
            check(getattr(self, name), "N", f"{name} of the tracks", sizes=sizes)

    def positions(self, at: float | Tensor) -> tuple[Tensor, Tensor]:
        """Places (x, y), [B, N] each, at the time ``at``."""
        moved = (_number(at) - self.time) * self.flow_px
        return self.x_px + moved[:, 0], self.y_px + moved[:, 1]


def volume_tracks(volume: EventVolume, flow_px: Tensor, carry_steps: int = 0) -> EventTracks:
    """Tracks of the contents of an event volume, each bin at its centroid.

    Args:
      volume: EventVolume, counts [B, 2, bins, H, W].
      flow_px: [B, 2, H, W] pixels per window, on the pixels of its start.
      carry_steps: fixed-point steps that look for the start of each track; 0 takes the flow of the
        pixel where the event is.
    Returns: EventTracks of N = bins H W.
    Gradient: counts and flow_px.
    Raises: ShapeError; DomainError for a flow that is not finite.
    """
    counts = check_volume(volume)
    batch, _, bins, height, width = counts.shape
    flow = _entered(flow_px, (batch, 2, height, width))
    time = volume_times(volume, flow)
    x, y = pixel_grid(height, width, flow)
    x, y, time = (
        values.expand(bins, height, width).flatten() for values in (x, y, time[:, None, None])
    )
    own = flow[:, :, None].expand(batch, 2, bins, height, width).flatten(2)
    return EventTracks(
        x, y, time, counts.flatten(2), _carried(flow, own, x, y, time, carry_steps), height, width
    )


def volume_times(volume: EventVolume, like: Tensor) -> Tensor:
    """[bins] centroids as shares of the window, in the type of ``like``."""
    return (volume.centroid_s / volume.collected_s.sum()).to(like)


def stream_tracks(
    stream: EventStream, flow_px: Tensor, t0_us: int, t1_us: int, carry_steps: int = 0
) -> EventTracks:
    """Tracks of the single events from t0 to t1, both included, at their time stamps.

    Args:
      stream: EventStream.
      flow_px: [2, H, W] or [1, 2, H, W] pixels from t0 to t1.
      t0_us, t1_us: whole microseconds.
      carry_steps: as in volume_tracks.
    Returns: EventTracks of B = 1.
    Gradient: flow_px.
    Raises: ShapeError; DomainError for an empty interval, an interval without events, or a flow
      that is not finite.
    """
    check_stream(stream)
    t0_us, t1_us = (
        check_whole(end, f"{name} (whole microseconds)", None)
        for end, name in ((t0_us, "t0_us"), (t1_us, "t1_us"))
    )
    if not -LATEST_US < t0_us < t1_us < LATEST_US:
        raise DomainError(
            f"the interval is {t0_us} to {t1_us} us; t1 > t0, both within 2^60 us, are needed."
        )
    check(flow_px, "...>=0", "the flow of these events")
    flow = _entered(
        flow_px if flow_px.ndim == 4 else flow_px[None], (1, 2, stream.height_px, stream.width_px)
    )
    first, last = torch.searchsorted(
        stream.t_us, torch.tensor([int(t0_us), int(t1_us) + 1], device=stream.t_us.device)
    ).tolist()
    if first == last:
        raise DomainError(
            f"no event lies between {t0_us} and {t1_us} us, so there is nothing to warp; choose an interval "
            "with events."
        )
    t_us, x, y, p = (
        column[first:last].to(flow.device) for column in (stream.t_us, stream.x, stream.y, stream.p)
    )
    time = ((t_us - int(t0_us)).double() / (int(t1_us) - int(t0_us))).to(flow)
    count = torch.stack([p > 0, p < 0])[None].to(flow)
    own = flow[:, :, y, x]
    x = x.to(flow)
    y = y.to(flow)
    return EventTracks(
        x,
        y,
        time,
        count,
        _carried(flow, own, x, y, time, carry_steps),
        stream.height_px,
        stream.width_px,
    )


def count_image(tracks: EventTracks, at: float | Tensor) -> Tensor:
    """Image [B, 2, H, W] of the events moved to the time ``at``, each shared between the four
    pixels around it in proportion to its nearness.

    A share that falls on no pixel is lost. Gradient: counts and flow; piecewise smooth, with a kink
    where an event crosses the centre line of a pixel.
    """
    x, y = check_kind(tracks, EventTracks, "the tracks").positions(at)
    left = x.detach().floor()
    top = y.detach().floor()
    right = x - left
    down = y - top
    corners = (
        (0, 0, (1 - right) * (1 - down)),
        (1, 0, right * (1 - down)),
        (0, 1, (1 - right) * down),
        (1, 1, right * down),
    )
    parts = ((step_x, step_y, tracks.count * share[:, None]) for step_x, step_y, share in corners)
    return _gathered(tracks, left.long(), top.long(), parts)


def nearest_images(tracks: EventTracks, at: float | Tensor) -> tuple[Tensor, Tensor]:
    """Counts and mean times, [B, 2, H, W] each, with every event on the pixel nearest to it (a tie
    goes right and down). Gradient: none in the flow."""
    check_kind(tracks, EventTracks, "the tracks")
    column, row = (torch.floor(value.detach() + 0.5).long() for value in tracks.positions(at))
    counts, sums = (
        _gathered(tracks, column, row, [(0, 0, value)])
        for value in (tracks.count, tracks.count * tracks.time)
    )
    empty = counts == 0
    return counts, torch.where(empty, 0.0, sums / torch.where(empty, 1.0, counts))


def smooth_image(tracks: EventTracks, at: float | Tensor, weight: Tensor | None = None) -> Tensor:
    """Like count_image, with each event spread over the nine pixels around it by the quadratic
    B-spline (Gaussian-like, variance 1/4 px^2).

    The spread is alike wherever an event falls, so the image is no sharper for whole-pixel motion
    (bilinear shares have a variance between 0 and 1/4), and its gradient has no jumps. weight:
    [B, N] factor per event, or None. Gradient: counts, flow and weight; continuous.
    """
    x, y = check_kind(tracks, EventTracks, "the tracks").positions(at)
    column, row = (value.detach().add(0.5).floor() for value in (x, y))
    share_x = _spline(x - column)
    share_y = _spline(y - row)
    count = tracks.count if weight is None else tracks.count * weight[:, None]
    cells = itertools.product(range(3), range(3))
    parts = ((i - 1, k - 1, count * (share_x[i] * share_y[k])[:, None]) for i, k in cells)
    return _gathered(tracks, column.long(), row.long(), parts)


def still_image(counts: Tensor) -> Tensor:
    """What smooth_image gives at zero flow, for counts [B, 2, bins, H, W], much faster."""
    image = counts.sum(2)
    shares = counts.new_tensor([0.125, 0.75, 0.125])  # of the B-spline at offset 0
    kernel = torch.outer(shares, shares)[None, None]
    return conv2d(image.flatten(0, 1)[:, None], kernel, padding=1).reshape(image.shape)


def warp_jacobian(
    tracks: EventTracks, bins: int, at: float | Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Jacobian of the warp to the time ``at`` at each pixel of each bin of a volume, by central
    differences over the flow of its tracks.

    Returns: dx'/dx, dx'/dy, dy'/dx, dy'/dy, [B, bins, H, W] each. Gradient: flow. Raises:
      ShapeError for images less than 2 pixels high or wide.
    """
    check_kind(tracks, EventTracks, "the tracks")
    shape = (check_whole(bins, "bins", 1), tracks.height_px, tracks.width_px)
    if math.prod(shape) != tracks.flow_px.shape[2]:
        raise ShapeError(
            f"the tracks are {tracks.flow_px.shape[2]}, not the {' x '.join(map(str, shape))} of a volume with {bins} "
            "bins; make them with volume_tracks."
        )
    if min(shape[1:]) < 2:
        raise ShapeError(
            f"an image of {shape[1]} x {shape[2]} pixels has no slope of the flow; at least 2 x 2 are needed."
        )
    by_y, by_x = torch.gradient(tracks.flow_px.unflatten(2, shape), dim=(3, 4))
    span = _number(at) - tracks.time.reshape(1, *shape)
    return 1 + span * by_x[:, 0], span * by_y[:, 0], span * by_x[:, 1], 1 + span * by_y[:, 1]


def area_change(jacobian: tuple[Tensor, Tensor, Tensor, Tensor]) -> Tensor:
    """Factor by which a warp with this Jacobian changes a small area; negative where it folds over.

    Source: Shiba, Aoki, Gallego, Event collapse in contrast maximization frameworks, Sensors 2022,
      sec. 3.4.2.
    """
    xx, xy, yx, yy = jacobian
    return xx * yy - xy * yx


def sharpness(image: Tensor) -> Tensor:
    """Mean squared slope of the image, both polarities added.

    Args:
      image: [B, 2, H, W] counts.
    Returns: [B] (events per pixel)^2 per px^2, by differences of neighbours.
    Gradient: image.
    Source: Gallego et al., Focus is all you need, CVPR 2019.
    """
    down, across = (image.diff(dim=axis).square().mean((2, 3)).sum(1) for axis in (2, 3))
    return down + across


def _spline(offset):
    """Shares of the pixel before, the nearest and the one after, at an offset of -1/2 to 1/2 from
    the nearest."""
    return (0.5 - offset).square() / 2, 0.75 - offset.square(), (0.5 + offset).square() / 2


def _number(at):
    """A time that tracks are moved to, or times that fit them."""
    return at if isinstance(at, Tensor) else check_number(at, "the time the events are moved to")


def _entered(flow_px, shape):
    # places in half precision would be half a pixel off
    return check_flow(flow_px, shape, "the flow of these events").to(
        torch.promote_types(flow_px.dtype, torch.float32)
    )


def _carried(flow, own, x, y, time, steps):
    """Flow [B, 2, N] of the tracks that pass (x, y) at a time."""
    steps = check_whole(steps, "carry_steps", 0, MOST_STEPS)
    found = own
    for _ in range(steps):
        start = torch.stack([x, y]) - time * found
        found = read_at(flow, start[:, :, None])[:, :, 0]
    return found


def _gathered(tracks, column, row, parts):
    """Sums on the pixels [B, 2, H, W] of parts (step right, step down, values [B, 2, N]), steps
    from -1 to 1 from whole pixels [B, N].

    What is outside falls on a margin that is cut off: places beyond are held two pixels from the
    image, so that no step leads back to it.
    """
    height = tracks.height_px
    width = tracks.width_px
    margin = 3
    padded_width = width + 2 * margin
    cell = (
        (row.clamp(-2, height + 1) + margin) * padded_width + column.clamp(-2, width + 1) + margin
    )
    image = torch.zeros(
        *tracks.count.shape[:2],
        (height + 2 * margin) * padded_width,
        dtype=torch.result_type(tracks.count, tracks.flow_px),
        device=cell.device,
    )
    for step_x, step_y, values in parts:
        image = image.scatter_add(
            2,
            (cell + (step_y * padded_width + step_x))[:, None].expand_as(values),
            values.to(image.dtype),
        )
    return image.unflatten(2, (height + 2 * margin, padded_width))[
        ..., margin:-margin, margin:-margin
    ]
