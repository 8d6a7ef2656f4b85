"""Random motions of flat layers: homographies over time, drawn per sample."""

import numpy as np


def similarity(draw, t, width_px, height_px, flow_px):
    """Rotation, zoom and translation about the image centre.

    Args: draw: numpy Generator. t: [T] times, window = 0..1. flow_px: (least, most) translation, px per
      window, uniform over the ring.
    Returns: [1, T, 3, 3]: from pixels at t = 0 (centred, px) to pixels at t.
    """
    least, most = flow_px
    length = np.sqrt(draw.uniform(least**2, most**2))
    angle = draw.uniform(0, 2 * np.pi)
    reach = np.hypot(width_px, height_px) / 2
    zoom, turn = (
        draw.uniform(-1, 1, 2) * 0.3 * most / reach
    )  # at the corners up to 0.3 of the largest translation each
    m = np.exp(t * complex(zoom, turn))
    out = np.zeros((1, len(t), 3, 3))
    out[0, :, 0, 0], out[0, :, 0, 1], out[0, :, 1, 0], out[0, :, 1, 1], out[0, :, 2, 2] = (
        m.real,
        -m.imag,
        m.imag,
        m.real,
        1,
    )
    out[0, :, 0, 2], out[0, :, 1, 2] = t * length * np.cos(angle), t * length * np.sin(angle)
    return out


def camera(draw, t, width_px, height_px, flow_px, layers):
    """A pinhole camera with a random focal length that turns and moves before tilted planes at different
    depths.

    H(t) = K (R(t) + T(t) n^T) K^-1, with n the plane's normal over its depth (Hartley and Zisserman, 2004,
    eq. 13.2). One nearer layer in four moves by itself.
    flow_px: (least, most): the root mean square flow at the image corners and centre over all layers is drawn
      uniformly between these.
    Returns: [layers, T, 3, 3], the farthest layer first.
    """
    focal = draw.uniform(0.6, 2.5) * max(width_px, height_px)
    k = np.diag([focal, focal, 1.0])
    k_inverse = np.diag([1 / focal, 1 / focal, 1.0])
    inverse_depth = np.sort(draw.uniform(0.15, 1.0, layers))
    slant = draw.normal(0, 0.35, (layers, 2))
    normal = inverse_depth[:, None] * np.concatenate([slant, np.ones((layers, 1))], 1)
    turn, move = _twist(draw, focal, max(width_px, height_px))
    still = np.zeros(3), np.zeros(3)
    extra = [
        _twist(draw, focal, max(width_px, height_px)) if layer and draw.random() < 1 / 4 else still
        for layer in range(layers)
    ]
    probe = np.stack([*_corners(width_px, height_px), np.ones(5)])
    wanted = draw.uniform(*flow_px)
    size = 1.0

    def motion(times):
        out = np.empty((layers, len(times), 3, 3))
        for layer in range(layers):
            w = turn + 0.5 * extra[layer][0]
            v = move + extra[layer][1]
            out[layer] = (
                k
                @ (_rotations(size * w, times) + size * times[:, None, None] * np.outer(v, normal[layer]))
                @ k_inverse
            )
        return out

    for _ in range(3):  # flow is nearly proportional to the twist: three corrections settle its size
        seen = motion(np.ones(1))[:, 0] @ probe
        flow = seen[:, :2] / seen[:, 2:] - probe[:2]
        size *= wanted / max(np.sqrt(np.square(flow).sum(1).mean()), 1e-9)
        size = min(size, 0.4 / max(np.abs(np.concatenate([turn, move])).max(), 1e-9))
    return motion(t)


def rotation(draw, t, width_px, height_px, flow_px):
    """A pinhole camera with a random focal length that turns about its centre, at a steady rate.

    H(t) = K R(t) K^-1, whatever the depth. flow_px: (least, most), as in camera.
    Returns: [1, T, 3, 3].
    """
    focal = draw.uniform(0.6, 2.5) * max(width_px, height_px)
    turn = draw.normal(0, 1, 3) * np.array([1, 1, 2 * focal / max(width_px, height_px)])
    k = np.diag([focal, focal, 1.0])
    probe = np.stack([*_corners(width_px, height_px), np.ones(5)])
    size = 1.0 / focal
    wanted = draw.uniform(*flow_px)

    def motion(times):
        return (k @ _rotations(size * turn, times) @ np.linalg.inv(k))[None]

    for _ in range(3):
        seen = motion(np.ones(1))[0, 0] @ probe
        flow = seen[:2] / seen[2:] - probe[:2]
        size *= wanted / max(np.sqrt(np.square(flow).sum(0).mean()), 1e-9)
    return motion(t)


