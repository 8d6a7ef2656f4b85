"""The page of the DAVIS study: what was found, in words, tables and figures."""

from dataclasses import dataclass
from typing import Any

from studies.davis_fit import figures as draw
from studies.davis_fit.compare import LABELS, POOLING_PX
from studies.davis_fit.model import START

PARAMETERS = {
    "theta_on": "ON threshold, ln units",
    "theta_off": "OFF threshold, ln units",
    "dark_offset": "dark offset, of 255",
    "blur_odds": "blurred over sharp share",
    "time_constant_s": "low-pass time constant, s",
    "noise_on_hz": "ON noise in the dark, per pixel and s",
    "noise_off_hz": "OFF noise in the dark, per pixel and s",
}


@dataclass(frozen=True)
class Results:
    """Everything the page shows; dictionaries go by judged half, then by model or clip name. curves:
    correlations over ``offsets_s``."""

    recording: Any
    clips: dict
    folds: list
    sensors: dict
    naives: dict
    simulated: dict
    figures: dict
    offsets_s: list
    curves: dict


def show(run, found):
    """Write the page."""
    best = list(found.figures["second"])[-1]
    _cards(run, found, best)
    run.section("What was done", _account(run, found))
    for fold in found.folds:
        _table(run, fold, found.figures[fold.judged])
    _side_by_side(run, found, best)
    run.section("Rates", "Each half is shown with the parameters fitted on the other.")
    caption = "Events per second of the whole picture. Lines: bins of 5 ms; steps: mean of an interval. The fitted line's teeth sit at the frames: in between, two moved frames are blended and weaker."
    run.figure(
        draw.rates(found.recording, found.folds, found.clips, found.sensors, found.simulated),
        "rates",
        caption,
    )
    shown = [
        name for name in ("naive", "unfitted", "fitted", "fitted_moved") if name in found.figures["second"]
    ]
    run.figure(
        draw.ratios(found.folds, found.figures, shown),
        "ratios",
        "Simulated over recorded events in each interval of 40 ms.",
    )
    _parameters(run, found)
    run.section("What limits it", _limits(run.metrics, found, best))
    caption = "Correlation when the recorded events' times are moved against the frames. Black: the recording against itself, moved."
    run.figure(draw.offsets(found.offsets_s, found.curves, found.folds), "offsets", caption)
    fitted, plain, naive = (found.figures["second"][name] for name in (best, "unfitted", "naive"))
    run.finish(
        "A real event camera against simulation",
        (
            "On the second half of the recording, fitted on the first, simulated signed counts per pixel "
            f"correlate by **{fitted.correlation[1].value:.3f}** with the recorded ones "
            f"(unfitted {plain.correlation[1].value:.3f}, naive {naive.correlation[1].value:.3f}), and ON "
            f"and OFF events number {fitted.ratio[0].value:.2f} and {fitted.ratio[1].value:.2f} times "
            f"the recorded ones (unfitted {plain.ratio[0].value:.2f} and {plain.ratio[1].value:.2f}, naive "
            f"{naive.ratio[0].value:.2f} and {naive.ratio[1].value:.2f})."
        ),
    )


def _cards(run, found, best):
    for label, name in (("fitted", best), ("unfitted, θ 0.2", "unfitted"), ("naive, θ 0.2", "naive")):
        second, first = (found.figures[half][name] for half in ("second", "first"))
        ratios = " · ".join(f"{ratio.value:.2f}" for half in (second, first) for ratio in half.ratio)
        note = f"correlation of signed counts per pixel, second · first half held out; events simulated over recorded (ON, OFF each): {ratios}"
        run.card(
            label.capitalize(), f"{second.correlation[1].value:.3f} · {first.correlation[1].value:.3f}", note
        )


def _account(run, found):
    recording = found.recording
    fold = found.folds[0]
    moved = (
        f"\n\n**Moved frames**: {found.clips['moved'].per_interval} steps per interval, made by moving both "
        "neighbours along their optical flow."
        if "moved" in found.clips
        else ""
    )
    return (
        f"{len(recording.frames)} frames, {1e3 * float(recording.mid_s.diff().mean()):.0f} ms apart, each "
        f"exposed for {1e3 * recording.exposure_s:.0f} ms, and {len(recording.stream):,} events "
        f"of one camera. Intervals reach from mid-exposure to mid-exposure; {fold.fit.start} to "
        f"{fold.fit.stop - 1} are the first half, {fold.test.start} to {fold.test.stop - 1} (from "
        f"{1e3 * float(recording.mid_s[fold.test.start]):.0f} ms on) the second. Parameters come from the "
        "recorded events of one half; the other is judged; then the halves are swapped. "
        "Frames are never held out: they are the input.\n\n"
        "**Memory**: a pixel fires when its level has moved by a threshold from a memorised level "
        "(`events.memory`). Unfitted: θ 0.2, lin-log level. Fitted: the level is a low-pass of "
        "ln(I + dark offset) of a partly blurred picture, with a threshold for either polarity and noise "
        "that fades with light; Adam on the logarithms of these seven numbers, gradients "
        f"through straight-through counts, loss `{run.config.loss}`.\n\n"
        "**Naive**: one event where two frames differ by θ. Its fitted rows are the best of a grid of "
        "thresholds and dark offsets by the same loss; 'shape alone': by correlation only." + moved
    )


