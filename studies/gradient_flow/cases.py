"""The gradients that gradient_flow and the test suite certify: functions of named parameters, with their
required figures."""

import math
from dataclasses import replace

import torch

from codesign import events, flow, lens, pose, render
from codesign.grad import certify
from codesign.grad.certify import Row
from scenes import textures, trajectories, worlds
from studies.lens_opt.task import PITCH_MM, SENSOR, TRAINING, draw_case, make_task, make_worlds

FINE = tuple(10.0**-k for k in (3, 4, 5, 6))
COARSE = (0.1, 0.05, 0.025, 0.0125)
CURVES = [0, 2, 3]  # the three curvatures of the final loss: front crown, both sides of the flint
POSE_UNIT = torch.tensor(
    [0.01, 0.01, 0.02, 0.005, 0.005, 0.01], dtype=torch.float64
)  # m, rad: each moves the image by a few pixels


def smooth_cases(seed):
    """(label, required figures, function that makes rows) of every smooth junction."""
    return [
        ("lens rays, float64", {"error": 1e-6}, lambda: rays_rows()),
        ("frames, plane, float64", {"error": 1e-5}, lambda: plane_rows(seed)),
        ("frames, room, float32", {"error": 0.01}, lambda: room_rows(seed)),
        ("true flow, float64", {"error": 1e-5}, lambda: truth_rows()),
        ("event counts, smooth", {"error": 1e-5}, lambda: count_rows(seed)),
        ("flow estimate, float64", {"error": 1e-5}, lambda: flow_rows(seed)),
        ("final loss, smooth events", {"error": 0.05, "cosine": 0.99}, lambda: loss_rows(seed)),
    ]


def hard_cases(seed, count):
    """The straight-through layer against differences of the hard loss, averaged over motions and textures."""
    return [("final loss, hard events", {"cosine": 0.9}, lambda: hard_rows(seed, count))]


def sensor_triplet(dtype=torch.float64):
    """The Cooke triplet at 11 mm, fit for the DAVIS346."""
    published = lens.load("cooke-triplet", dtype)
    return published.scaled(0.22)


def rays_rows():
    """Sum of weighted landing points and optical paths of 200 rays, with respect to all lens tensors."""
    geo = lens.load("cooke-triplet").freeze()
    generator = torch.Generator().manual_seed(0)
    disc = torch.randn(200, 2, generator=generator, dtype=torch.float64).clamp(-1.5, 1.5) * 2.5
    origin = torch.cat([disc, torch.full((200, 1), -5.0, dtype=torch.float64)], 1)
    direction = torch.nn.functional.normalize(
        torch.tensor([0.02, 0.15, 1.0], dtype=torch.float64), dim=0
    ).expand(200, 3)
    mix = torch.randn(200, 3, generator=generator, dtype=torch.float64)

    def fn(p):
        out = geo.replace(**p).trace(origin, direction)
        return (
            (out.position_mm * mix).sum() + (out.direction * mix).sum() + 0.1 * out.optical_path_mm.sum()
        ) / 200

    params = {
        "curvature_per_mm": geo.curvature_per_mm,
        "thickness_mm": geo.thickness_mm,
        "conic": geo.conic,
        "index_offset": geo.index_offset,
    }
    return certify(
        fn,
        params,
        scales={"curvature_per_mm": 0.02, "thickness_mm": 1.0, "conic": 1.0, "index_offset": 0.1},
        ladder=FINE,
        tolerance=1e-6,
    )


