"""Random motions of layers, drawn per sample: homographies over time [layers, T, 3, 3], from pixels
at time 0 (px from the image's centre) to those at each time; and smooth fields of displacement,
which no homography has.

Arguments of all: draw: numpy Generator. t: [T] times, window = 0..1. width_px, height_px: of the
image. flow_px: (least, most), px per window.
"""

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch.nn.functional import interpolate

from codesign.errors import DomainError
from scenes.windows.layers import Warp

MODES = 10  # waves of a field
AFFINE = 0.5  # of the translation, at the corner: turn, zoom and shear
BEND = 0.6  # of the translation: the waves
STEEPEST_WARP = 0.9  # largest stretch of a field; from 1 on it folds over
MARGIN = 0.5  # of the image's sides, beyond which a displacement stays as at its border
KNOTS = (3, 7)  # random values along a side, least and most
STEEPEST = 0.25  # px of displacement per px; far below 1, where a field folds over


def similarity(draw, t, width_px, height_px, flow_px):
    """Rotation, zoom and translation about the image centre; flow_px: of the translation, uniform
    over the ring."""
    least, most = flow_px
    length = np.sqrt(draw.uniform(least**2, most**2))
    angle = draw.uniform(0, 2 * np.pi)
    reach = np.hypot(width_px, height_px) / 2
    # at the corners up to 0.3 of the largest translation each
    zoom, turn = draw.uniform(-1, 1, 2) * 0.3 * most / reach
    return _similarities(
        np.exp(t * complex(zoom, turn)), t * length * np.cos(angle), t * length * np.sin(angle)
    )


def vibration(draw, t, width_px, height_px, flow_px):
    """A shaking camera: shifts along x and y and roll swing, each with its own frequency of 0.05 to
    0.3 periods per window, over a slow drift. flow_px: amplitude of a shift, drawn evenly."""
    reach = np.hypot(width_px, height_px) / 2
    amplitude = draw.uniform(*flow_px, 3) * np.array([1, 1, 0.3 / reach])
    frequency = 2 * np.pi * draw.uniform(0.05, 0.3, 3)
    phase = draw.uniform(0, 2 * np.pi, 3)
    drift = amplitude * draw.normal(0, 0.3, 3)
    t = np.asarray(t)[:, None]
    x, y, roll = (amplitude * (np.sin(frequency * t + phase) - np.sin(phase)) + drift * t).T
    return _similarities(np.cos(roll) + 1j * np.sin(roll), x, y)


def zoom(draw, t, width_px, height_px, rate):
    """An approach or a retreat at a steady course, by exp(rate t); rate: (least, most) per
    window."""
    return _about(draw, t, width_px, draw.choice([-1.0, 1.0]) * draw.uniform(*rate))


def roll(draw, t, width_px, height_px, turn_rad):
    """A turn about an axis of view near the middle. turn_rad: (least, most) per window."""
    return _about(draw, t, width_px, 1j * draw.choice([-1.0, 1.0]) * draw.uniform(*turn_rad))


def out_and_back(draw, t, width_px, height_px, flow_px):
    """A shift out and half to all of the way back, at an even pace, in the window. flow_px: of the
    way out."""
    length = draw.uniform(*flow_px)
    angle = draw.uniform(0, 2 * np.pi)
    turn = 1 / (1 + draw.uniform(0.5, 1.0))  # when it turns
    t = np.asarray(t)
    way = length * (turn - np.abs(t - turn)) / turn
    return _similarities(np.ones(len(t), complex), way * np.cos(angle), way * np.sin(angle))


def rotation(draw, t, width_px, height_px, flow_px):
    """A pinhole camera with a random focal length that turns about its centre, at a steady rate;
    flow_px: as camera."""
    extent = max(width_px, height_px)
    focal = draw.uniform(0.6, 2.5) * extent
    turn = draw.normal(0, 1, 3) * np.array([1, 1, 2 * focal / extent])
    wanted = draw.uniform(*flow_px)
    twists = [(turn, np.zeros(3), np.zeros(3))]
    return _sized(focal, twists, (width_px, height_px), wanted, 1.0 / focal, np.inf, t)


def camera(draw, t, width_px, height_px, flow_px, layers):
    """A pinhole camera with a random focal length that turns and moves before tilted planes at
    different depths, the farthest first. One nearer layer in four moves by itself.

    flow_px: the root mean square flow at the image corners and centre over all layers is drawn
    evenly between these.
    """
    extent = max(width_px, height_px)
    focal = draw.uniform(0.6, 2.5) * extent
    inverse_depth = np.sort(draw.uniform(0.15, 1.0, layers))
    slant = draw.normal(0, 0.35, (layers, 2))
    normal = inverse_depth[:, None] * np.concatenate([slant, np.ones((layers, 1))], 1)
    turn, move = _twist(draw, focal, extent)
    still = np.zeros(3), np.zeros(3)
    extra = [
        _twist(draw, focal, extent) if layer and draw.random() < 1 / 4 else still
        for layer in range(layers)
    ]
    wanted = draw.uniform(*flow_px)
    twists = [(turn + 0.5 * w, move + v, n) for (w, v), n in zip(extra, normal, strict=True)]
    most = 0.4 / max(np.abs(np.concatenate([turn, move])).max(), 1e-9)
    return _sized(focal, twists, (width_px, height_px), wanted, 1.0, most, t)


