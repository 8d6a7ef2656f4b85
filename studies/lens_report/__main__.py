"""What a lens can do: first-order figures, Seidel sums, layout, spots, fans, wavefront, point
spread, MTF, distortion and field curvature on one page.

Any lens that `codesign.lens.load` reads. The object is at infinity, or at the distances of --at-m;
apertures clip. Where a lens names no half field, the largest field up to 10 degrees whose chief ray
and at least half of whose rays arrive is taken, and the page says so.
"""

import contextlib
import math
import sys
import time
from dataclasses import dataclass

import torch

from codesign import lens
from codesign.errors import DomainError
from codesign.lens import analysis
from codesign.lens.distance import vergence_per_mm
from codesign.lens.paraxial import cardinal_points, image_scale_mm
from codesign.lens.seidel import NAMES, seidel_sums
from codesign.report import lens_curves, lens_figures
from codesign.report.lens_layout import degrees
from studies.frame.run import Run, StudyConfig, main
from studies.lens_report.depth import depth

SHARES = (0.0, 0.7, 1.0)
WIDEST_DEG = 10.0  # where a lens does not say
ALL_PASS = 0.995  # share from which the page does not say how many
FEWEST = 0.05  # share of the rays of a field that must arrive for it to be shown
# across the pupil; where a wavefront or a picture asks for more, rays tell nearly the same
MOST_CELLS = 512
# periods of the highest frequency within the radius that holds the rays: beyond, an MTF is hardly
# more than 0 and asks for ever more rays
SPREADS = 16.0
# across the pupil, of every spot and of every wavefront that a figure is taken from
SPOT_CELLS = 32
FRONT_CELLS = 96


@dataclass(frozen=True)
class Config(StudyConfig):
    lens: str = "cooke-triplet"
    """Name in the catalogue, or a lens file."""
    half_field_deg: float | None = None
    """Half field, degrees; that of the lens when left out."""
    wavelengths_um: tuple[float, ...] = lens_figures.VISIBLE_UM
    """Wavelengths of equal weight; the first is the reference."""
    at_m: tuple[float, ...] = ()
    """Distances of the object, metres from the entrance pupil; pictures are those of the first.
    Left out: parallel light."""
    focus_m: float | None = None
    """Distance of the axial point whose RMS spot is least on the film; the first of --at-m, or as
    in the lens file where that is left out too."""
    blur_um: float = 20.0
    """Diameter of the blur that the depth of field allows, micrometres."""


def study(run: Run[Config]) -> None:
    start = time.perf_counter()
    if not run.config.blur_um > 0:
        raise DomainError(
            f"a blur of {run.config.blur_um:g} um cannot be; give a positive diameter."
        )
    geo = lens.load(run.config.lens).requires_grad_(False)
    light = run.config.wavelengths_um
    for line in light:
        geo.first_order(line)  # says what is wrong with it
    quick = run.config.quick
    analysis.spectral_lines(light)
    distances = run.config.at_m or (math.inf,)
    vergence_per_mm(geo, distances)
    at_m = distances[0]
    focus_m = at_m if run.config.focus_m is None and run.config.at_m else run.config.focus_m
    geo = geo if focus_m is None else geo.focus_at(focus_m, light[0], spot_grid=16)
    half_deg, why = half_field(geo, run.config.half_field_deg, light[0], at_m)
    fields, left_out = arriving([math.radians(half_deg) * h for h in SHARES], geo, light[0], at_m)
    notes = [
        why,
        f"The object lies at {names_of(distances)}; the film "
        + ("stands as in the lens file." if focus_m is None else f"is focused on {focus_m:g} m."),
        *(
            f"The field of {math.degrees(f):.3g}° is left out: fewer than {FEWEST:.0%} of its rays arrive."
            for f in left_out
        ),
    ]
    first_order(run, geo, light, half_deg, at_m)
    seidel(run, geo, math.radians(half_deg), light[0], at_m)
    spots = pictures(run, geo, fields, light, quick, at_m)
    sharpness(run, geo, fields, light, quick, at_m)
    depth(run, geo, fields, light, distances)
    run.record(half_field_deg=half_deg, seconds=time.perf_counter() - start)
    said = f"At f/{run.metrics['fno']:.3g} the lens makes RMS spots of {', '.join(spots)}"
    said += "." if math.isinf(at_m) else f" of an object at {at_m:g} m."
    run.finish(f"Lens report: {geo.name}", " ".join([said, *notes]))


