"""The page of the classification study: accuracies, what was asked, examples, confusions."""

import matplotlib.pyplot as plt
import numpy as np

from studies.event_classes.generators import SENSOR
from studies.event_classes.pictures import CLASSES
from studies.event_classes.saccades import LEG_S, SIDE_PX
from studies.event_classes.score import interval

OURS = "spike_esim"
ASKED = (
    (OURS, "esim_best"),
    (OURS, "esim"),
    ("esim_best", "naive_best"),
    ("esim", "naive"),
)  # the first at least as good as the second
FULL_SCALE = 3  # signed count of full colour


def show(run, keys, labels, found, examples, truth):
    """Record the figures and write the page. keys: sources in order; labels, found (Found), examples
    ([classes, H, W]): by key."""
    means = {key: interval(found[key].accuracy) for key in keys}
    for key, mean in means.items():
        run.record(
            **{
                f"{key}_accuracy": mean.mean,
                f"{key}_accuracy_low": mean.low,
                f"{key}_accuracy_high": mean.high,
            }
        )
    gains = compare(run, found)
    for key in [key for key in (OURS, "esim_best", "naive_best", "physical") if key in means]:
        run.card(
            labels[key],
            f"{100 * means[key].mean:.1f} %",
            f"95 % interval {100 * means[key].low:.1f} to {100 * means[key].high:.1f}, {run.config.seeds} seeds",
        )
    run.section("What was done", _account(run))
    order = sorted(keys, key=lambda key: means[key].mean)
    run.section("Accuracy")
    now = run.metrics
    rows = [
        [
            labels[k],
            str(means[k]),
            f"{100 * now[f'{k}_own_events_accuracy']:.1f}",
            f"{now[f'{k}_events_per_picture']:.0f}",
        ]
        for k in reversed(order)
    ]
    columns = [
        "trained on events of",
        "accuracy on the physical sensor's events, %",
        "on its own events, %",
        "events per picture",
    ]
    run.table(
        "By generator",
        columns,
        rows,
        f"In brackets 95 % intervals of the mean over {run.config.seeds} seeds. On its own events: first seed. "
        f"Chance is {100 / CLASSES:.0f} %.",
    )
    run.figure(
        _bars(order, labels, found, means),
        "accuracy",
        "Accuracy on the physical sensor's events. Bars: 95 % intervals of the mean; marks: seeds.",
    )
    rows = [
        [
            f"{labels[a]} over {labels[b]}",
            f"{100 * g.mean:+.1f} ({100 * g.low:+.1f} to {100 * g.high:+.1f})",
            "met" if g.mean >= 0 else "missed",
        ]
        for (a, b), g in gains.items()
    ]
    run.table(
        "What was asked", ["gain in accuracy, points", "paired over seeds", "first at least second"], rows
    )
    run.section("Events", "Signed counts of the first saccade. Red: more ON, blue: more OFF.")
    run.figure(
        _examples(["picture", *reversed(order)], labels, examples),
        "events",
        "The same pictures, seen by every generator.",
    )
    pair = [next(key for key in (OURS, "esim_best") if key in keys), "naive"]
    run.section("Confusions")
    run.figure(
        _confusions(pair, labels, found),
        "confusions",
        f"Share of each digit (row) that was taken for each (column), physical events, all {run.config.seeds} "
        "seeds.",
    )
    best = f"{labels[pair[0]]} {100 * means[pair[0]].mean:.1f} %, {labels['esim_best']} {100 * means['esim_best'].mean:.1f} %, {labels['naive_best']} {100 * means['naive_best'].mean:.1f} %"
    run.finish(
        "Emulated events for a real sensor's classifier",
        f"Accuracy on {len(truth)} pictures seen by the physical sensor, trained on events of: {best}; the "
        f"sensor itself {100 * means['physical'].mean:.1f} %.",
    )


