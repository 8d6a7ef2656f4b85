"""Motions that no homography has: smooth random fields of displacement, as scenes of many depths and bodies
that bend show them."""

import numpy as np
import torch

from codesign.errors import DomainError

MODES = 10  # waves of a field
AFFINE = 0.5  # of the translation, at the corner: turn, zoom and shear
BEND = 0.6  # of the translation: the waves
STEEPEST = 0.9  # largest stretch of a field; from 1 on it folds over
WITHIN_PX = 1e-5  # last change of the inverse
ITERATIONS = 60


class Warp:
    """A point at q at time 0 is at q + share(t) v(q) at time t, with a smooth field v of waves.

    Args: wave: [K, 2] radians per px. phase: [K]. size_px: [K, 2] amplitudes of x and y. affine: [2, 3],
      px per (1, px, px). share: [T], 0 at time 0 and 1 at the window's end.
    """

    def __init__(self, wave, phase, size_px, affine, share):
        self.wave = wave
        self.phase = phase
        self.size_px = size_px
        self.affine = affine
        self.share = share

    def displacement(self, points):
        """v(q) [..., 2] px at points q [..., 2] px from the image's centre."""
        waves = torch.cos(points @ self.wave.T + self.phase) @ self.size_px
        return waves + self.affine[:, 0] + points @ self.affine[:, 1:].T

    def stretch(self, points):
        """Spectral norm [...] of the slope of v at points [..., 2]."""
        slope = -torch.sin(points @ self.wave.T + self.phase)[..., None, None] * (
            self.size_px[:, :, None] * self.wave[:, None, :]
        )
        return torch.linalg.matrix_norm(slope.sum(-3) + self.affine[:, 1:], 2)

    def origins(self, points):
        """Where what is seen at points [H, W, 2] at each time was at time 0: [T, H, W, 2], float32.

        q = x - share v(q) by fixed point in float64, each time from those before. Raises: DomainError where the field
        is so steep that this does not settle.
        """
        points = points.double()
        found = torch.empty(len(self.share), *points.shape)
        order = self.share.abs().argsort().tolist()
        seen = {1: [], -1: []}  # by sign: (share, displacement) settled so far
        for number in order:
            share = float(self.share[number])
            known = seen[1 if share > 0 else -1]
            moved = _foreseen(known, share, self.displacement(points))
            for _ in range(ITERATIONS):
                before = moved
                moved = self.displacement(points - share * before)
                if abs(share) * float((moved - before).abs().max()) < WITHIN_PX:
                    break
            else:
                raise DomainError(
                    "a field of displacement folds over, so frames cannot be looked up along it; give a "
                    "shorter flow_px or larger images."
                )
            known.append((share, moved))
            found[number] = points - share * moved
        return found

    def texels(self, place, points):
        """As flow_windows.Plane.texels."""
        return (self.origins(points) @ place[:2, :2].T + place[:2, 2]).movedim(-1, 1)

    def end(self, points):
        """Where points [H, W, 2] of the start are at the window's end, [H, W, 2]."""
        points = points.double()
        return (points + self.share[-1] * self.displacement(points)).float()


def _foreseen(known, share, first):
    """Displacement at a share, along the line through the last two known."""
    if not known:
        return first
    (s0, v0), (s1, v1) = ([(0.0, first), *known])[-2:]
    return v1 + (v1 - v0) * ((share - s1) / (s1 - s0)) if s1 != s0 else v1


def warps(draw, t, width_px, height_px, flow_px, layers):
    """A Warp per layer, farthest first: a camera's translation that grows from layer to layer, and what each
    layer does by itself.

    Args: draw: numpy Generator. t: [T] times, window = 0..1. flow_px: (least, most): root mean square flow
      over the image and all layers, drawn evenly; the same draw with twice the range has twice the flow.
    Raises: DomainError for a flow so long that the field would fold.
    """
    extent = max(width_px, height_px)
    wanted = draw.uniform(*flow_px)
    heading = draw.uniform(0, 2 * np.pi)
    nearness = np.sort(draw.uniform(0.3, 1.5, layers))
    found = [_field(draw, extent, heading, near) for near in nearness]
    y, x = torch.meshgrid(
        torch.linspace(-height_px / 2, height_px / 2, 17),
        torch.linspace(-width_px / 2, width_px / 2, 17),
        indexing="ij",
    )
    probe = torch.stack([x, y], -1).double()
    share = torch.from_numpy(np.asarray(t, dtype=np.float64))
    unit = [Warp(wave, phase, part, affine, share) for wave, phase, part, affine in found]
    length = torch.stack([field.displacement(probe).square().sum(-1) for field in unit]).mean().sqrt()
    size = wanted / float(length)
    steepest = size * float(torch.stack([field.stretch(probe) for field in unit]).max())
    if steepest > STEEPEST:
        raise DomainError(
            f"a flow of {wanted:.1f} px would stretch a field by {steepest:.2f} on {width_px} x {height_px} "
            f"pixels, {STEEPEST} at most is possible; give a shorter flow_px or larger images."
        )
    return [Warp(wave, phase, size * part, size * affine, share) for wave, phase, part, affine in found]


def _field(draw, extent, heading, near):
    """(wave, phase, size, affine) of a field of about unit length."""
    length_px = extent * np.exp(draw.uniform(np.log(1.0), np.log(3.0), MODES))
    bearing = draw.uniform(0, 2 * np.pi, MODES)
    wave = 2 * np.pi / length_px[:, None] * np.stack([np.cos(bearing), np.sin(bearing)], -1)
    size = BEND * draw.normal(0, 1, (MODES, 2)) * (length_px / length_px.mean())[:, None] / MODES**0.5
    own = draw.normal(0, 0.3, 2)
    affine = np.zeros((2, 3))
    affine[:, 0] = near * np.array([np.cos(heading), np.sin(heading)]) + own
    affine[:, 1:] = AFFINE * draw.normal(0, 1, (2, 2)) / extent
    phase = draw.uniform(0, 2 * np.pi, MODES)
    return tuple(torch.from_numpy(values) for values in (wave, phase, size, affine))