def half_field(geo, wanted_deg, wavelength_um, at_m=math.inf):
    """Half field in degrees, and a sentence that says where it comes from."""
    if wanted_deg is not None:
        if not 0 < wanted_deg < 90:
            raise DomainError(
                f"a half field of {wanted_deg} degrees cannot be; give one between 0 and 90."
            )
        return wanted_deg, f"Half field {wanted_deg:g}°, as asked."
    if geo.half_field_deg is not None:
        return geo.half_field_deg, f"Half field {geo.half_field_deg:.4g}°, that of the lens."
    degrees = WIDEST_DEG
    while degrees > 0.1 and arrival(geo, math.radians(degrees), wavelength_um, at_m) < 0.5:
        degrees /= 1.25
    return (
        degrees,
        f"The lens names no half field; {degrees:.3g}° is taken, the largest up to {WIDEST_DEG:g}° (in "
        "steps of 1.25) of which at least half of the rays pass.",
    )


def arrival(geo, field_rad, wavelength_um, at_m=math.inf):
    """Share of the pupil's light that arrives at a field, 0 when its chief ray does not."""
    try:
        analysis.chief_ray(geo, field_rad, wavelength_um, at_m=at_m)
        return analysis.trace_field(
            geo, field_rad, analysis.pupil_grid(32, geo.dtype), wavelength_um, True, at_m=at_m
        ).weight.mean()
    except DomainError:
        return 0.0


def arriving(fields, geo, wavelength_um, at_m=math.inf):
    """Fields that can be shown, and those that cannot. Raises: DomainError when none can."""
    good = [field for field in fields if arrival(geo, field, wavelength_um, at_m) >= FEWEST]
    if not good:
        raise DomainError(
            f"{geo.name}: hardly a ray of the fields {[round(math.degrees(f), 2) for f in fields]} degrees "
            "passes all apertures; check apertures, stop and entrance pupil."
        )
    return good, [field for field in fields if field not in good]


def first_order(run, geo, light, half_deg, at_m):
    f = geo.first_order(light[0])
    points = cardinal_points(geo, light[0])
    run.card(
        "Focal length",
        f"{f.efl_mm:.4g} mm",
        f"f/{f.fno:.3g} at {light[0] * 1e3:.0f} nm",
    )
    run.record(efl_mm=f.efl_mm, bfl_mm=f.bfl_mm, fno=f.fno)
    run.section("First order")
    scale = image_scale_mm(geo, vergence_per_mm(geo, at_m), light[0])
    figures = {
        "effective focal length": f.efl_mm,
        "back focal length": f.bfl_mm,
        "f-number (no unit)": f.fno,
        "image plane behind the last vertex": geo.thickness_mm[-1],
        "length, first to last vertex": geo.thickness_mm[:-1].sum(),
        "entrance pupil, from the first vertex": f.entrance_pupil_z_mm,
        "entrance pupil diameter": f.entrance_pupil_diameter_mm,
        "exit pupil, from the last vertex": f.exit_pupil_z_mm,
        "exit pupil diameter": f.exit_pupil_diameter_mm,
        "stop semi-aperture": f.stop_semi_aperture_mm,
        "front focal point, from the first vertex": points.front_focal_z_mm,
        "front principal point, from the first vertex": points.front_principal_z_mm,
        "rear principal point, from the last vertex": points.rear_principal_z_mm,
        "rear nodal point, from the last vertex": points.rear_nodal_z_mm,
        f"image height at {half_deg:.4g}°, paraxial": scale * math.tan(math.radians(half_deg)),
    }
    run.table(
        f"Paraxial figures at {light[0] * 1e3:.1f} nm, mm",
        ("figure", "mm"),
        [(name, f"{value:.6g}") for name, value in figures.items()],
    )
    if len(light) > 1:
        colour = 1e3 * analysis.chromatic_focus_shift_mm(geo, light, light[0], at_m)
        rows = [(f"{w * 1e3:.1f}", f"{shift:.4g}") for w, shift in zip(light, colour, strict=True)]
        run.table("Paraxial focus by wavelength", ("nm", "shift (µm)"), rows)


