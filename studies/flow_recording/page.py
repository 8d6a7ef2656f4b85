"""The page of a recording: figures and their means, pictures, and what they do not say: windows and
events left out, and why a true flow may be none."""

import operator
import statistics

import torch

from codesign.flow.contrast import count_image, stream_tracks
from codesign.report.flow_colours import flow_colours
from codesign.report.prose import counted
from studies.frame.show import pictures as show_pictures

FEW = 100  # events of a packet
SHARPER = 1.02  # times the truth's FWL: estimates are sharper than a truth that is right by less
NAMED = 5  # packets that a sentence names
UNITS = {
    "aee_px": "AEE, px",
    "rotation_difference_px": "difference from the flow of rotation alone, px",
    "aee_dense_px": "AEE everywhere, px",
    "zero_aee_px": "AEE of zero flow, px",
    "outlier_percent": "outliers, %",
    "angular_error_deg": "angular error, degrees",
    "fwl": "FWL",
    "rsat": "RSAT",
    "fwl_where_known": "FWL where flow is known",
    "truth_fwl": "FWL of the true flow there",
}


def show(run, packets, rows, names, film):
    """Metrics, tables and page. rows: (packet, estimator, figures); names: of the estimators; film:
    or None."""
    means = {name: _means([found for _, one, found in rows if one == name]) for name in names}
    for name, mine in means.items():
        run.record(**{f"{_key(name)}_{figure}": value for figure, value in mine.items()})
    # the trained network where there is one; its figures also under plain names
    best = names[-1]
    main = means[best]
    run.record(packets=len(packets), **counts(packets, rows, best))
    run.record(**{figure: main[figure] for figure in UNITS if figure in main})
    if "aee_px" in main:
        zero = f"zero flow: {main['zero_aee_px']:.3f} px"
        run.card(f"AEE where events are, {best}", f"{main['aee_px']:.3f} px", zero)
    if "fwl" in main:
        share = f"above 1 in {100 * main['fwl_above_1_share']:.0f} % of packets"
        run.card(f"FWL, {best}", f"{main['fwl']:.3f}", share)
    synthetic = run.config.recording is None
    made_up = (
        "**The recording is synthetic**: a camera that turns before a photograph; the simulator's events, "
        "the gyroscope's exact rates. "
    )
    notes = " ".join(f"{note}." for note in packets[0].notes)
    run.section("Packets", f"{made_up if synthetic else ''}{notes}")
    table = [
        (packet.name, _ms(packet), len(packet.stream), name, *map(found.get, UNITS))
        for packet, name, found in rows
    ]
    run.table(
        "Every packet",
        ("packet", "ms", "events", "estimator", *UNITS.values()),
        table,
        "AEE, outliers (above 3 px and 5 % of the true length) and angles where events are and the truth "
        "is valid, unless said otherwise. FWL above 1: sharper than without flow; RSAT below 1 likewise.",
    )
    table = [(name, *map(mine.get, UNITS)) for name, mine in means.items()]
    run.table("Means over packets", ("estimator", *UNITS.values()), table)
    if len(packets) < (run.config.packets or 0):
        run.text(
            f"**{len(packets)} of the {run.config.packets} windows asked for**: no more fit in the recording, and a true flow "
            "without times tells of one window only, at its start."
        )
    for sentence in doubts(packets, rows, best):
        run.text(sentence)
    if film is not None:
        run.section("Video", film.sentence)
        run.video(film.path.name, film.caption)
    source = "a synthetic recording" if synthetic else f"`{run.config.recording}`"
    seen = sum(bool(len(packet.stream)) for packet in packets)
    run.finish(
        "Event flow on a recording",
        f"{answer(best, main)} Means of {counted(seen, 'packet')} with events of {source}.",
    )


def answer(name, means):
    """How well an estimator works on a recording, by its mean figures."""
    said = []
    if "aee_px" in means:
        share = means["aee_px"] / max(means["zero_aee_px"], 1e-9)
        said.append(
            f"errs by {means['aee_px']:.2f} px where events are, {share:.2f} times what zero flow does"
        )
    if "fwl" in means:
        sharper = f"{means['fwl_above_1_share']:.0%} of the packets (FWL {means['fwl']:.2f})"
        said.append(f"sharpens the events of {sharper}, warped along it")
        if means["fwl"] > 1 < means.get("rsat", 0):
            said.append(f"yet by RSAT ({means['rsat']:.2f}) blurs them: the measures disagree")
    return (
        f"The flow of '{name}' {', and '.join(said) or 'cannot be judged: no packet has events'}."
    )


def _key(name):
    return name.replace("-", "_").replace(".", "_")


def _ms(packet):
    return 1e-3 * (packet.t1_us - packet.t0_us)


def _means(found):
    """{figure: mean over the packets that have it}, and shares of packets."""
    values = {figure: [each[figure] for each in found if figure in each] for figure in UNITS}
    means = {figure: statistics.fmean(each) for figure, each in values.items() if each}
    if sharp := values["fwl"]:
        means["fwl_least"] = min(sharp)
        means["fwl_above_1_share"] = statistics.fmean(value > 1 for value in sharp)
    if "aee_px" in means:
        worse = map(operator.gt, values["aee_px"], values["zero_aee_px"])
        means["worse_than_zero_share"] = statistics.fmean(worse)
    return means


