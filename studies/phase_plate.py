"""What does a phase plate in the stop buy an event camera that looks from 0.3 to 5 m at once?

A plate in Zernike terms is designed by gradient on point spreads over depth and field: contrast at the
frequencies of the pixels, in all directions, at the worst of the depths. It is judged, in light of three
wavelengths and at depths in between, against the same lens without it, opened and stopped down, each refocused by
the same objective. A stop costs light, a plate none: beside contrast stands contrast times the root of the light,
the signal over shot noise at equal exposure. First, free-space propagation is held against its closed forms.
"""

import math
import sys
from dataclasses import dataclass
from typing import ClassVar

import matplotlib.pyplot as plt
import torch
from scipy import special
from torch import Tensor

from codesign import events, lens
from codesign.errors import DomainError
from codesign.lens import WAVELENGTH_UM, GeoLens, diffraction
from codesign.lens.analysis import Light, psf_on_pixels
from codesign.lens.diffraction import ZernikePlate, with_plate
from scenes import textures
from studies.frame.run import Run, StudyConfig, main

D = torch.float64
CYCLES_PER_PX = (1 / 8, 1 / 4)
DIRECTIONS = 8  # of the half circle
FINER = 2  # samples of the point spread per pixel
SAMPLES = 64
TERMS: tuple[int, ...] = (4, 7, 8, 9, 10, 11, 22)
STARTS: dict[str, dict[int, float]] = {  # radians RMS; the cubic is x^3 + y^3
    "cubic": {7: 0.7, 8: 0.7, 9: -0.7, 10: 0.7},
    "round": {11: 0.8},
}
FOCI = 9  # distances tried for a lens without a plate
LINES = tuple(WAVELENGTH_UM[line] for line in "dFC")
SHOWN_M = (0.3, 0.42, 0.8, 5.0)
PLATED = "open, plate"
FRAMES = 9  # of the moving texture
PICTURE = 256  # samples of the texture


@dataclass(frozen=True)
class Config(StudyConfig):
    QUICK: ClassVar = {"steps": 2, "depths": 2, "judged": 3, "stops": (0.5,), "starts": 1, "fields": (0.0,)}
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


def study(run: Run[Config]):
    config = run.config
    if not 0 < config.near_m < config.far_m:
        raise DomainError(
            f"distances from {config.near_m} to {config.far_m} m do not make a range; give near < far."
        )
    closed_forms(run, config.quick)
    geo = lens.load(config.lens)
    if geo.half_field_deg is None:
        raise DomainError(f"{geo.name} names no half field; give a lens that does, or one of the catalogue.")
    geo = geo.scaled(config.efl_mm / float(geo.first_order().efl_mm.detach())).requires_grad_(False)
    per_m = torch.linspace(1 / config.far_m, 1 / config.near_m, config.depths, dtype=D)
    middle_m = 2 / (1 / config.near_m + 1 / config.far_m)
    plate, losses = design(run, geo.focus_at(middle_m), per_m)
    rivals = {PLATED: (with_plate(geo.focus_at(middle_m), plate, z_mm=config.plate_z_mm), 1.0)}
    for share in (1.0, *config.stops):
        stopped = GeoLens(
            geo.to_surfaces(),
            geo.entrance_pupil_diameter_mm * share,
            name=geo.name,
            half_field_deg=geo.half_field_deg,
        )
        found = refocused(config, stopped.requires_grad_(False))
        rivals["open" if share == 1 else f"stopped to {share:g}"] = (found, share**2)
    compare(run, rivals, losses)


# --- propagation


