"""Curves at which radiance may jump, as seen from a point: straight edges, rims, and the outlines
of spheres and cylinders.

A curve is cut into pieces [s0, s1] of its parameter; a piece becomes a point of the world once a
parameter and a viewpoint are given. ``aside_rad`` says how far to either side of the true curve the
radiances before and behind it are read, ``counts`` whether the curve is one from a place of the
pupil, and ``face_slope`` how steeply the faces on both its sides are seen.

Rays are cast in float32. Mitsuba finds a sphere or cylinder of radius r at distance d by the sign
of b^2 - 4 a c, of size (r / d)^2 of its terms; an error of one part in 2^23 of these moves the edge
by 2^-23 d / r rad. Measured by bisection at d / r from 1.2 to 5000, coordinates up to 100 m from
the origin: at most 1.05 times that for both, and 2^-23 times coordinate over distance where that is
larger (cylinders, whose matrix is inverted in float32). A straight edge moves by 2^-23 times 2 or
less times the distance of its furthest end over that of the ray's point. Readings lie at twice
that, never deeper in the shape than half its radius; where the edge itself may lie there
(beyond some 2,000 radii) the curve is refused.
"""

from dataclasses import dataclass, fields
from typing import Any

import torch
from torch import Tensor

from codesign.errors import DomainError

ASIDE_RAD = 1e-5  # of round curves; rays through a float32 lens are good to a tenth of that
STRAIGHT_RAD = 3e-6  # of straight edges, near whose corners a wider reading would see the next edge
EPS = 2.0**-23
SAFETY = 2.0
DEEPEST = 0.5  # share of the radius seen at which the reading inside a curved shape lies at most
LONG = 2.0  # units in the last place by which a straight edge moves per share of its furthest end
ROUND = 96  # pieces of a full circle
PARTS = 16  # parts of a cylinder's length that tell their own distance
# cosine of the view below which a piece is left out: it runs along the outline, which is listed
GRAZING = 0.05


class Curve:
    """A curve that counts from everywhere, with nothing known of the surfaces beside it."""

    def counts(self, index: Tensor, y: Tensor, viewpoint: Tensor) -> Tensor:
        """Whether [n] the curves ``index`` [n] are any at their points y [n, 3] from the viewpoint
        [n, 3]
        itself: next to an outline lie edges that are one from elsewhere in the pupil, and would be
          counted with it."""
        return torch.ones_like(index, dtype=torch.bool)

    def face_slope(self, index: Tensor, y: Tensor, viewpoint: Tensor) -> Tensor:
        """Tangent [n] of the angle between view and normal of the steeper of the faces on both
        sides of points y [n, 3], where both are seen: a reading from farther away than they lie has
        missed them. Infinite elsewhere."""
        return torch.full(index.shape, torch.inf, dtype=torch.float64)

    def apex_m(self, index: Tensor) -> Tensor:
        """Third corners [n, 2, 3] of the triangles on both sides of the curves ``index`` [n], NaN
        where there are none."""
        return torch.full((*index.shape, 2, 3), torch.nan, dtype=torch.float64)


