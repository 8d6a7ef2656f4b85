"""Gradients along the chain, junction by junction, and of one graph with lens, mount, thresholds
and
network: functions of named parameters, with their required figures. The tests certify them too."""

import math
from dataclasses import replace

import torch

from codesign import events, flow, lens, pose, render
from codesign.grad import Row as CertificateRow
from codesign.grad import certify
from codesign.grad.modules import by_group
from codesign.mount import Mount
from codesign.system import Batch, System
from scenes import textures, trajectories, worlds
from studies.gradient_flow.topic import Asked, Topic, of_certificate
from studies.lens_opt.task import PITCH_MM, SENSOR, TRAINING, draw_case, make_task, make_worlds

FINE = tuple(10.0**-k for k in (3, 4, 5, 6))
CURVES = [0, 2, 3]  # the three curvatures of the final loss: front crown, both sides of the flint
# m, rad: each moves the image by a few pixels
POSE_UNIT = torch.tensor([0.01, 0.01, 0.02, 0.005, 0.005, 0.01], dtype=torch.float64)


def normal(*shape, seed):
    """Standard normal numbers, float64."""
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def rays_rows():
    """Sum of weighted landing points and optical paths of 200 rays, with respect to all lens
    tensors."""
    geo = lens.load("cooke-triplet").freeze()
    disc = normal(200, 2, seed=0).clamp(-1.5, 1.5) * 2.5
    origin = torch.cat([disc, torch.full((200, 1), -5.0, dtype=torch.float64)], 1)
    towards = torch.tensor([0.02, 0.15, 1.0], dtype=torch.float64)
    direction = torch.nn.functional.normalize(towards, dim=0).expand(200, 3)
    mix = normal(200, 3, seed=1)

    def fn(p):
        out = geo.replace(**p).trace(origin, direction)
        landing = (out.position_mm * mix).sum() + (out.direction * mix).sum()
        return (landing + 0.1 * out.optical_path_mm.sum()) / 200

    scales = {"curvature_per_mm": 0.02, "thickness_mm": 1.0, "conic": 1.0, "index_offset": 0.1}
    params = {name: getattr(geo, name) for name in scales}
    return certify(fn, params, scales=scales, ladder=FINE, tolerance=1e-6)


def _camera_rows(loss, size_px, samples, seed, curvature, **options):
    """Rows of loss(camera, twist) with respect to curvatures, thicknesses and pose. curvature: its
    step unit."""
    geo = lens.load("cooke-triplet").scaled(0.22).freeze()
    params = {
        "curvature": geo.curvature_per_mm,
        "thickness": geo.thickness_mm,
        "pose": torch.zeros(6, dtype=torch.float64),
    }

    def fn(p):
        optics = geo.replace(curvature_per_mm=p["curvature"], thickness_mm=p["thickness"])
        camera = render.Camera(optics, size_px, size_px, PITCH_MM * 192 / size_px, samples, seed)
        return loss(camera, pose.se3_exp(p["pose"]))

    scales = {"curvature": curvature, "thickness": 0.1, "pose": POSE_UNIT}
    return certify(fn, params, scales=scales, **options)


def _frame_rows(scene, start, seed, samples, **options):
    """Of a small sequence of frames."""
    motion = trajectories.translation(start, (0.4, 0.1, 0.2), trajectories.times(3, 100.0))
    # a smooth weight: the loss of a stage downstream never sees single pixels
    weight = torch.nn.functional.avg_pool2d(normal(3, 48, 48, seed=seed), 5, 1, 2)

    def loss(camera, twist):
        image = render.frames(camera, scene, motion @ twist).double()
        return (weight * image).mean() + 0.01 * (image / 100).square().mean()

    return _camera_rows(loss, 48, samples, seed, 0.002, **options)


