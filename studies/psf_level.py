"""Frames by point spread functions against traced frames: what the level costs, and how far it is off.

Lenses on a 346 x 260 sensor of 18.5 um before walls and rooms, and before depth edges where the level must guess.
Errors are RMS differences from many traced samples over the picture's RMS contrast, beside those of traced frames
of 16 and 64 samples (their noise) and of the thin lens. Times are processor times with everything of the lens
ready (rays, map), as in many frames of one lens, and with the gradient to lens and poses, which makes both anew.
"""

import sys
from dataclasses import dataclass
from typing import ClassVar

import matplotlib.pyplot as plt
import torch

from codesign import lens, pose, render
from codesign.errors import DomainError
from scenes import textures, worlds
from studies.frame.run import Run, StudyConfig, main
from studies.frame.timing import measure

SENSOR_PX = (346, 260)
PITCH_MM = 18.5e-3
EFL_MM = 11.0
NEAREST_M = 0.4
EACH = 64  # samples of the traced frames whose time counts, and of every part of the reference
ASKED_ERROR = 2.0
ASKED_RATIO = 3.0
SLOW = ("far wall", "near wall", "leaning wall", "empty room")  # worlds without depth edges
OTHERS = ("far wall", "near wall", "empty room")  # worlds that the other lenses see
EVEN = ("triplet", "triplet at 0.5 m", "triplet, 60 um defocus", "thin lens at 0.5 m")  # blur changes slowly


@dataclass(frozen=True)
class Config(StudyConfig):
    QUICK: ClassVar = {"parts": 2, "repeats": 3}
    parts: int = 4
    """Traced frames of 64 samples that make the reference."""
    repeats: int = 5
    """Timed repeats."""


def study(run: Run[Config]) -> None:
    config = run.config
    if config.parts < 2 or config.repeats < 2:
        raise DomainError(f"parts = {config.parts}, repeats = {config.repeats}: give at least 2 of each.")
    scenes = views()
    optics = lenses()
    cases = [(name, view) for name in optics for view in scenes]
    cases = [c for c in cases if c[0] in EVEN[:2] or (not config.quick and c[1] in OTHERS)]
    rows = []
    pictures = {}
    with run.progress(len(cases) + 2, "measuring") as progress:
        for name, view in cases:
            found, picture = errors(optics[name], *scenes[view], config.parts)
            rows.append((name, view, *found))
            if name == EVEN[1]:
                pictures[view] = picture
            progress.advance(error=found[0])
        ratios = {
            view: times(optics[EVEN[0]], *scenes[view], config.repeats) for view in ("far wall", "tabletop")
        }
        progress.advance()
        slope = gradients(optics[EVEN[1]], scenes["leaning wall"][1])
        progress.advance()
    slow = [row for row in rows if row[0] in EVEN and row[1] in SLOW]
    edges = [row for row in rows if row[0] in EVEN and row[1] not in SLOW]
    hard = [row for row in rows if row[0] not in EVEN]
    run.record(
        psf_level_rms_error_percent=max(row[2] for row in slow),
        psf_level_edges_rms_error_percent=max(row[2] for row in edges),
        psf_level_reference_noise_percent=max(row[6] for row in slow),
        psf_level_speed_ratio_64=min(r[0] for r in ratios.values()),
        psf_level_gradient_speed_ratio_64=min(r[1] for r in ratios.values()),
        **slope,
    )
    if hard:
        run.record(psf_level_hard_lenses_rms_error_percent=max(row[2] for row in hard))
    for view, (forward, backward, psf_s, traced_s) in ratios.items():
        key = view.replace(" ", "_")
        run.record(
            **{
                f"{key}_speed_ratio_64": forward,
                f"{key}_gradient_speed_ratio_64": backward,
                f"{key}_psf_cpu_s": psf_s,
                f"{key}_traced_64_cpu_s": traced_s,
            }
        )
    found = run.metrics
    met = (
        found["psf_level_rms_error_percent"] <= ASKED_ERROR
        and found["psf_level_speed_ratio_64"] >= ASKED_RATIO
    )
    run.table(
        "RMS error over contrast, %",
        ("lens", "world", "by PSF", "traced, 16", "traced, 64", "thin lens, 64", "of the reference"),
        rows,
        "The reference's own noise is estimated from its halves.",
    )
    run.table(
        "Processor time of 64 traced samples over that of the PSF level",
        ("world", "lens ready", "with gradients", "PSF frame, s", "traced frame, s"),
        [(view, *values) for view, values in ratios.items()],
    )
    run.figure(
        figure(pictures), "psf_level", f"{EVEN[1]}: traced, by PSF, and the difference (grey is none)."
    )
    run.finish(
        "Frames by point spread functions",
        f"Where blur changes slowly the error is at most {found['psf_level_rms_error_percent']:.2g} % of the "
        f"contrast ({ASKED_ERROR:g} asked), with depth edges {found['psf_level_edges_rms_error_percent']:.2g} %; 64 "
        f"traced samples take {found['psf_level_speed_ratio_64']:.2g} times as long ({ASKED_RATIO:g} asked), with "
        f"gradients {found['psf_level_gradient_speed_ratio_64']:.2g} times."
        + ("" if met else " **Missed.**"),
    )