@dataclass(frozen=True)
class Segments(Curve):
    """Straight edges. start, end: [E, 3]. normals: [E, 2, 3] of the two faces, on the side that
    shines, 0 where none is known; always: [E] bool, True where it counts from every side but that
    from which both faces are black (rims, seams, sharp creases). width_m: [E], how far apart edges
    lie that count as this one.
    apexes: [E, 2, 3], third corners of the two faces, NaN for none."""

    start: Tensor
    end: Tensor
    normals: Tensor
    always: Tensor
    width_m: Tensor
    apexes: Tensor

    @classmethod
    def of(cls, edges):
        """Segments of Edges, arrays that are named as its own."""
        return cls(*(torch.tensor(getattr(edges, field.name)) for field in fields(cls)))

    def pieces(self, viewpoint, angle, within_m=0.0):
        """Indices and parameters [n], [n, 2] of pieces that subtend at most ``angle`` from the
        viewpoint [3] and may be outlines from there or from a place at most ``within_m`` away."""
        facing = self._facing(slice(None), viewpoint)
        outline = (facing.amin(1) <= within_m) & (facing.amax(1) >= -within_m)
        black = (facing < -within_m).all(1)
        kept = torch.nonzero((self.always | outline) & ~black)[:, 0]
        return cut_line(self, kept, viewpoint, angle)

    def counts(self, index, y, viewpoint):
        """As for Curve."""
        facing = self._facing(index, viewpoint)
        outline = (facing.amin(1) <= 0) & (facing.amax(1) >= 0)
        return (self.always[index] | outline) & ~(facing < 0).all(1)

    def _facing(self, index, viewpoint):
        """Height [n, 2] of the viewpoint over both faces, metres."""
        return (self.normals[index] * (viewpoint - self.start[index])[:, None]).sum(2)

    def points(self, index, s, viewpoint):
        """Points [n, 3] of the curves ``index`` [n] at parameters s [n]."""
        return on_line(self, index, s)

    def aside_rad(self, index, viewpoint):
        """Angle [n] from the viewpoint [3] or [n, 3] at which radiances beside the curves ``index``
        [n] are read."""
        start = self.start[index]
        end = self.end[index]
        a = start - viewpoint
        b = end - viewpoint
        distance = _nearest(a, b)
        furthest = torch.maximum(a.norm(dim=1), b.norm(dim=1))
        size = torch.maximum(start.norm(dim=1), end.norm(dim=1))
        rays = STRAIGHT_RAD + SAFETY * LONG * EPS * furthest / distance.clamp_min(1e-6)
        return rays + rounding_rad(viewpoint, size, distance) + _wide(self.width_m[index], distance)

    def face_slope(self, index, y, viewpoint):
        """As for Curve, of creases."""
        facing = self._facing(index, viewpoint).amin(1) / (viewpoint - y).norm(dim=1)
        return torch.where(
            facing > 0, (1 - facing.square()).clamp_min(0).sqrt() / facing, torch.inf
        )

    def apex_m(self, index):
        """As for Curve."""
        return self.apexes[index]


@dataclass(frozen=True)
class Circles(Curve):
    """Rims of disks and cylinders: centre + cos u + sin v, with u and v of the rim's radius; axis:
    from there to the cylinder's other end, 0 for disks; [C, 3] each. width_m: [C], how far apart
    rims lie that count as this one."""

    centre: Tensor
    u: Tensor
    v: Tensor
    axis: Tensor
    width_m: Tensor

    def pieces(self, viewpoint, angle, within_m=0.0):
        """As for Segments; all of every rim, cut where it turns back as seen from the viewpoint: a
        piece that went out and came back would look short and be long."""
        first, share = self._facing(viewpoint)
        arcs = torch.stack([share, 1 - share], 1).reshape(-1)
        index, s = cut(torch.arange(arcs.numel()), (arcs * ROUND).ceil().clamp_min(1).long())
        begin = torch.stack([first, first + share], 1).reshape(-1)
        return index // 2, begin[index, None] + arcs[index, None] * s

    def _facing(self, viewpoint):
        """Where the arc that faces the viewpoint begins, and its share of the rim: it ends where
        lines from the viewpoint's foot in the rim's plane are tangent. Half the rim where there are
        none."""
        towards = viewpoint - self.centre
        across = torch.linalg.cross(self.u, self.v)
        size = across.square().sum(1)
        x = (torch.linalg.cross(towards, self.v) * across).sum(1) / size
        y = (torch.linalg.cross(self.u, towards) * across).sum(1) / size
        share = torch.acos(1 / torch.hypot(x, y).clamp_min(1)) / torch.pi
        share = torch.where(share > 0, share, 0.5)
        return torch.atan2(y, x) / (2 * torch.pi) - share / 2, share

    def points(self, index, s, viewpoint):
        """As for Segments."""
        turn = 2 * torch.pi * s[:, None]
        return self.centre[index] + turn.cos() * self.u[index] + turn.sin() * self.v[index]

    def aside_rad(self, index, viewpoint):
        """As for Segments. The rim of a tube is where the ray's distance, good to 2^-23 d^2 / r,
        ends it."""
        centre = self.centre[index]
        radius = torch.minimum(self.u[index].norm(dim=1), self.v[index].norm(dim=1))
        distance = torch.maximum((centre - viewpoint).norm(dim=1), radius)
        wide = ASIDE_RAD + SAFETY * EPS * distance / radius
        return (
            torch.minimum(wide, DEEPEST * radius / distance)
            + rounding_rad(viewpoint, centre.norm(dim=1), distance)
            + _wide(self.width_m[index], distance)
        )

    def counts(self, index, y, viewpoint):
        """As for Curve: not behind the near wall of the cylinder itself."""
        axis = self.axis[index]
        return ~(axis.any(1) & behind_itself(y - self.centre[index], viewpoint - y, axis))


