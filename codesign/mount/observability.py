"""The flow in an image that each velocity of a body makes.

A static point X in camera axes moves as X' = -(v + w x X) when the camera moves with velocity v and
rotation rate w (Longuet-Higgins and Prazdny, 1980). The pixel that images it moves so that its
chief ray goes on passing through the point, for any lens that has chief rays. The flow is linear in
the twist of the body:
velocity of its origin (forward, left, up; m/s) and rotation rate (about the same axes; rad/s). A
body in the plane has three of these six: forward, lateral, yaw rate.
"""

import torch
from torch import Tensor

from codesign.checks import check_finite
from codesign.errors import DomainError, ShapeError
from codesign.types import ChiefRayCamera

# central differences of chief rays: exact for a pinhole, 1e-6 of the third derivative otherwise
_STEP_PX = 1e-3
# of the six: forward, lateral, yaw rate
PLANAR = (0, 1, 5)
FREE = (0, 1, 2, 3, 4, 5)


def body_flow(
    camera: ChiefRayCamera, depth_m: Tensor, T_body_cam: Tensor, pixels: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Flow that each unit of a body's twist makes in every pixel.

    Args:
      camera: has ``chief_rays`` and ``film`` (see render.Camera).
      depth_m: [..., P] true depth along the camera's z axis per pixel, film order.
      T_body_cam: [..., 4, 4]. Pixels without a surface carry a depth that is not finite or not
        positive.
      pixels: [P, 2] px to look at, or [..., P, 2]; all of the film when None.
    Returns: flow [..., P, 2, 6] px/s per m/s forward, left, up of the body's origin and per rad/s
      about these axes; 0 where there is no surface. seen [..., P] bool.
    Gradient: depth, mount, and the lens behind the chief rays.
    Raises: ShapeError when the depths are not one per pixel, or the mount is not [..., 4, 4];
      DomainError when the mount is not finite.

    >>> from codesign import lens, render
    >>> from codesign.mount import Mount
    >>> camera = render.Camera(lens.ThinLens(8.0, 2.0), 16, 12, 0.05)
    >>> ahead = Mount((0.0, 0.0, 1.0), (0.0, 0.0, 0.0))().detach()
    >>> flow, seen = body_flow(camera, torch.full((192,), 2.0), ahead)
    >>> [round(v) for v in flow[0, 1].tolist()]  # down in the image: 160 px over 2 m for a metre up per second
    [-3, 0, 80, 7, -163, 0]
    """
    pixels = camera.film.pixels() if pixels is None else pixels
    return flow_along(pixel_lines(camera, pixels), depth_m, T_body_cam)


def pixel_lines(camera: ChiefRayCamera, pixels: Tensor) -> tuple[Tensor, ...]:
    """``chief_lines`` of pixels [..., P, 2], in that shape."""
    lines = chief_lines(camera, pixels.reshape(-1, 2))
    return tuple(part.unflatten(0, pixels.shape[:-1]) for part in lines)


def flow_along(
    lines: tuple[Tensor, ...], depth_m: Tensor, T_body_cam: Tensor
) -> tuple[Tensor, Tensor]:
    """``body_flow`` along chief rays that are known (``pixel_lines``)."""
    base, slope, base_step, slope_step = lines
    count = slope.shape[-2]
    if depth_m.shape[-1:] != (count,) or T_body_cam.shape[-2:] != (4, 4):
        raise ShapeError(
            f"the flow of a body needs depths [..., {count}] (one per pixel) and a mount [..., 4, 4], "
            f"got {tuple(depth_m.shape)} and {tuple(T_body_cam.shape)}."
        )
    check_finite(T_body_cam, "T_body_cam")
    depth = depth_m.double()
    seen = depth.detach().isfinite() & (depth.detach() > 0)
    depth = torch.where(seen, depth, 1.0)[..., None]
    point = torch.cat([base + slope * depth, depth], -1)  # [..., P, 3]
    moving = _point_velocity(point, T_body_cam.double())  # [..., P, 3, 3]
    flow = flow_of_points(moving, slope, base_step + slope_step * depth[..., None])
    return torch.where(seen[..., None, None], flow, 0.0), seen


def flow_precision(covariance: Tensor, floor: float = 0.0) -> Tensor:
    """Inverse covariance of flow as a measurement, out of what an estimator says of its flow.

    Args:
      covariance: [..., 3] of the error (xx, xy, yy), px^2 as of FlowField.covariance_px2, or
        px^2/s^2.
      floor: standard deviation of errors that no covariance knows of, px.
    Returns: [..., 2, 2], (S + floor^2)^-1. Gradient: covariance.
    Raises: ShapeError; DomainError for what is no covariance.

    >>> flow_precision(torch.tensor([2.0, 1.0, 1.0])).tolist()
    [[1.0, -1.0], [-1.0, 2.0]]
    """
    if covariance.shape[-1:] != (3,):
        raise ShapeError(
            f"a covariance of flow is [..., 3] (xx, xy, yy), got {tuple(covariance.shape)}."
        )
    check_finite(covariance, "covariance of flow")
    xx, xy, yy = covariance.unbind(-1)
    xx = xx + floor**2
    yy = yy + floor**2
    determinant = xx * yy - xy * xy
    if not bool(((xx > 0) & (determinant > 0)).all()):
        raise DomainError(
            "a covariance of flow is not positive (xx > 0 and xx yy > xy^2 are needed); give a floor above 0."
        )
    inverse = torch.stack([torch.stack([yy, -xy], -1), torch.stack([-xy, xx], -1)], -2)
    return inverse / determinant[..., None, None]


def chief_lines(camera: ChiefRayCamera, pixels: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Chief rays as lines x(z) = base + slope z, [P, 2] each, and their change per pixel, [P, 2, 2]
    (last
    axis: pixel x, y)."""
    step = (
        torch.tensor(
            [[0.0, 0.0], [1, 0], [-1, 0], [0, 1], [0, -1]], dtype=pixels.dtype, device=pixels.device
        )
        * _STEP_PX
    )
    # those of one pixel stand side by side
    rays = camera.chief_rays((pixels[:, None] + step).reshape(-1, 2))
    origin = rays.origin_m.double()
    direction = rays.direction.double()
    slope = direction[:, :2] / direction[:, 2:]
    base = (origin[:, :2] - slope * origin[:, 2:]).reshape(-1, 5, 2)
    slope = slope.reshape(-1, 5, 2)

    def change(v):
        return torch.stack([v[:, 1] - v[:, 2], v[:, 3] - v[:, 4]], -1) / (2 * _STEP_PX)

    return base[:, 0], slope[:, 0], change(base), change(slope)


def flow_of_points(velocity: Tensor, slope: Tensor, step: Tensor) -> Tensor:
    """Image motion [..., P, 2, K] px per unit of K motions of the points under pixels.

    Args:
      velocity: [..., P, 3, K] m of the points, in camera axes.
      slope: [..., P, 2] of the chief rays.
      step: [..., P, 2, 2] m by which a pixel's ray moves sideways at the point, last axis: pixel x,
        y.
    """
    sideways = velocity[..., :2, :] - slope[..., None] * velocity[..., 2:, :]
    return torch.linalg.solve(step, sideways)


def _point_velocity(point, T_body_cam):
    """Velocity in camera axes of static points [..., P, 3] per unit of the body's twist:
    [..., P, 3 (axis), 6]."""
    to_camera = T_body_cam[..., :3, :3].mT  # columns: the body's axes as the camera has them
    position = T_body_cam[..., :3, 3]
    units = torch.eye(3).to(position).expand_as(to_camera)
    lever = torch.linalg.cross(units, position[..., None, :]).mT  # of the camera, in body axes
    shift = torch.cat([to_camera, to_camera @ lever], -1)
    axes = to_camera.mT[..., None, :, :].expand(*point.shape[:-1], 3, 3)
    turning = torch.linalg.cross(axes, point[..., None, :]).mT
    return -(shift[..., None, :, :] + torch.cat([torch.zeros_like(turning), turning], -1))
