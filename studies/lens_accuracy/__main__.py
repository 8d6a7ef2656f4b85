"""How true the traced lenses are: rays, first-order figures, spots and ray derivatives against independent
programs.

Three published lenses (Cooke triplet, double Gauss, a plano-convex singlet) are traced in float64 and
float32. The truth is a folder of reference
files: 54 rays per lens traced with 30 digits, focal lengths, nine spot diagrams by a public ray tracer, and
  derivatives of rays with respect to curvatures, thicknesses and indices with 32 digits, and Seidel sums of
  every surface by the same ray tracer.

Random lenses with objects at 0.2 to 5 m follow: every figure of the analysis, of the solves and of the third order
against a long-double lens that shares no code with ours (longdouble.py).
"""

import math
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import matplotlib.pyplot as plt
import torch

from codesign import lens
from codesign.errors import DomainError, FileFormatError
from codesign.lens.seidel import seidel_sums
from codesign.reading import read_json, reading
from studies.frame.run import Run, StudyConfig, main
from studies.lens_accuracy.near import NEAR_ASKED, near_objects, show_near_objects

FILES = {"cooke-triplet": "cooke_triplet.json", "double-gauss": "double_gauss.json", "la1509": "la1509.json"}
PRECISION = {"float64": torch.float64, "float32": torch.float32}
# figure -> (what it is, largest value allowed in float64, in float32 or None where nothing is asked)
FIGURES = {
    "max_position_error_mm": ("ray position on the image plane, mm", 1e-11, 3e-5),
    "max_direction_error": ("ray direction cosine", 1e-12, None),
    "max_path_error_mm": ("optical path, mm", 1e-11, None),
    "focal_length_relative_error": ("focal length, relative", 1e-12, None),
    "spot_relative_error": ("RMS spot, relative", 1e-9, None),
    "derivative_relative_error": ("ray derivative, relative", 1e-8, None),
    "seidel_relative_error": ("Seidel sum, relative", 1e-6, None),
    "seidel_surface_relative_error": ("Seidel term of a surface, relative", 1e-6, None),
}
SLOTS = {"c": "curvature_per_mm", "t": "thickness_mm", "n": "index_offset"}
RAY = ("x", "y", "L", "M", "N", "opl")
# a derivative below this share of the largest to a parameter of its kind (many vanish by symmetry) is judged
# against that share
SMALL = 1e-3


@dataclass(frozen=True)
class Config(StudyConfig):
    QUICK: ClassVar = {"systems": 12}
    references: Path | None = None
    """Folder that holds cooke_triplet.json, double_gauss.json and la1509.json; ../shared/refs/lens beside the
    repository, or tests/data/refs/lens in it, when left out."""
    systems: int = 50
    """Random lenses with objects at finite distances."""


def study(run: Run[Config]) -> None:
    if run.config.systems < 1:
        raise DomainError(f"{run.config.systems} random lenses were asked for; give at least 1.")
    folder = run.config.references or default_folder()
    pages = {name: read_page(folder / file) for name, file in FILES.items()}
    errors: dict[tuple[str, str], dict[str, float]] = {}
    with run.progress(len(FILES) * len(PRECISION), "comparing") as progress:
        for precision, dtype in PRECISION.items():
            for name, page in pages.items():
                errors[precision, name] = compare(name, page, dtype)
                progress.advance(position_mm=errors[precision, name]["max_position_error_mm"])
    for (precision, name), found in errors.items():
        run.record(
            **{f"{figure}_{precision}_{name.replace('-', '_')}": value for figure, value in found.items()}
        )
    near = near_objects(run)
    missed = []
    for column, precision in enumerate(PRECISION):
        for figure, (label, *limits) in FIGURES.items():
            worst = max(errors[precision, name][figure] for name in FILES)
            limit = limits[column]
            run.record(**{f"{figure}_{precision}": worst})
            if limit is not None and worst > limit:
                missed.append(f"{label} ({precision}): {worst:.2g} against {limit:g}")
    missed += [
        f"{name.replace('_', ' ')} of near objects: {value:.2g} against {NEAR_ASKED:g}"
        for name, value in near.items()
        if not value <= NEAR_ASKED
    ]
    run.record(
        focal_length_relative_error=run.metrics["focal_length_relative_error_float64"],
        spot_relative_error=run.metrics["spot_relative_error_float64"],
        derivative_relative_error=run.metrics["derivative_relative_error_float64"],
        seidel_relative_error=run.metrics["seidel_relative_error_float64"],
        figures_missed=len(missed),
    )
    show(run, errors, near, missed)