def compare(run, found):
    """Interval of the gain in accuracy, paired over seeds, by pair of ASKED whose both sides are there;
    recorded with a verdict."""
    gains = {}
    for first, second in ASKED:
        if first in found and second in found:
            gains[first, second] = gain = interval(found[first].accuracy - found[second].accuracy)
            start = f"{first}_over_{second}"
            run.record(
                **{
                    f"{start}_gain": gain.mean,
                    f"{start}_gain_low": gain.low,
                    f"{start}_gain_high": gain.high,
                    f"{start}_met": int(gain.mean >= 0),
                }
            )
    return gains


def _account(run):
    given = ", ".join(
        f"{name} {value:g}" for name, value in vars(SENSOR).items() if isinstance(value, float) and value
    )
    return (
        f"Digits in six fonts on pieces of photographs move by three saccades of {SIDE_PX:g} px and "
        f"{1e3 * LEG_S:.0f} ms along a triangle, in front of 32 x 32 pixels. "
        f"**Generators** see {run.config.video_hz:g} frames per second; the **physical sensor** sees "
        f"{run.config.sensor_hz:g} ({given}), and every picture has a specimen of its own. "
        f"In still pictures it makes {run.metrics['noise_events_per_picture']:.0f} events of noise each.\n\n"
        f"Voxels of 2 x {run.config.bins} bins go into a residual network of 78 thousand weights, "
        f"{run.config.epochs} passes over {run.config.training} pictures; the test is {run.config.test} other "
        "pictures on other photographs, seen by the physical sensor. Seeds change training pictures, noise "
        "and first weights.\n\n"
        f"**Best θ** is the one whose events train the best classifier of {run.config.calibration} calibration "
        "recordings; the **thesis network** and **Spike-ESIM** are fitted to the same recordings. "
        "*Noise left out*: the fitted Spike-ESIM without its drawn noise. *ESIM with shot noise* knows the "
        "sensor's noise rate, *the sensor's model on video* all of its parameters: neither is fitted."
    )


def _bars(order, labels, found, means):
    figure, axis = plt.subplots(figsize=(8, 0.42 * len(order) + 1.2), layout="constrained")
    for row, key in enumerate(order):
        axis.barh(
            row,
            100 * means[key].mean,
            color="#1b6ca8" if key == OURS else "#9aa5ad" if key == "physical" else "#9cc3dd",
            height=0.65,
        )
        axis.plot(
            100 * found[key].accuracy.numpy(), np.full(len(found[key].accuracy), row), "o", ms=3, color="0.2"
        )
        axis.plot([100 * means[key].low, 100 * means[key].high], [row, row], color="black", lw=1.5)
    axis.axvline(100 / CLASSES, color="0.4", lw=0.8, ls="--")
    axis.set(
        yticks=range(len(order)),
        xlabel="accuracy on the physical sensor's events, % (dashed: chance)",
        xlim=(0, 100),
    )
    axis.set_yticklabels([labels[key] for key in order])
    axis.spines[["top", "right"]].set_visible(False)
    return figure


def _examples(keys, labels, examples):
    figure, axes = plt.subplots(
        len(keys), CLASSES, figsize=(CLASSES + 2.2, len(keys)), squeeze=False, layout="constrained"
    )
    for row, key in zip(axes, keys, strict=True):
        for axis, picture in zip(row, examples[key].numpy(), strict=True):
            if key == "picture":
                axis.imshow(picture, cmap="gray")
            else:
                axis.imshow(
                    picture, cmap="RdBu_r", vmin=-FULL_SCALE, vmax=FULL_SCALE, interpolation="nearest"
                )
            axis.set(xticks=[], yticks=[])
        row[0].set_ylabel(labels.get(key, "at rest"), rotation=0, ha="right", va="center", fontsize=9)
    return figure


def _confusions(keys, labels, found):
    figure, axes = plt.subplots(1, len(keys), figsize=(4.2 * len(keys), 4.1), layout="constrained")
    for axis, key in zip(axes, keys, strict=True):
        shown = axis.imshow(found[key].confusion.numpy(), cmap="Blues", vmin=0, vmax=1)
        axis.set(
            title=labels[key], xlabel="taken for", ylabel="is", xticks=range(CLASSES), yticks=range(CLASSES)
        )
    figure.colorbar(shown, ax=axes, shrink=0.8, label="share")
    return figure