def _table(run, fold, figures):
    columns = (
        "model",
        *(f"correlation, {side_px} px" for side_px in POOLING_PX),
        "ON ratio",
        "OFF ratio",
        "per polarity",
        "rates off by",
        "slope",
    )
    rows = [
        (
            LABELS[name],
            *map(str, made.correlation.values()),
            *map(str, made.ratio),
            f"{made.by_polarity:.3f}",
            f"{made.rate_factor:.2f}",
            f"{made.slope:.2f}",
        )
        for name, made in figures.items()
    ]
    run.table(
        f"Judged on the {fold.judged} half, fitted on the other",
        columns,
        rows,
        (
            "Correlation of ON − OFF per interval over all pixels, or over squares of 2 and 4 px; events "
            "simulated over recorded. In brackets 95 % intervals from "
            "bootstrap over blocks of 20 x 20 pixels. 'Per polarity': correlation of ON counts and OFF "
            "counts, not their difference, 1 px. 'Rates off by': factor by which the "
            "events of an interval and polarity are typically too many or too few (root mean square of its "
            "logarithm). 'Slope': simulated over recorded ON − OFF, least squares over squares of 4 px."
        ),
    )


def _side_by_side(run, found, best):
    recorded = found.recording.counts()
    simulated = found.simulated["second"]
    fold = found.folds[0]
    names = ("naive", "unfitted", best)
    totals = recorded.sum((1, 2, 3))
    ranked = sorted(range(fold.test.start, fold.test.stop), key=lambda k: float(totals[k]))
    chosen = [ranked[-1], ranked[len(ranked) // 2], ranked[0]]
    labels = [f"interval {k}\n{int(totals[k]):,} events" for k in chosen]
    run.section(
        "Side by side",
        "Red: more ON, blue: more OFF. The half that was not fitted: its busiest, a middling and its "
        "quietest interval.",
    )
    run.figure(
        draw.maps(recorded, simulated, names, chosen, labels),
        "maps",
        "Signed counts per pixel, recorded and simulated. Rows of pixels with hardly any event are cut off.",
    )
    caption = "Signed counts over squares of 4 x 4 pixels, second half; on the red line simulated equals recorded. What lies beyond the picture is drawn at its edge. The naive emulator ends at one event per pixel."
    run.figure(draw.scatter(recorded, simulated, names, fold, 4), "scatter", caption)


def _parameters(run, found):
    run.section(
        "Fitted parameters",
        "Fits to either half: their difference says how well the recording determines them. Thresholds "
        "trade off against the dark offset.",
    )
    model = {"frames": "fitted", "moved": "fitted_moved"}
    other = {"second": "first", "first": "second"}
    columns = (
        "parameter",
        "start",
        *(
            f"{LABELS[model[name]]}, {other[fold.judged]} half"
            for name in found.clips
            for fold in found.folds
        ),
    )
    fits = [found.sensors[fold.judged][name].values() for name in found.clips for fold in found.folds]
    run.table(
        "By gradient",
        columns,
        [
            (label, f"{START[key]:.3g}", *(f"{float(fit[key].detach()):.3g}" for fit in fits))
            for key, label in PARAMETERS.items()
        ],
    )
    rows = [
        (
            LABELS[f"naive_{model[name].replace('fitted', kind)}"],
            *(f"{value:.3g}" for fold in found.folds for value in found.naives[fold.judged][name][kind]),
        )
        for name in found.clips
        for kind in ("fitted", "shape")
    ]
    run.table(
        "Naive emulator, best of a grid",
        ("model", "θ, first half", "dark offset, first half", "θ, second half", "dark offset, second half"),
        rows,
    )


def _limits(now, found, best):
    fitted = found.figures["second"]
    at = "fitted_on_second_half_moved_times"
    moved = (
        f" Moved frames bring {now['cancelled_share_fitted_moved']:.0%}, and fewer than the recording "
        "because the frames are smeared."
        if best == "fitted_moved"
        else ""
    )
    lines = [
        f"- **Slow frames.** {now['cancelled_share_recorded']:.0%} of the recorded events are undone by the "
        "other polarity in the same pixel and interval: rims and highlights pass by. Two frames show "
        f"only the net change.{moved} To reach the number of events, the fit makes up for them where there "
        f"is a net change: strong changes get {fitted[best].slope:.2f} times their events.",
        f"- **Exposure.** The shutter is open for {now['exposed_share_of_time']:.0%} of the time. What "
        "moves by some pixels meanwhile is smeared in the frames, not in the events; "
        "what is fast and fine gets too few events, and the fit, which holds the sum, gives more to what is "
        "slow (rates by interval, above).",
        "- **Timing.** The recording, compared with itself moved by 5 ms, correlates by "
        f"{now['recording_on_second_half_against_itself_5_ms_later_correlation_1px']:.3f}. Its events come "
        f"{1e3 * now[at + '_offset_s']:.0f} ms later than the mid-exposures say (offset chosen on the "
        "fitted half): with moved times the fitted sensor on plain frames reaches "
        f"{now[at + '_correlation_1px']:.3f} instead of {now[at + '_correlation_1px_unmoved']:.3f}. A "
        "low-pass does not recover this from the frames, which do not say when within an interval a pixel "
        "changed.",
    ]
    if "still_pixel_on_hz" in now:
        lines.append(
            f"- **Weak changes and noise.** {now['still_pixel_share']:.0%} of the pixels are still in the "
            f"frames. They make {now['still_pixel_event_share']:.1%} of the events, "
            f"{now['still_pixel_on_hz']:.2f} ON and {now['still_pixel_off_hz']:.2f} OFF per pixel and "
            f"second, but only {now['still_pixel_hz_in_quietest_interval']:.2f} of both in the quietest "
            "interval: "
            "most of them come with the motion, from changes too weak for 8-bit frames. The fitted noise "
            "stands for them, and differs between the halves."
        )
    return "\n".join(lines)
