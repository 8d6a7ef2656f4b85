"""Windows of events out of the rendered 3-D worlds: surfaces that hide one another, the full
sensor, exact flow. Networks are judged on them."""

import torch

from codesign import events, lens, render
from codesign.errors import DomainError
from scenes import worlds
from scenes.dataset_motion import FAMILIES, LEAD_S, make_world, motion
from scenes.windows.rendered import LEAD, Windows

PATH_S = 1.0  # length of the path a window is taken from
PROBE_S = 0.01  # over which the speed in the image is measured
LONGEST_S = 0.4
FOCAL_MM = 4.0
# least and most of what is drawn
THETA = (0.1, 0.2)
# events per pixel, polarity and eighth of the window, evenly in the logarithm
NOISE = (0.0005, 0.005)
FOV_DEG = (45.0, 80.0)  # horizontal
ALL = tuple(name for name in worlds.WORLDS if not name.startswith(("blank", "dark")))


class WorldWindows(Windows):
    """A window of interval 1 starts somewhere on a path of one of five families, and lasts until
    the root mean square flow is ``flow_px`` (drawn evenly). Truth is valid where the world is seen
    (the sky has no flow) and its point stays in the image.

    Args:
      names: worlds, taken in turn.
      size_px: width and height.
      flow_px: (least, most).
      samples: rays per pixel.
      seed, bins, intervals: as Windows.
    """

    def __init__(
        self,
        names=ALL,
        *,
        seed=0,
        size_px=128,
        bins=8,
        intervals=32,
        flow_px=(1.0, 6.0),
        samples=8,
    ):
        unknown = sorted(set(names) - set(worlds.WORLDS))
        if unknown or not names:
            raise DomainError(
                f"worlds {unknown} are unknown; there are {', '.join(worlds.WORLDS)}."
            )
        super().__init__(seed, bins, intervals)
        self.names = tuple(names)
        self.size_px = size_px
        self.flow_px = flow_px
        self.samples = samples
        self._built = {}

    @torch.no_grad()
    def _window(self, index):
        draw = torch.Generator().manual_seed(1_000_003 * self.seed + index)

        def between(low, high):
            return low + (high - low) * float(torch.rand((), generator=draw, dtype=torch.float64))

        turn, which = divmod(index, len(self.names))
        name = self.names[which]
        if name not in self._built:
            self._built[name] = make_world(name)
        scene, stage = self._built[name]
        width_mm = 2 * FOCAL_MM * torch.tensor(between(*FOV_DEG) / 2).deg2rad().tan().item()
        film = (self.size_px, self.size_px, width_mm / self.size_px)
        camera = render.Camera(lens.Pinhole(FOCAL_MM), *film, self.samples)
        path = motion(FAMILIES[turn % len(FAMILIES)], stage, scene, camera, PATH_S, draw)
        start = LEAD_S + between(0.05, PATH_S - LONGEST_S)
        probe = path(start + torch.tensor([0.0, PROBE_S], dtype=torch.float64)).detach()
        flow, seen = render.true_flow(camera, scene, probe)
        speed = float(flow[0].square().sum(0)[seen[0]].mean().sqrt()) / PROBE_S
        length = min(between(*self.flow_px) / max(speed, 1e-6), LONGEST_S)
        t = torch.arange(-LEAD, self.intervals + 1, dtype=torch.float64) / self.intervals
        poses = path(start + length * t).detach()
        frames = render.frames(camera, scene, poses)
        flow, valid = render.true_flow(camera, scene, poses[[LEAD, -1]])
        theta = between(*THETA)
        noise = NOISE[0] * (NOISE[1] / NOISE[0]) ** between(0, 1)
        # in windows of one second: two polarities, eight eighths
        sensor = events.SensorModel(theta, theta, 0.03 * theta, shot_rate_hz=16 * noise)
        counts = events.dense_counts(frames, t - t[0], sensor, generator=draw)[LEAD:]
        return counts, flow[0].float(), valid[0], frames[[LEAD, -1]].float()