def seidel(run, geo, half_rad, wavelength_um, at_m):
    sums = seidel_sums(geo, half_rad, wavelength_um, at_m=at_m)
    run.section(
        "Seidel sums",
        "Wavefront coefficients in waves at the rims of pupil and field; positive spherical aberration is "
        "undercorrected. Colour sums lie between F and C.",
    )
    figure = lens_curves.seidel_bars(sums, wavelength_um)
    run.figure(figure, "seidel", "Contributions of the surfaces, and their sums.")
    colours = torch.stack([sums.axial_colour, sums.lateral_colour], 1)
    columns = torch.cat([sums.per_surface, colours], 1) / (wavelength_um * 1e-3)
    total = columns.sum(0)
    cells = [(f"{v:.4f}" for v in row) for row in (*columns, total)]
    rows = [(str(k), *row) for k, row in enumerate(cells, 1)]
    rows[-1] = ("total", *rows[-1][1:])
    heads = ("surface", "S I", "S II", "S III", "S IV", "S V", "C I", "C II")
    run.table("Seidel sums, waves", heads, rows)
    run.record(
        **{f"seidel_{name}_waves": value for name, value in zip(NAMES, total[:5], strict=True)}
    )


def pictures(run, geo, fields, light, quick, at_m):
    """Layout, spots, fans, field errors; returns what is said of the RMS spot of each field."""
    run.section("Layout")
    run.figure(
        lens_figures.lens_layout(geo, fields, at_m=at_m),
        "layout",
        "Cross-section with meridional rays; only rays that pass all apertures are drawn.",
    )
    run.section("Rays")
    run.figure(
        lens_figures.spots_by_wavelength(geo, fields, light, SPOT_CELLS, True, at_m),
        "spots",
        f"Spots about the chief ray at {light[0] * 1e3:.0f} nm; the RMS is that of all wavelengths; the "
        "circle is the Airy disc.",
    )
    run.figure(
        lens_figures.ray_fans(geo, fields, light, True, at_m),
        "fans",
        "Ray fans: transverse aberration and optical path difference over the pupil.",
    )
    run.figure(
        lens_curves.encircled_curves(geo, fields, light, True, at_m),
        "encircled_energy",
        "Encircled energy of the rays about their mean.",
    )
    run.section("Over the field")
    half = fields[-1] or math.radians(0.5)
    run.figure(
        lens_curves.field_errors(geo, half, light, count=9 if quick else 21, at_m=at_m),
        "field_errors",
        "Field curvature of thin bundles, and distortion against the tangent"
        + (", and lateral colour of the chief ray." if len(light) > 1 else "."),
    )
    rows = []
    said = []
    for field in fields:
        positions, weight = analysis.polychromatic_spot(
            geo, field, light, SPOT_CELLS, True, at_m=at_m
        )
        shift = analysis.focus_shift_mm(geo, [field], light[0], at_m=at_m)[0]
        radius = 1e3 * float(analysis.spot_radius_mm(positions, weight))
        distortion = float(
            analysis.distortion_percent(geo, [field], wavelength_um=light[0], at_m=at_m)[0]
        )
        passed = arrival(geo, field, light[0], at_m)
        record_at(
            run, field, rms_spot_um=radius, distortion_percent=distortion, passed_share=passed
        )
        said.append(
            f"{radius:.1f} µm at {degrees(field)}"
            + (f" (of the {passed:.0%} of its rays that pass)" if passed < ALL_PASS else "")
        )
        foci = (f"{s:.4f}" for s in shift)
        rows.append((degrees(field), f"{radius:.2f}", f"{distortion:.3f}", *foci, f"{passed:.3f}"))
    run.table(
        "By field",
        (
            "field",
            "RMS spot, all wavelengths (µm)",
            "distortion (%)",
            "tangential focus (mm)",
            "sagittal focus (mm)",
        )
        + ("share that passes",),
        rows,
    )
    return said


def record_at(run, field, **figures):
    place = f"{math.degrees(field):.3g}deg".replace(".", "p")
    run.record(**{f"{name}_{place}": float(value) for name, value in figures.items()})


