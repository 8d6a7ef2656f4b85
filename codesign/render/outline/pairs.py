"""Which of many triangles or edges may touch: pairs whose boxes overlap, from a tree of boxes walked all levels at once."""

import numpy as np

BITS = 10  # of each coordinate in the order along a space-filling curve


def touching(corners: np.ndarray, margin_m: float) -> np.ndarray:
    """Pairs [n, 2], first below second, of triangles or edges, by their corners [N, k, 3], whose boxes come nearer than ``margin_m``."""
    count = len(corners)
    if count < 2:
        return np.zeros((0, 2), dtype=np.int64)
    order = np.argsort(_along_curve(corners.mean(1)))
    size = 1 << (count - 1).bit_length()
    low = np.full((3, size), np.inf)
    high = np.full((3, size), -np.inf)
    low[:, :count] = corners[order].min(1).T - margin_m / 2
    high[:, :count] = corners[order].max(1).T + margin_m / 2
    levels = [(low, high)]
    while levels[-1][0].shape[1] > 1:
        low, high = levels[-1]
        levels.append((np.minimum(low[:, ::2], low[:, 1::2]), np.maximum(high[:, ::2], high[:, 1::2])))
    a = b = np.zeros(1, dtype=np.int32)
    for low, high in reversed(levels[:-1]):
        apart = np.nonzero(a != b)[0]
        a, b = (
            np.concatenate([2 * a, 2 * a, 2 * a + 1, 2 * a[apart] + 1]),
            np.concatenate([2 * b, 2 * b + 1, 2 * b + 1, 2 * b[apart]]),
        )
        for axis in range(3):
            near = np.nonzero((low[axis][a] <= high[axis][b]) & (low[axis][b] <= high[axis][a]))[0]
            a = a[near]
            b = b[near]
    different = a != b
    return np.sort(order[np.stack([a[different], b[different]], 1)], axis=1)


def _along_curve(points):
    """Morton codes [N] of points [N, 3]: neighbours in space are near in their order."""
    low = points.min(0)
    cells = ((points - low) / max(float((points.max(0) - low).max()), 1e-300) * (2**BITS - 1)).astype(
        np.int64
    )
    code = np.zeros(len(points), dtype=np.int64)
    for bit in range(BITS):
        for axis in range(3):
            code |= ((cells[:, axis] >> bit) & 1) << (3 * bit + axis)
    return code
