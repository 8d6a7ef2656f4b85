"""Hard cases of rigid motions and of mounts: no turn, half a turn, far away, many in a row."""

import math

import torch

from codesign import lens, mount, pose, render
from scenes import trajectories
from studies.stability.case import Case, Span, nothing, spoilt
from studies.stability.motion import hat, rigid, rodrigues, small

MANY = 100_000
SLOPE_PX = 20.0 / 0.5
LEVEL = torch.tensor([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]], dtype=torch.float64)
MIDDLE_M = torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64)


def turned(shift, axis, angle):
    return torch.cat([shift, angle * axis / axis.norm()])


def exp_turned(**parts):
    return pose.se3_exp(turned(**parts))


def by_formula(**parts):
    """Rodrigues' formula within 1e-6 of pi, on both sides."""
    return rodrigues(turned(**parts))


def far_inverse(twist, distance):
    return pose.inverse(pose.se3_exp(torch.cat([distance * twist[:3], twist[3:]])))


def transposed(twist, distance):
    """The inverse of a pose 1e-9 to 1e9 m away: R^T and -R^T t."""
    there = rodrigues(torch.cat([distance * twist[:3], twist[3:]]))
    return rigid(there[:3, :3].mT, -there[:3, :3].mT @ there[:3, 3])


def many_steps(twist):
    start, steps = (torch.eye(4).double(), torch.arange(MANY).double())
    return trajectories.body_twist(start, twist.double() / MANY, steps)[-1]


def one_motion(twist):
    """A steady twist in 1e5 steps is one motion."""
    return rodrigues(twist * (MANY - 1) / MANY)


def spoilt_pose(place):
    """NaN anywhere in a pose is refused."""
    return pose.check_pose(spoilt(torch.eye(4).to(place), place))


def mirrored_pose(place):
    """A pose that mirrors is refused."""
    signs = torch.ones(4).to(place).index_fill(0, (place * 2.9).long(), -1)
    return pose.check_pose(torch.diag(signs))


def pose_of(numbers):
    return mount.Mount(MIDDLE_M, (0.5,) * 3)(numbers)


def level_pose(numbers):
    """The middle of the box, level, with the generators."""
    turn = torch.eye(3, dtype=torch.float64) + hat(numbers[3:].double())
    return rigid(LEVEL @ turn, MIDDLE_M + 0.5 * numbers[:3])


def body_flow(depth):
    """Flow px/s per m/s forward, left and up, in 2 x 2 pixels; none where nothing is seen."""
    camera = render.Camera(lens.Pinhole(20.0), 2, 2, 0.5)
    T_body_cam = mount.Mount((0.0, 0.0, 0.0), (0.0,) * 3)().detach()
    return mount.body_flow(camera, depth.expand(4), T_body_cam)[0][..., :3]


def pinhole_flow(depth):
    """Off the middle by x / Z, right and down by f / Z (Longuet-Higgins and Prazdny, 1980)."""
    x = torch.tensor([[-0.5, -0.5], [0.5, -0.5], [-0.5, 0.5], [0.5, 0.5]], dtype=torch.float64)
    across = SLOPE_PX * torch.eye(2, dtype=torch.float64).expand(4, 2, 2)
    return torch.cat([x[..., None], across], -1) / depth


def spoilt_mount(place):
    """NaN anywhere in the numbers of a mount is refused."""
    return pose_of(spoilt(place.new_zeros(6), place))


ZERO, TINY = Span(0, 0, (6,)), Span(1e-320, 1e-9, (6,), log=True)
TWIST, PLACE = Span(0.2, 1, (6,)), {"place": Span(0, 1)}
PI = Span(math.pi - 1e-6, math.pi + 1e-6)
HALF_TURN = {"shift": Span(-3, 3, (3,)), "axis": Span(0.2, 1, (3,)), "angle": PI}
# the gradient to the distance adds entries up that cancel for some twists
FAR = {"twist": TWIST, "distance": Span(1e-9, 1e9, log=True)}
TURNS = ("twist",)
DEPTH = {"depth": Span(1e-6, 1e9, log=True)}
EXACT, FIRST_ORDER = (1e-15, 1e-15, 1e-6), (1e-15, 1e-8, 1e-6)
CASES = [
    Case("identity rotation", "pose", {"twist": ZERO}, pose.se3_exp, small, EXACT),
    Case("denormals", "pose", {"twist": TINY}, pose.se3_exp, small, FIRST_ORDER),
    Case("half turn", "pose", HALF_TURN, exp_turned, by_formula),
    Case("huge, tiny coordinates", "pose", FAR, far_inverse, transposed, learn=TURNS, unit=0.0),
    Case("1e5 frames", "pose", {"twist": TWIST}, many_steps, one_motion, learn=(), slow=True),
    Case("NaN or infinity", "pose", PLACE, spoilt_pose, "poses must be finite"),
    Case("mirrored shapes", "pose", PLACE, mirrored_pose, "mirrors"),
    Case("identity rotation", "mount", {"numbers": ZERO}, pose_of, level_pose, EXACT),
    Case("denormals", "mount", {"numbers": TINY}, pose_of, level_pose, FIRST_ORDER),
    Case("huge, tiny coordinates", "mount", DEPTH, body_flow, pinhole_flow, unit=0.0),
    Case("all rays lost", "mount", {"depth": Span(-5, 0)}, body_flow, nothing),
    Case("NaN or infinity", "mount", PLACE, spoilt_mount, "mount numbers must be finite"),
]