def default_folder():
    """The reference folder beside the repository (or in it), where there is one, else the one of the tests."""
    root = Path(__file__).resolve().parents[2]
    found = [
        place / "refs" / "lens"
        for place in (root.parent / "shared", root / "shared", root / "tests" / "data")
    ]
    return next((folder for folder in found if folder.is_dir()), found[0])


def read_page(path):
    """A reference file as a dictionary. Raises: FileFormatError when it is missing or not such a file."""
    if not Path(path).is_file():
        raise FileFormatError(f"no lens references lie at {path}; name their folder with --references.")
    page = read_json(path)
    with reading(path, "name a folder of lens references with --references"):
        missing = {"wavelengths_um", "rays", "spots", "first_order", "ray_parameter_gradients_d"} - set(page)
    if missing:
        raise FileFormatError(
            f"'{path}' lacks {', '.join(sorted(missing))}; name a folder of lens references with "
            "--references."
        )
    return page


def compare(name, page, dtype=torch.float64):
    """Errors of a named lens against a reference page.

    Args: name: catalogue name. page: dictionary of a reference file. dtype: precision of the lens and its
      rays.
    Returns: dictionary with the keys of FIGURES.
    """
    geo = lens.load(name, dtype)
    return {
        **_rays(geo, page, dtype),
        **_seidel(geo, page),
        "focal_length_relative_error": _first_order(geo, page),
        "spot_relative_error": _spots(geo, page),
        "derivative_relative_error": _derivatives(geo, page, dtype),
    }


def _rays(geo, page, dtype):
    worst = torch.zeros(6, dtype=torch.float64)
    for line, wavelength_um in page["wavelengths_um"].items():
        rows = [row for row in page["rays"] if row["w"] == line]
        start, towards = (
            torch.tensor([row[key] for row in rows], dtype=torch.float64).to(dtype)
            for key in ("start", "dir")
        )
        out = geo.trace(start, towards, wavelength_um)
        found = torch.cat([out.position_mm[:, :2], out.direction, out.optical_path_mm[:, None]], 1).detach()
        truth = torch.tensor([[float(row["mp30"][key]) for key in RAY] for row in rows], dtype=torch.float64)
        worst = torch.maximum(worst, (found - truth).abs().amax(0))
    return {
        "max_position_error_mm": float(worst[:2].max()),
        "max_direction_error": float(worst[2:5].max()),
        "max_path_error_mm": float(worst[5]),
    }


def _first_order(geo, page):
    """Largest relative error of focal length and back focal length at the three lines."""
    worst = 0.0
    for line, wavelength_um in page["wavelengths_um"].items():
        found = geo.first_order(wavelength_um)
        truth = page["first_order"][line]
        worst = max(
            worst,
            abs(float(found.efl_mm.detach()) / truth["efl"]["own"] - 1),
            abs(float(found.bfl_mm.detach()) / truth["bfl"]["own"] - 1),
        )
    return worst


def _spots(geo, page):
    worst = 0.0
    for row in page["spots"]:
        positions, _ = lens.spots(
            geo, [math.radians(page["half_field_deg"] * row["H"])], lens.WAVELENGTH_UM[row["w"]]
        )
        positions = positions.detach()[0]
        rms_um = 1e3 * float((positions - positions.mean(0)).square().sum(1).mean().sqrt())
        worst = max(worst, abs(rms_um / row["rayoptics"]["rms_centroid_um"] - 1))
    return worst


def _derivatives(geo, page, dtype):
    worst = 0.0
    for case in page["ray_parameter_gradients_d"]["rays"]:
        out = geo.trace(
            *(torch.tensor([case["ray"][key]], dtype=torch.float64).to(dtype) for key in ("start", "dir"))
        )
        values = [*out.position_mm[0, :2], *out.direction[0], out.optical_path_mm[0]]
        tensors = [getattr(geo, name) for name in SLOTS.values()]
        found = [torch.autograd.grad(value, tensors, retain_graph=True) for value in values]
        largest = {
            kind: max(abs(row["d"][key]) for row in case["grads"] if row["param"] == kind for key in RAY)
            for kind in SLOTS
        }
        for row in case["grads"]:
            at = list(SLOTS).index(row["param"])
            mine = torch.stack([part[at][row["surface"]] for part in found]).double()
            truth = torch.tensor([row["d"][key] for key in RAY], dtype=torch.float64)
            size = truth.abs().clamp_min(SMALL * largest[row["param"]])
            worst = max(worst, float(((mine - truth).abs() / size).max()))
    return worst


