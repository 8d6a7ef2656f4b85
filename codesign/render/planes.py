"""A textured plane in closed form: band-limited texture, float32 or float64, for checks and smooth
scenes."""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from codesign.checks import check, check_number
from codesign.errors import DomainError
from codesign.pose import Poses, check_pose


class TexturedPlane:
    """The plane z = 0 of its own frame, with radiance mean * exp(sum of cosines), seen from both
    sides.

    Args:
      frequency_per_m: [K, 2] spatial frequencies, cycles per metre; the texture has no detail finer
        than the largest.
      amplitude: [K] of the log radiance; phase_rad: [K]. mean: radiance where the sum is zero
        (0..255 scale).
      T_world_plane: [4, 4]; identity when None. dtype: precision of intersection and shading.
    Rays that do not meet the plane see ``mean``.
    """

    def __init__(
        self,
        frequency_per_m: Tensor | Sequence[Sequence[float]],
        amplitude: Tensor | Sequence[float],
        phase_rad: Tensor | Sequence[float],
        mean: float = 100.0,
        T_world_plane: Poses | None = None,
        dtype: torch.dtype = torch.float64,
    ):
        for label, value in (
            ("frequency_per_m", frequency_per_m),
            ("amplitude", amplitude),
            ("phase_rad", phase_rad),
        ):
            try:
                found = torch.as_tensor(value, dtype=torch.float64)
            except (TypeError, ValueError, RuntimeError):
                raise DomainError(
                    f"textured plane: {label} holds no numbers; give one per wave."
                ) from None
            if not bool(found.isfinite().all()):
                raise DomainError(
                    f"textured plane: {label} holds NaN or infinite entries; remove them."
                )
        check_number(
            mean, "textured plane: mean", 0.0, remedy="give a radiance on the 0..255 scale"
        )
        self.dtype = dtype
        self.mean = float(mean)
        frequency = torch.as_tensor(frequency_per_m, dtype=torch.float64)
        self.frequency = check(frequency, "K 2", "textured plane: frequency_per_m")
        self.amplitude = torch.as_tensor(amplitude, dtype=torch.float64)
        self.phase = torch.as_tensor(phase_rad, dtype=torch.float64)
        sizes = self.frequency.shape[0], self.amplitude.numel(), self.phase.numel()
        if len(set(sizes)) != 1:
            raise DomainError(
                f"textured plane: {sizes[0]} frequencies, {sizes[1]} amplitudes, {sizes[2]} phases were "
                "given; give one of each per wave."
            )
        self.T_world_plane = (
            torch.eye(4, dtype=torch.float64)
            if T_world_plane is None
            else check_pose(T_world_plane).double()
        )

    def _constants(self, arr):
        """Scalars as opaque drjit values, so that another texture needs no new kernel."""
        import drjit as dr

        def opaque(tensor):
            return [dr.opaque(arr.Float, v) for v in tensor.reshape(-1).tolist()]

        columns = (*self.frequency.unbind(1), self.amplitude, self.phase)
        waves = list(zip(*map(opaque, columns), strict=True))
        return opaque(self.T_world_plane[:3]), waves, dr.opaque(arr.Float, self.mean)

    def outline(self) -> list[Any]:
        """No curves: its radiance jumps nowhere."""
        return []

    def nearest_m(self, eye_m: Tensor) -> float:
        """Distance of the plane from a point [3] in world axes."""
        height = (eye_m.double() - self.T_world_plane[:3, 3]) @ self.T_world_plane[:3, 2]
        return abs(float(height))

    def radiance(self, arr: Any, origin: Any, direction: Any) -> Any:
        """Radiance along world rays (drjit arrays). Gradient: exact, to the rays."""
        return self.radiance_and_distance(arr, origin, direction)[0]

    def radiance_and_distance(self, arr: Any, origin: Any, direction: Any) -> Any:
        """Radiance as above, and the distance to the plane (infinite where it is not met).
        Gradient: to the rays."""
        import drjit as dr

        m, waves, mean = self._constants(arr)
        rel = [origin[i] - m[4 * i + 3] for i in range(3)]

        def local(v):
            return [m[k] * v[0] + m[4 + k] * v[1] + m[8 + k] * v[2] for k in range(3)]

        o = local(rel)
        d = local(direction)
        meets = (dr.abs(d[2]) > 1e-9) & (o[2] * d[2] < 0)
        t = dr.select(meets, -o[2] / dr.select(meets, d[2], 1), 0)
        x = o[0] + t * d[0]
        y = o[1] + t * d[1]
        total = arr.Float(0)
        for fx, fy, a, phase in waves:
            total += a * dr.cos((2 * dr.pi) * (fx * x + fy * y) + phase)
        return mean * dr.select(meets, dr.exp(total), 1), dr.select(meets, t, dr.inf)

    def hit(self, origin_m: Tensor, direction: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Where world rays [N, 3] meet the plane: point, normal, valid (see MitsubaScene.hit)."""
        normal = self.T_world_plane[:3, 2].to(origin_m)
        height = ((origin_m.detach() - self.T_world_plane[:3, 3].to(origin_m)) * normal).sum(-1)
        falling = (direction.detach() * normal).sum(-1)
        valid = (height * falling < 0) & (falling.abs() > 1e-9)
        t = torch.where(valid, -height / torch.where(valid, falling, 1.0), 1.0)
        return (
            origin_m.detach() + direction.detach() * t[:, None],
            normal.expand_as(origin_m),
            valid,
        )
