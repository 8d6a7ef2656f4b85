"""All frames of a sequence in one wavefront: camera-space rays x poses -> frames."""

from codesign.backend import run_kernel
from codesign.errors import DomainError, ShapeError
from codesign.pose import check_poses


def frames(camera, scene, T_world_cam):
    """Frames of a scene along a trajectory.

    Args: camera: Camera. scene: anything with ``radiance`` and ``dtype`` (MitsubaScene, TexturedPlane). T_world_cam: [T, 4, 4].
    Returns: [T, H, W] (or [T, windows, H, W]) linear irradiance in the scene's units, box-filtered over each pixel.
    Gradient: lens and poses, for what moves inside surfaces; the motion of silhouettes is not in it.
    """
    return shade(camera.rays(), scene, T_world_cam, camera.samples_per_pixel).reshape(T_world_cam.shape[0], *camera.film.shape)


def shade(rays, scene, T_world_cam, samples_per_pixel):
    """Pixel means [T, P] of the radiance along rays given in camera space, seen from every pose.

    Args: rays: Rays with N = P x samples_per_pixel. Gradient: to the rays (weights included) and the poses.
    """
    check_poses(T_world_cam)
    count, poses = rays.weight.numel(), T_world_cam.shape[0]
    if not samples_per_pixel >= 1:
        raise DomainError(f"samples_per_pixel = {samples_per_pixel} must be at least 1.")
    if count % samples_per_pixel:
        raise ShapeError(f"{count} rays are not a whole number of pixels at {samples_per_pixel} samples each.")
    dtype = scene.dtype
    columns = [*rays.origin_m.unbind(1), *rays.direction.unbind(1), rays.weight]
    inputs = [c.to(dtype) for c in columns] + [T_world_cam[:, :3].to(dtype)]
    kernel = _Wavefront(scene, count, poses, samples_per_pixel)
    (image,) = run_kernel(kernel, inputs, [(poses, count // samples_per_pixel)])
    return image


class _Wavefront:
    def __init__(self, scene, count, poses, samples):
        self.scene, self.count, self.poses, self.samples = scene, count, poses, samples

    def __call__(self, arr, ox, oy, oz, dx, dy, dz, weight, pose):
        import drjit as dr

        lane = dr.arange(arr.UInt32, self.count * self.poses)
        frame = lane // self.count
        ray = lane - frame * self.count
        o, d = (arr.Array3(*[dr.gather(arr.Float, v, ray) for v in part]) for part in ((ox, oy, oz), (dx, dy, dz)))
        m = [dr.gather(arr.Float, pose, frame * 12 + k) for k in range(12)]
        origin = arr.Array3(*[m[4 * r] * o.x + m[4 * r + 1] * o.y + m[4 * r + 2] * o.z + m[4 * r + 3] for r in range(3)])
        direction = arr.Array3(*[m[4 * r] * d.x + m[4 * r + 1] * d.y + m[4 * r + 2] * d.z for r in range(3)])
        light = self.scene.radiance(arr, origin, direction) * dr.gather(arr.Float, weight, ray)
        if dr.grad_enabled(light):  # the adjoint of the sum needs no values of light: without this it would be rendered twice
            light = dr.replace_grad(dr.zeros(arr.Float, dr.width(light)), light)
        return (dr.block_sum(light, self.samples) / self.samples,)