def plane_rows(seed):
    """Frames of the analytic plane, everything in float64."""
    plane = worlds.smooth_plane(seed, pose.look_at((0, 0, 0), (0, -1, 0)))
    start = pose.look_at((0.1, -2, 0.05), (0, 0, 0))
    return _frame_rows(
        plane, start, seed, 8, ladder=(0.1, 0.03, 0.01, 0.003, 0.001), tolerance=1e-5
    )


def room_rows(seed):
    """Frames of the photo-textured room without objects, so that no silhouette moves; scene in
    float32."""
    start = pose.look_at((0.3, -0.8, 1.2), (0.1, 2.0, 1.0))
    scene = worlds.room(objects=False)
    return _frame_rows(scene, start, seed, 16, ladder=(0.03, 0.02, 0.014, 0.01), tolerance=0.01)


def truth_rows():
    """Ground-truth flow through the lens, with respect to lens and the first pose."""
    wall = worlds.smooth_plane(0, pose.look_at((0, 0, 0), (0, -1, 0)))
    first = pose.look_at((0, -2, 0), (0.1, 0, 0))
    later = pose.look_at((0.03, -1.95, 0.02), (0.12, 0, 0))
    weight = normal(1, 2, 24, 24, seed=1)

    def loss(camera, twist):
        found, _ = render.true_flow(camera, wall, torch.stack([first @ twist, later]))
        return (weight * found).mean()

    return _camera_rows(loss, 24, 1, 0, 0.01, ladder=(1e-1, 1e-2, 1e-3, 1e-4), tolerance=1e-5)


def _moving_frames(seed, contrast=0.6):
    """A small band-limited sequence in float64, as a function of contrast and shift per frame:
    fn(p) -> frames [8, 24, 24]; and the point where it is asked."""
    frequency, amplitude, phase = (
        part[..., None, None, None] for part in textures.waves(seed, 12, 6.0, 24.0, contrast)
    )
    pixel = torch.arange(24, dtype=torch.float64)
    steps = torch.arange(8, dtype=torch.float64)[:, None, None]

    def frames(p):
        at_x = pixel - p["shift"][0] * steps
        at_y = pixel[:, None] - p["shift"][1] * steps
        waves = (2 * math.pi * (frequency[:, 0] * at_x + frequency[:, 1] * at_y) + phase).cos()
        return 80 * (p["contrast"] * (amplitude * waves).sum(0)).exp()

    point = {"contrast": torch.ones(1), "shift": torch.tensor([0.4, -0.2])}
    return frames, {name: value.double() for name, value in point.items()}


def count_rows(seed):
    """Smooth event counts with respect to contrast, motion and threshold. Small steps: counts have
    a kink where the level stands still."""
    frames, params = _moving_frames(seed)
    weight = torch.rand(
        7, 2, 24, 24, generator=torch.Generator().manual_seed(2), dtype=torch.float64
    )
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
    """Mean log angular flow error over cases, as a function of three curvatures and the camera
    pose."""
    base = task.design.reference

    def fn(p, cases=case_list):
        change = torch.zeros_like(base.curvature_per_mm).index_put(
            (torch.tensor(CURVES),), p["curvature"].to(base.curvature_per_mm)
        )
        optics = base.replace(curvature_per_mm=base.curvature_per_mm + change)
        system = task.system(
            task.camera(optics, samples), events.layer(layer, sensor, learn=()), flow.estimate_lk
        )
        moved = [
            replace(case, T_world_body=case.T_world_body @ pose.se3_exp(p["pose"]))
            for case in cases
        ]
        return torch.stack([system(case).loss for case in moved]).mean()

    # moves the rays by about a pixel
    unit = task.design.basis[:5, -1].abs().max() * torch.ones(3, dtype=torch.float64)
    params = {
        "curvature": torch.zeros(3, dtype=torch.float64),
        "pose": torch.zeros(6, dtype=torch.float64),
    }
    return fn, params, {"curvature": unit, "pose": POSE_UNIT}


