"""How true the render stage's ground truth and pictures are, against closed forms and Mitsuba's own sensors.

- Flow of a still and of a moving plane against float64 homographies, analytic and as Mitsuba geometry.
- Points under pixels projected back, through five lenses and over the whole film.
- Images through pinhole and thin lens against Mitsuba's `perspective` and `thinlens`, paired over seeds.
"""

import math
import sys
from dataclasses import dataclass

import numpy as np
import torch

from codesign import backend, lens, pose, render
from scenes import textures, worlds
from studies.frame.run import Run, StudyConfig, main

SENSOR_PX = (346, 260)
PITCH_MM = 18.5e-3
ASKED = {"flow_still_px": 1e-4, "flow_moving_px": 1e-3, "unproject_px": 1e-9}
SEEDS = 16


@dataclass(frozen=True)
class Config(StudyConfig):
    pass


def study(run: Run[Config]) -> None:
    with run.progress(4, "measuring") as progress:
        still = max(flow_error(card, moving=False) for card in (plane, rectangle))
        progress.advance()
        moving = max(flow_error(card, moving=True) for card in (plane, rectangle))
        run.record(
            flow_still_px=still, flow_moving_px=moving, flow_analytic_px=flow_error(plane, moving=True)
        )
        progress.advance()
        rows = {
            name: unproject_error(optics(), 4 if run.config.quick else 1) for name, optics in OPTICS.items()
        }
        run.record(
            unproject_px=max(rows.values()),
            **{
                f"unproject_{name.replace('-', '_').replace(' ', '_')}_px": error
                for name, error in rows.items()
            },
        )
        progress.advance()
        pictures = {
            "perspective": against("perspective", lens.Pinhole(5.0)),
            "thinlens": against("thinlens", lens.ThinLens(1 / (1 / 5.0 + 1 / 2000.0), 20.0, 5.0)),
        }
        progress.advance()
    for kind, (level, square, pixels) in pictures.items():
        run.record(**{f"{kind}_level_z": level, f"{kind}_mean_square_z": square, f"{kind}_pixels": pixels})
    found = run.metrics
    words = {
        "flow_still_px": "flow of a still plane against its homography, px",
        "flow_moving_px": "flow of a moving plane against its homography, px",
        "unproject_px": "points under pixels projected back, px",
    }
    run.table(
        "Truth",
        ("what", "largest error", "allowed", "met"),
        [(words[k], found[k], ASKED[k], "yes" if found[k] <= ASKED[k] else "NO") for k in words],
    )
    run.table("Projected back", ("lens", "largest error, px"), list(rows.items()))
    run.text(
        f"Pictures: {SEEDS} seeds on either side. z is the difference of a pixel's means over its standard "
        "error; for equal pictures its mean square is 1.1 (the standard error itself is estimated)."
    )
    run.table(
        "Against Mitsuba's sensors",
        ("sensor", "z of the whole image's mean", "mean square of z", "pixels"),
        [(kind, *values) for kind, values in pictures.items()],
    )
    missed = [words[k] for k in words if found[k] > ASKED[k]]
    run.finish(
        "Truth of the render stage",
        "All figures are met." if not missed else f"**Missed:** {'; '.join(missed)}.",
    )


def plane():
    return render.TexturedPlane(*textures.waves(1, finest_period_m=0.2))


def rectangle():
    mi = backend.mitsuba()
    return render.MitsubaScene(
        {
            "card": {
                "type": "rectangle",
                "to_world": mi.ScalarTransform4f().scale(3.0),
                "emitter": {"type": "area", "radiance": {"type": "rgb", "value": 50.0}},
            }
        }
    )


def flow_error(card, moving):
    """Largest difference of the flow of a card and its homography (Hartley and Zisserman, 8.1), px."""

    def turn(*twist):
        return pose.se3_exp(
            torch.linspace(0, 1, 3, dtype=torch.float64)[:, None] * torch.tensor(twist, dtype=torch.float64)
        )

    poses = pose.look_at((0, 0, 2), (0, 0, 0), down=(0, 1, 0)) @ turn(0.05, -0.03, 0.08, 0.02, -0.03, 0.05)
    objects = (
        turn(-0.1, 0.06, 0.04, 0.05, 0.03, -0.1)
        if moving
        else torch.eye(4, dtype=torch.float64).expand(3, 4, 4)
    )
    camera = render.Camera(lens.Pinhole(8.0), 24, 16, 0.1, 1)
    behind = torch.eye(4, dtype=torch.float64)
    behind[2, 3] = -3.0
    scene = (
        render.MovingScene(
            render.TexturedPlane(*textures.waves(2), T_world_plane=behind), {"card": (card(), objects)}
        )
        if moving
        else card()
    )
    flow, valid = render.true_flow(camera, scene, poses)
    K = np.array([[80.0, 0, 11.5], [0, 80.0, 7.5], [0, 0, 1]])

    def onto(k):
        return K @ (np.linalg.inv(poses[k].numpy()) @ objects[k].numpy())[:3, [0, 1, 3]]

    pixels = camera.film.pixels().numpy()
    worst = 0.0
    for k in range(2):
        h = (
            np.concatenate([pixels, np.ones_like(pixels[:, :1])], 1)
            @ (onto(k + 1) @ np.linalg.inv(onto(k))).T
        )
        truth = (h[:, :2] / h[:, 2:] - pixels).T.reshape(2, 16, 24)
        worst = max(worst, float(np.abs(flow[k].numpy() - truth)[:, valid[k].numpy()].max()))
    return worst


