"""Looks at a pair before its first frame: what would spoil a study of it gets a sentence."""

from collections.abc import Sequence

import torch

from codesign import events, render
from codesign.errors import DomainError
from codesign.mount import check_mount
from scenes.robots import pair as robot_pair
from scenes.robots.pair import RobotPair

DRIVES = 6  # looked at in each world
BLOCK_PX = 8
# of the blocks: the horizon over blank ground makes 0.08, the pairs have 0.4 and more
LEAST_TEXTURE = 0.15
STILL = 1e-6  # m/s and rad/s
LEAST_MOVED_PX = 0.1  # median flow over the window: the pairs have 6 and more
LEAST_FOLLOWED = 0.05  # of the pixels that show a surface: the pairs have 0.7 and more


@torch.no_grad()
def check_pair(
    pair: RobotPair,
    camera: render.Camera | None = None,
    numbers: Sequence[int] = (0,),
) -> None:
    """Look at bounds, mount, drives and worlds of a pair.

    Args:
      camera: to judge by; None is that of the pair's design.
      numbers: of the worlds and drives looked at; each world is made and one frame of six drives
        rendered.
    Raises: DomainError, in a sentence that says what to change, for a design outside its bounds,
      one that does not keep the pair's requirements, a box inside or far from the robot, a lens
      whose image circle is smaller than the sensor (``mount.check_mount``) or that is wider than
      the camera's housing, a box that reaches under the ground whose depth is believed in, drives
      that never move, or by less than LEAST_MOVED_PX, or so fast that less than LEAST_FOLLOWED of
      the surfaces seen stays within a window's width, and worlds of which less than LEAST_TEXTURE
      of what the camera sees (blocks of 8 x 8 pixels) varies by more than the sensor's threshold.
    """
    pair.check(pair.design)
    camera = pair.camera(pair.design) if camera is None else camera
    requirements = pair.requirements()
    check_width(pair, camera)
    check_mount(robot_pair.mount_at(pair.ranges, pair.design.mount()), requirements, camera)
    if pair.depth == "ground" and pair.low.z_m - pair.housing_radius_m <= pair.ground_z_m:
        raise DomainError(
            f"pair '{pair.name}': the camera may sit as low as {pair.low.z_m:g} m in body axes, "
            f"its housing has a radius of {pair.housing_radius_m:g} m, and the ground, from which "
            f"depth is known, lies at {pair.ground_z_m + 0.0:.3g} m; raise the box."
        )
    for number in numbers:
        poses, twist = pair.drive(number, DRIVES)
        if not twist.abs().max() > STILL:
            raise DomainError(
                f"pair '{pair.name}': drives {number} never move, so there are no events; give a "
                "motion that does."
            )
        middle = poses[:, robot_pair.FRAMES // 2] @ pair.design.mount()
        world = pair.world(number)
        share = _textured(render.frames(camera, world, middle))
        if share < LEAST_TEXTURE:
            raise DomainError(
                f"pair '{pair.name}': world {number} has no texture where the camera looks: "
                f"{share:.0%} of blocks of {BLOCK_PX} x {BLOCK_PX} pixels vary by more than the "
                f"sensor's threshold, {LEAST_TEXTURE:.0%} are the least; paint its surfaces with "
                "pictures of radiance 0 to 255, turn the start to where there are some, see "
                "whether so long, wide or wrongly focused a lens blurs them, or whether world and "
                "motion are in other units or places."
            )
        ends = poses[:, [1, -1]] @ pair.design.mount()
        flow_px, valid = render.true_flow(camera, world, ends)
        length_px = flow_px.norm(dim=2)[valid]
        moved_px = length_px.median()
        if moved_px < LEAST_MOVED_PX:
            raise DomainError(
                f"pair '{pair.name}': in drives {number} the picture moves by {moved_px:.2g} "
                f"pixels in {1e3 * robot_pair.DURATION_S:g} ms, {LEAST_MOVED_PX:g} are the least; "
                "drive faster, or see whether the motion is in metres and seconds."
            )
        followed = (length_px <= robot_pair.WINDOW_PX).double().mean()
        if not followed >= LEAST_FOLLOWED:  # no surface, no number
            raise DomainError(
                f"pair '{pair.name}': in drives {number} {followed:.0%} of the surfaces seen move "
                f"by less than the width of a window ({robot_pair.WINDOW_PX} pixels in "
                f"{1e3 * robot_pair.DURATION_S:g} ms), {LEAST_FOLLOWED:.0%} are the least; drive "
                "more slowly, or take a shorter lens."
            )


def check_width(pair: RobotPair, camera: render.Camera) -> None:
    """Raise DomainError for a lens that does not fit into the camera's housing."""
    lens, housing_mm = camera.lens, 2e3 * pair.housing_radius_m
    widths = (
        2 * lens.semi_aperture_mm
        if hasattr(lens, "semi_aperture_mm")
        else lens.entrance_pupil_diameter_mm
    )
    width_mm = torch.as_tensor(widths).max()
    if width_mm > housing_mm:
        raise DomainError(
            f"pair '{pair.name}': its lens is {width_mm:.3g} mm wide, wider than the camera's "
            f"housing, {housing_mm:g} mm; stop it down, take a shorter one, or give a larger "
            "housing (require.clearance.radius_m)."
        )


def _textured(frames):
    """Share of blocks over which the sensor's log level spans more than a threshold."""
    level = events.lin_log(frames)
    rows, columns = (min(BLOCK_PX, size) for size in level.shape[-2:])
    blocks = level.unfold(-2, rows, rows).unfold(-2, columns, columns).flatten(-2)
    least = min(float(robot_pair.SENSOR.theta_on), float(robot_pair.SENSOR.theta_off))
    return float((blocks.amax(-1) - blocks.amin(-1) > least).double().mean())