def sharpness(run, geo, fields, light, quick, at_m):
    run.section(
        "Wavefront",
        f"At {light[0] * 1e3:.0f} nm, against the sphere about the chief ray's image point.",
    )
    run.figure(
        lens_figures.opd_maps(geo, fields, light[0], FRONT_CELLS, True, at_m),
        "wavefront",
        "Optical path difference over the entrance pupil, piston and tilt removed.",
    )
    rows = []
    for field in fields:
        front = analysis.wavefront(geo, field, light[0], FRONT_CELLS, True, at_m=at_m)
        flat = analysis.remove_fit(front)
        rms, extent = analysis.rms_waves(front), analysis.peak_to_valley_waves(front)
        figures = rms, analysis.rms_waves(flat), extent, analysis.strehl_direct(flat)
        record_at(run, field, rms_waves=rms)
        rows.append((degrees(field), *(f"{v:.4f}" for v in figures)))
    run.table(
        "Wavefront by field",
        ("field", "RMS (waves)", "RMS without tilt", "peak to valley", "Strehl ratio without tilt"),
        rows,
    )
    fno = float(analysis.working_fno(geo, light[0], at_m))
    airy = light[0] * 1e-3 * fno
    how = {"about_chief": True, "at_m": at_m}
    widest = max(
        float(analysis.encircled_radius_mm(geo, field, 0.99, light, 48, True, **how))
        for field in fields
    )
    pixels = 64 if quick else 96
    pixel = max(2.6 * widest, 12 * airy) / pixels
    highest = round_frequency(min(1 / airy, 250.0, SPREADS / max(widest, airy)))
    frequency = torch.linspace(0, highest, 51, dtype=geo.dtype)
    ideal = analysis.ideal_mtf(frequency, fno, light[0])
    psfs = {}
    curves = {}
    for field in fields:
        steep = not sampled(geo, field, light, at_m)
        picture, cells, how = analysis.psf_on_pixels, MOST_CELLS, "diffraction"
        # the picture repeats with the number of cells
        if steep or 1.2 * pixels * pixel > MOST_CELLS * min(light) * 1e-3 * fno:
            picture, cells, how = analysis.geometric_psf, 256, "rays"
        psf = picture(geo, field, pixel, pixels, light, cells, True, at_m=at_m)
        psfs[f"{degrees(field)}, {how}"] = psf
        given = geo, field, frequency, light
        if steep:
            curve = ideal * analysis.geometric_mtf(*given, vignetting=True, at_m=at_m)
        else:
            cells = 256 if quick else MOST_CELLS
            curve = analysis.diffraction_mtf(*given, cells, True, at_m=at_m)
        curves[f"{degrees(field)}{', rays' if steep else ''}"] = curve
        record_at(run, field, mtf_tangential=curve[0, 20], mtf_sagittal=curve[1, 20])
    run.record(mtf_at_per_mm=float(frequency[20]))
    traced = any("rays" in name for name in (*psfs, *curves))
    run.section(
        "Point spread and MTF",
        "Where it says rays, the aberration is too large for a sampled wavefront: rays stand in, their MTF "
        "multiplied by that of a perfect lens."
        if traced
        else "",
    )
    run.figure(
        lens_figures.psf_pictures(list(psfs.values()), list(psfs)),
        "psf",
        f"Point spread in light of {len(light)} wavelength{'s' * (len(light) > 1)}, each over its peak.",
    )
    run.figure(
        lens_figures.mtf_curves(frequency, curves, ideal),
        "mtf",
        "MTF; dotted: a perfect lens with the same cone of light on the axis.",
    )
    depth = max(8 * airy * fno, 2 * widest * fno)
    shifts = torch.linspace(-depth, depth, 11 if quick else 31).tolist()
    middle = float(frequency[10])
    run.figure(
        lens_curves.through_focus(geo, fields, shifts, middle, light, True, at_m=at_m),
        "through_focus",
        f"RMS spot, and geometric MTF at {middle:g} line pairs per mm, over the place of the image plane.",
    )


def names_of(distances):
    return ", ".join("infinity" if math.isinf(d) else f"{d:g} m" for d in distances)


def sampled(geo, field, light, at_m):
    """Whether the wavefront of a field is gentle enough for ``MOST_CELLS`` pupil cells at every
    wavelength."""
    with contextlib.suppress(DomainError):
        for wavelength_um in light:
            # half the cells: a lens that just passes has room
            analysis.pupil_function(geo, field, wavelength_um, MOST_CELLS // 2, True, at_m=at_m)
        return True
    return False


def round_frequency(value):
    """The largest of 1, 2 and 5 times a power of ten that is not above the value."""
    power = 10.0 ** math.floor(math.log10(value))
    return max(step * power for step in (1, 2, 5) if step * power <= value)


if __name__ == "__main__":
    sys.exit(main(study, Config))
