"""A robot and the view of a camera on it, drawn in the robot's own axes."""

from typing import Any

import numpy as np
import torch
from matplotlib.ticker import MaxNLocator
from mpl_toolkits.mplot3d.art3d import Line3DCollection, Poly3DCollection

from codesign import pose
from codesign.render import Camera
from codesign.render.camera import lines

MOST_DRAWN = 6000  # triangles: of more, the largest
# of the robot's size: longer edges are cut in half, since drawing sorts whole triangles by depth
SMALL = 0.08


def draw_robot(axis: Any, triangles: np.ndarray, shade: np.ndarray, lines: np.ndarray) -> None:
    """Draw triangles [F, 3, 3] m in greys [F] 0..1, and lines [L, 2, 3] m of a view, into a 3-D
    axis of matplotlib."""
    across = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    kept = np.argsort(-np.linalg.norm(across, axis=1))[:MOST_DRAWN]
    longest = SMALL * np.ptp(triangles.reshape(-1, 3), axis=0).max()
    drawn, grey = cut(triangles[kept], shade[kept], longest)
    colours = np.repeat(grey[:, None], 3, 1)
    axis.add_collection3d(
        Poly3DCollection(drawn, facecolors=colours, edgecolors=colours, linewidths=0.2)
    )
    axis.add_collection3d(Line3DCollection(list(lines), colors="tab:red", linewidths=1.2))
    points = np.concatenate([triangles.reshape(-1, 3), lines.reshape(-1, 3)])
    low, high = points.min(0), points.max(0)
    axis.set(
        xlim=(low[0], high[0]),
        ylim=(low[1], high[1]),
        zlim=(low[2], high[2]),
        xlabel="x, m",
        ylabel="y, m",
        zlabel="z, m",
    )
    axis.set_box_aspect(np.maximum(high - low, 1e-3), zoom=0.85)  # room for letters
    for side, extent in zip((axis.xaxis, axis.yaxis, axis.zaxis), high - low, strict=True):
        side.set_major_locator(MaxNLocator(1 + round(4 * extent / (high - low).max())))
    axis.view_init(elev=22, azim=-125)


def cut(triangles: np.ndarray, shade: np.ndarray, longest: float) -> tuple[np.ndarray, np.ndarray]:
    """Triangles [F, 3, 3] and their shades, cut into four at the middles of their edges until those
    are short."""
    done = []
    while len(triangles):
        edges = np.linalg.norm(triangles - np.roll(triangles, -1, 1), axis=2).max(1)
        large = edges > longest
        done.append((triangles[~large], shade[~large]))
        a, b, c = triangles[large].swapaxes(0, 1)
        d, e, f = (a + b) / 2, (b + c) / 2, (c + a) / 2
        parts = [(a, d, f), (d, b, e), (f, e, c), (d, e, f)]
        triangles = np.concatenate([np.stack(part, 1) for part in parts])
        shade = np.tile(shade[large], 4)
    return np.concatenate([part for part, _ in done]), np.concatenate([part for _, part in done])


def view_lines(camera: Camera, T_robot_cam: torch.Tensor, length_m: float) -> np.ndarray:
    """The view as lines [8, 2, 3] in the robot's axes: to the corners of the sensor at a depth, and
    around them."""
    film = camera.film
    half = torch.tensor([film.sensor_width_px, film.sensor_height_px]).double() / 2
    corners_px = (
        film.middle_px + half * torch.tensor([[-1.0, -1], [1, -1], [1, 1], [-1, 1]]).double()
    )
    rays = camera.rays_through(corners_px, torch.zeros_like(corners_px))
    straight = (corners_px - film.middle_px) * camera.slope_per_px()
    # where the lens passes no light, a corner is where a pinhole would see it
    slope = torch.where(rays.weight[:, None] > 0, lines(rays)[1].double(), straight)
    ends = pose.apply(T_robot_cam, length_m * torch.nn.functional.pad(slope, (0, 1), value=1.0))
    ends = ends.detach().numpy()
    eye = np.broadcast_to(T_robot_cam[:3, 3].detach().numpy(), ends.shape)
    return np.concatenate([np.stack([eye, ends], 1), np.stack([ends, np.roll(ends, -1, 0)], 1)])