def fitted(name):
    """The lens scaled until its published field fills the sensor's half diagonal."""
    geo = lens.load(name)
    image_mm = float(geo.first_order().efl_mm.detach()) * math.tan(math.radians(lens.half_field_deg(name)))
    return geo.scaled(math.hypot(*SENSOR_PX) / 2 * PITCH_MM / image_mm)


OPTICS = {
    "pinhole": lambda: lens.Pinhole(8.0),
    "thin lens": lambda: lens.ThinLens(8.0, 2.0, 8.05),
    "cooke-triplet": lambda: fitted("cooke-triplet"),
    "double-gauss": lambda: fitted("double-gauss"),
    "la1509": lambda: fitted("la1509"),
}


def unproject_error(optics, every):
    """Largest distance, px, between pixels and the projections of the points that are seen there; a tilted
    plane 2 m ahead."""
    camera = render.Camera(optics, *SENSOR_PX, PITCH_MM, 1)
    where = pose.look_at((0, 0, 2), (0, 0, 0), down=(0, 1, 0)) @ pose.se3_exp(
        torch.tensor([0.05, -0.03, 0.08, 0.1, -0.05, 0.05], dtype=torch.float64)
    )
    with torch.no_grad():
        pixels = camera.film.pixels()[::every]
        points, _, valid = render.truth.world_points(camera.chief_rays(pixels), plane(), where)
        back = render.project(camera, pose.apply(pose.inverse(where), points[valid]))
    return float((back - pixels[valid]).abs().max())


def against(kind, optics, width=32, height=24, pitch_mm=0.1, efl_mm=5.0, samples=64):
    """Z of the mean level, mean square of z per pixel, number of pixels: our images of the room against those
    of Mitsuba's sensor."""
    scene = worlds.room()
    where = pose.look_at((0.35, -1.3, 1.2), (0.0, 0.9, 0.5))
    mi = backend.mitsuba()
    turned = where.numpy().copy()
    turned[:3, :2] *= -1  # Mitsuba's sensors look along +z with x to the left and y up
    film = {
        "type": "hdrfilm",
        "width": width,
        "height": height,
        "pixel_format": "luminance",
        "rfilter": {"type": "box"},
    }
    sensor = {
        "type": kind,
        "to_world": mi.ScalarTransform4f(turned),
        "fov_axis": "x",
        "fov": math.degrees(2 * math.atan(width * pitch_mm / 2 / efl_mm)),
        "film": film,
        "sampler": {"type": "independent"},
    }
    if kind == "thinlens":
        sensor |= {"aperture_radius": optics.entrance_pupil_diameter_mm / 2e3, "focus_distance": 2.0}
    sensor = mi.load_dict(sensor)
    integrator = mi.load_dict({"type": "direct"})
    theirs = torch.stack(
        [
            torch.from_numpy(
                np.array(
                    mi.render(scene.scene, sensor=sensor, integrator=integrator, spp=samples, seed=100 + k)
                )
            )
            .double()
            .reshape(height, width)
            for k in range(SEEDS)
        ]
    )
    with torch.no_grad():
        ours = torch.cat(
            [
                render.frames(
                    render.Camera(optics, width, height, pitch_mm, samples, seed=k), scene, where[None]
                )
                for k in range(SEEDS)
            ]
        ).double()
    error = ((ours.var(0) + theirs.var(0)) / SEEDS + (1e-5 * ours.mean(0)).square()).sqrt()
    z = (ours.mean(0) - theirs.mean(0)) / error
    means = [images.mean((1, 2)) for images in (ours, theirs)]
    spread = float(((means[0].var() + means[1].var()) / SEEDS).sqrt())
    return float(means[0].mean() - means[1].mean()) / spread, float(z.square().mean()), z.numel()


if __name__ == "__main__":
    sys.exit(main(study, Config))
