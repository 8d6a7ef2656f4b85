"""Pictures of studies.flow_quality."""

import matplotlib.pyplot as plt

from codesign.report.flow_colours import flow_colours

DEVIATION_PX = 2.0  # shown white


def windows(shown, who):
    """Figure: a row per window of its events, true flow, every estimate, and the last claim.

    Args: shown: [(FlowWindows, {estimator: FlowField}, number of the sample)]. who: estimators, in order.
    """
    figure, axes = plt.subplots(
        len(shown),
        len(who) + 3,
        figsize=(2.1 * (len(who) + 3), 2.2 * len(shown)),
        constrained_layout=True,
        squeeze=False,
    )
    for row, (given, fields, k) in zip(axes, shown, strict=True):
        counts = given.volume.counts[k]
        row[0].imshow((counts[0] - counts[1]).sum(0).numpy(), cmap="RdBu_r", vmin=-4, vmax=4)
        truth = given.truth.flow_px[k]
        most = float(truth.square().sum(0).sqrt().max())
        for axis, flow in zip(row[1:-1], [truth, *(fields[name].flow_px[k] for name in who)], strict=True):
            axis.imshow(flow_colours(flow.numpy(), most))
        covariance = fields[list(who)[-1]].covariance_px2
        if covariance is not None:
            deviation = ((covariance[k, 0] + covariance[k, 2]) / 2).sqrt()
            row[-1].imshow(deviation.numpy(), cmap="gray", vmin=0, vmax=DEVIATION_PX)
    names = [name.replace("_", " ") for name in who]
    titles = ("events", "true flow", *names, f"claimed (white: {DEVIATION_PX:g} px)")
    for axis, title in zip(axes[0], titles, strict=True):
        axis.set_title(title, fontsize=8)
    for axis in axes.flat:
        axis.set_axis_off()
    return figure