@dataclass(frozen=True)
class Spheres(Curve):
    """Outlines of spheres: the circle where rays from the viewpoint are tangent. centre: [C, 3];
    radius:
    [C]. Parameters run over 0..1, 2..3 or 4..5: where on the circle they begin is told from the
    first, second or third axis, the one farthest from the view, so that they name the same place
    from all points of a pupil."""

    centre: Tensor
    radius: Tensor

    def pieces(self, viewpoint, angle, within_m=0.0):
        """As for Segments; none for a sphere around the viewpoint."""
        towards = viewpoint - self.centre
        outside = torch.nonzero(towards.norm(dim=1) > self.radius * (1 + 1e-6))[:, 0]
        index, s = cut(outside, torch.full(outside.shape, ROUND))
        return index, s + 2 * towards.abs().argmin(1)[index, None]

    def points(self, index, s, viewpoint):
        """As for Segments; viewpoint [3] or [n, 3]."""
        centre = self.centre[index]
        radius = self.radius[index]
        towards = viewpoint - centre
        distance = towards.norm(dim=1, keepdim=True)
        axis = towards / distance
        share = radius[:, None] / distance
        beside = ((s + 0.5) / 2).floor()
        u, v = _across(axis, beside.long())
        turn = 2 * torch.pi * (s - 2 * beside)[:, None]
        return centre + radius[:, None] * (
            share * axis
            + (1 - share.square()).clamp_min(0).sqrt() * (turn.cos() * u + turn.sin() * v)
        )

    def aside_rad(self, index, viewpoint):
        """As for Segments. Raises: DomainError for a sphere too small and far for float32 rays."""
        centre = self.centre[index]
        distance = (centre - viewpoint).norm(dim=1)
        return _beside_round("sphere", centre, self.radius[index], distance, distance, viewpoint)