def loss_rows(seed):
    """The final loss with the smooth counts layer, whole chain, scene in float32.

    Without noise the smooth layer lets the closed-form flow come within hundredths of a pixel, and
    the gradient is that of rounding; shot noise of 40 Hz gives an error that the optics can change.
    Band-limited textures, since texel borders are kinks.
    """
    task = make_task("cooke-triplet", seed, 1.0)
    walls = [
        worlds.wall(
            textures.speckle(k, size_px=1024, finest_px=32.0, coarsest_px=128.0), texel_m=0.002
        )
        for k in (5, 6)
    ]
    cases = [draw_case(walls, 61 + i) for i in range(4)]
    noisy = events.SensorModel(theta_on=0.2, theta_off=0.2, theta_sigma=0.03, shot_rate_hz=40.0)
    fn, params, scales = _final(task, cases, "counts", 16, noisy)
    return certify(fn, params, scales=scales, ladder=(0.014, 0.01, 0.007, 0.005), tolerance=0.05)


def plane_loss_rows():
    """Endpoint error of the closed form on smooth counts of the analytic plane, whole chain in
    float64."""
    plane = worlds.smooth_plane(3, pose.look_at((0, 0, 0), (0, -1, 0)))
    t_s = torch.linspace(0, 0.05, 8, dtype=torch.float64)
    path = trajectories.translation(pose.look_at((0.1, -2, 0.05), (0, 0, 0)), (0.4, 0.1, 0.2), t_s)

    def loss(camera, twist):
        moved = path @ twist
        counts = events.soft_counts(render.frames(camera, plane, moved), 0.2, 0.2)
        field = flow.estimate_lk(events.from_counts(counts, t_s, bins=5))
        return flow.metrics.aee(field.flow_px, *render.true_flow(camera, plane, moved[[0, -1]]))

    ladder = (3e-3, 1e-3, 3e-4, 1e-4, 3e-5, 1e-5)
    return _camera_rows(loss, 24, 8, 0, 0.002, ladder=ladder, tolerance=1e-6)


def hard_rows(seed, count, moved=("curvature", "pose")):
    """Straight-through gradient against central differences of the hard loss.

    Steps of half a pixel of ray motion and 1 to 2 pixels of image motion move several counts per
    pixel row. Single cases are noisy on both sides, so both are averaged over motions and textures
    before they are compared; the noise floor is the standard error of the mean difference. On walls
    that look alike everywhere the mean loss hardly depends on the pose: there the floor is above 1,
    and the differences themselves say nothing.
    """
    task = make_task("cooke-triplet", seed)
    pool = make_worlds(TRAINING)
    task_cases = [draw_case(pool, 50_000 + i) for i in range(count)]
    fn, start, scales = _final(task, task_cases, "memory", 16)
    params = {name: start[name] for name in moved}
    step = {"curvature": 0.5, "pose": 1.0}
    slopes, differences = ({name: [] for name in params} for _ in range(2))
    for case in task_cases:
        leaves = {name: value.clone().requires_grad_(True) for name, value in params.items()}
        grads = torch.autograd.grad(fn({**start, **leaves}, [case]), list(leaves.values()))
        for (name, value), grad in zip(params.items(), grads, strict=True):
            slopes[name].append(grad * scales[name])
            with torch.no_grad():
                ends = [
                    [fn({**start, name: value + sign * h}, [case]) for sign in (1, -1)]
                    for h in step[name] * scales[name] * torch.eye(value.numel(), dtype=value.dtype)
                ]
            change = torch.stack([ahead - behind for ahead, behind in ends])
            differences[name].append(change / (2 * step[name]))
    columns = [
        {name: torch.stack(values) for name, values in side.items()}
        for side in (slopes, differences)
    ]
    both = [torch.cat(list(side.values()), 1) for side in columns]
    rows = [_averaged(name, *(side[name] for side in columns), step[name]) for name in params]
    return [*rows, _averaged("all", *both, 1.0)]


