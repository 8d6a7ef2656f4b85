"""The body's velocity from image flow, and how well a mount can tell it: weighted least squares with known
depth.

A static point X in camera axes moves as X' = -(v + w x X) when the camera moves with velocity v and rotation
rate w (Longuet-Higgins and Prazdny, 1980). The pixel that images it moves so that its chief ray goes on
passing through the point, for any lens that has chief rays. The flow is linear in the twist of the body:
velocity of its origin (forward, left, up; m/s) and rotation rate (about the same axes; rad/s). A body in the
plane has three of these six: forward, lateral, yaw rate.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from codesign.errors import DomainError, ShapeError, check_finite
from codesign.types import ChiefRayCamera

# central differences of chief rays: exact for a pinhole, 1e-6 of the third derivative otherwise
_STEP_PX = 1e-3
# of eigenvalues of the information matrix, below which a velocity is not observable in float64
_SMALLEST_RATIO = 1e-12
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
      T_body_cam: [..., 4, 4]. Pixels without a surface carry a depth that is not finite or not positive.
      pixels: [P, 2] px to look at, or [..., P, 2]; all of the film when None.
    Returns: flow [..., P, 2, 6] px/s per m/s forward, left, up of the body's origin and per rad/s about these
      axes; 0 where there is no surface. seen [..., P] bool.
    Gradient: depth, mount, and the lens behind the chief rays.
    Raises: ShapeError when the depths are not one per pixel, or the mount is not [..., 4, 4]; DomainError
      when the mount is not finite.

    >>> from codesign import lens, render
    >>> from codesign.mount import Mount
    >>> camera = render.Camera(lens.ThinLens(8.0, 2.0), 16, 12, 0.05)
    >>> ahead = Mount((0.0, 0.0, 1.0), (0.0, 0.0, 0.0))().detach()
    >>> flow, seen = body_flow(camera, torch.full((192,), 2.0), ahead)
    >>> [round(v) for v in flow[0, 1].tolist()]  # down in the image: 160 px over 2 m for a metre up per second
    [-3, 0, 80, 7, -163, 0]
    """
    pixels = camera.film.pixels() if pixels is None else pixels
    if depth_m.shape[-1:] != pixels.shape[-2:-1] or T_body_cam.shape[-2:] != (4, 4):
        raise ShapeError(
            f"the flow of a body needs depths [..., {pixels.shape[-2]}] (one per pixel) and a mount [..., 4, 4], "
            f"got {tuple(depth_m.shape)} and {tuple(T_body_cam.shape)}."
        )
    check_finite(T_body_cam, "T_body_cam")
    depth = depth_m.double()
    seen = depth.detach().isfinite() & (depth.detach() > 0)
    depth = torch.where(seen, depth, 1.0)[..., None]
    base, slope, base_step, slope_step = (
        part.unflatten(0, pixels.shape[:-1]) for part in chief_lines(camera, pixels.reshape(-1, 2))
    )
    point = torch.cat([base + slope * depth, depth], -1)  # [..., P, 3]
    moving = _point_velocity(point, T_body_cam.double())  # [..., P, 3, 3]
    flow = flow_of_points(moving, slope, base_step + slope_step * depth[..., None])
    return torch.where(seen[..., None, None], flow, 0.0), seen


