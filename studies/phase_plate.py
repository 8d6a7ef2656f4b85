"""What does a phase plate in the stop buy an event camera that looks from 0.3 to 5 m at once?

A plate in Zernike terms is designed by gradient on point spreads over depth and field: contrast at
the frequencies of the pixels, in all directions, at the worst of the depths. It is judged, in light
of three wavelengths and at depths in between, against the same lens without it, opened and stopped
down, each refocused by the same objective. A stop costs light, a plate none: beside contrast stands
contrast times the root of the light, the signal over shot noise at equal exposure.
"""

import math
import sys
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from codesign import lens
from codesign.errors import DomainError
from codesign.lens import WAVELENGTH_UM, GeoLens
from codesign.lens.analysis import Light, Psf, psf_on_pixels
from codesign.lens.diffraction import ZernikePlate, with_plate
from codesign.report import lens_figures
from studies.frame.run import Run, StudyConfig, main
from studies.frame.show import Panel, panels, table
from studies.frame.sweep import plain, sweep

D = torch.float64
PERIODS_PX = (8, 4)
DIRECTIONS = 8  # of the half circle
FINER = 2  # samples of the point spread per pixel
SAMPLES = 64
TERMS: tuple[int, ...] = (4, 7, 8, 9, 10, 11, 22)
# radians RMS; the cubic is x^3 + y^3
STARTS: dict[str, dict[int, float]] = {
    "cubic": {7: 0.7, 8: 0.7, 9: -0.7, 10: 0.7},
    "round": {11: 0.8},
}
FOCI = 9  # distances tried for a lens without a plate
LINES = tuple(WAVELENGTH_UM[line] for line in "dFC")
SHOWN_M = (0.3, 0.42, 0.8, 5.0)
PLATED = "open, plate"


@dataclass(frozen=True)
class Config(StudyConfig):
    QUICK: ClassVar = {
        "steps": 2,
        "depths": 2,
        "judged": 3,
        "stops": (0.5,),
        "starts": 1,
        "fields": (0.0,),
    }
    lens: str = "cooke-triplet"
    """Lens out of the catalogue, or a file."""
    efl_mm: float = 11.0
    """Focal length it is scaled to."""
    pixel_um: float = 4.86
    """Pixel pitch of the event camera."""
    near_m: float = 0.3
    """Nearest distance."""
    far_m: float = 5.0
    """Farthest distance."""
    plate_z_mm: float = 0.3
    """Distance of the plate behind the stop."""
    fields: tuple[float, ...] = (0.0, 0.6)
    """Shares of the half field."""
    depths: int = 4
    """Distances designed for, even in 1 / distance."""
    judged: int = 9
    """Distances judged at."""
    steps: int = 25
    """Gradient steps of each start."""
    starts: int = 2
    """Plates to start from: the cubic, then the round one."""
    stops: tuple[float, ...] = (0.71, 0.6, 0.5, 0.35)
    """Diameters of the stopped-down rivals, as shares."""

    def per_m(self, count: int) -> Tensor:
        """Distances, 1 / m."""
        return torch.linspace(1 / self.far_m, 1 / self.near_m, count, dtype=D)


def study(run: Run[Config]):
    config = run.config
    if not 0 < config.near_m < config.far_m:
        raise DomainError(
            f"distances from {config.near_m} to {config.far_m} m do not make a range; give near < far."
        )
    geo = lens.load(config.lens)
    if geo.half_field_deg is None:
        raise DomainError(
            f"{geo.name} names no half field; give a lens that does, or one of the catalogue."
        )
    geo = geo.scaled(config.efl_mm / float(geo.first_order().efl_mm.detach())).requires_grad_(False)
    middle = geo.focus_at(2 / (1 / config.near_m + 1 / config.far_m))
    plate, losses = design(run, middle)
    # name -> the lens and its share of the light
    rivals = {PLATED: (with_plate(middle, plate, z_mm=config.plate_z_mm), 1.0)}
    for share in (1.0, *config.stops):
        diameter = geo.entrance_pupil_diameter_mm * share
        stopped = GeoLens(
            geo.to_surfaces(), diameter, name=geo.name, half_field_deg=geo.half_field_deg
        )
        name = "open" if share == 1 else f"stopped to {share:g}"
        rivals[name] = (refocused(config, stopped.requires_grad_(False)), share**2)
    compare(run, rivals, losses)


