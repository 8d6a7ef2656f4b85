"""Random events and a calibration in the layout of the Event-Camera Dataset, for tests of recordings."""

import numpy as np

DAVIS = (180, 240)
ETH_CALIBRATION = "199.092366542 198.82882047 132.192071378 110.712660011 -0.368436311798 0.150947243557 -0.000296130534385 -0.000759431726241 0.0"


def made(count=500, seed=0, size=DAVIS, start_s=1468939993.067416, duration_s=0.05):
    """(t_us, x, y, on) of random events, times rising."""
    draw = np.random.default_rng(seed)
    t_us = np.sort(draw.integers(0, round(duration_s * 1e6), count)) + round(start_s * 1e6)
    return (
        t_us,
        draw.integers(0, size[1], count),
        draw.integers(0, size[0], count),
        draw.integers(0, 2, count),
    )


def eth_text(columns, form="{t:.9f} {x} {y} {p}\n"):
    return "".join(
        form.format(t=t * 1e-6, t_us=t, x=x, y=y, p=p, sign=2 * p - 1)
        for t, x, y, p in zip(*(c.tolist() for c in columns), strict=True)
    )