def velocity_from_flow(
    flow_px_s: Tensor,
    camera: ChiefRayCamera,
    depth_m: Tensor,
    T_body_cam: Tensor,
    weight: Tensor | None = None,
    prior: Sequence[float] | Tensor | None = None,
    axes: Sequence[int] = PLANAR,
) -> Tensor:
    """Velocity of the body by weighted least squares.

    Args:
      flow_px_s: [B, 2, H, W] image flow, px per second. camera, depth_m [P] or [B, P], T_body_cam [4, 4] or
        [B, 4, 4]: as for ``body_flow``.
      weight: [P] or [B, P] >= 0, inverse variance of the flow per pixel, s^2/px^2, or [..., P, 2, 2], the
        inverse of its covariance (``flow_precision``); equal weights when None.
      prior: [K] standard deviations expected of the K velocities around zero; what the image does not show
        then stays near zero. None: no prior.
      axes: which K of the six velocities the body has (``body_flow``); ``PLANAR``, or ``FREE``.
    Returns: [B, K] float64; of a body in the plane: forward m/s, lateral m/s (left), yaw rate rad/s (left).
    Gradient: flow, depth, mount, weight, lens.
    Raises: ShapeError; DomainError for NaN in flow, negative weights, and (without a prior) when no pixel
      sees a surface or the velocity is not observable.

    >>> from codesign import lens, render
    >>> from codesign.mount import Mount
    >>> camera = render.Camera(lens.ThinLens(8.0, 2.0), 16, 12, 0.05)
    >>> down = Mount((0.0, 0.0, 2.0), (0.0, 0.0, 0.0), pitch_rad=1.5707963)().detach()
    >>> depth_m = torch.full((192,), 2.0)
    >>> rows = body_flow(camera, depth_m, down)[0][..., PLANAR]
    >>> flow_px_s = (rows @ torch.tensor([1.0, 0.5, 0.2], dtype=torch.float64)).T.reshape(1, 2, 12, 16)
    >>> velocity_from_flow(flow_px_s, camera, depth_m, down)[0].round(decimals=6).tolist()
    [1.0, 0.5, 0.2]
    """
    if flow_px_s.ndim != 4 or flow_px_s.shape[1] != 2:
        raise ShapeError(f"velocity_from_flow needs flow [B, 2, H, W], got {tuple(flow_px_s.shape)}.")
    check_finite(flow_px_s, "flow")
    rows, weight = _weighted_rows(camera, depth_m, T_body_cam, weight, axes)
    measured = flow_px_s.double().flatten(2).mT  # [B, P, 2]
    if measured.shape[1] != rows.shape[-3]:
        raise ShapeError(
            f"the flow has {measured.shape[1]} pixels, the camera {rows.shape[-3]}; use the flow of this "
            "camera."
        )
    normal = _normal_matrix(rows, weight, prior)
    right = torch.einsum("...pkc,...pc->...k", rows.mT @ weight, measured)
    return torch.linalg.solve(normal.expand(*right.shape, right.shape[-1]), right)


def information(
    camera: ChiefRayCamera,
    depth_m: Tensor,
    T_body_cam: Tensor,
    weight: Tensor | None = None,
    prior: Sequence[float] | Tensor | None = None,
    axes: Sequence[int] = PLANAR,
) -> Tensor:
    """Information matrix of the body's velocity in a flow field: sum over pixels of J^T weight J.

    Args: as for velocity_from_flow, with or without a batch axis. With weight = 1 / variance of the flow
      (s^2/px^2) its inverse is the covariance of the velocity.
    Returns: [K, K] (or [B, K, K]), float64. Gradient: depth, mount, weight, lens.
    Raises: as velocity_from_flow.

    >>> from codesign import lens, render
    >>> from codesign.mount import Mount
    >>> camera = render.Camera(lens.ThinLens(8.0, 2.0), 16, 12, 0.05)
    >>> down = Mount((0.0, 0.0, 2.0), (0.0, 0.0, 0.0), pitch_rad=1.5707963)().detach()
    >>> found = information(camera, torch.full((192,), 2.0), down, weight=torch.full((192,), 4.0))
    >>> round(float(found.inverse()[0, 0].sqrt()), 5)  # m/s: 0.5 px/s of noise over 80 px/s, in 192 pixels
    0.00045
    """
    return _normal_matrix(*_weighted_rows(camera, depth_m, T_body_cam, weight, axes), prior)


def flow_precision(covariance: Tensor, confidence: Tensor | None = None, floor: float = 0.0) -> Tensor:
    """Inverse covariance of flow as a measurement, out of what an estimator says of its flow.

    Args:
      covariance: [..., 3] of the error (xx, xy, yy), px^2 as of FlowField.covariance_px2, or px^2/s^2.
      confidence: [...] in 0..1, None: 1. A flow with a prior has precision S^-1 of which about confidence
        S^-1 came from events.
      floor: standard deviation of errors that no covariance knows of, px.
    Returns: [..., 2, 2], confidence (S + floor^2)^-1, for ``information`` and ``velocity_from_flow`` (times
      the square of the interval where the covariance is in px^2). Gradient: both.
    Raises: ShapeError; DomainError for what is no covariance.

    >>> flow_precision(torch.tensor([2.0, 1.0, 1.0]), torch.tensor(0.5)).tolist()
    [[0.5, -0.5], [-0.5, 1.0]]
    """
    if covariance.shape[-1:] != (3,):
        raise ShapeError(f"a covariance of flow is [..., 3] (xx, xy, yy), got {tuple(covariance.shape)}.")
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
    share = 1.0 if confidence is None else confidence[..., None, None]
    return share * inverse / determinant[..., None, None]