def spread(config: Config, geo: GeoLens, at_m: float | Tensor, share: float, light: Light) -> Psf:
    """Point spread of SAMPLES x SAMPLES at a share of the half field."""
    field_rad = math.radians(share * (geo.half_field_deg or 0.0))
    return psf_on_pixels(geo, field_rad, config.pixel_um * 1e-3 / FINER, SAMPLES, light, at_m=at_m)


def contrast(
    config: Config,
    geo: GeoLens,
    at_m: float | Tensor,
    share: float,
    light: Light = WAVELENGTH_UM["d"],
) -> Tensor:
    """Contrast [periods] of a point spread: the root mean square of its transfer over all
    directions."""
    energy = spread(config, geo, at_m, share, light).energy
    turn = torch.arange(DIRECTIONS, dtype=D) * (math.pi / DIRECTIONS)
    radians = 2 * math.pi / (FINER * torch.tensor(PERIODS_PX, dtype=D))[:, None, None]
    at = radians * (torch.arange(SAMPLES, dtype=D) - SAMPLES // 2)
    x, y = (torch.exp(-1j * axis[:, None] * at) for axis in (turn.cos(), turn.sin()))
    transfer = torch.einsum("fdy,yx,fdx->fd", y, energy.to(x.dtype), x)
    return (transfer / energy.sum()).abs().square().mean(1).sqrt()


def shortfall(config, geo, per_m):
    """What is minimised: log of the harmonic mean square of the contrast over depths, by field and
    period."""
    found = [
        torch.stack([contrast(config, geo, 1 / p, share) for p in per_m]) for share in config.fields
    ]
    return torch.stack([0.5 * f.pow(-2).mean(0).log() for f in found]).mean()


def design(run, geo):
    """The best plate of all starts, and the losses of each."""
    config = run.config
    radius = 1.1 * float(geo.first_order().stop_semi_aperture_mm)
    given = {"config": config, "geo": geo, "radius_mm": radius}
    rows = sweep(run, descended, "starts", given=given, start=list(STARTS)[: config.starts])
    best = min(rows, key=lambda row: min(row["losses"]))
    found = dict(zip(TERMS, best["coefficients"], strict=True))
    run.card("Plate", best["start"], f"the better of {len(rows)} starts")
    run.section("The plate", "Noll's terms, radians RMS over 1.1 times the stop's radius.")
    run.table("Coefficients", ("term", "rad"), [(str(t), f"{v:+.3f}") for t, v in found.items()])
    run.record(plate_loss=min(best["losses"]), **{f"plate_z{t}_rad": v for t, v in found.items()})
    plate = ZernikePlate(found, radius, wavelength_um=LINES[0]).requires_grad_(False)
    return plate, {row["start"]: row["losses"] for row in rows}


def descended(start, config, geo, radius_mm):
    """The way down from one plate: the loss before each step, and the coefficients of the least."""
    terms = {term: STARTS[start].get(term, 0.0) for term in TERMS}
    plate = ZernikePlate(terms, radius_mm, wavelength_um=LINES[0])
    plated = with_plate(geo, plate, z_mm=config.plate_z_mm)
    optimiser = torch.optim.Adam(plate.parameters(), lr=0.15, betas=(0.8, 0.99))
    fade = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, config.steps, 0.01)
    path = []
    losses = []
    for _ in range(config.steps):
        optimiser.zero_grad()
        path.append(plate.coefficients_rad.tolist())
        loss = shortfall(config, plated, config.per_m(config.depths))
        losses.append(float(loss.detach()))
        loss.backward()
        optimiser.step()
        fade.step()
    return {"coefficients": path[losses.index(min(losses))], "losses": losses}


def refocused(config, geo):
    """A lens without a plate, focused where the same objective is least over the depths it is
    judged at."""
    per_m = config.per_m(config.judged)
    with torch.no_grad():
        foci = [1 / float(p) for p in torch.linspace(float(per_m[0]), float(per_m[-1]), FOCI)[1:-1]]
        return min(
            (geo.focus_at(m) for m in foci), key=lambda g: float(shortfall(config, g, per_m))
        )


