"""What becomes of published lens files: which load, why the others are refused, and whether focal lengths are
those their makers claim.

Every .json, .zmx, .seq and .txt file of a folder is loaded. Where a header, title, catalogue number, patent
or file note claims a focal length, it is compared with the paraxial one of the loaded lens, at the wavelength
of the claim.
"""

import json
import math
import sys
from dataclasses import dataclass
from pathlib import Path

import torch

from codesign import lens
from codesign.atomic import write_atomic
from codesign.errors import CodesignError, FileFormatError
from studies.frame.run import Run, StudyConfig, main

EXTENSIONS = (".json", ".zmx", ".seq", ".txt")
ALLOWED = 0.005  # relative difference of focal lengths up to which a claim counts as met
D_UM = 0.5875618
COLUMNS = ("file", "result", "surfaces", "pupil mm", "EFL mm", "claimed mm", "claimed by", "difference %")
COLUMNS += ("remark",)


@dataclass(frozen=True)
class Claim:
    """A focal length somebody states for a file, and why it may differ."""

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
    """What became of one file: why it is refused, or its focal length in mm (None when afocal) at the wavelength of
    the first claim, and each claim with the lens's own for it."""

    file: str
    reason: str = ""
    geo: lens.GeoLens | None = None
    claims: tuple[tuple[Claim, float | None], ...] = ()

    def rows(self):
        """Rows of the table: one per claim, at least one."""
        if self.geo is None:
            return [(self.file, "refused", *[None] * 6, self.reason)]
        start = self.file, "loads", len(self.geo.surfaces), f"{self.geo.entrance_pupil_diameter_mm:.5g}"
        if not self.claims:
            efl = efl_mm(self.geo)
            return [(*start, "afocal" if efl is None else f"{efl:.6g}", None, None, None, "")]
        return [
            (*start, f"{found:.6g}", f"{claim.efl_mm:.6g}", claim.source)
            + (f"{100 * (found / claim.efl_mm - 1):+.2f}", claim.remark)
            for claim, found in self.claims
            if found is not None
        ]


def study(run: Run[Config]) -> None:
    root = Path(__file__).resolve().parents[1]
    places = [place / "shared" / "data" / "lenses" for place in (root.parent, root)]
    folder = run.config.folder or next(filter(Path.is_dir, places), places[0])
    files = sorted(path for path in folder.rglob("*") if path.suffix.lower() in EXTENSIONS)
    if not files:
        raise FileFormatError(
            f"'{folder}' holds no lens file ({', '.join(EXTENSIONS)}); name another folder with --folder."
        )
    outcomes = []
    with run.progress(len(files), "loading") as progress:
        for path in files:
            outcomes.append(examine(path, folder))
            progress.advance(refused=sum(bool(o.reason) for o in outcomes))
    claims = [pair for outcome in outcomes for pair in outcome.claims if pair[1] is not None]
    missed = [claim for claim, found in claims if abs(found / claim.efl_mm - 1) > ALLOWED]
    loaded = sum(not outcome.reason for outcome in outcomes)
    met = len(claims) - len(missed)
    run.record(
        files=len(files),
        loaded=loaded,
        refused=len(files) - loaded,
        claims=len(claims),
        claims_met=met,
        claims_missed=len(missed),
        claims_missed_without_reason=sum(
            not claim.remark or claim.remark.startswith("unexplained") for claim in missed
        ),
    )
    rows = [row for outcome in outcomes for row in outcome.rows()]
    lines = [COLUMNS, ["---"] * len(COLUMNS), *rows]
    text = "\n".join("| " + " | ".join("" if v is None else str(v) for v in line) + " |" for line in lines)
    write_atomic(run.path("table.md"), f"{text}\n".encode())
    run.card("Files that load", f"{loaded} of {len(files)}", "the others are refused with their reason")
    run.card("Focal lengths", f"{met} of {len(claims)}", f"within {100 * ALLOWED:g} % of what is claimed")
    run.table(
        "Every file",
        COLUMNS,
        rows,
        "EFL: paraxial focal length at the wavelength of the claim, at 0.5876 µm where there is none.",
    )
    run.finish(
        "Lens files",
        f"{loaded} of {len(files)} published lens files load; {met} of {len(claims)} claimed focal "
        f"lengths are met within {100 * ALLOWED:g} %.",
    )


def examine(path, folder):
    """Outcome of loading one file; claims come from CLAIMS and from the header of the file."""
    name = path.relative_to(folder).as_posix()
    try:
        geo = lens.load(path)
    except CodesignError as error:
        return Outcome(name, str(error).replace(f"lens file {path}: ", "", 1))
    claims = ([CLAIMS[name]] if name in CLAIMS else []) + header_claims(path, geo)
    return Outcome(name, "", geo, tuple((claim, efl_mm(geo, claim.wavelength_um)) for claim in claims))


def efl_mm(geo, wavelength_um=D_UM):
    """Paraxial focal length, or None of an afocal lens."""
    try:
        return float(geo.first_order(wavelength_um).efl_mm.detach())
    except CodesignError:
        return None


def header_claims(path, geo):
    """The focal length in the header of a DeepLens file; some headers hold the one of the image's edge, which
    distortion changes."""
    page = json.loads(path.read_text(encoding="utf-8")) if path.suffix.lower() == ".json" else {}
    if "foclen" not in page:
        return []
    claimed = page["foclen"]
    remark = ""
    if abs(efl_mm(geo) / claimed - 1) > ALLOWED:
        edge = edge_focal_length_mm(geo, page["r_sensor"])
        is_edge = abs(edge / claimed - 1) < 2 * ALLOWED
        remark = "the header holds the focal length of the image's edge" if is_edge else "unexplained"
        remark += f": at the sensor's edge, radius / tan(field) = {edge:.4g} mm"
    return [Claim(claimed, D_UM, "header", remark)]


def edge_focal_length_mm(geo, radius_mm):
    """Image height / tan(field) where the chief ray meets the image at ``radius_mm``; NaN where it never
    does."""
    angles = torch.arange(1, 800, dtype=torch.float64).mul(math.radians(0.1))
    towards = torch.stack([torch.zeros_like(angles), angles.sin(), angles.cos()], 1)
    centre = torch.tensor([0.0, 0.0, float(geo.first_order().entrance_pupil_z_mm)], dtype=torch.float64)
    out = geo.trace(centre - 50 * towards, towards)
    # a ray that fails ends the search
    heights = torch.where(out.status == 0, out.position_mm[:, 1].detach().abs(), math.inf)
    first = int((heights >= radius_mm).int().argmax())
    return radius_mm / math.tan(float(angles[first])) if math.isfinite(float(heights[first])) else math.nan


if __name__ == "__main__":
    sys.exit(main(study, Config))
