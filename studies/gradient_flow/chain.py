"""Gradients of what the five scenes do not show: lens rays by themselves, the straight-through layer
beside the hard loss, and one graph with lens, mount, thresholds and network."""

from dataclasses import replace

import torch

from codesign import events, flow, lens, pose, render
from codesign.grad import Row as CertificateRow
from codesign.grad import certify
from codesign.grad.modules import by_group
from codesign.mount import Mount
from codesign.system import Batch, System
from scenes import trajectories, worlds
from studies.gradient_flow.topic import Asked, Topic, of_certificate
from studies.lens_opt.task import SENSOR, TRAINING, draw_case, make_task, make_worlds

FINE = tuple(10.0**-k for k in (3, 4, 5, 6))
CURVES = [0, 2, 3]  # the three curvatures of the final loss: front crown, both sides of the flint
# m, rad: each moves the image by a few pixels
POSE_UNIT = torch.tensor([0.01, 0.01, 0.02, 0.005, 0.005, 0.01], dtype=torch.float64)


def normal(*shape, seed):
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


def _final(task, case_list, layer, samples):
    """Mean log angular flow error over cases, as a function of three curvatures and the camera
    pose."""
    base = task.design.reference

    def fn(p, cases=case_list):
        change = torch.zeros_like(base.curvature_per_mm).index_put(
            (torch.tensor(CURVES),), p["curvature"].to(base.curvature_per_mm)
        )
        optics = base.replace(curvature_per_mm=base.curvature_per_mm + change)
        system = task.system(
            task.camera(optics, samples), events.layer(layer, SENSOR, learn=()), flow.estimate_lk
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
    both = [torch.cat(tuple(side.values()), 1) for side in columns]
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


def draw_batch(drives: int, seed: int) -> Batch:
    """Drives that start near the middle of the room, forward with some slip and turn."""
    generator = torch.Generator().manual_seed(seed)
    t_s = torch.linspace(0, DURATION_S, 9, dtype=torch.float64)
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
    scales = dict.fromkeys(GROUPS, 1.0) | {"network": float(params["network"].norm()) / 4}
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

HARD = "final loss, hard events"
RAYS = "lens rays, float64"
ASKED = {RAYS: Asked({}, {"relative_error": 1e-6}), HARD: Asked({"cosine": 0.9}, {})}


def measure_junction(config, label):
    rows = rays_rows() if label == RAYS else hard_rows(config.seed, config.hard_cases)
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
    TEXT + " Lens rays in float64, and the final loss with respect to three curvatures and "
    "all six pose components with the straight-through layer, against differences of the hard loss.",
    ("junction", "parameters"),
    lambda quick: [(label,) for label in ASKED],
    measure_junction,
    lambda row: ASKED[row.names[0]],
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