def lenses():
    """Name -> lens of 11 mm."""
    triplet = scaled("cooke-triplet")
    behind = triplet.thickness_mm.detach().clone()
    behind[-1] += 0.06
    crown = lens.Glass.from_indices(1.6074, 1.62041, 1.6268, "crown")
    single = [
        lens.Surface(7.0, 1.5, crown, 3.0),
        lens.Surface(-200.0, 0.3, None, 3.0),
        lens.Surface(float("inf"), 10.0, None, 2.0, is_stop=True),
    ]
    singlet = lens.GeoLens(single, 2.2, dtype=torch.float32, name="singlet").focus_at(1.0)
    return {
        "triplet": triplet,
        "triplet at 0.5 m": triplet.focus_at(0.5).freeze(),
        "triplet, 60 um defocus": triplet.replace(thickness_mm=behind).freeze(),
        "thin lens at 0.5 m": triplet.thin().focus_at(0.5),
        "double Gauss": scaled("double-gauss"),
        "singlet": singlet.freeze(),
    }


def scaled(name):
    published = lens.load(name, torch.float32)
    return published.scaled(EFL_MM / float(published.first_order().efl_mm.detach())).freeze()


def views():
    """Name -> scene and pose [1, 4, 4]."""
    soft = textures.softened(textures.photo("gravel"), 2.0)
    far = worlds.wall(soft, texel_m=0.005)
    near = worlds.wall(soft, texel_m=0.001)
    start, end = worlds.VIEWS["room"]
    found = {
        "far wall": (far, pose.look_at((0.1, -3, 0.2), (0.1, 0, 0.2))),
        "near wall": (near, pose.look_at((0.1, -0.6, 0.2), (0.1, 0, 0.2))),
        "leaning wall": (near, pose.look_at((0.1, -0.7, 0.2), (0.6, 0, 0.4))),
        "empty room": (worlds.room(objects=False), pose.look_at(start, end)),
        "grain of one pixel": (
            worlds.wall(textures.photo("gravel"), 0.005),
            pose.look_at((0.1, -3, 0), (0.1, 0, 0)),
        ),
        "room with crates": (worlds.room(), pose.look_at((0.1, -0.2, 1.0), (0.0, 1.2, 0.3))),
        "tabletop": (worlds.tabletop(), pose.look_at(*worlds.VIEWS["tabletop"])),
    }
    return {name: (scene, at.reshape(1, 4, 4)) for name, (scene, at) in found.items()}


def camera(optics, samples=EACH, seed=0):
    return render.Camera(optics, *SENSOR_PX, PITCH_MM, samples, seed)


@torch.no_grad()
def errors(optics, scene, at, parts):
    """Errors in percent (PSF, traced 16 and 64, thin lens, reference), and the pictures (traced, by PSF)."""
    every = torch.stack([render.frames(camera(optics, seed=k + 1), scene, at)[0] for k in range(parts)])
    reference = every.mean(0)

    def percent(picture):
        return 100 * float((picture - reference).square().mean().sqrt() / reference.std())

    near = render.psf_frames(camera(optics), scene, at, render.psf_map(camera(optics), NEAREST_M))[0]
    thin = optics.thin() if hasattr(optics, "thin") else optics
    found = (
        near,
        render.frames(camera(optics, 16), scene, at)[0],
        render.frames(camera(optics), scene, at)[0],
        render.frames(camera(thin), scene, at)[0],
    )
    halves = every[::2].mean(0) - every[1::2].mean(0)
    noise = 50 * float(halves.square().mean().sqrt() / reference.std())
    return (*map(percent, found), noise), (reference, near)


