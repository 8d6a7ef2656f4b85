"""What becomes of published lens files: which load, why the others are refused, and whether focal
lengths are those their makers claim.

Every .json, .zmx, .seq and .txt file of a folder is loaded. Where a header, title, catalogue
number, patent or file note claims a focal length, it is compared with the paraxial one of the
loaded lens, at the wavelength of the claim.
"""

import csv
import itertools
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
COLUMNS = (
    "file",
    "result",
    "surfaces",
    "pupil mm",
    "EFL mm",
    "claimed mm",
    "claimed by",
    "difference %",
)
COLUMNS += ("remark",)


@dataclass(frozen=True)
class Claim:
    """A focal length somebody states for a file, and why it may differ."""

    efl_mm: float
    wavelength_um: float
    source: str
    remark: str = ""


def _claims():
    with Path(__file__).with_name("lens_claims.csv").open(encoding="utf-8", newline="") as table:
        for file, efl_mm, wavelength_um, *why in itertools.islice(csv.reader(table), 1, None):
            yield file, Claim(float(efl_mm), float(wavelength_um), *why)


CLAIMS = dict(_claims())


@dataclass(frozen=True)
class Config(StudyConfig):
    folder: Path | None = None
    """Folder of lens files, searched with its subfolders; ../shared/data/lenses beside the
    repository when left out."""


@dataclass(frozen=True)
class Outcome:
    """What became of one file: why it is refused, or its focal length in mm (None when afocal) at
    the wavelength of the first claim, and each claim with the lens's own for it."""

    file: str
    reason: str = ""
    geo: lens.GeoLens | None = None
    claims: tuple[tuple[Claim, float | None], ...] = ()

    def rows(self):
        """Rows of the table: one per claim, at least one."""
        if self.geo is None:
            return [(self.file, "refused", *[None] * 6, self.reason)]
        start = (
            self.file,
            "loads",
            len(self.geo.surfaces),
            f"{self.geo.entrance_pupil_diameter_mm:.5g}",
        )
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
    text = "\n".join(
        "| " + " | ".join("" if v is None else str(v) for v in line) + " |" for line in lines
    )
    write_atomic(run.path("table.md"), f"{text}\n".encode())
    run.card(
        "Files that load", f"{loaded} of {len(files)}", "the others are refused with their reason"
    )
    run.card(
        "Focal lengths", f"{met} of {len(claims)}", f"within {100 * ALLOWED:g} % of what is claimed"
    )
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
    return Outcome(
        name, "", geo, tuple((claim, efl_mm(geo, claim.wavelength_um)) for claim in claims)
    )


def efl_mm(geo, wavelength_um=D_UM):
    """Paraxial focal length, or None of an afocal lens."""
    try:
        return float(geo.first_order(wavelength_um).efl_mm.detach())
    except CodesignError:
        return None


def header_claims(path, geo):
    """The focal length in the header of a DeepLens file; some headers hold the one of the image's
    edge, which distortion changes."""
    page = json.loads(path.read_text(encoding="utf-8")) if path.suffix.lower() == ".json" else {}
    if "foclen" not in page:
        return []
    claimed = page["foclen"]
    remark = ""
    if abs(efl_mm(geo) / claimed - 1) > ALLOWED:
        edge = edge_focal_length_mm(geo, page["r_sensor"])
        is_edge = abs(edge / claimed - 1) < 2 * ALLOWED
        remark = (
            "the header holds the focal length of the image's edge" if is_edge else "unexplained"
        )
        remark += f": at the sensor's edge, radius / tan(field) = {edge:.4g} mm"
    return [Claim(claimed, D_UM, "header", remark)]


def edge_focal_length_mm(geo, radius_mm):
    """Image height / tan(field) where the chief ray meets the image at ``radius_mm``; NaN where it
    never does."""
    angles = torch.arange(1, 800, dtype=torch.float64).mul(math.radians(0.1))
    towards = torch.stack([torch.zeros_like(angles), angles.sin(), angles.cos()], 1)
    centre = torch.tensor(
        [0.0, 0.0, float(geo.first_order().entrance_pupil_z_mm)], dtype=torch.float64
    )
    out = geo.trace(centre - 50 * towards, towards)
    # a ray that fails ends the search
    heights = torch.where(out.status == 0, out.position_mm[:, 1].detach().abs(), math.inf)
    first = int((heights >= radius_mm).int().argmax())
    return (
        radius_mm / math.tan(float(angles[first]))
        if math.isfinite(float(heights[first]))
        else math.nan
    )


if __name__ == "__main__":
    sys.exit(main(study, Config))