def _averaged(name, slopes, differences, step):
    """Row of mean gradients; each sample's gradient is clipped to five times the median length, as
    an optimiser would."""
    length = slopes.norm(dim=1, keepdim=True)
    a = (slopes * (5 * length.median() / length).clamp(max=1)).mean(0)
    d = differences.mean(0)
    size = float(d.norm())
    floor = float((differences.std(0) / differences.shape[0] ** 0.5).norm()) / size
    error = float((a - d).norm()) / size
    cosine = float(a @ d) / (float(a.norm()) * size)
    return CertificateRow(
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


# ---- lens, mount, thresholds and network in one graph

GROUPS = {"lens": "lens.", "mount": "mount.", "thresholds": "events.", "network": "flow."}
SIDE_PX = 48
BLOCK_MM = 0.074  # blocks of 4 x 4 pixels of a DAVIS346
BINS = 4
DURATION_S = 0.05
DEPTH_M = 1.5  # of the room, about
# pixels of motion: an untrained network answers to a tenth of a pixel with another flow, so steps
# are small; the rounding of float32 frames allows it
LADDER = (0.005, 0.0035, 0.0025, 0.0018)


def make_system(weights: int, seed: int) -> System:
    """A system with learnable lens (curvatures, focus), mount, thresholds and network, in natural
    steps."""
    geo = lens.load("cooke-triplet").scaled(0.22)
    geo.variables("curvature", "focus", step_mm=BLOCK_MM, keep_efl=True)
    camera = render.Camera(geo, SIDE_PX, SIDE_PX, BLOCK_MM, samples_per_pixel=16, seed=seed)
    mount = Mount((0.1, 0.0, 0.3), (0.1, 0.1, 0.1), pitch_rad=0.1, yaw_rad=0.2)
    mount.variables(camera, DEPTH_M)
    sensor = events.layer("counts", events.SensorModel(theta_on=0.2, theta_off=0.25))
    return System(
        camera=camera,
        mount=mount,
        events=sensor,
        flow=flow.FlowNetEvents.with_weights(weights, bins=BINS, seed=seed),
        objectives={"endpoint error": endpoint_error},
        scene=worlds.room(objects=False),
    )


def endpoint_error(field, truth):
    """Mean distance of estimated from true flow, px; rounded at zero, so that it is smooth."""
    miss = (field.flow_px - truth.flow_px).square().sum(1)
    return (miss[truth.valid] + 1e-4).sqrt().mean()


def draw_batch(drives: int, seed: int, frames: int = 9) -> Batch:
    """Drives that start near the middle of the room, forward with some slip and turn."""
    generator = torch.Generator().manual_seed(seed)
    t_s = torch.linspace(0, DURATION_S, frames, dtype=torch.float64)
    poses = []
    for _ in range(drives):
        at = 0.5 * (2 * torch.rand(2, generator=generator, dtype=torch.float64) - 1)
        heading = 6.28 * float(torch.rand(1, generator=generator, dtype=torch.float64))
        start = torch.eye(4, dtype=torch.float64)
        turn = torch.tensor(heading, dtype=torch.float64)
        start[:2, :2] = torch.stack([turn.cos(), -turn.sin(), turn.sin(), turn.cos()]).reshape(2, 2)
        start[:3, 3] = torch.tensor([*at.tolist(), 0.8], dtype=torch.float64)
        forward, slip, yaw = torch.randn(3, generator=generator, dtype=torch.float64).tolist()
        twist = torch.tensor(
            [0.8 + 0.2 * forward, 0.2 * slip, 0.0, 0.0, 0.0, 0.4 * yaw], dtype=torch.float64
        )
        poses.append(trajectories.body_twist(start, twist, t_s))
    return Batch(torch.stack(poses), t_s, seed=seed)


def joint_rows(system: System, batch: Batch, directions: int) -> list[CertificateRow]:
    """Autograd against differences, a row per group; the network along random directions."""
    with torch.no_grad():
        frames = system.begin(batch)["frames"]

    def behind_frames(call):
        # gradients pass through the whole graph; differences of what lies behind the frames need
        # one rendering
        recorded = {} if torch.is_grad_enabled() else {"frames": frames}
        return call(batch, recorded=recorded).loss

    whole, params = by_group(system, lambda call: call(batch).loss, GROUPS)
    behind, _ = by_group(system, behind_frames, GROUPS)
    loss = {"lens": whole, "mount": whole, "thresholds": behind, "network": behind}
    scales = {
        "lens": 1.0,
        "mount": 1.0,
        "thresholds": 1.0,
        "network": float(params["network"].norm()) / 4,
    }
    return [
        row
        for name in params
        for row in certify(
            lambda p, name=name: loss[name]({**params, **p}),
            {name: params[name]},
            scales={name: scales[name]},
            ladder=LADDER if name in ("lens", "mount") else (0.1, 0.03, 0.01),
            tolerance=0.05,
            directions=directions if name == "network" else None,
            generator=torch.Generator().manual_seed(0),
        )
    ]


# ---- the cases of the study

# label: what is asked, and what makes the rows
JUNCTIONS = {
    "lens rays, float64": (Asked({}, {"relative_error": 1e-6}), lambda seed: rays_rows()),
    "frames, plane, float64": (Asked({}, {"relative_error": 1e-5}), lambda seed: plane_rows(seed)),
    "frames, room, float32": (Asked({}, {"relative_error": 0.01}), lambda seed: room_rows(seed)),
    "true flow, float64": (Asked({}, {"relative_error": 1e-5}), lambda seed: truth_rows()),
    "event counts, smooth": (Asked({}, {"relative_error": 1e-5}), lambda seed: count_rows(seed)),
    "flow estimate, float64": (Asked({}, {"relative_error": 1e-5}), lambda seed: flow_rows(seed)),
    "final loss, plane, float64": (
        Asked({}, {"relative_error": 1e-6}),
        lambda seed: plane_loss_rows(),
    ),
    "final loss, smooth events": (
        Asked({"cosine": 0.99}, {"relative_error": 0.05}),
        lambda seed: loss_rows(seed),
    ),
}
HARD = "final loss, hard events"


def measure_junction(config, label):
    rows = (
        hard_rows(config.seed, config.hard_cases)
        if label == HARD
        else JUNCTIONS[label][1](config.seed)
    )
    return [of_certificate((label, row.name), row) for row in rows]


def measure_joint(config):
    system = make_system(10_000, config.seed)
    batch = draw_batch(4, 1000 + config.seed)
    return [
        of_certificate(("one graph", row.name), row)
        for row in joint_rows(system, batch, 4 if config.quick else 12)
    ]


TEXT = (
    "Relative error is |autograd - difference| / |difference| over the group; signal to noise is one over "
    "the noise of the differences, in the same unit."
)
CHAIN = Topic(
    "Along the chain",
    TEXT
    + " Lens rays in float64, frames (textured room, no silhouettes) with respect to lens and pose, "
    "event counts, flow, and the final loss with respect to three curvatures and all six pose components, "
    "once with the smooth event layer and once with the straight-through layer against differences of the "
    "hard loss.",
    ("junction", "parameters"),
    lambda quick: [(label,) for label in (*JUNCTIONS, HARD)],
    measure_junction,
    lambda row: Asked({"cosine": 0.9}, {}) if row.names[0] == HARD else JUNCTIONS[row.names[0]][0],
)
JOINT = Topic(
    "Lens, mount, thresholds and network in one graph",
    TEXT
    + " Smooth event layer, textured room, a network of ten thousand weights along random directions.",
    ("graph", "group"),
    lambda quick: [()],
    measure_joint,
    lambda row: Asked({"cosine": 0.99}, {"relative_error": 0.05}),
)