def times(optics, scene, at, repeats):
    """Processor time of traced frames over that of frames by PSF, with the lens ready and with gradients; and the
    two times with the lens ready, s."""
    cam = camera(optics)
    with torch.no_grad():
        rays = cam.rays()
        psf = render.psf_map(cam, NEAREST_M)
        by_psf = measure(lambda: render.psf_frames(cam, scene, at, psf), repeats).cpu
        traced = measure(lambda: render.frames(cam, scene, at, rays=rays), repeats).cpu

    def step(make):
        changed = cam.with_lens(optics.replace(thickness_mm=optics.thickness_mm.detach().requires_grad_()))
        make(changed, at.clone().requires_grad_()).square().mean().backward()

    few = max(2, repeats // 2)
    back_psf = measure(
        lambda: step(lambda c, p: render.psf_frames(c, scene, p, render.psf_map(c, NEAREST_M))), few, warm=1
    ).cpu
    back_traced = measure(lambda: step(lambda c, p: render.frames(c, scene, p)), few, warm=1).cpu
    return traced / by_psf, back_traced / back_psf, by_psf, traced


def gradients(optics, at):
    """The gradient of a smooth functional of the picture to curvatures and thicknesses, each by its natural
    step: against differences of the level itself, and against the traced level's."""
    optics = optics.double()
    stand = torch.eye(4, dtype=torch.float64)
    stand[:3, :3] = torch.tensor([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]], dtype=torch.float64)
    plane = render.TexturedPlane(
        *textures.waves(0, finest_period_m=0.01, coarsest_period_m=0.1), T_world_plane=stand
    )
    size = (64, 48)
    coarse = torch.randn(1, 1, 6, 8, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    weights = torch.nn.functional.interpolate(coarse, size=size[::-1], mode="bilinear", align_corners=True)[0]
    c = optics.curvature_per_mm.detach()
    t = optics.thickness_mm.detach()

    def value(x, level):
        half = len(x) // 2
        changed = optics.replace(curvature_per_mm=c * (1 + x[:half]), thickness_mm=t * (1 + x[half:]))
        cam = render.Camera(changed, *size, 4 * PITCH_MM, 256)
        if level == "psf":
            return (render.psf_frames(cam, plane, at, render.psf_map(cam, NEAREST_M)) * weights).sum()
        return (render.frames(cam, plane, at) * weights).sum()

    found = {}
    for level in ("psf", "traced"):
        x = torch.zeros(2 * len(c), dtype=torch.float64, requires_grad=True)
        (found[level],) = torch.autograd.grad(value(x, level), x)
    shifts = 1e-6 * torch.eye(2 * len(c), dtype=torch.float64)
    with torch.no_grad():
        truth = torch.stack([(value(s, "psf") - value(-s, "psf")) / 2e-6 for s in shifts])
    own, traced = found["psf"], found["traced"]
    return {
        "psf_level_gradient_difference_relative_error": float((own - truth).norm() / truth.norm()),
        "psf_level_gradient_traced_relative_error": float((own - traced).norm() / traced.norm()),
        "psf_level_gradient_traced_cosine": float(own @ traced / (own.norm() * traced.norm())),
    }


def figure(pictures):
    chosen = [name for name in ("leaning wall", "room with crates", "tabletop") if name in pictures]
    made, axes = plt.subplots(len(chosen), 3, figsize=(9, 2.4 * len(chosen)), layout="constrained")
    for row, name in zip(axes, chosen, strict=True):
        traced, near = pictures[name]
        top = float(traced.max())
        row[0].imshow(traced, cmap="gray", vmin=0, vmax=top)
        row[1].imshow(near, cmap="gray", vmin=0, vmax=top)
        shown = row[2].imshow(near - traced, cmap="RdGy", vmin=-0.2 * top, vmax=0.2 * top)
        made.colorbar(shown, ax=row[2])
        for axis, title in zip(row, (f"{name}: traced", "by PSF", "difference"), strict=True):
            axis.set(title=title, xticks=[], yticks=[])
    return made


if __name__ == "__main__":
    sys.exit(main(study, Config))
