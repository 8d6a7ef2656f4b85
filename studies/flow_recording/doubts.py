"""What the figures of a recording do not say: windows and events left out, and why a true flow may be none."""

SHARPER = 1.02  # times the truth's FWL: estimates are sharper than a truth that is right by less
NAMED = 5  # packets that a sentence names


def counts(packets, rows, name):
    """{metric: number} of the faults of a recording and of its packets. rows: (packet, estimator, figures); name:
    the estimator that is compared with the truth."""
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


def sentences(packets, rows, name):
    """Paragraphs for the page, those alone that concern this recording."""
    found = counts(packets, rows, name)
    empty = found["packets_without_events"]
    blind = found["packets_without_truth"]
    if empty or blind:
        yield (
            f"{empty} packet(s) hold no event, {blind} have no true flow; they do not count in the figures that need "
            "one."
        )
    left_out = [
        f"{number} {fault.replace('_', ' ')}" for fault, number in packets[0].left_out.items() if number
    ]
    if left_out:
        yield f"**Left out**: {', '.join(left_out)}."
    if found["packets_across_gaps"]:
        yield (
            f"**{found['packets_across_gaps']} packet(s) lie across a gap** of the recording, where no pixel sent an "
            "event: their flow is that of the rest of the window."
        )
    moving = [packet.name for packet in packets if packet.translates]
    if moving:
        yield (
            f"**The camera translates** in {len(moving)} packet(s) ({_some(moving)}), and the only true flow is that of "
            "its rotation: the difference from it is no error and is not counted as one; FWL says how good the flow is."
        )
    if found["truth_undistorted_doubt_px"]:
        yield (
            "**The camera has distortion**, and the true flow comes from a file: if that is of undistorted pixels, it "
            f"is {found['truth_undistorted_doubt_px']:.2f} px off in the mean of a packet, enough to turn rankings "
            "round. `--truth-pixels undistorted` carries it to the sensor's pixels."
        )
    sharper = _sharper(rows, name)
    if sharper:
        yield (
            f"**{name} makes the events sharper than the true flow does** in {len(sharper)} packet(s) "
            f"({_some(sharper)}): the truth may belong to other pixels or times, or leave something out; errors "
            "against it are then not the estimate's alone."
        )
    doubtful = [
        packet.name for packet, one, figures in rows if one == name and (figures["truth_fwl"] or 1) < 1
    ]
    if doubtful:
        yield (
            f"**The true flow makes the events less sharp than none** in {len(doubtful)} packet(s) "
            f"({_some(doubtful)}): check its unit, times and axes, or whether it holds there."
        )


def _sharper(rows, name):
    return [
        packet.name
        for packet, one, figures in rows
        if one == name and figures["truth_fwl"] and figures["fwl"] > SHARPER * figures["truth_fwl"]
    ]


def _some(names):
    return ", ".join(names[:NAMED]) + (", ..." if len(names) > NAMED else "")