def _frame_rows(scene, start, seed, ladder, tolerance, samples=8):
    """Loss of a small sequence with respect to curvatures, thicknesses and pose."""
    geo = sensor_triplet().freeze()
    t_s = trajectories.times(3, 100.0)
    motion = trajectories.translation(start, (0.4, 0.1, 0.2), t_s)
    weight = torch.randn(3, 48, 48, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    weight = torch.nn.functional.avg_pool2d(
        weight, 5, 1, 2
    )  # a smooth weight: the loss of a stage downstream never sees single pixels

    def fn(p):
        optics = geo.replace(curvature_per_mm=p["curvature"], thickness_mm=p["thickness"])
        camera = render.Camera(optics, 48, 48, 4 * PITCH_MM, samples, seed)
        image = render.frames(camera, scene, motion @ pose.se3_exp(p["pose"]))
        return (weight * image.double()).mean() + 0.01 * (image.double() / 100).square().mean()

    params = {
        "curvature": geo.curvature_per_mm,
        "thickness": geo.thickness_mm,
        "pose": torch.zeros(6, dtype=torch.float64),
    }
    scales = {"curvature": 0.002, "thickness": 0.1, "pose": POSE_UNIT}
    return certify(fn, params, scales=scales, ladder=ladder, tolerance=tolerance)


def plane_rows(seed):
    """Frames of the analytic plane, everything in float64."""
    plane = worlds.smooth_plane(seed, pose.look_at((0, 0, 0), (0, -1, 0)))
    return _frame_rows(
        plane, pose.look_at((0.1, -2, 0.05), (0, 0, 0)), seed, (0.1, 0.03, 0.01, 0.003, 0.001), 1e-5
    )


def room_rows(seed):
    """Frames of the photo-textured room without objects, so that no silhouette moves; scene in float32."""
    scene = worlds.room(objects=False)
    return _frame_rows(
        scene,
        pose.look_at((0.3, -0.8, 1.2), (0.1, 2.0, 1.0)),
        seed,
        (0.03, 0.02, 0.014, 0.01),
        0.01,
        samples=16,
    )


def truth_rows():
    """Ground-truth flow through the lens, with respect to lens and both poses."""
    geo = sensor_triplet().freeze()
    wall = worlds.smooth_plane(0, pose.look_at((0, 0, 0), (0, -1, 0)))
    poses = torch.stack(
        [pose.look_at((0, -2, 0), (0.1, 0, 0)), pose.look_at((0.03, -1.95, 0.02), (0.12, 0, 0))]
    )
    weight = torch.randn(1, 2, 24, 24, generator=torch.Generator().manual_seed(1), dtype=torch.float64)

    def fn(p):
        optics = geo.replace(curvature_per_mm=p["curvature"], thickness_mm=p["thickness"])
        camera = render.Camera(optics, 24, 24, 8 * PITCH_MM, 1, 0)
        found, _ = render.true_flow(camera, wall, torch.stack([poses[0] @ pose.se3_exp(p["pose"]), poses[1]]))
        return (weight * found).mean()

    params = {
        "curvature": geo.curvature_per_mm,
        "thickness": geo.thickness_mm,
        "pose": torch.zeros(6, dtype=torch.float64),
    }
    return certify(
        fn,
        params,
        scales={"curvature": 0.01, "thickness": 0.1, "pose": POSE_UNIT},
        ladder=(1e-1, 1e-2, 1e-3, 1e-4),
        tolerance=1e-5,
    )


def _moving_frames(seed, contrast=0.6):
    """A small band-limited sequence in float64, as a function of contrast and shift per frame: fn(p) ->
    frames [8, 24, 24]."""
    frequency, amplitude, phase = textures.waves(seed, 12, 6.0, 24.0, contrast)
    y, x = torch.meshgrid(
        torch.arange(24, dtype=torch.float64), torch.arange(24, dtype=torch.float64), indexing="ij"
    )
    steps = torch.arange(8, dtype=torch.float64)[:, None, None]

    def frames(p):
        at_x = x - p["shift"][0] * steps
        at_y = y - p["shift"][1] * steps
        waves = (
            2
            * math.pi
            * (frequency[:, 0, None, None, None] * at_x + frequency[:, 1, None, None, None] * at_y)
            + phase[:, None, None, None]
        ).cos()
        return 80 * (p["contrast"] * (amplitude[:, None, None, None] * waves).sum(0)).exp()

    return frames, {
        "contrast": torch.ones(1, dtype=torch.float64),
        "shift": torch.tensor([0.4, -0.2], dtype=torch.float64),
    }


def count_rows(seed):
    """Smooth event counts with respect to contrast, motion and threshold. Small steps: counts have a kink
    where the level stands still."""
    frames, params = _moving_frames(seed)
    weight = torch.rand(7, 2, 24, 24, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    params = {**params, "theta": torch.tensor([0.2], dtype=torch.float64)}
    return certify(
        lambda p: (weight * events.soft_counts(frames(p), p["theta"], p["theta"])).mean(),
        params,
        scales={"theta": 0.1, "shift": 0.1},
        ladder=(1e-4, 1e-5, 1e-6),
        tolerance=1e-5,
    )


def flow_rows(seed):
    """Mean estimated flow and its square, with respect to contrast and motion."""
    frames, params = _moving_frames(seed)
    t_s = torch.linspace(0, 0.05, 8, dtype=torch.float64)

    def fn(p):
        volume = events.from_counts(events.soft_counts(frames(p), 0.2, 0.2), t_s, 4)
        found = flow.estimate_lk(volume, "constant", levels_px=(2.0, 1.0), steps=2).flow_px
        return found.mean() + 0.1 * found.square().mean()

    return certify(fn, params, scales={"shift": 0.1}, ladder=(1e-3, 1e-4, 1e-5), tolerance=1e-5)


def _final(task, case_list, layer, samples, sensor=SENSOR):
    """Mean log angular flow error over cases, as a function of three curvatures and the camera pose."""
    base = task.design.reference

    def fn(p, cases=case_list):
        change = torch.zeros_like(base.curvature_per_mm).index_put(
            (torch.tensor(CURVES),), p["curvature"].to(base.curvature_per_mm)
        )
        optics = base.replace(curvature_per_mm=base.curvature_per_mm + change)
        system = task.system(
            task.camera(optics, samples), events.layer(layer, sensor, learn=()), flow.estimate_lk
        )
        moved = [replace(case, T_world_body=case.T_world_body @ pose.se3_exp(p["pose"])) for case in cases]
        return torch.stack([system(case).loss for case in moved]).mean()

    unit = task.design.basis[:5, -1].abs().max() * torch.ones(
        3, dtype=torch.float64
    )  # moves the rays by about a pixel
    params = {"curvature": torch.zeros(3, dtype=torch.float64), "pose": torch.zeros(6, dtype=torch.float64)}
    return fn, params, {"curvature": unit, "pose": POSE_UNIT}


def loss_rows(seed):
    """The final loss with the smooth counts layer, whole chain, scene in float32.

    Without noise the smooth layer lets the closed-form flow come within hundredths of a pixel, and the
    gradient is that of rounding; shot noise of 40 Hz gives an error that the optics can change. Band-limited
    textures, since texel borders are kinks.
    """
    task = make_task("cooke-triplet", seed, 1.0)
    walls = [
        worlds.wall(textures.speckle(k, size_px=1024, finest_px=32.0, coarsest_px=128.0), texel_m=0.002)
        for k in (5, 6)
    ]
    cases = [draw_case(walls, 61 + i) for i in range(4)]
    noisy = events.SensorModel(theta_on=0.2, theta_off=0.2, theta_sigma=0.03, shot_rate_hz=40.0)
    fn, params, scales = _final(task, cases, "counts", 16, noisy)
    return certify(fn, params, scales=scales, ladder=(0.014, 0.01, 0.007, 0.005), tolerance=0.05)


def hard_rows(seed, count):
    """Straight-through gradient against central differences of the hard loss.

    Steps of half a pixel of ray motion and 1 to 2 pixels of image motion move several counts per pixel row.
    Single cases are noisy on both sides, so both are averaged over motions and textures before they are
    compared; the noise floor is the standard error of the mean difference. On walls that look alike
    everywhere the mean loss hardly depends on the pose: there the floor is above 1, and the differences
    themselves say nothing.
    """
    task = make_task("cooke-triplet", seed)
    pool = make_worlds(TRAINING)
    task_cases = [draw_case(pool, 50_000 + i) for i in range(count)]
    fn, params, scales = _final(task, task_cases, "memory", 16)
    step = {"curvature": 0.5, "pose": 1.0}
    slopes = {n: [] for n in params}
    differences = {n: [] for n in params}
    for case in task_cases:
        leaves = {n: v.clone().requires_grad_(True) for n, v in params.items()}
        grads = torch.autograd.grad(fn(leaves, [case]), list(leaves.values()))
        with torch.no_grad():
            for (name, value), grad in zip(params.items(), grads, strict=True):
                unit = scales[name]
                slopes[name].append(grad * unit)
                found = []
                for direction in torch.eye(value.numel(), dtype=value.dtype):
                    h = step[name] * unit * direction
                    found.append(
                        (fn({**params, name: value + h}, [case]) - fn({**params, name: value - h}, [case]))
                        / (2 * step[name])
                    )
                differences[name].append(torch.stack(found))
    rows = [
        _averaged(name, torch.stack(slopes[name]), torch.stack(differences[name]), step[name])
        for name in params
    ]
    both = _averaged(
        "all",
        torch.cat([torch.stack(slopes[n]) for n in params], 1),
        torch.cat([torch.stack(differences[n]) for n in params], 1),
        1.0,
    )
    return [*rows, both]


def _averaged(name, slopes, differences, step):
    """Row of mean gradients; each sample's gradient is clipped to five times the median length, as an
    optimiser would."""
    length = slopes.norm(dim=1, keepdim=True)
    a = (slopes * (5 * length.median() / length).clamp(max=1)).mean(0)
    d = differences.mean(0)
    size = float(differences.mean(0).norm())
    floor = float((differences.std(0) / differences.shape[0] ** 0.5).norm()) / size
    error = float((a - d).norm()) / size
    cosine = float(a @ d) / (float(a.norm()) * size)
    return Row(
        name,
        tuple(a.tolist()),
        tuple(d.tolist()),
        error,
        cosine,
        float(a @ d) / size**2 - 1,
        floor,
        (step,) * d.numel(),
        "pass" if cosine >= 0.9 else "fail",
    )