def counts(packets, rows, name):
    """{metric: number} of the faults of a recording. name: the estimator held against the truth."""
    return {
        "packets_without_events": sum(not len(packet.stream) for packet in packets),
        "packets_without_truth": sum(packet.truth is None for packet in packets),
        "packets_translating": sum(packet.translates for packet in packets),
        "packets_across_gaps": sum(packet.across_gap for packet in packets),
        "packets_sharper_than_truth": len(_sharper(rows, name)),
        "truth_undistorted_doubt_px": max(packet.undistorted_px for packet in packets),
        "events": sum(len(packet.stream) for packet in packets),
        **{f"left_out_{fault}": number for fault, number in packets[0].left_out.items()},
    }


def doubts(packets, rows, name):
    """Paragraphs for the page, those alone that concern this recording."""
    found = counts(packets, rows, name)
    empty, blind, gaps = (
        found[f"packets_{what}"] for what in ("without_events", "without_truth", "across_gaps")
    )
    left_out = [
        f"{number} {fault.replace('_', ' ')}"
        for fault, number in packets[0].left_out.items()
        if number
    ]
    moving = [packet.name for packet in packets if packet.translates]
    distorted_px = found["truth_undistorted_doubt_px"]
    sharper = _sharper(rows, name)
    mine = [(packet.name, figures) for packet, one, figures in rows if one == name]
    blurred = [packet for packet, figures in mine if figures.get("truth_fwl", 1) < 1]
    few = statistics.median(len(packet.stream) for packet in packets)
    sentences = (
        (
            few < FEW,
            f"**A packet holds {few:g} events** (median), too few to tell flow: is the unit of the times right "
            "(`--time-unit`), and the window long enough?",
        ),
        (
            empty or blind,
            f"Packets without any event: {empty}, without true flow: {blind}; they do not count in the "
            "figures that need one.",
        ),
        (left_out, f"**Left out**: {', '.join(left_out)}."),
        (
            gaps,
            f"**Across a gap lie {counted(gaps, 'packet')}** of the recording, where no pixel sent an event: their "
            "flow is that of the rest of the window.",
        ),
        (
            moving,
            f"**The camera translates** in {_some(moving)}, and the only true flow is that of its "
            "rotation: the difference from it is no error and is not counted as one; FWL says how good "
            "the flow is.",
        ),
        (
            distorted_px,
            "**The camera has distortion**, and the true flow comes from a file: if that is of "
            f"undistorted pixels, it is {distorted_px:.2f} px off in the mean of a packet, enough to turn "
            "rankings round. `--truth-pixels undistorted` carries it to the sensor's pixels.",
        ),
        (
            sharper,
            f"**{name} makes the events sharper than the true flow does** in {_some(sharper)}: the truth "
            "may belong to other pixels or times, or leave something out; errors against it are then not "
            "the estimate's alone.",
        ),
        (
            blurred,
            f"**The true flow makes the events less sharp than none** in {_some(blurred)}: check its unit, "
            "times and axes, or whether it holds there.",
        ),
    )
    return [sentence for holds, sentence in sentences if holds]


def _sharper(rows, name):
    return [
        packet.name
        for packet, one, figures in rows
        if one == name
        and "truth_fwl" in figures
        and figures["fwl_where_known"] > SHARPER * figures["truth_fwl"]
    ]


def _some(names):
    return f"{counted(len(names), 'packet')} ({', '.join(names[:NAMED])}{', ...' if len(names) > NAMED else ''})"


def caption(packet):
    return (
        f"{packet.name}: {len(packet.stream)} events in {_ms(packet):.2f} ms. {'; '.join(packet.notes)}. "
        "Hue is the direction of the flow, saturation its length; black where nothing is known."
    )


def pictures(packet, fields):
    """Figure: per estimator a row of the events as they came, the events warped to the window's
    end, the flow, and the true flow. fields: {name: FlowField}."""
    still = _warped(packet, torch.zeros(1, 2, packet.stream.height_px, packet.stream.width_px))
    truth = packet.truth
    longest = None
    if truth is not None and truth.valid.any():
        longest = float(truth.flow_px.abs().amax(1)[truth.valid].max())
    rows = {}
    for name, field in fields.items():
        full = longest or max(float(field.flow_px.abs().max()), 1e-6)
        known = field.valid[0]
        if field.confidence is not None:
            known = known & (field.confidence[0] > 0)
        row = rows[f"{name}, full colour {full:.1f} px"] = {
            "events as they came": still,
            "warped by the flow": _warped(packet, field.flow_px),
            "flow": _colours(field.flow_px[0], known, full),
        }
        if truth is not None:
            row["true flow"] = _colours(truth.flow_px[0], truth.valid[0], full)
    return show_pictures(rows, side=3.0, flow=True)


def _colours(flow_px, known, full):
    colours = torch.from_numpy(flow_colours(flow_px.numpy(), full))
    return torch.where(known[..., None], colours, torch.zeros_like(colours)).numpy()


def _warped(packet, flow_px):
    if not len(packet.stream):
        return torch.zeros(flow_px.shape[2:])
    tracks = stream_tracks(packet.stream, flow_px, packet.t0_us, packet.t1_us)
    return count_image(tracks, 1.0)[0].sum(0)