def closed_forms(run, quick):
    """Largest errors of free-space propagation against closed forms, into the metrics."""
    count = 384 if quick else 512
    wavelength = 0.5e-3
    pitch = 0.02 * 384 / count
    half = 0.157 * count * pitch
    errors = []
    energy = []
    for number in (0.5, 1.0, 2.0):
        z = half**2 / (wavelength * number)
        field = diffraction.Field(
            diffraction.rectangle(count, pitch, (half, half)).to(torch.complex128), pitch, 0.5
        )
        x = field.places_mm()
        scale = math.sqrt(2 / (wavelength * z))
        s1, c1 = special.fresnel(scale * (x.numpy() + half))
        s0, c0 = special.fresnel(scale * (x.numpy() - half))
        truth = torch.tensor((c1 - c0) ** 2 + (s1 - s0) ** 2) / 2
        for found in (
            diffraction.angular_spectrum(field, z, may_leave=0.1),
            diffraction.fresnel(field, z, pitch, count),
        ):
            errors.append(float((found.intensity - truth * truth[:, None]).abs().max()))
        beam = torch.exp(-(x.square() + x[:, None].square()) / (0.6 * half) ** 2).to(torch.complex128)
        beam = diffraction.Field(beam, pitch, 0.5)
        energy.append(abs(float(diffraction.angular_spectrum(beam, z / 4).energy / beam.energy) - 1))
    radius, focus = 5.0, 100.0
    pitch = 2.05 * radius / (count // 2)
    disc = diffraction.Field(diffraction.disc(count // 2, pitch, radius).to(torch.complex128), pitch, 0.5)
    found = diffraction.fresnel(disc, focus, 0.001, 96, focus_mm=focus)
    x = found.places_mm()
    v = 2 * math.pi / wavelength * radius / focus * torch.sqrt(x.square() + x[:, None].square())
    airy = torch.where(v == 0, 1, 2 * torch.special.bessel_j1(v) / torch.where(v == 0, 1, v)).square()
    peak = (math.pi * radius**2 / (wavelength * focus)) ** 2
    run.record(
        propagation_fresnel_error_max=max(errors),
        propagation_airy_error_max=(found.intensity / peak - airy).abs().max(),
        propagation_energy_error=max(energy),
    )
    run.section(
        "Free space", "Largest errors against closed forms, in units of the incident light or the peak."
    )
    run.table(
        "Propagation",
        ("compared with", "error"),
        [
            ("Fresnel integrals behind a square opening, Fresnel numbers 0.5 to 2", f"{max(errors):.1e}"),
            ("Airy pattern in focus", f"{run.metrics['propagation_airy_error_max']:.1e}"),
            ("energy of a Gaussian beam", f"{max(energy):.1e}"),
        ],
    )


# --- contrast


def contrast(
    config: Config, geo: GeoLens, at_m: float | Tensor, share: float, light: Light = WAVELENGTH_UM["d"]
) -> Tensor:
    """Contrast [frequencies] of a point spread: the root mean square of its transfer over all directions."""
    fine_mm = config.pixel_um * 1e-3 / FINER
    field_rad = math.radians(share * (geo.half_field_deg or 0.0))
    energy = psf_on_pixels(geo, field_rad, fine_mm, SAMPLES, light, at_m=at_m).energy
    turn = torch.arange(DIRECTIONS, dtype=D) * (math.pi / DIRECTIONS)
    cycles = torch.tensor(CYCLES_PER_PX, dtype=D)[:, None] / FINER
    at = torch.arange(SAMPLES, dtype=D) - SAMPLES // 2
    phase_x, phase_y = (
        2 * math.pi * cycles[..., None] * f[None, :, None] * at for f in (turn.cos(), turn.sin())
    )
    ones = torch.ones_like(phase_x)
    transfer = torch.einsum(
        "fdy,yx,fdx->fd",
        torch.polar(ones, -phase_y),
        energy.to(torch.complex128),
        torch.polar(ones, -phase_x),
    )
    return (transfer / energy.sum()).abs().square().mean(1).sqrt()


def shortfall(config, geo, per_m):
    """What is minimised: log of the harmonic mean square of the contrast over depths, by field and frequency."""
    found = [torch.stack([contrast(config, geo, 1 / p, share) for p in per_m]) for share in config.fields]
    return torch.stack([0.5 * f.pow(-2).mean(0).log() for f in found]).mean()


def design(run, geo, per_m):
    """The best plate of all starts, and the losses of each."""
    config = run.config
    radius = 1.1 * float(geo.first_order().stop_semi_aperture_mm)
    starts = list(STARTS.items())[: config.starts]
    stored = run.load_state() if run.resumed else None
    done = [] if stored is None else list(stored.tensors["coefficients"])
    losses = {} if stored is None else stored.numbers["losses"]
    with run.progress(len(starts) * config.steps, "steps of the plate", len(done) * config.steps) as progress:
        for name, start in starts[len(done) :]:
            plate = ZernikePlate(
                {term: start.get(term, 0.0) for term in TERMS}, radius, wavelength_um=LINES[0]
            )
            plated = with_plate(geo, plate, z_mm=config.plate_z_mm)
            optimiser = torch.optim.Adam(plate.parameters(), lr=0.15, betas=(0.8, 0.99))
            fade = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, config.steps, 0.01)
            best = (math.inf, plate.coefficients_rad.detach().clone())
            losses[name] = []
            for _ in range(config.steps):
                optimiser.zero_grad()
                loss = shortfall(config, plated, per_m)
                losses[name].append(float(loss.detach()))
                if losses[name][-1] < best[0]:
                    best = (losses[name][-1], plate.coefficients_rad.detach().clone())
                loss.backward()
                optimiser.step()
                fade.step()
                progress.advance(loss=losses[name][-1])
            done.append(best[1])
            run.save_state({"coefficients": torch.stack(done)}, {"losses": losses})
    name = min(losses, key=lambda n: min(losses[n]))
    found: dict[int, float] = dict(zip(TERMS, done[list(losses).index(name)].tolist(), strict=True))
    run.card("Plate", name, f"the better of {len(losses)} starts")
    run.section("The plate", "Noll's terms, radians RMS over 1.1 times the stop's radius.")
    run.table("Coefficients", ("term", "rad"), [(str(t), f"{v:+.3f}") for t, v in found.items()])
    run.record(plate_loss=min(losses[name]), **{f"plate_z{t}_rad": v for t, v in found.items()})
    plate = ZernikePlate(found, radius, wavelength_um=LINES[0]).requires_grad_(False)
    return plate, losses


def judged_per_m(config):
    return torch.linspace(1 / config.far_m, 1 / config.near_m, config.judged, dtype=D)


def refocused(config, geo):
    """A lens without a plate, focused where the same objective is least over the depths it is judged at."""
    per_m = judged_per_m(config)
    with torch.no_grad():
        foci = [1 / float(p) for p in torch.linspace(float(per_m[0]), float(per_m[-1]), FOCI)[1:-1]]
        return min((geo.focus_at(m) for m in foci), key=lambda g: float(shortfall(config, g, per_m)))


# --- judgement


def blurred(picture: Tensor, energy: Tensor) -> Tensor:
    """A periodic picture [N, N] on the point spread's samples, as the lens images it."""
    kernel = torch.zeros_like(picture)
    kernel[:SAMPLES, :SAMPLES] = energy / energy.sum()
    kernel = kernel.roll((-(SAMPLES // 2), -(SAMPLES // 2)), (0, 1))
    return torch.fft.irfft2(torch.fft.rfft2(picture) * torch.fft.rfft2(kernel), s=picture.shape).clamp_min(0)


def counts(picture: Tensor) -> Tensor:
    """Signed events [H, W] of a hard sensor past which a picture on the point spread's samples moves obliquely."""
    moved = [picture.roll((s, 2 * s), (0, 1)) for s in range(FRAMES)]
    frames = torch.nn.functional.avg_pool2d(torch.stack(moved)[:, None], FINER)[:, 0]
    stream = events.simulate(frames, torch.arange(FRAMES, dtype=D) * 1e-3, events.SensorModel())
    height, width = frames.shape[1:]
    seen = torch.zeros(2, height * width, dtype=D)
    seen[0].index_add_(0, stream.y.long() * width + stream.x.long(), stream.p.to(D))
    seen[1].index_add_(0, stream.y.long() * width + stream.x.long(), torch.ones_like(stream.p, dtype=D))
    rim = FRAMES  # where the picture's far side comes in, and blur with it
    return seen.reshape(2, height, width)[:, rim:-rim, rim:-rim]


def compare(run, rivals, losses):
    """Contrast of every lens over depth, in three wavelengths."""
    config = run.config
    per_m = judged_per_m(config)
    curves = {}
    rows = []
    with torch.no_grad(), run.progress(len(rivals), "lenses judged") as progress:
        for name, (geo, _) in rivals.items():
            found = [[contrast(config, geo, 1 / p, s, LINES) for p in per_m] for s in config.fields]
            curves[name] = torch.stack([torch.stack(f) for f in found])  # field, depth, frequency
            progress.advance()
    for name, (_, light) in rivals.items():
        low, high = curves[name][..., 0], curves[name][..., 1]
        key = metric_key(name)
        figures = (low.min(), low.mean(), high.min(), high.mean(), high.std() / high.mean())
        run.record(
            **{
                f"{key}_light": light,
                f"{key}_contrast_8px_worst": figures[0],
                f"{key}_contrast_4px_worst": figures[2],
                f"{key}_contrast_4px_mean": figures[3],
                f"{key}_contrast_4px_spread": figures[4],
            }
        )
        worst = float(figures[0]) * math.sqrt(light), float(figures[2]) * math.sqrt(light)
        rows.append(
            (name, f"{light:.2f}", *(f"{float(v):.3f}" for v in figures), *(f"{w:.3f}" for w in worst))
        )
    run.section("Over depth")
    run.table(
        f"Contrast from {config.near_m:g} to {config.far_m:g} m",
        (
            "lens",
            "light",
            "8 px worst",
            "8 px mean",
            "4 px worst",
            "4 px mean",
            "4 px spread / mean",
            "8 px worst × √light",
            "4 px worst × √light",
        ),
        rows,
        "RMS transfer over directions of patterns with a period of 8 and 4 pixels; F, d and C light.",
    )
    rows = count_events(run, rivals, per_m)
    run.table(
        "Events of a moving texture",
        (
            "lens",
            "events per pixel, worst depth",
            "of the sharp picture",
            "correlation with its counts, worst depth",
        ),
        rows,
        "Gravel, moved by 8 and 16 samples (4 and 8 pixels) past a hard sensor of threshold 0.2, on the axis; the same "
        "picture at every distance, blurred by the diffraction of F, d and C light. Bright light: no photon noise.",
    )
    draw(run, rivals, curves, per_m, losses)
    run.finish("A phase plate for depth", verdict(run, rivals, curves))


def count_events(run, rivals, per_m):
    """Events of every lens at its worst depth, and how they go with those of the sharp picture."""
    picture = torch.from_numpy(textures.photo("gravel")).to(D)[:PICTURE, :PICTURE]
    sharp = counts(picture)
    rows = []
    for name, (geo, _) in rivals.items():
        share = []
        alike = []
        for p in per_m:
            with torch.no_grad():
                fine_mm = run.config.pixel_um * 1e-3 / FINER
                energy = psf_on_pixels(geo, 0.0, fine_mm, SAMPLES, LINES, at_m=1 / p).energy
            seen = counts(blurred(picture, energy))
            share.append(float(seen[1].mean()))
            alike.append(float(torch.corrcoef(torch.stack([seen[0].flatten(), sharp[0].flatten()]))[0, 1]))
        key = metric_key(name)
        run.record(
            **{
                f"{key}_events_per_px_worst": min(share),
                f"{key}_events_over_sharp_worst": min(share) / float(sharp[1].mean()),
                f"{key}_events_correlation_worst": min(alike),
            }
        )
        rows.append(
            (name, f"{min(share):.2f}", f"{min(share) / float(sharp[1].mean()):.2f}", f"{min(alike):.3f}")
        )
    return rows


def metric_key(name):
    return name.replace(",", "").replace(" ", "_").replace(".", "p")


def verdict(run, rivals, curves):
    """The first lines of the page: the plate against no plate, and against the stop of equal contrast."""
    found = []
    for index, period in ((0, "8"), (1, "4")):
        worst = {name: float(curve.amin((0, 1))[index]) for name, curve in curves.items()}
        plain = [(light, worst[name]) for name, (_, light) in rivals.items() if name != PLATED]
        gain = worst[PLATED] / worst["open"]
        noise = worst[PLATED] / max(contrast * math.sqrt(light) for light, contrast in plain)
        light = max((light for light, contrast in plain if contrast >= worst[PLATED]), default=0.0)
        run.record(
            **{
                f"plate_over_open_contrast_{period}px_worst": gain,
                f"plate_over_best_stop_signal_over_noise_{period}px": noise,
                f"stop_of_equal_contrast_{period}px_light": light,
            }
        )
        run.card(f"Worst depth, {period} px", f"{gain:.2f} x", "contrast of the plate over none, all light")
        run.card(
            f"Over shot noise, {period} px", f"{noise:.2f} x", "plate over the best stop, equal exposure"
        )
        stop = (
            f"as much contrast without it takes a stop to {light:.0%} of the light"
            if light
            else "no stop has as much"
        )
        found.append(
            f"At a period of {period} pixels the plate has {gain:.2f} times the contrast of the open lens at the worst "
            f"depth; {stop}; over shot noise, at equal exposure, it has {noise:.2f} times what the best stop has."
        )
    share = {name: run.metrics[f"{metric_key(name)}_events_over_sharp_worst"] for name in rivals}
    best = max((name for name in share if name != PLATED), key=lambda name: share[name])
    found.append(
        f"In bright light a moving texture fires {share[PLATED]:.0%} of the sharp picture's events with the plate, at "
        f"its worst depth, and {share[best]:.0%} with the best lens without it ({best})."
    )
    return " ".join(found)


def draw(run, rivals, curves, per_m, losses):
    """Contrast over depth, losses, and point spreads."""
    config = run.config
    figure, axes = plt.subplots(1, 3, figsize=(12, 3.4), layout="constrained")
    for axis, index, period in zip(axes, (0, 1), (8, 4), strict=False):
        for name, curve in curves.items():
            axis.plot(
                per_m.tolist(),
                curve[0, :, index].tolist(),
                label=name,
                linewidth=2.5 if name == PLATED else 1.2,
            )
        axis.set(xlabel="1 / distance (1/m)", ylabel="contrast", title=f"period of {period} px, axis", ylim=0)
    axes[0].legend(frameon=False, fontsize=8)
    for name, values in losses.items():
        axes[2].plot(values, label=name)
    axes[2].set(xlabel="step", ylabel="log shortfall of contrast", title="design")
    axes[2].legend(frameon=False, fontsize=8)
    run.figure(
        figure,
        "contrast",
        "Contrast over depth, in light of three wavelengths, and the descent of each start.",
    )
    shown = [PLATED, "open", next(name for name in reversed(rivals) if name != PLATED)]
    figure, axes = plt.subplots(len(shown), len(SHOWN_M), figsize=(10, 7.5), layout="constrained")
    fine_mm = config.pixel_um * 1e-3 / FINER
    for row, name in zip(axes, shown, strict=True):
        for axis, at_m in zip(row, SHOWN_M, strict=True):
            with torch.no_grad():
                energy = psf_on_pixels(rivals[name][0], 0.0, fine_mm, SAMPLES, LINES, at_m=at_m).energy
            half = SAMPLES / FINER / 2
            axis.imshow(
                (energy / energy.max()).sqrt().numpy(),
                origin="lower",
                extent=(-half, half, -half, half),
                cmap="magma",
            )
            axis.set(title=f"{name}, {at_m:g} m" if axis is row[0] else f"{at_m:g} m")
    run.figure(figure, "psf", "Point spreads on the axis over distance, root scale, pixels.")


if __name__ == "__main__":
    sys.exit(main(study, Config))