def compare(run, rivals, losses):
    """Contrast of every lens over depth, in three wavelengths."""
    config = run.config
    per_m = config.per_m(config.judged)
    curves = {}
    rows = []
    with torch.no_grad(), run.progress(len(rivals), "lenses judged") as progress:
        for name, (geo, light) in rivals.items():
            found = [[contrast(config, geo, 1 / p, s, LINES) for p in per_m] for s in config.fields]
            # field, depth, period
            curves[name] = curve = torch.stack([torch.stack(f) for f in found])
            low, high = curve.amin((0, 1)).tolist()
            row = {
                "light": light,
                "contrast_8px_worst": low,
                "contrast_4px_worst": high,
                "contrast_4px_mean": float(curve[..., 1].mean()),
                "contrast_4px_spread": float(curve[..., 1].std() / curve[..., 1].mean()),
                "signal_over_noise_8px_worst": low * math.sqrt(light),
                "signal_over_noise_4px_worst": high * math.sqrt(light),
            }
            run.record(**{f"{plain(name)}_{figure}": value for figure, value in row.items()})
            rows.append({"lens": name, **row})
            progress.advance()
    run.section("Over depth")
    run.table(
        f"Contrast from {config.near_m:g} to {config.far_m:g} m",
        *table(rows),
        "RMS transfer over directions of patterns with a period of 8 and 4 pixels; F, d and C light. Over shot noise: "
        "contrast times the root of the light.",
    )
    draw(run, rivals, curves, per_m, losses)
    run.finish("A phase plate for depth", verdict(run, rivals, curves))


def verdict(run, rivals, curves):
    """The first lines of the page: the plate against no plate, and against the stop of equal
    contrast."""
    found = []
    for index, period in enumerate(PERIODS_PX):
        worst = {name: float(curve.amin((0, 1))[index]) for name, curve in curves.items()}
        stops = [(light, worst[name]) for name, (_, light) in rivals.items() if name != PLATED]
        gain = worst[PLATED] / worst["open"]
        noise = worst[PLATED] / max(contrast * math.sqrt(light) for light, contrast in stops)
        light = max((light for light, contrast in stops if contrast >= worst[PLATED]), default=0.0)
        names = "over_open_contrast", "over_best_stop_signal_over_noise", "equal_stop_light"
        for figure, value in zip(names, (gain, noise, light), strict=True):
            run.record(**{f"plate_{figure}_{period}px": value})
        found.append(
            f"At a period of {period} pixels the plate has {gain:.2f} times the contrast of the open lens at "
            f"the worst depth, and over shot noise {noise:.2f} times what the best stop has; a stop of equal "
            f"contrast passes {light:.0%} of the light (0 %: none has it)."
        )
    return " ".join(found)


def draw(run, rivals, curves, per_m, losses):
    """Contrast over depth, losses, and point spreads."""
    charts = [
        Panel(
            {name: (per_m.tolist(), curve[0, :, index].tolist()) for name, curve in curves.items()},
            "1 / distance (1/m)",
            f"contrast on the axis, period of {period} px",
        )
        for index, period in enumerate(PERIODS_PX)
    ]
    descent = {f"from {name}": (range(len(row)), row) for name, row in losses.items()}
    run.figure(
        panels(*charts, Panel(descent, "step", "log shortfall of contrast")),
        "contrast",
        "Contrast over depth, in F, d and C light, and the descent of each start.",
    )
    for name in (PLATED, "open", list(rivals)[-1]):
        with torch.no_grad():
            spreads = [spread(run.config, rivals[name][0], at_m, 0.0, LINES) for at_m in SHOWN_M]
        titles = [f"{at_m:g} m" for at_m in SHOWN_M]
        run.figure(
            lens_figures.psf_pictures(spreads, titles),
            f"psf_{plain(name)}",
            f"Point spreads, {name}.",
        )


if __name__ == "__main__":
    sys.exit(main(study, Config))