@dataclass(frozen=True)
class Cylinders(Curve):
    """Outlines of cylinders without caps: lines where rays from the viewpoint are tangent, ``side``
    +1 or -1 of the axis. start, end: [C, 3] of a part of the axis; radius, side: [C]."""

    start: Tensor
    end: Tensor
    radius: Tensor
    side: Tensor

    @classmethod
    def of(cls, start, end, radius):
        """Both lines of cylinders with axes start, end [C, 3] and radius [C], in PARTS parts
        each."""
        share = torch.linspace(0, 1, PARTS + 1, dtype=torch.float64)[:, None, None]
        ends = start + share * (end - start)
        count = PARTS * start.shape[0]
        return cls(
            ends[:-1].reshape(-1, 3).repeat(2, 1),
            ends[1:].reshape(-1, 3).repeat(2, 1),
            radius.repeat(2 * PARTS),
            torch.tensor([1.0, -1.0], dtype=torch.float64).repeat_interleave(count),
        )

    def pieces(self, viewpoint, angle, within_m=0.0):
        """As for Segments; none where the viewpoint lies within the radius of the axis."""
        towards, _ = self._across(viewpoint)
        kept = torch.nonzero(towards.norm(dim=1) > self.radius * (1 + 1e-6))[:, 0]
        start, end = (
            self.points(kept, torch.full(kept.shape, s, dtype=torch.float64), viewpoint) - viewpoint
            for s in (0.0, 1.0)
        )
        return cut(kept, pieces_of(start, end, angle))

    def points(self, index, s, viewpoint):
        """As for Segments; viewpoint [3] or [n, 3]."""
        towards, axis = self._across(viewpoint, index)
        distance = towards.norm(dim=1, keepdim=True)
        share = (self.radius[index][:, None] / distance).clamp_max(1)
        out = towards / distance
        aside = torch.linalg.cross(axis, out) * self.side[index][:, None]
        return (
            self.start[index]
            + s[:, None] * (self.end - self.start)[index]
            + self.radius[index][:, None] * (share * out + (1 - share.square()).sqrt() * aside)
        )

    def aside_rad(self, index, viewpoint):
        """As for Segments. Raises: DomainError for a cylinder too thin and far for float32 rays."""
        towards, _ = self._across(viewpoint, index)
        middle = (self.start + self.end)[index] / 2
        distance = (middle - viewpoint).norm(dim=1)
        return _beside_round(
            "cylinder", middle, self.radius[index], towards.norm(dim=1), distance, viewpoint
        )

    def _across(self, viewpoint, index=slice(None)):
        """From the axis to the viewpoint, across the axis [n, 3], and the axis' direction
        [n, 3]."""
        axis = torch.nn.functional.normalize((self.end - self.start)[index], dim=1)
        towards = viewpoint - self.start[index]
        return towards - (towards * axis).sum(1, keepdim=True) * axis, axis


def _beside_round(kind, place, radius, across, distance, viewpoint):
    """Reading angle beside round shapes whose axis is ``across`` [n] away in the plane of their
    curvature and ``distance`` [n] along the ray; see the head of this file."""
    slant = across / distance  # what lies along the axis is seen foreshortened
    error = EPS * across / radius * slant
    coordinates = rounding_rad(viewpoint, place.norm(dim=1), distance)
    deepest = DEEPEST * torch.asin((radius / across).clamp_max(1)) * slant
    lost = torch.nonzero(error + coordinates / SAFETY > deepest)[:, 0]
    if lost.numel():
        k = int(lost[0])
        at = ", ".join(f"{v:.3g}" for v in place[k].tolist())
        raise DomainError(
            f"a {kind} of radius {float(radius[k]):.3g} m near ({at}) m is seen from "
            f"{float(distance[k]):.3g} m, too far for float32 rays to find its edge; make it thicker or a "
            "mesh, or ask for gradient 'difference'."
        )
    return torch.minimum(ASIDE_RAD + SAFETY * error + coordinates, deepest)


def behind_itself(away: Tensor, towards: Tensor, axis: Tensor) -> Tensor:
    """Whether points [..., 3] of a round shape, ``away`` from its centre and with ``towards`` left
    to the viewpoint, lie behind the shape's own near side; ``axis`` of a cylinder from its centre
    to its other end, 0 for a sphere."""
    square = axis.square().sum(-1).clamp_min(1e-300)
    across, sight = (v - ((v * axis).sum(-1) / square)[..., None] * axis for v in (away, towards))
    outward = (across * sight).sum(-1)
    share = -2 * outward / sight.square().sum(-1).clamp_min(1e-300)
    level = ((away + share[..., None] * towards) * axis).sum(-1) / square
    return (outward < 0) & (share < 1) & (level >= 0) & (level <= 1)


def rounding_rad(viewpoint, size, distance):
    """Angle [n] that rounding of coordinates of the given size [n] m and of the viewpoint may
    make."""
    return SAFETY * EPS * (viewpoint.norm(dim=-1) + size) / distance.clamp_min(1e-6)


def _wide(width_m, distance):
    """Angle [n] beyond curves that lie ``width_m`` apart and count as one."""
    return SAFETY * width_m / distance.clamp_min(1e-6)