def _seidel(geo, page):
    """Largest relative error of S_I to S_V: of the lens against one program, of every surface (over the
    largest of its kind) against another.

    The second puts the object at 1e10 mm, which moves small entries of single surfaces by up to 1e-6 of
    themselves.
    """
    sums = seidel_sums(geo, math.radians(page["half_field_deg"]))
    reference = page["seidel_d"]
    total = -torch.tensor(reference["optiland_seidels"], dtype=torch.float64)  # the other sign convention
    each = torch.tensor(
        [reference["rayoptics_per_surface"][f"S-{k}"][:-1] for k in ("I", "II", "III", "IV", "V")],
        dtype=torch.float64,
    ).T

    def worst(found, truth, size):
        return float(((found.detach().double() - truth).abs() / size).max())

    return {
        "seidel_relative_error": worst(sums.total, total, total.abs()),
        "seidel_surface_relative_error": worst(sums.per_surface, each, each.abs().amax(0)),
    }


def show(run, errors, near, missed):
    """Cards, figure, table and the page."""
    worst = run.metrics
    run.card(
        "Ray position, float64",
        f"{worst['max_position_error_mm_float64']:.1e} mm",
        "largest of 162 rays; asked: 1e-11",
    )
    run.card(
        "Ray position, float32",
        f"{worst['max_position_error_mm_float32_double_gauss']:.1e} mm",
        "double Gauss; asked: 3e-5",
    )
    run.card("Spots", f"{worst['spot_relative_error']:.1e}", "relative; asked: 1e-9")
    run.card("Ray derivatives", f"{worst['derivative_relative_error']:.1e}", "relative; asked: 1e-8")
    run.card("Seidel sums", f"{worst['seidel_relative_error']:.1e}", "relative; asked: 1e-6")
    run.section(
        "Error over what is asked",
        "Each mark is one lens. Left of the line: better than asked. The references' own programs differ by "
        "up to 5e-14 mm, which no comparison can undercut.",
    )
    run.figure(
        _figure(errors),
        "errors",
        "Largest error of each lens, divided by the largest error allowed, on a logarithmic axis.",
    )
    for precision in PRECISION:
        rows = [
            (
                label,
                *(f"{errors[precision, name][figure]:.1e}" for name in FILES),
                f"{limits[precision == 'float32']:g}" if limits[precision == "float32"] else None,
            )
            for figure, (label, *limits) in FIGURES.items()
        ]
        run.table(f"Largest errors, {precision}", ("figure", *FILES, "asked"), rows)
    run.text(
        f"Derivatives: |found − true| over the true entry, or over {SMALL:g} of the ray's largest "
        "derivative to a parameter of the same kind where the entry is smaller than that."
    )
    show_near_objects(run, near)
    lead = "All figures are met." if not missed else f"**Missed:** {'; '.join(missed)}."
    run.finish(
        "Lens accuracy",
        "Three published lenses against independent programs, in float64 and float32, and "
        f"{run.config.systems} random lenses with near objects against a long-double lens. {lead}",
    )


def _figure(errors):
    rows = [
        (figure, precision, limits[k])
        for k, precision in enumerate(PRECISION)
        for figure, (_, *limits) in FIGURES.items()
        if limits[k] is not None
    ]
    figure, axes = plt.subplots(figsize=(8, 3.4), layout="constrained")
    for marker, name in zip("os^", FILES, strict=True):
        shares = [max(errors[precision, name][key] / limit, 1e-7) for key, precision, limit in rows]
        axes.plot(shares, range(len(rows)), marker, label=name, alpha=0.8, markersize=7, linestyle="none")
    axes.axvline(1, color="firebrick", linewidth=1.5)
    axes.set_yticks(
        range(len(rows)), [f"{FIGURES[key][0].split(',')[0]}, {precision}" for key, precision, _ in rows]
    )
    axes.set(xscale="log", xlabel="error / largest error allowed", xlim=(5e-8, 10))
    axes.invert_yaxis()
    axes.grid(axis="x", alpha=0.3)
    axes.legend(loc="upper center", bbox_to_anchor=(0.4, 1.16), ncols=3, frameon=False)
    return figure


if __name__ == "__main__":
    sys.exit(main(study, Config))
