"""The part of the lens report about the distance of the object: depth of field, hyperfocal
distance, spots."""

import math

from codesign.errors import DomainError
from codesign.lens import analysis
from codesign.lens.distance import vergence_per_mm
from codesign.report import lens_curves


def depth(run, geo, fields, light, distances):
    """Depth of field of the film as it stands, hyperfocal distance, and spots at the distances
    asked for."""
    wavelength_um = light[0]
    blur_mm = run.config.blur_um * 1e-3
    run.section(
        "Over the distance",
        f"A point is sharp enough where its blur disc is at most {run.config.blur_um:g} µm across: of paraxial rays, "
        f"and of traced ones by the RMS spot of such a disc, both at {wavelength_um * 1e3:.0f} nm. Metres from the "
        "entrance pupil.",
    )
    limits = []
    refused = []
    for title, function in (
        ("paraxial", analysis.depth_of_field),
        ("traced", analysis.traced_depth_of_field),
    ):
        try:
            found = function(geo, blur_mm, wavelength_um=wavelength_um)
        except DomainError as error:
            refused.append(f"{title}: {error}")
            continue
        ends = {"near": found.near_m, "far": found.far_m}
        limits.append((title, *(f"{v:.4g}" for v in (*ends.values(), found.focus_m))))
        for name, end in ends.items():
            if math.isfinite(end):
                run.record(**{f"depth_of_field_{name}_m_{title}": end})
    nearest = min(distances)
    try:
        hyperfocal = float(analysis.hyperfocal_m(geo, blur_mm, wavelength_um))
        run.record(hyperfocal_m=hyperfocal)
        refused.append(
            f"Focused on {hyperfocal:.4g} m, the hyperfocal distance, everything from about half of it to infinity is "
            "sharp enough."
        )
        nearest = min(nearest, hyperfocal / 4)
    except DomainError as error:
        refused.append(str(error))
    if limits:
        run.table(
            "Depth of field on the axis", ("rays", "near (m)", "far (m)", "sharpest (m)"), limits
        )
    run.text(" ".join(refused))
    sizes = [
        [
            1e3
            * float(
                analysis.spot_radius_mm(
                    *analysis.polychromatic_spot(geo, f, light, vignetting=True, at_m=d)
                )
            )
            for f in fields
        ]
        for d in distances
    ]
    run.table(
        "RMS spot, all wavelengths (µm), film where it stands",
        ("object at (m)", *(f"{math.degrees(f):.3g}°" for f in fields)),
        [(f"{d:g}", *(f"{v:.2f}" for v in row)) for d, row in zip(distances, sizes, strict=True)],
    )
    for d, row in zip(distances, sizes, strict=True):
        for f, v in zip(fields, row, strict=True):
            run.record(**{f"rms_spot_um_{math.degrees(f):.3g}deg_at_{d:g}m".replace(".", "p"): v})
    try:
        vergence_per_mm(geo, nearest)
    except DomainError:
        nearest = min(distances)
    if math.isfinite(nearest):
        run.figure(
            lens_curves.depth_curves(geo, fields, nearest, math.inf, blur_mm, wavelength_um),
            "depth",
            f"RMS spot at {wavelength_um * 1e3:.0f} nm over the distance of the object; dashed: that of a disc of the blur "
            "allowed.",
        )