def _nearest(a, b):
    """Distance [n] of the origin from segments a to b [n, 3]."""
    along = b - a
    share = (-(a * along).sum(1) / along.square().sum(1).clamp_min(1e-300)).clamp(0, 1)
    return (a + share[:, None] * along).norm(dim=1)


def pieces_of(a, b, angle):
    """Number [n] of pieces of segments a to b [n, 3] that subtend at most ``angle`` from the
    origin."""
    pieces = (b - a).norm(dim=1) / (_nearest(a, b).clamp_min(1e-6) * angle)
    return pieces.ceil().clamp(1, 4096).long()


def cut_line(lines, index, viewpoint, angle):
    """Pieces, as ``cut`` has them, of lines start to end [n, 3] that subtend at most ``angle`` from
    the viewpoint."""
    return cut(
        index, pieces_of(lines.start[index] - viewpoint, lines.end[index] - viewpoint, angle)
    )


def on_line(lines, index, s):
    """Points [n, 3] at parameters s [n] of lines start to end [n, 3]."""
    return lines.start[index] + s[:, None] * (lines.end - lines.start)[index]


def cut(index, count):
    """Cut the parameter 0..1 of each curve into ``count`` pieces: indices [n], bounds [n, 2]."""
    which = torch.repeat_interleave(torch.arange(index.shape[0]), count)
    first = torch.cumsum(count, 0) - count
    k = torch.arange(which.shape[0]) - first[which]
    return index[which], torch.stack([k / count[which], (k + 1) / count[which]], 1).double()


def _across(axis, beside):
    """Two unit vectors [n, 3] across unit vectors [n, 3], the first across the coordinate axis
    ``beside`` [n] too."""
    helper = torch.eye(3, dtype=axis.dtype)[beside]
    u = torch.nn.functional.normalize(torch.linalg.cross(axis, helper), dim=1)
    return u, torch.linalg.cross(axis, u)


@dataclass(frozen=True)
class Meridians(Curve):
    """Half circles centre + sin u + cos v for angles 0 to pi. centre, u, v: [C, 3], u and v of the
    sphere's radius."""

    centre: Tensor
    u: Tensor
    v: Tensor

    def pieces(
        self,
        viewpoint: Tensor,
        angle: float,
        within_m: float = 0.0,
    ) -> tuple[Tensor, Tensor]:
        """As for Segments; those that face the viewpoint [3]."""
        index, s = cut(torch.arange(len(self.centre)), torch.full((len(self.centre),), ROUND // 2))
        seen = torch.ones(len(index), dtype=torch.bool)
        for end in s.unbind(1):
            seen &= self._cosine(index, self.points(index, end, viewpoint), viewpoint) > GRAZING
        return index[seen], s[seen]

    def points(self, index: Tensor, s: Tensor, viewpoint: Any) -> Tensor:
        """As for Segments."""
        turn = torch.pi * s[:, None]
        return self.centre[index] + turn.sin() * self.u[index] + turn.cos() * self.v[index]

    def aside_rad(self, index: Tensor, viewpoint: Tensor) -> Tensor:
        """As for Segments: texture coordinates follow the point that is met, good to float32 of its
        distance."""
        distance = (self.centre[index] - viewpoint).norm(dim=1)
        return 1e-5 + 1e-6 * distance / self.u[index].norm(dim=1)

    def counts(self, index: Tensor, y: Tensor, viewpoint: Tensor) -> Tensor:
        """As for Curve: on the side that faces the viewpoint."""
        return self._cosine(index, y, viewpoint) > 0

    def face_slope(self, index: Tensor, y: Tensor, viewpoint: Tensor) -> Tensor:
        """As for Curve: of the sphere, on both sides."""
        cosine = self._cosine(index, y, viewpoint)
        return torch.where(
            cosine > 0, (1 - cosine.square()).clamp_min(0).sqrt() / cosine, torch.inf
        )

    def _cosine(self, index, y, viewpoint):
        towards = torch.nn.functional.normalize(viewpoint - y, dim=1)
        return (torch.nn.functional.normalize(y - self.centre[index], dim=1) * towards).sum(1)
