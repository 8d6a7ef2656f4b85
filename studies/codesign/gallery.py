"""Whole designs side by side, from the lens to the flow, and the hand-over of one."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from codesign import lens
from codesign.system import HandOver, load_hand_over, save_hand_over
from scenes.robots import pair as robot_pair
from studies.codesign.design import Whole
from studies.codesign.race import JUDGED, Judge
from studies.frame.run import Run

COLUMNS = ("lens", "robot and view", "frame", "events", "flow")
FIELDS_RAD = (0.0, 0.2, 0.4)  # of the rays that are drawn


def side_by_side(judge: Judge, designs: Mapping[str, Whole]):
    """A row for each design: lens, robot with the camera's view, frame, single events and flow of
    one unseen drive."""
    import matplotlib.pyplot as plt

    from codesign.report.lens_figures import draw_layout
    from studies.placement.figures import draw_pair, draw_seen, fastest

    drawn = judge.drawn
    samples = fastest(drawn.base, JUDGED)
    figure = plt.figure(figsize=(13, 3.2 * len(designs)), layout="constrained")
    parts = figure.subfigures(len(designs), squeeze=False)[:, 0]
    for row, (part, (title, whole)) in enumerate(zip(parts, designs.items(), strict=True)):
        part.suptitle(title, x=0.01, ha="left", fontsize=13)
        axes = [
            part.add_subplot(
                1, len(COLUMNS), number, projection="3d" if name == "robot and view" else None
            )
            for number, name in enumerate(COLUMNS, 1)
        ]
        looked = drawn.looked(whole, samples, "sensor")
        if isinstance(whole.camera.lens, lens.GeoLens):
            draw_layout(axes[0], whole.camera.lens, FIELDS_RAD, rays=3)
            axes[0].get_legend().remove()  # it would lie over the robot
        axes[0].set_axis_off()
        draw_pair(axes[1], whole.space.pair, whole.camera, whole.T_body_cam)
        draw_seen(
            axes[2:], looked.batch, whole.camera, whole.T_body_cam, looked.run, titled=row == 0
        )
    return figure


def handed(run: Run[Any], judge: Judge, whole: Whole, error: float, said: str) -> None:
    """Write a design as design.yaml with its lens beside it, read it back, and see that it has the
    same score. said: whose it is."""
    path = run.path("design.yaml")
    size = run.config
    told = ("light", "speed", "judged_worlds", "judged_drives")
    asked = {name: getattr(size, name) for name in told} | {"pair": str(size.robot or size.pair)}
    save(path, whole, {**asked, "error_unseen": error})
    back = loaded(path, whole)
    again = judge.of(back)["errors"]
    run.record(hand_over_score=error, hand_over_score_again=sum(again) / len(again))
    run.section(
        "Hand-over",
        f"Of the answers that expected least on their own way, and the default where it raced, {said} is the one of which "
        f"least is expected in drives of the training worlds. `design.yaml` has its transform, camera and sensor, and the estimator's prior among its notes; the lens stands beside "
        f"it, a traced one as `design.zmx` too (`codesign.lens.load` reads both). Read back it scores "
        f"{sum(again) / len(again):.4f} where the answer had {error:.4f}.",
    )


def save(path: Path, whole: Whole, told: Mapping[str, Any]) -> None:
    """A design for those who build it, with what is told of it (its error in unseen worlds, and
    their light and speed) and its numbers as notes."""
    pair = whole.space.pair
    mount = robot_pair.mount_at(pair.ranges, whole.T_body_cam)
    notes = {**told, **whole.numbers}
    save_hand_over(
        path, HandOver(mount, whole.camera, whole.sensor, pair.frame, "camera_optical_frame", notes)
    )
    if isinstance(whole.camera.lens, lens.GeoLens):
        lens.save(whole.camera.lens, path.with_suffix(".zmx"))


def loaded(path: Path, like: Whole) -> Whole:
    """A design of the same space as the file has it: its lens, camera, mount and sensor, none of
    them made anew."""
    back = load_hand_over(path)
    numbers = {name: float(back.notes[name]) for name in like.numbers}
    found = Whole(like.space, numbers)
    with torch.no_grad():
        vars(found).update(camera=back.camera, T_body_cam=back.mount().detach(), sensor=back.sensor)
    return found
