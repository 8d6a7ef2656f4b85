"""Are worlds from Mitsuba scenes the pictures that Mitsuba makes, and is their gradient right?

Five scenes that come along (scenes/foreign_examples.py), or files of one's own. At the level "path" frames are
compared with mi.render through the scene's own sensor, with as many paths per pixel: the ratio of the means, and the
RMS difference over that of two references. At the level "baked" their error is measured against paths (with the noise
taken out, after one brightness factor), and the gradient of a random smooth loss to the pose against central
differences with common random numbers, interior alone and with the boundary term.
"""

import math
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import matplotlib.pyplot as plt
import numpy as np
import torch

from codesign import backend, pose, render
from codesign.errors import CodesignError, DomainError
from codesign.render import light
from scenes import foreign, worlds
from scenes.foreign_examples import FOREIGN
from studies.frame.run import Run, StudyConfig, main

REFERENCES = 4
STEP_M = 1e-3  # of the differences, and the same in radians
WAYS = ("interior", "boundary")


@dataclass(frozen=True)
class Config(StudyConfig):
    QUICK: ClassVar = {"width_px": 32, "paths": 16, "bake_samples": 8, "gradient_samples": 16, "texels": 4000}
    scene: tuple[str, ...] = ()
    """Names of scenes that come along, or paths of .xml files; all that come along when left out."""
    up: str = "y"
    """The axis that points up in the scenes: y or z."""
    width_px: int = 96
    """Width of the pictures."""
    paths: int = 256
    """Paths per pixel of the pictures that are compared."""
    bake_samples: int = 256
    """Paths per texel of baked light."""
    texels: int = 60_000
    """Texels of baked light, about."""
    gradient_samples: int = 128
    """Samples per pixel of gradient and differences; 0 leaves the gradient out."""


def study(run: Run[Config]) -> None:
    config = run.config
    if (
        min(config.width_px, config.paths, config.bake_samples, config.texels) < 1
        or config.gradient_samples < 0
    ):
        raise DomainError(
            "width_px, paths, bake_samples and texels must be at least 1, gradient_samples at least 0."
        )
    rows = []
    pictures = {}
    with run.progress(len(config.scene or FOREIGN), "scenes") as progress:
        for name in config.scene or tuple(FOREIGN):
            found, label = measure(name, config, pictures)
            run.record(
                **{
                    f"foreign_{label}_{key}": value
                    for key, value in found.items()
                    if isinstance(value, float)
                }
            )
            rows.append((label, found))
            progress.advance(mean_ratio=found["mean_ratio"])
    show(run, rows, pictures)


def source_of(name: str) -> Any:
    """A scene that comes along, or the path of a file. Raises: DomainError when it is neither."""
    if name in FOREIGN:
        return FOREIGN[name]()
    if Path(name).suffix != ".xml":
        raise DomainError(
            f"there is no scene '{name}'; choose from {', '.join(FOREIGN)}, or give an .xml file."
        )
    return name


def measure(name: str, config: Config, pictures: dict[str, Any]) -> tuple[dict[str, Any], str]:
    """Figures of one scene, None for those that it has not, and its name in them."""
    mi = backend.mitsuba()
    label = (Path(name).parent.name + "_" + Path(name).stem if name.endswith(".xml") else name).replace(
        "-", "_"
    )
    scene = foreign.loaded(mi, source_of(name), {}, merge=False)
    view = worlds.view_of(scene, up=config.up)
    poses = view.T_world_cam[None]
    camera = view.camera(config.paths, config.width_px)
    paths = worlds.from_mitsuba(scene, "path", up=config.up, samples=1)
    theirs = references(mi, scene, view, camera, config.paths)
    with torch.no_grad():
        ours = torch.stack([frame(camera, paths.with_seed(k), poses) for k in range(REFERENCES)])
    alone = [rms(theirs[i] - theirs[j]) for i in range(REFERENCES) for j in range(i)]
    found: dict[str, Any] = {
        "mean_ratio": float(ours.mean() / theirs.mean()),
        "rms_over_noise": float(np.mean([rms(a - b) for a in ours for b in theirs]) / np.mean(alone)),
        "mean_noise": float((ours.mean((1, 2)).var() + theirs.mean((1, 2)).var()).sqrt() / 2 / theirs.mean()),
        "baked_rms_after_gain": None,
        "bake_cpu_s": None,
        **{f"gradient_{way}_error": None for way in WAYS},
        "gradient_noise": None,
        "refused": None,
        "gradient_refused": None,
    }
    pictures[label] = [theirs.mean(0), ours.mean(0)]
    start = time.process_time()
    options = {"samples": config.bake_samples, "texel_m": math.sqrt(area_m2(scene) / config.texels)}
    try:
        baked = worlds.from_mitsuba(scene, "baked", up=config.up, **options)
    except CodesignError as error:
        found["refused"] = str(error)
        baked = worlds.from_mitsuba(scene, "baked", up=config.up, matte=True, **options)
    found["bake_cpu_s"] = time.process_time() - start
    few = camera_of(view, config, 16)
    error = light.level_error(baked, worlds.from_mitsuba(scene, "path", up=config.up, samples=16), few, poses)
    found["baked_rms_after_gain"] = float(error.rms_after_gain.max())
    with torch.no_grad():
        pictures[label].append(frame(few, baked, poses))
    if config.gradient_samples:
        found |= gradients(camera_of(view, config, config.gradient_samples), baked, poses)
    return found, label