def vibration(draw, t, width_px, height_px, flow_px):
    """A shaking camera: shifts along x and y and roll swing, each with its own frequency of 0.05 to 0.3 periods
    per window, over a slow drift.

    flow_px: (least, most) amplitude of a shift, drawn evenly. Returns: [1, T, 3, 3].
    """
    reach = np.hypot(width_px, height_px) / 2
    amplitude = draw.uniform(*flow_px, 3) * np.array([1, 1, 0.3 / reach])
    frequency = 2 * np.pi * draw.uniform(0.05, 0.3, 3)
    phase = draw.uniform(0, 2 * np.pi, 3)
    drift = amplitude * draw.normal(0, 0.3, 3)
    t = np.asarray(t)[:, None]
    x, y, roll = (amplitude * (np.sin(frequency * t + phase) - np.sin(phase)) + drift * t).T
    out = np.zeros((1, len(t), 3, 3))
    out[0, :, 0, 0] = out[0, :, 1, 1] = np.cos(roll)
    out[0, :, 1, 0] = np.sin(roll)
    out[0, :, 0, 1] = -np.sin(roll)
    out[0, :, 0, 2] = x
    out[0, :, 1, 2] = y
    out[0, :, 2, 2] = 1
    return out


def zoom(draw, t, width_px, height_px, rate):
    """An approach or a retreat at a steady course, by exp(rate t) about a point near the middle.

    rate: (least, most) per window. Returns: [1, T, 3, 3].
    """
    return _about(draw, t, width_px, draw.choice([-1.0, 1.0]) * draw.uniform(*rate))


def roll(draw, t, width_px, height_px, turn_rad):
    """A turn about an axis of view near the middle. turn_rad: (least, most) per window. Returns: [1, T, 3, 3]."""
    return _about(draw, t, width_px, 1j * draw.choice([-1.0, 1.0]) * draw.uniform(*turn_rad))


def _about(draw, t, width_px, rate):
    """Similarities exp(rate t) about a point within a tenth of the width of the middle."""
    centre = complex(*draw.uniform(-0.1, 0.1, 2)) * width_px
    m = np.exp(np.asarray(t) * rate)
    rows = [m.real, -m.imag, ((1 - m) * centre).real, m.imag, m.real, ((1 - m) * centre).imag]
    out = np.zeros((1, len(t), 3, 3))
    out[0, :, :2] = np.stack(rows, -1).reshape(-1, 2, 3)
    out[0, :, 2, 2] = 1
    return out


def out_and_back(draw, t, width_px, height_px, flow_px):
    """A shift out and half to all of the way back, at an even pace, in the window.

    flow_px: (least, most) of the way out. Returns: [1, T, 3, 3].
    """
    length = draw.uniform(*flow_px)
    angle = draw.uniform(0, 2 * np.pi)
    turn = 1 / (1 + draw.uniform(0.5, 1.0))  # when it turns
    t = np.asarray(t)
    way = length * (turn - np.abs(t - turn)) / turn
    out = np.tile(np.eye(3), (1, len(t), 1, 1))
    out[0, :, 0, 2] = way * np.cos(angle)
    out[0, :, 1, 2] = way * np.sin(angle)
    return out


def _corners(width_px, height_px):
    """x and y [5] of the corners and the centre."""
    return (
        np.array([-1, 1, -1, 1, 0]) * width_px / 2,
        np.array([-1, -1, 1, 1, 0]) * height_px / 2,
    )


def _twist(draw, focal, width_px):
    """Turn (rad) and move (in depths of the nearest plane), one of them sometimes absent; turning about the
    view axis acts with the image's radius."""
    turn, move = draw.normal(0, 1, (2, 3)) * np.array([1, 1, 2 * focal / width_px])
    kind = draw.random()
    return turn * draw.uniform(0.1, 1) * (kind > 0.3), move * draw.uniform(0.1, 1) * (kind < 0.8)


def _rotations(w, times):
    """Rotations exp(t w) [T, 3, 3] (Rodrigues)."""
    angle = np.linalg.norm(w)
    cross = np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]]) / max(angle, 1e-12)
    return (
        np.eye(3)
        + np.sin(times * angle)[:, None, None] * cross
        + (1 - np.cos(times * angle))[:, None, None] * cross @ cross
    )
