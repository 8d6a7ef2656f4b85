"""What becomes of published lens files: which load, why the others are refused, and whether focal lengths are
those their makers claim.

Every .json, .zmx, .seq and .txt file of a folder is loaded. Where a header, title, catalogue number, patent
or file note claims a focal length, it is compared with the paraxial one of the loaded lens, at the wavelength
of the claim.

Where optiland is installed (``pip install codesign[bench]``), six lenses are written as .zmx and opened there:
focal lengths and spots must be the same.
"""

import importlib.util
import json
import math
import sys
import tempfile
import warnings
from dataclasses import dataclass
from pathlib import Path

import torch

from codesign import lens
from codesign.atomic import write_atomic
from codesign.errors import CodesignError, FileFormatError
from codesign.lens.analysis.rays import field_rays
from studies.frame.run import Run, StudyConfig, main

EXTENSIONS = (".json", ".zmx", ".seq", ".txt")
ALLOWED = 0.005  # relative difference of focal lengths up to which a claim counts as met
D_UM = 0.5875618
# names or files that optiland opens again
ROUND_TRIPS = (
    "cooke-triplet",
    "double-gauss",
    "la1509",
    "optiland/heliar.json",
    "rayoptics/US05331467-1.zmx",
    "deeplens/camera/ef35mm_f2.0.zmx",
)
ROUND_TRIP_EFL = 1e-5  # relative differences allowed
ROUND_TRIP_SPOT = 0.01


@dataclass(frozen=True)
class Claim:
    """A focal length somebody states for a file: mm, wavelength in um, where it is said, and why it may
    differ."""

    efl_mm: float
    wavelength_um: float
    source: str
    remark: str = ""


NAME_ROUNDS = "product names round the focal length"
CLAIMS = {
    "deeplens/camera/ef35mm_f2.0.zmx": Claim(35.0, D_UM, "name", NAME_ROUNDS),
    "deeplens/camera/ef85mm_f1.8.json": Claim(
        85.0, D_UM, "name", "the header holds another quantity, see below"
    ),
    "deeplens/camera/rf16mm_f2.8.json": Claim(16.0, D_UM, "name", NAME_ROUNDS),
    "deeplens/camera/rf24mm_f1.8.json": Claim(
        24.0, D_UM, "name", NAME_ROUNDS + "; the header repeats that of ef40mm_f2.8 to the last digit"
    ),
    "deeplens/thorlabs/acl12708u.json": Claim(
        8.0, D_UM, "catalogue", "the catalogue rounds, and holds for its own wavelength (8.03 mm at 780 nm)"
    ),
    "diffoptics/ThorLabs/ACL5040U.txt": Claim(40.0, D_UM, "catalogue"),
    "diffoptics/ThorLabs/LA1131.txt": Claim(49.8, D_UM, "catalogue"),
    "diffoptics/end2end/end2end_edof.txt": Claim(100.0, D_UM, "catalogue, its doublet"),
    "optiland/Cooke_triplet.json": Claim(50.0, 0.55, "sample lens, 50 mm f/5"),
    "rayoptics/354710-C-Zemax(ZMX).zmx": Claim(1.49, 1.55, "NAME line"),
    "rayoptics/CODV_32327.seq": Claim(100.0, D_UM, "catalogue"),
    "rayoptics/CODV_49664.seq": Claim(35.0, D_UM, "title"),
    "rayoptics/CODV_65988.seq": Claim(15.0, D_UM, "catalogue"),
    "rayoptics/HoO-V2C18Ex03.zmx": Claim(80.0, 0.55, "f/4 and 20 mm"),
    "rayoptics/US00583336-2-scaled.zmx": Claim(49.4, D_UM, "target in the file"),
    "rayoptics/ag_dblgauss.seq": Claim(100.0, D_UM, "title f/2, pupil 50 mm"),
    "rayoptics/paraboloid.seq": Claim(100.0, 0.55, "title f/1, pupil 100 mm"),
    "rayoptics/paraboloid_f8.seq": Claim(200.0, 0.55, "title"),
    "rayoptics/questar35.seq": Claim(1282.0, 0.555, "maker, 3.5 inch"),
    "rayoptics/rc_f16.seq": Claim(
        3962.4 * 8,
        0.55,
        "f/8 and 3962.4 mm",
        "the title says f/16; the file has the pupil 3962.4 mm in a comment and twice that in force",
    ),
    "rayoptics/zmax_55278.zmx": Claim(52.24, D_UM, "DBDT record"),
}


