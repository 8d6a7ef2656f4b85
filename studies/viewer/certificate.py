"""Is the gradient right at this setting? The chain from pose, focus and threshold to the length of
flow, by autograd and by differences."""

from dataclasses import replace

import torch
from torch import Tensor

from codesign import events, pose, render
from codesign.grad import Row, certify
from scenes.robots import pair as robot_pair
from studies.viewer.state import Setting

AROUND_PX = 24  # of the window in the film's middle
SCALES = {"pose": 1e-3, "focus": 0.1, "threshold": 0.05}
LADDER = (1e-1, 3e-2, 1e-2)
DIRECTIONS = 2


def certificate(setting: Setting) -> list[Row]:
    """Rows for the pose of the camera (m and rad in its own axes), the threshold and, of a lens
    that can be moved, the focus (1/m), over the middle of the film.

    The loss is the mean square of the flow of smooth counts, which have no noise: hard counts have
    no derivative to compare with. Where texels are finer than pixels its slope changes within the
    steps, which the noise floor does not see (docs/viewer.md).
    """
    drive, whole = setting.drive, setting.whole
    one = min(AROUND_PX, drive.film.sensor_width_px)
    edge = (drive.film.sensor_width_px - one) // 2
    film = replace(drive.film, width_px=one, height_px=one, windows_px=((edge, edge),))
    T_world_cam = drive.batch.T_world_body[0] @ whole.T_body_cam
    gain = whole.space.costs.gain(whole.numbers["fno"])

    held = drive.camera(whole).with_film(film)
    bins = min(robot_pair.BINS, len(drive.batch.t_s) - 1)

    def loss(p: dict[str, Tensor]) -> Tensor:
        camera = held
        if "focus" in p:
            design = replace(whole.design, focus_per_m=p["focus"])
            camera = held.with_lens(drive.space.pair.camera(design).lens)
        poses = T_world_cam @ pose.se3_exp(p["pose"])
        frames = render.frames(camera, drive.batch.scene[0], poses)
        counts = events.soft_counts(gain * frames[0].double(), p["threshold"], p["threshold"])
        volume = events.from_counts(counts, drive.batch.t_s, bins)
        return whole.flow(volume).flow_px.square().mean()

    point = {
        "pose": torch.zeros(6, dtype=torch.float64),
        "threshold": torch.tensor(whole.numbers["theta"], dtype=torch.float64),
    }
    if "focus_per_m" in drive.space.free:
        point["focus"] = torch.tensor(whole.numbers["focus_per_m"], dtype=torch.float64)
    scales = {name: SCALES[name] for name in point}
    return certify(loss, point, scales=scales, ladder=LADDER, directions=DIRECTIONS)