def warps(draw, t, width_px, height_px, flow_px, layers):
    """A Warp per layer, farthest first: a camera's translation that grows from layer to layer, and
    what each layer does by itself.

    flow_px: root mean square flow over the image and all layers, drawn evenly; the same draw with
    twice the range has twice the flow. Raises: DomainError for a flow so long that the field would
    fold.
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
    length = (
        torch.stack([field.displacement(probe).square().sum(-1) for field in unit]).mean().sqrt()
    )
    size = wanted / float(length)
    steepest = size * float(torch.stack([field.stretch(probe) for field in unit]).max())
    if steepest > STEEPEST_WARP:
        raise DomainError(
            f"a flow of {wanted:.1f} px would stretch a field by {steepest:.2f} on {width_px} x {height_px} "
            f"pixels, {STEEPEST_WARP} at most is possible; give a shorter flow_px or larger images."
        )
    return [
        Warp(wave, phase, size * part, size * affine, share) for wave, phase, part, affine in found
    ]


def displacement(draw, width_px, height_px, rms_px):
    """A smooth random field [2, h, w] of this root mean square length, or shorter where that were
    too steep."""
    knots = int(draw.integers(KNOTS[0], KNOTS[1] + 1))
    values = torch.from_numpy(draw.standard_normal((1, 2, knots, knots))).float()
    size = [int((1 + MARGIN) * side) for side in (height_px, width_px)]
    field = interpolate(values, size=size, mode="bicubic", align_corners=True)[0]
    field = field * (rms_px / field.square().sum(0).mean().sqrt())
    steepest = max(float(field.diff(dim=axis).abs().max()) for axis in (1, 2))
    return field * min(1.0, STEEPEST / max(steepest, 1e-12))


def pace(draw, t, most):
    """Times at which a motion is at its steady course when it hurries and tarries: 0 and 1 stay.
    most: largest change of speed, relative."""
    frequency = 2 * np.pi * draw.uniform(0.2, 1.0)
    phase = draw.uniform(0, 2 * np.pi)
    swing = draw.uniform(0, most) / frequency
    wave = swing * np.sin(frequency * t + phase)
    first = swing * np.sin(phase)
    last = swing * np.sin(frequency + phase)
    return t + wave - first * (1 - t) - last * t


def _similarities(factor, x, y):
    """[1, T, 3, 3]: multiplication of x + iy by complex factors [T], then shifts x, y [T]."""
    rows = [factor.real, -factor.imag, x, factor.imag, factor.real, y]
    out = np.zeros((1, len(factor), 3, 3))
    out[0, :, :2] = np.stack(rows, -1).reshape(-1, 2, 3)
    out[0, :, 2, 2] = 1
    return out


def _about(draw, t, width_px, rate):
    """Similarities exp(rate t) about a point within a tenth of the width of the middle."""
    centre = complex(*draw.uniform(-0.1, 0.1, 2)) * width_px
    m = np.exp(np.asarray(t) * rate)
    shift = (1 - m) * centre
    return _similarities(m, shift.real, shift.imag)


def _sized(focal, twists, size_px, wanted, size, most, t):
    """H(t) = K (R(t) + T(t) n^T) K^-1 of (turn, move, normal) of every layer, all of one size such
    that the root mean square flow is ``wanted`` (Hartley and Zisserman, 2004, eq. 13.2). size: to
    begin with; most: largest allowed."""
    k = np.diag([focal, focal, 1.0])
    k_inverse = np.diag([1 / focal, 1 / focal, 1.0])
    width, height = size_px
    corners = np.array([[-1, 1, -1, 1, 0], [-1, -1, 1, 1, 0]]) * np.array([[width], [height]]) / 2
    probe = np.stack([*corners, np.ones(5)])

    def motion(times):
        found = []
        for w, v, n in twists:
            turn = Rotation.from_rotvec(np.outer(times, size * w)).as_matrix()
            found.append(k @ (turn + size * times[:, None, None] * np.outer(v, n)) @ k_inverse)
        return np.stack(found)

    # flow is nearly proportional to the twist: three corrections find its size
    for _ in range(3):
        seen = motion(np.ones(1))[:, 0] @ probe
        flow = seen[:, :2] / seen[:, 2:] - probe[:2]
        size = min(size * (wanted / max(np.sqrt(np.square(flow).sum(1).mean()), 1e-9)), most)
    return motion(t)


def _twist(draw, focal, width_px):
    """Turn (rad) and move (in depths of the nearest plane), one of them sometimes absent; turning
    about the view axis acts with the image's radius."""
    turn, move = draw.normal(0, 1, (2, 3)) * np.array([1, 1, 2 * focal / width_px])
    kind = draw.random()
    return turn * draw.uniform(0.1, 1) * (kind > 0.3), move * draw.uniform(0.1, 1) * (kind < 0.8)


def _field(draw, extent, heading, near):
    """(wave, phase, size, affine) of a field of about unit length."""
    length_px = extent * np.exp(draw.uniform(np.log(1.0), np.log(3.0), MODES))
    bearing = draw.uniform(0, 2 * np.pi, MODES)
    wave = 2 * np.pi / length_px[:, None] * np.stack([np.cos(bearing), np.sin(bearing)], -1)
    size = (
        BEND * draw.normal(0, 1, (MODES, 2)) * (length_px / length_px.mean())[:, None] / MODES**0.5
    )
    own = draw.normal(0, 0.3, 2)
    affine = np.zeros((2, 3))
    affine[:, 0] = near * np.array([np.cos(heading), np.sin(heading)]) + own
    affine[:, 1:] = AFFINE * draw.normal(0, 1, (2, 2)) / extent
    phase = draw.uniform(0, 2 * np.pi, MODES)
    return tuple(torch.from_numpy(values) for values in (wave, phase, size, affine))