@dataclass(frozen=True)
class Config(StudyConfig):
    folder: Path | None = None
    """Folder of lens files, searched with its subfolders; ../shared/data/lenses beside the repository when
    left out."""


@dataclass(frozen=True)
class Outcome:
    """What became of one file. efl_mm is at the wavelength of the first claim; claims pair each claim with
    the lens's focal length for it."""

    file: str
    reason: str = ""
    surfaces: int = 0
    pupil_mm: float = 0.0
    efl_mm: float | None = None
    claims: tuple[tuple[Claim, float | None], ...] = ()


def study(run: Run[Config]) -> None:
    folder = run.config.folder or default_folder()
    files = lens_files(folder)
    outcomes = []
    with run.progress(len(files), "loading") as progress:
        for path in files:
            outcomes.append(examine(path, folder))
            progress.advance(refused=sum(bool(o.reason) for o in outcomes))
    trips = round_trips(folder) if importlib.util.find_spec("optiland") else None
    show(run, outcomes, trips)


@dataclass(frozen=True)
class RoundTrip:
    """One lens opened in optiland from our .zmx: relative differences of the focal length, of the RMS spots at the d
    line, and of those at F and C; whether all its glasses are named."""

    lens: str
    named: bool
    efl_mm: float
    efl: float
    spot_d: float
    spot_lines: float


def round_trips(folder):
    """RoundTrips of those of ROUND_TRIPS that are there."""
    there = [name for name in ROUND_TRIPS if "/" not in name or (folder / name).is_file()]
    with warnings.catch_warnings():
        # of the peer's compiler and tables, the first time they work: nothing that a user of ours can mend
        warnings.simplefilter("ignore")
        return [
            round_trip(lens.load(folder / name if "/" in name else name).freeze(), name) for name in there
        ]


def round_trip(geo, name):
    """RoundTrip of a lens: the same points of the entrance pupil, at 0, 0.7 and 1 of its half field."""
    import numpy as np
    from optiland.fileio import load_zemax_file  # pyright: ignore[reportMissingImports]

    with tempfile.TemporaryDirectory() as place:
        path = Path(place) / "lens.zmx"
        lens.save(geo, path)
        content = path.read_text()
        optic = load_zemax_file(str(path))
    pupil = lens.pupil_grid(8)
    shares = (0.0, 0.7, 1.0) if geo.half_field_deg else (0.0,)
    miss = {}
    for line, w in lens.WAVELENGTH_UM.items():
        spots = []
        for share in shares:
            field = share * math.radians(geo.half_field_deg or 0.0)
            ours = geo.trace(*field_rays(geo, field, pupil, w), w)
            rays = optic.trace_generic(0.0, share, pupil[:, 0].numpy(), pupil[:, 1].numpy(), w)
            theirs = torch.from_numpy(np.stack([np.ravel(rays.x), np.ravel(rays.y)], 1))
            both = (ours.status == 0) & theirs.isfinite().all(1)
            spots.append([_rms(points[both]) for points in (ours.position_mm[:, :2], theirs)])
        miss[line] = max(abs(their / our - 1) for our, their in spots)
    efl = efl_mm(geo)
    their_efl = float(np.ravel(np.asarray(optic.paraxial.f2()))[0])
    return RoundTrip(
        name, "___BLANK" not in content, efl, abs(their_efl / efl - 1), miss["d"], max(miss["F"], miss["C"])
    )


def _rms(points):
    return float((points - points.mean(0)).square().sum(1).mean().sqrt())


