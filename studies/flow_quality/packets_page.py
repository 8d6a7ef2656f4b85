"""Recordings on the page of studies.flow_quality: figures of every estimator on packets of a fixed number of
events."""

import statistics

from studies.flow_quality.recordings import cases, judged, of_reference

MEASURES = ("distance_px", "aee_px", "fwl")
TITLES = {
    "distance_px": (
        "Distance to the contrast maximisation, px",
        "Mean over pixels with events; mean over packets (worst). The judge sees single events, and searches "
        "all rotations or affine flows.",
    ),
    "aee_px": (
        "Endpoint error where events are, px",
        "Against the exact flow; mean over packets (worst).",
    ),
    "fwl": ("Flow warp loss (FWL)", "Above 1 is sharper; mean over packets (least)."),
}
JUDGED = "refiner"
REFERENCE = "closed_form_quadratic"  # whose distance the network's is compared with


def show(run, who, bins):
    """Measure, record, and show."""
    found = {}
    counts = {}
    todo = cases(run.config, run.say)
    with run.progress(len(todo), "packets") as progress:
        for case in todo:
            reference = case.seek()
            rows = {name: judged(case, reference, estimate, bins) for name, estimate in who.items()}
            rows |= of_reference(case, reference, bins)
            found.setdefault(case.kind, []).append(rows)
            counts.setdefault(case.kind, []).append((case.packet, case.assumed))
            progress.advance()
    for kind, packets in found.items():
        _record(run, kind, packets)
    run.section(
        "Recordings",
        "Packets of a fixed number of events. `turning` and `sliding` are made here with the full sensor "
        "(bandwidth, mismatch, noise, leak, dead time, hot pixels) and have exact flow.",
    )
    rows = []
    for kind, packets in counts.items():
        stream = packets[0][0].stream
        length_ms = statistics.fmean(1e-3 * (p.t1_us - p.t0_us) for p, _ in packets)
        density = statistics.fmean(len(p.stream) for p, _ in packets) / (stream.height_px * stream.width_px)
        rows.append([kind, len(packets), round(length_ms, 2), round(density, 3), packets[0][1]])
    run.table("Packets", ["packets", "number", "mean ms", "events per px", "contrast maximisation of"], rows)
    names = [*who, "contrast_maximisation", "true_flow", "zero_flow"]
    for measure in MEASURES:
        title, note = TITLES[measure]
        rows = []
        for kind, packets in found.items():
            cells = [_cell(packets, name, measure) for name in names]
            if any(cells):
                rows.append([kind, *cells])
        run.table(title, ["packets", *(name.replace("_", " ") for name in names)], rows, note)


def _values(packets, name, measure):
    values = [rows[name][measure] for rows in packets if name in rows]
    return [value for value in values if value is not None]


def _cell(packets, name, measure):
    values = _values(packets, name, measure)
    if not values:
        return None
    worst = min(values) if measure == "fwl" else max(values)
    return f"{statistics.fmean(values):.2f} ({worst:.2f})"


def _record(run, kind, packets):
    names = {name for rows in packets for name in rows}
    for name in sorted(names):
        for measure in MEASURES:
            values = _values(packets, name, measure)
            if values:
                run.record(
                    **{
                        f"{kind}_{name}_{measure}": statistics.fmean(values),
                        f"{kind}_{name}_{measure}_{'least' if measure == 'fwl' else 'largest'}": (
                            min(values) if measure == "fwl" else max(values)
                        ),
                    }
                )
    if JUDGED in packets[0] and REFERENCE in packets[0]:
        shares = [rows[JUDGED]["distance_px"] / rows[REFERENCE]["distance_px"] for rows in packets]
        run.record(**{f"{kind}_{JUDGED}_distance_over_closed_form_largest": max(shares)})
