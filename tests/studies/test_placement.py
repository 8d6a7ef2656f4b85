"""Pieces of the placement study: poses, depth, gradients against differences, and a search that gets
somewhere."""

import json
import math

import pytest
import torch

from codesign.grad import certify
from codesign.place import Mount
from codesign.pose import check_poses
from codesign.render.truth import world_points
from studies.frame.run import main
from studies.placement import __main__ as placement
from studies.placement.search import descend, draw_mount, grid_mounts
from studies.placement.task import HALF_RANGE_M, NOMINAL_M, footprint, make_task, nearness, planar


@pytest.fixture(scope="module")
def task():
    return make_task(("gravel", "speckle-1"), 2, seed=0)


def mount_at(pitch, yaw=0.4, roll=0.3):
    return Mount(NOMINAL_M, HALF_RANGE_M, pitch_rad=math.radians(pitch), yaw_rad=yaw, roll_rad=roll)


def test_depth_is_the_renderers(task):
    """Closed-form depth against the hit of rays with the scene, at poses in mid-motion."""
    with torch.no_grad():
        mounts = mount_at(40)().expand(task.samples, 4, 4)
        _, depth, valid = world_points(
            task.camera.chief_rays(task.camera.film.pixels()), task.worlds[0], task.poses(mounts)[1, 5]
        )
        mine = task.depth_m(mounts)[1]
    assert bool(
        (nearness(mine)[~valid] < 1e-3).all()
    )  # the scene ends 10 m away: what lies beyond hardly counts
    torch.testing.assert_close(
        mine[valid], depth[valid], rtol=1e-4, atol=0
    )  # the scene's hit is float32 at up to 12 m


def test_every_mount_looks_at_the_samples_patch(task):
    """At mid-interval the camera's axis meets the ground at the sample's patch, whatever the mount (but for
    the pull towards near ground: 1 % at 45 degrees)."""
    with torch.no_grad():
        for pitch, yaw in ((90, 0.0), (60, 2.0), (50, -1.0)):
            middle = task.poses(mount_at(pitch, yaw)().expand(task.samples, 4, 4))[:, 4]
            check_poses(middle)
            axis_length = -middle[:, 2, 3] / middle[:, 2, 2]
            met = middle[:, :2, 3] + axis_length[:, None] * middle[:, :2, 2]
            away = (met - task.patch.reshape(-1, 3)[:, :2]).norm(dim=1)
            assert (
                float(away.max())
                <= 0.0101 * 0.4 / math.tan(math.radians(pitch)) / math.sin(math.radians(pitch)) ** 2 + 1e-9
            )


def test_footprint_heading_is_the_turn_about_the_vertical(generator):
    straight_down = mount_at(90, 0.0, 0.0)().detach()[None]
    for heading in (6.28 * torch.rand(5, generator=generator, dtype=torch.float64) - 3.14).tolist():
        turned = (
            planar(torch.zeros(1, 2, dtype=torch.float64), torch.tensor([heading], dtype=torch.float64))
            @ straight_down
        )
        change = float((footprint(turned)[1] - footprint(straight_down)[1])[0]) - heading
        assert abs(math.remainder(change, 2 * math.pi)) < 1e-12


SCALES = torch.tensor([1.0, 1.0, 1.0, 0.1, 0.1, 0.1], dtype=torch.float64)  # of the six numbers of a mount


def test_gradient_of_the_expected_error_against_differences(task):
    mount = mount_at(62)

    def loss(design):
        return task.expected(mount(design["mount"])).square().mean().sqrt()

    (row,) = certify(
        loss, {"mount": mount.numbers.detach()}, scales={"mount": SCALES}, ladder=(3e-3, 1e-3), tolerance=0.05
    )
    assert row.cosine >= 0.99


def test_gradient_with_smooth_events_is_that_of_the_whole_chain(task):
    """From the six numbers of the mount to the task's error, with soft counts.

    The error has kinks (texels, rounding of float32 frames) closer than any step of a difference, so a step
    is compared with the mean of the gradients along it, which it equals for any loss without jumps; twelve
    points per step leave 1 % of the length.
    """
    mount = mount_at(62)
    start = mount.numbers.detach()
    points = 12
    step = 0.02

    def loss(numbers):
        return task.errors(mount(numbers), "counts").task

    differences = []
    means = []
    for shift in step * torch.diag(SCALES):
        with torch.no_grad():
            differences.append(loss(start + shift) - loss(start - shift))
        along = [(start + shift * ((k + 0.5) / points * 2 - 1)).requires_grad_(True) for k in range(points)]
        means.append(2 * sum((torch.autograd.grad(loss(x), x)[0] * shift).sum() for x in along) / points)
    found = torch.stack(means)
    truth = torch.stack(differences)
    assert float(torch.nn.functional.cosine_similarity(found, truth, dim=0)) >= 0.99
    assert float(found.norm() / truth.norm()) == pytest.approx(1.0, abs=0.05)


def test_steps_from_a_poor_start_lower_the_error(task):
    start = mount_at(20)
    path = descend(task, start, 4)
    assert float(path.error.min()) < 0.8 * float(path.error[0])
    with torch.no_grad():
        assert float(task.errors(path.T_body_cam[path.best]).task) == pytest.approx(
            float(path.error.min()), rel=1e-6
        )  # the same noise every time
    assert path.renders.tolist() == [2, 4, 6, 8, 10]


def test_nothing_to_see_gives_zero_velocity(task):
    sky = mount_at(-60)().detach()
    assert (
        float(task.begin(sky)["estimate"].abs().max()) < 0.02
    )  # events of noise alone, against a prior of 1


def test_drawn_and_grid_mounts_are_where_they_should_be(generator):
    drawn = torch.stack([draw_mount(generator)().detach() for _ in range(50)])
    assert float(((drawn[:, :3, 3] - torch.tensor(NOMINAL_M)).abs() - torch.tensor(HALF_RANGE_M)).max()) < 0
    assert bool((drawn[:, 2, 2] < 0).all())  # all look below the horizon
    grid = grid_mounts(3, 4)
    assert grid.shape == (12, 4, 4)
    torch.testing.assert_close(
        -grid[:, 2, 2].reshape(3, 4),
        torch.tensor([15.0, 45, 75]).deg2rad().sin().double()[:, None].expand(3, 4),
        rtol=0,
        atol=1e-7,
    )


def test_the_study_runs_to_its_page(tmp_path):
    sizes = ["--starts", "1", "--steps", "1", "--motions", "1", "--pitches", "1", "--yaws", "2"]
    assert main(placement.study, placement.Config, [*sizes, "--out", str(tmp_path / "run")]) == 0
    found = json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert found["grid_mounts"] == 2
    assert found["control_no_texture_error"] > 1  # nothing to see: no better than answering zero
    assert (tmp_path / "run" / "report.html").exists()
