"""Makes the subset of reference values in this folder from the whole set:
``python tests/data/make.py FOLDER``.

FOLDER holds lens/, events/ and srm/ as README.md describes them. Numbers are chosen and packed,
never changed.
"""

import json
import sys
from pathlib import Path

import numpy as np
import torch

HERE = Path(__file__).resolve().parent / "refs"
SIDE = 16  # kept pixels a side, of 64
SEQUENCES = ("edge", "grating", "flicker")
CONFIGURATIONS = ("ideal", "asym", "cut30", "refr3ms", "leak20_det")


def log_level(frames):
    """v2e's lin-log level, rounded as v2e does."""
    level = np.where(frames <= 20, frames * np.log(20) / 20, np.log(np.maximum(frames, 20)))
    return (np.round(level * 1e8) / 1e8).astype(np.float32)


def counts_before_dead_time(frames, t_s, given):
    """Larger of the ON and OFF counts [T, H, W] that v2e's comparator sees, by its equations
    without noise, written out; the largest of a frame says in how many slots its events are put."""
    seen = np.zeros(frames.shape, np.int64)
    theta_on, theta_off = np.float32(given["pos_thres"]), np.float32(given["neg_thres"])
    level = log_level(frames)
    low = level[0]
    memorised = level[0].copy()
    last_s = np.full(frames.shape[1:], -given["refractory_period_s"], np.float32)
    for k in range(1, len(frames)):
        dt = float(t_s[k] - t_s[k - 1])
        if given["cutoff_hz"] > 0:
            share = np.minimum(1, (frames[k] + 20) / 275 * dt * 2 * np.pi * given["cutoff_hz"])
            low = (1 - share) * low + share * level[k]
        else:
            low = level[k]
        memorised = memorised - dt * given["leak_rate_hz"] * theta_on
        difference = low - memorised
        on = np.floor_divide(np.maximum(difference, 0), theta_on).astype(np.int64)
        off = np.floor_divide(np.maximum(-difference, 0), theta_off).astype(np.int64)
        seen[k] = np.maximum(on, off)
        slots = max(int(seen[k].max()), 1)
        held = np.zeros_like(on)
        times = torch.linspace(
            float(t_s[k - 1]) + dt / slots, float(t_s[k]), slots, dtype=torch.float32
        ).numpy()
        for index, time in enumerate(times):  # v2e's own rounding: dead times end on slots
            ready = time - last_s > np.float32(given["refractory_period_s"])
            kept = (seen[k] > index) & (ready | (given["refractory_period_s"] <= dt / slots))
            held += kept
            last_s = np.where(kept, time, last_s)
        memorised = memorised + held * np.where(on > 0, theta_on, -theta_off)
    return seen


def chosen_pixels(frames, t_s, settings):
    """Flat numbers of SIDE x SIDE pixels that hold, in every frame and configuration, one with the
    most events of all: its number of slots is then that of the whole. The rest are drawn."""
    needed = []
    for given in settings:
        seen = counts_before_dead_time(frames, t_s, given).reshape(len(frames), -1)
        needed += [row == row.max() for row in seen if row.max() > 1]
    left = np.array(needed)
    kept = []
    while len(left):
        kept.append(int(left.sum(0).argmax()))
        left = left[~left[:, kept[-1]]]
    others = np.random.default_rng(0).permutation(frames[0].size)
    kept += [pixel for pixel in others if pixel not in set(kept)][: SIDE**2 - len(kept)]
    assert len(kept) == SIDE**2, f"{len(kept)} pixels are needed; raise SIDE"
    return np.sort(kept)


def only(data, pixels, width):
    """Events of some pixels, moved into a SIDE x SIDE picture in their order."""
    flat = data["y"].astype(np.int64) * width + data["x"]
    place = np.searchsorted(pixels, flat).clip(max=len(pixels) - 1)
    mine = pixels[place] == flat
    place = place[mine]
    found = {
        "t": data["t"][mine],
        "x": (place % SIDE).astype(np.int16),
        "y": (place // SIDE).astype(np.int16),
        "p": data["p"][mine],
        "params": data["params"],
    }
    for name in ("base_log_frame", "lp_log_frame"):
        if name in data:
            found[name] = data[name].reshape(-1)[pixels].reshape(SIDE, SIDE)
    if "per_frame" in data:
        # frames are 1 ms apart
        frame = np.ceil(np.round(found["t"].astype(np.float64) * 1e6) / 1e3).astype(int)
        found["per_frame"] = np.bincount(frame, minlength=len(data["per_frame"]))
    return found


def events(source, target):
    for sequence in SEQUENCES:
        whole = np.load(source / f"seq_{sequence}.npz")
        frames, t_s = whole["frames"], whole["t"]
        emulated = {c: np.load(source / f"v2e_{sequence}_{c}.npz") for c in CONFIGURATIONS}
        settings = [json.loads(str(data["params"])) for data in emulated.values()]
        pixels = chosen_pixels(frames, t_s, settings)
        kept = frames.reshape(len(frames), -1)[:, pixels].reshape(-1, SIDE, SIDE)
        np.savez_compressed(target / f"seq_{sequence}.npz", frames=kept, t=t_s)
        for configuration, data in emulated.items():
            np.savez_compressed(
                target / f"v2e_{sequence}_{configuration}.npz",
                **only(data, pixels, frames.shape[2]),
            )
        name = f"esimpy_fixedalias_{sequence}_ideal_eps1e-3.npz"
        if (source / name).exists():
            np.savez_compressed(
                target / name, **only(np.load(source / name), pixels, frames.shape[2])
            )
    statistics = json.loads((source / "v2e_stats.json").read_text())
    (target / "v2e_stats.json").write_text(json.dumps(statistics, separators=(",", ":")) + "\n")


def lenses(source, target):
    for path in sorted(source.glob("*.json")):
        page = json.loads(path.read_text())
        page["rays"] = [
            {k: v for k, v in ray.items() if k not in ("image", "optiland", "rayoptics")}
            for ray in page["rays"]
        ]
        (target / path.name).write_text(json.dumps(page, separators=(",", ":")) + "\n")


def spikes(source, target):
    for path in sorted(source.glob("*.npz")):
        np.savez_compressed(target / path.name, **np.load(path))


if __name__ == "__main__":
    whole = Path(sys.argv[1])
    for part, make in (("lens", lenses), ("events", events), ("srm", spikes)):
        (HERE / part).mkdir(parents=True, exist_ok=True)
        make(whole / part, HERE / part)