def chief_lines(camera: ChiefRayCamera, pixels: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Chief rays as lines x(z) = base + slope z, [P, 2] each, and their change per pixel, [P, 2, 2] (last
    axis: pixel x, y)."""
    step = (
        torch.tensor([[0.0, 0.0], [1, 0], [-1, 0], [0, 1], [0, -1]], dtype=pixels.dtype, device=pixels.device)
        * _STEP_PX
    )
    rays = camera.chief_rays((pixels + step[:, None]).reshape(-1, 2))
    origin = rays.origin_m.double()
    direction = rays.direction.double()
    slope = direction[:, :2] / direction[:, 2:]
    base = (origin[:, :2] - slope * origin[:, 2:]).reshape(5, -1, 2)
    slope = slope.reshape(5, -1, 2)

    def change(v):
        return torch.stack([v[1] - v[2], v[3] - v[4]], -1) / (2 * _STEP_PX)

    return base[0], slope[0], change(base), change(slope)


def flow_of_points(velocity: Tensor, slope: Tensor, step: Tensor) -> Tensor:
    """Image motion [..., P, 2, K] px per unit of K motions of the points under pixels.

    Args:
      velocity: [..., P, 3, K] m of the points, in camera axes.
      slope: [..., P, 2] of the chief rays.
      step: [..., P, 2, 2] m by which a pixel's ray moves sideways at the point, last axis: pixel x, y.
    """
    sideways = velocity[..., :2, :] - slope[..., None] * velocity[..., 2:, :]
    return torch.linalg.solve(step, sideways)


def _point_velocity(point, T_body_cam):
    """Velocity in camera axes of static points [..., P, 3] per unit of the body's twist: [..., P, 3 (axis),
    6]."""
    to_camera = T_body_cam[..., :3, :3].mT  # columns: the body's axes as the camera has them
    position = T_body_cam[..., :3, 3]
    units = torch.eye(3).to(position).expand_as(to_camera)
    lever = torch.linalg.cross(units, position[..., None, :]).mT  # of the camera, in body axes
    shift = torch.cat([to_camera, to_camera @ lever], -1)
    axes = to_camera.mT[..., None, :, :].expand(*point.shape[:-1], 3, 3)
    turning = torch.linalg.cross(axes, point[..., None, :]).mT
    return -(shift[..., None, :, :] + torch.cat([torch.zeros_like(turning), turning], -1))


def _weighted_rows(camera, depth_m, T_body_cam, weight, axes):
    """Rows [..., P, 2, K], and weights [..., P, 2, 2] that are 0 where nothing is seen."""
    if not axes or not set(axes) <= set(FREE):
        raise DomainError(
            f"axes = {tuple(axes)}; choose from 0 to 5: forward, left, up, and turns about these."
        )
    rows, seen = body_flow(camera, depth_m, T_body_cam)
    rows = rows[..., list(axes)]
    both = torch.eye(2, dtype=rows.dtype, device=rows.device)
    if weight is None:
        return rows, seen.to(rows)[..., None, None] * both
    weight = check_finite(weight, "flow weight").double()
    if weight.ndim < 3 or weight.shape[-3:] != (rows.shape[-3], 2, 2):
        if bool((weight.detach() < 0).any()):
            raise DomainError(
                f"a flow weight is negative (smallest {float(weight.detach().min()):.3g}); weights are inverse "
                "variances, at least 0."
            )
        weight = weight[..., None, None] * both
    xx, xy, yx, yy = weight.detach().flatten(-2).unbind(-1)
    if not bool(((xx >= 0) & (yy >= 0) & (xy == yx) & (xx * yy - xy * yx >= -1e-9 * xx * yy)).all()):
        raise DomainError(
            "a flow weight [2, 2] is not symmetric and positive; give inverses of covariances, as of "
            "mount.flow_precision."
        )
    return rows, torch.where(seen[..., None, None], weight, 0.0)


def _normal_matrix(rows, weight, prior):
    normal = torch.einsum("...pkc,...pcl->...kl", rows.mT @ weight, rows)
    if prior is not None:
        deviation = torch.as_tensor(prior, dtype=rows.dtype, device=rows.device)
        if deviation.shape != rows.shape[-1:] or not bool(((deviation > 0) & deviation.isfinite()).all()):
            raise DomainError(
                f"prior is {deviation.tolist()}; {rows.shape[-1]} finite standard deviations > 0 (m/s, rad/s), "
                "one per velocity, are needed."
            )
        return normal + torch.diag(deviation**-2)
    strength = weight.detach().diagonal(dim1=-2, dim2=-1).sum(-1)
    if not bool((strength > 0).any(-1).all()):
        raise DomainError(
            "no pixel sees the ground with positive weight, so the flow says nothing about the velocity; "
            "turn the camera towards the ground, or give a prior."
        )
    eigenvalues = torch.linalg.eigvalsh(normal.detach())
    if bool((eigenvalues[..., 0] <= _SMALLEST_RATIO * eigenvalues[..., -1]).any()):
        raise DomainError(
            "the velocity is not observable: some motion of the body leaves the flow of all weighted pixels "
            "as it is; see more of the ground, or give a prior."
        )
    return normal