def camera_of(view, config, samples):
    return view.camera(samples, config.width_px)


def area_m2(scene):
    return sum(float(shape.surface_area()[0]) for shape in scene.shapes())


def frame(camera, scene, poses):
    return render.frames(camera, scene, poses)[0].double().reshape(camera.film.shape[-2:])


def rms(image):
    return float(image.square().mean().sqrt())


def references(mi, scene, view, camera, paths):
    """Pictures [REFERENCES, H, W] of mi.render through the sensor of the scene, with a film of this size, box
    filtered."""
    film = camera.film
    own = mi.traverse(scene.sensors()[0])
    sensor = mi.load_dict(
        {
            "type": "perspective",
            "fov": math.degrees(view.field_of_view_rad),
            "fov_axis": "x",
            "near_clip": float(own["near_clip"]),
            "far_clip": float(own["far_clip"]),
            "to_world": mi.ScalarTransform4f(np.array(own["to_world"].matrix)[..., 0]),
            "film": {
                "type": "hdrfilm",
                "width": film.sensor_width_px,
                "height": film.sensor_height_px,
                "crop_width": film.width_px,
                "crop_height": film.height_px,
                "crop_offset_x": (film.windows_px or ((0, 0),))[0][0],
                "crop_offset_y": (film.windows_px or ((0, 0),))[0][1],
                "pixel_format": "luminance",
                "rfilter": {"type": "box"},
            },
        }
    )
    integrator = scene.integrator() or mi.load_dict({"type": "path"})
    images = [
        np.array(mi.render(scene, sensor=sensor, integrator=integrator, spp=paths, seed=100 + k))[..., 0]
        for k in range(REFERENCES)
    ]
    return torch.from_numpy(np.stack(images)).double()


def gradients(camera, scene, poses):
    """Relative L2 error of the six pose components of a random smooth loss, by way, and that of the differences at
    another seed of the camera."""
    generator = torch.Generator().manual_seed(0)
    height, width = camera.film.shape[-2:]
    coarse = torch.randn(1, 1, 6, 8, generator=generator, dtype=torch.float64)
    weight = torch.nn.functional.interpolate(
        coarse, size=(height, width), mode="bilinear", align_corners=True
    )[0, 0]

    def differences(seed):
        found = []
        for twist in STEP_M * torch.eye(6, dtype=torch.float64):
            with torch.no_grad():
                ahead, behind = (
                    frame(camera.with_seed(seed), scene, poses @ pose.se3_exp(sign * twist[None]))
                    for sign in (1, -1)
                )
            found.append(float(((ahead - behind) * weight).sum()) / (2 * STEP_M))
        return torch.tensor(found)

    truth = [differences(seed) for seed in range(4)]
    mean = torch.stack(truth).mean(0)
    found = {"gradient_noise": float((torch.stack(truth).std(0) / 2).norm() / mean.norm())}
    for way in WAYS:
        twist = torch.zeros(1, 6, dtype=torch.float64, requires_grad=True)
        try:
            image = render.frames(camera.with_seed(4), scene, poses @ pose.se3_exp(twist), gradient=way)
        except DomainError as error:
            found["gradient_refused"] = str(error)
            continue
        (image[0].double().reshape(height, width) * weight).sum().backward()
        found[f"gradient_{way}_error"] = float((twist.grad[0] - mean).norm() / mean.norm())
    return found


def show(run, rows, pictures):
    """Table and pictures of the page."""
    run.card("Scenes", str(len(rows)), "as Mitsuba renders them")
    run.card(
        "RMS over noise", f"{max(found['rms_over_noise'] for _, found in rows):.2f}", "largest, asked 1.1"
    )
    run.section("Pictures", "mi.render, the level path, and the level baked, on one scale each (gamma 2.2).")
    run.figure(sheet(pictures), "pictures", "Each scene from its own sensor.", dpi=110)
    run.section(
        "Figures", "Shares of the radiance and of the gradient; baked scenes that needed it are matte."
    )

    def number(value):
        return None if value is None else f"{value:.4g}"

    keys = [key for key in rows[0][1] if not key.endswith("refused")]
    run.table("", ("scene", *keys), [(label, *(number(found[key]) for key in keys)) for label, found in rows])
    refused = [
        f"- **{label}**: {found[key]}"
        for label, found in rows
        for key in ("refused", "gradient_refused")
        if found[key]
    ]
    if refused:
        run.section("What cannot be baked as it is, or has no gradient of silhouettes", "\n".join(refused))
    run.finish("Scenes of others", "Mitsuba scenes as worlds: pictures, baked light and gradients.")


def sheet(pictures):
    """Figure of the pictures: a row per scene."""
    figure, axes = plt.subplots(
        len(pictures), 3, figsize=(9.6, 2.5 * len(pictures)), squeeze=False, layout="constrained"
    )
    for row, (label, images) in zip(axes, pictures.items(), strict=True):
        white = float(images[0].quantile(0.98).clamp_min(1e-9))
        for axis, image, level in zip(row, images, ("mi.render", "path", "baked"), strict=True):
            axis.axis("off")
            axis.imshow((image.numpy() / white).clip(0, 1) ** (1 / 2.2), cmap="gray", vmin=0, vmax=1)
            axis.set_title(f"{label}, {level}", fontsize=9)
    return figure


if __name__ == "__main__":
    sys.exit(main(study, Config))
