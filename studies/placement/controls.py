"""What must come out when there is nothing to be found."""

from dataclasses import replace

import torch
from torch import Tensor

from codesign import events
from codesign.mount import FREE, EgoVelocity, UnknownDepth
from codesign.types import EventVolume
from scenes.robots.pair import BINS, LEAD_S, SENSOR
from studies.placement.problem import Problem, Samples

MISMATCHED = replace(SENSOR, theta_on=1.3 * SENSOR.theta_on, theta_off=0.8 * SENSOR.theta_off)
NEAR_M = 0.01  # before a face of the robot
DOWN = 0.5  # cosine with straight down from which on a face is one of the underside


@torch.no_grad()
def controls(problem: Problem, mount: Tensor, samples: Samples) -> dict[str, float]:
    """Mean bounded errors with single events: of a mount [4, 4] as it is, and with something taken
    away from it."""
    batch = problem.batch(samples)
    system = problem.system(mount, "sensor")
    run = system.begin(batch)
    errors = problem.pair.errors

    def judged(recorded, chain=system):
        return float(errors(chain.begin(batch, recorded)["estimate"], batch).bounded().mean())

    frames = run["frames"]
    still = torch.full_like(frames, float(frames.mean()))
    told = run["estimate"]
    zero = replace(told, velocity=torch.zeros_like(told.velocity))
    other = events.HardSensor(MISMATCHED, BINS, LEAD_S)
    mapless = EgoVelocity(FREE, problem.pair.prior, UnknownDepth())
    backward = problem.system(looking_back(problem), "sensor")
    return {
        "as_found": float(errors(told, batch).bounded().mean()),
        "no_texture": judged({"frames": still}),
        "shuffled_events": judged({"events": shuffled(run["volume"])}),
        "depth_unknown": judged({"flow": run["field"]}, system.replaced(estimate=mapless)),
        "only_the_robot": judged({}, backward),
        "thresholds_mismatched": judged({"frames": frames}, system.replaced(events=other)),
        "always_zero": float(errors(zero, batch).bounded().mean()),
    }


def shuffled(volume: EventVolume) -> EventVolume:
    """Every window's events at other pixels of it: as many, in the same bins, with no picture that
    moves."""
    height, width = volume.counts.shape[-2:]
    order = torch.randperm(height * width, generator=torch.Generator().manual_seed(0))
    counts = volume.counts.flatten(-2)[..., order].unflatten(-1, (height, width))
    return replace(volume, counts=counts)


def looking_back(problem: Problem) -> Tensor:
    """T_body_cam [4, 4] of a camera before the middle of the robot's largest face that is not its
    underside, so near that it sees nothing else."""
    meshes = problem.pair.bodies.values()
    faces = torch.cat([torch.as_tensor(mesh.vertices_m[mesh.faces]) for mesh in meshes]).double()
    across = torch.linalg.cross(faces[:, 1] - faces[:, 0], faces[:, 2] - faces[:, 0])
    # beneath them there may be no room over the ground
    downward = across[:, 2] < -DOWN * across.norm(dim=1)
    largest = int(across.norm(dim=1).masked_fill(downward, 0).argmax())
    face = faces[largest]
    view, right = (way / way.norm() for way in (-across[largest], face[1] - face[0]))
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = torch.stack([right, torch.linalg.cross(view, right), view], 1)
    pose[:3, 3] = face.mean(0) - NEAR_M * view
    return pose