def show_round_trips(run, trips):
    """Metrics and table of the lenses opened elsewhere."""
    run.section("Opened in optiland")
    if trips is None:
        run.text(
            "optiland is not installed, so no lens was opened there; pip install 'codesign[bench]' and run again."
        )
        run.record(round_trips=0)
        return
    named = [trip for trip in trips if trip.named]
    model = [trip for trip in trips if not trip.named]
    run.record(
        round_trips=len(trips),
        round_trip_efl_relative_error=max(trip.efl for trip in trips),
        round_trip_spot_relative_error_d=max(trip.spot_d for trip in trips),
        round_trip_spot_relative_error_named_glasses=max(max(t.spot_d, t.spot_lines) for t in named),
        round_trips_missed=sum(
            trip.efl > ROUND_TRIP_EFL
            or trip.spot_d > ROUND_TRIP_SPOT
            or (trip.named and trip.spot_lines > ROUND_TRIP_SPOT)
            for trip in trips
        ),
        **(
            {"round_trip_spot_relative_error_model_glasses": max(t.spot_lines for t in model)}
            if model
            else {}
        ),
    )
    run.table(
        "Written as .zmx and opened in optiland: relative differences",
        ("lens", "glasses", "EFL mm", "EFL", "spots at d", "spots at F and C"),
        [
            (t.lens, "named" if t.named else "model", f"{t.efl_mm:.6g}", f"{t.efl:.1e}", f"{t.spot_d:.1e}")
            + (f"{t.spot_lines:.1e}",)
            for t in trips
        ],
        "RMS spots of 52 rays at 0, 0.7 and 1 of the half field. A model glass gives nd and Vd alone: what it is at F "
        "and C each program works out for itself.",
    )


def default_folder():
    """The folder of lens files beside the repository (or in it), where there is one."""
    root = Path(__file__).resolve().parents[1]
    found = [place / "shared" / "data" / "lenses" for place in (root.parent, root)]
    return next((folder for folder in found if folder.is_dir()), found[0])


def lens_files(folder):
    """The lens files of a folder, sorted. Raises: FileFormatError when there are none."""
    found = sorted(path for path in Path(folder).rglob("*") if path.suffix.lower() in EXTENSIONS)
    if not found:
        raise FileFormatError(
            f"'{folder}' holds no lens file ({', '.join(EXTENSIONS)}); name another folder with --folder."
        )
    return found


def examine(path, folder):
    """Outcome of loading one file; claims come from CLAIMS and from the header of the file."""
    name = path.relative_to(folder).as_posix()
    try:
        geo = lens.load(path)
    except CodesignError as error:
        return Outcome(name, str(error).replace(f"lens file {path}: ", "", 1))
    claims = ([CLAIMS[name]] if name in CLAIMS else []) + header_claims(path, geo)
    found = tuple((claim, efl_mm(geo, claim.wavelength_um)) for claim in claims)
    return Outcome(
        name,
        "",
        len(geo.surfaces),
        geo.entrance_pupil_diameter_mm,
        found[0][1] if found else efl_mm(geo),
        found,
    )


def efl_mm(geo, wavelength_um=D_UM):
    """Paraxial focal length, or None of an afocal lens."""
    try:
        return float(geo.first_order(wavelength_um).efl_mm.detach())
    except CodesignError:
        return None


def header_claims(path, geo):
    """The focal length in the header of a DeepLens file; some headers hold the one of the image's edge, which
    distortion changes."""
    if path.suffix.lower() != ".json":
        return []
    page = json.loads(path.read_text(encoding="utf-8"))
    if "foclen" not in page:
        return []
    edge = edge_focal_length_mm(geo, page["r_sensor"])
    remark = ""
    if abs(efl_mm(geo) / page["foclen"] - 1) > ALLOWED:
        near = edge is not None and abs(edge / page["foclen"] - 1) < 2 * ALLOWED
        remark = f"at the sensor's edge, radius / tan(field) = {edge:.4g} mm" if edge is not None else ""
        focus = f"the paraxial focus lies {float((geo.first_order().bfl_mm - geo.thickness_mm[-1]).detach()):+.2g} mm from the image plane"
        remark = (
            f"the header holds the focal length of the image's edge: {remark}"
            if near
            else f"unexplained; {focus}; {remark}"
        )
    return [Claim(page["foclen"], D_UM, "header", remark)]


def edge_focal_length_mm(geo, radius_mm):
    """Image height / tan(field) where the chief ray meets the image at ``radius_mm``; None where it never
    does."""
    angles = torch.arange(1, 800, dtype=torch.float64).mul(math.radians(0.1))
    towards = torch.stack([torch.zeros_like(angles), angles.sin(), angles.cos()], 1)
    centre = torch.stack(
        [torch.zeros(()), torch.zeros(()), geo.first_order().entrance_pupil_z_mm.detach()]
    ).double()
    out = geo.trace(centre - 50 * towards, towards)
    heights = torch.where(out.status == 0, out.position_mm[:, 1].detach().abs(), math.nan)
    meets = (heights >= radius_mm).nonzero()
    return (
        radius_mm / math.tan(float(angles[meets[0]]))
        if len(meets) and not bool(heights[: meets[0]].isnan().any())
        else None
    )


def show(run, outcomes, trips):
    """Metrics, table.md and the page."""
    loaded = [o for o in outcomes if not o.reason]
    claims = [(o.file, claim, found) for o in loaded for claim, found in o.claims if found is not None]
    differences = [abs(found / claim.efl_mm - 1) for _, claim, found in claims]
    met = sum(d <= ALLOWED for d in differences)
    run.record(
        files=len(outcomes),
        loaded=len(loaded),
        refused=len(outcomes) - len(loaded),
        claims=len(claims),
        claims_met=met,
        claims_missed=len(claims) - met,
        claims_missed_without_reason=sum(
            d > ALLOWED and (not claim.remark or claim.remark.startswith("unexplained"))
            for d, (_, claim, _) in zip(differences, claims, strict=True)
        ),
    )
    rows = [row for outcome in outcomes for row in table_rows(outcome)]
    columns = (
        "file",
        "result",
        "surfaces",
        "pupil mm",
        "EFL mm",
        "claimed mm",
        "claimed by",
        "difference %",
        "remark",
    )
    lines = [
        "| " + " | ".join(columns) + " |",
        "|---" * len(columns) + "|",
        *("| " + " | ".join("" if v is None else str(v) for v in row) + " |" for row in rows),
    ]
    write_atomic(run.path("table.md"), ("\n".join(lines) + "\n").encode())
    run.card(
        "Files that load", f"{len(loaded)} of {len(outcomes)}", "the others are refused with their reason"
    )
    run.card("Focal lengths", f"{met} of {len(claims)}", f"within {100 * ALLOWED:g} % of what is claimed")
    run.section("Files")
    run.table(
        "Every file",
        columns,
        rows,
        "EFL: paraxial focal length at the wavelength of the claim, at 0.5876 µm where there is none.",
    )
    show_round_trips(run, trips)
    run.finish(
        "Lens files",
        f"{len(loaded)} of {len(outcomes)} published lens files load; {met} of {len(claims)} claimed focal "
        f"lengths are met within {100 * ALLOWED:g} %.",
    )


def table_rows(outcome):
    """Rows of the table: one per claim, at least one."""
    if outcome.reason:
        return [(outcome.file, "refused", None, None, None, None, None, None, outcome.reason)]
    start = (outcome.file, "loads", outcome.surfaces, f"{outcome.pupil_mm:.5g}")
    if not outcome.claims:
        return [
            (
                *start,
                f"{outcome.efl_mm:.6g}" if outcome.efl_mm is not None else "afocal",
                None,
                None,
                None,
                "",
            )
        ]
    return [
        (
            *start,
            f"{found:.6g}",
            f"{claim.efl_mm:.6g}",
            claim.source,
            f"{100 * (found / claim.efl_mm - 1):+.2f}",
            claim.remark,
        )
        for claim, found in outcome.claims
        if found is not None
    ]


if __name__ == "__main__":
    sys.exit(main(study, Config))
