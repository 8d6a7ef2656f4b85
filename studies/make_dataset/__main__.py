"""Data sets of a moving event camera: frames, events, optical flow, depth, poses and calibration
along five families of trajectories.

Every sequence is a folder with events and frames in HDF5 (laid out as in DSEC), flow as 16-bit PNG,
poses as text, and the camera's calibration. A run that was stopped or killed goes on with --resume,
and ends with the same bytes. The layout is described in docs/datasets.md.
"""

import io
import itertools
import math
import os
import sys
import time
from collections.abc import Callable
from contextlib import closing, contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np
import torch

from codesign import lens
from codesign.atomic import write_atomic
from codesign.errors import CodesignError, DomainError
from codesign.events import SensorModel, SensorState, simulate
from codesign.fidelity import Task
from codesign.fidelity.levels import Fidelity, camera_at
from codesign.flow import estimate_lk
from codesign.flow.files import write_flow
from codesign.lens import catalogue
from codesign.optional import require
from codesign.render import Camera, shade
from codesign.render.moving import at_frames
from codesign.render.projection import ProjectionTable
from codesign.render.truth import truth_of_frames
from scenes.dataset_motion import FAMILIES, LEAD_S, make_world, motion
from scenes.trajectories import times
from scenes.tum import write_tum
from studies.frame import workers
from studies.frame.bench import resident_mb as resident_mb_now
from studies.frame.config import check_least, read_config
from studies.frame.fidelity import Tolerant, chosen
from studies.frame.folder import held
from studies.frame.run import Run, main
from studies.make_dataset import page as pages
from studies.make_dataset import store
from studies.make_dataset.segments import Segments

FIELD_SHARE = 0.95  # of the lens's field that the picture's diagonal takes
# fewer frames than asked for are worked on together where pictures are large
PIXELS_PER_CHUNK = 2**19
PIXELS_PER_TRUTH = 2**16  # worked on together in float64
WINDOW = 9  # frames of what --tolerance is judged on
BINS = 4
LONGEST_S = 4000.0  # event times are 32-bit microseconds


@dataclass(frozen=True)
class Config(Tolerant):
    GPU: ClassVar = True
    QUICK: ClassVar = {"trajectories": 2, "frames": 40, "size": 64, "samples": 4}
    ANEW: ClassVar = ("processes",)
    device: Literal["auto", "cpu", "cuda"] = "cpu"
    """Where rays, truth and events are computed; auto takes CUDA where there is one."""
    trajectories: int = 5
    """Number of sequences; the families orbital, radial, vertical, driving, flying take turns."""
    frames: int = 600
    """Frames of every sequence."""
    rate_hz: float = 200.0
    """Frames per second. Events are simulated between them, with log intensity linear in time."""
    world: str = "room"
    """The world to move in, a name out of scenes.worlds.WORLDS."""
    light: Literal["emissive", "baked", "path"] = "emissive"
    """How the world is lit: its pictures as radiance, its lamps worked out once, or path traced."""
    lens: str = "cooke-triplet"
    """A lens of the catalogue, or a lens file."""
    level: Literal["traced", "thin", "pinhole"] = "traced"
    """Traced lens, its thin lens (blur without aberrations), or a pinhole."""
    focal_length_mm: float = 8.0
    """The lens is scaled to this focal length; the pixels to its field."""
    size: int = 128
    """Width and height of the picture, pixels."""
    samples: int = 8
    """Rays per pixel."""
    theta: float = 0.2
    """Contrast threshold of the event sensor, natural log units."""
    theta_sigma: float = 0.02
    """Standard deviation of the thresholds over the pixels."""
    shot_rate_hz: float = 0.1
    """Noise events per pixel and second."""
    chunk: int = 25
    """Frames that are rendered, simulated and written together; what is lost at most when the run
    is killed."""
    flo: bool = False
    """Also write every flow as a Middlebury .flo file, exact to float32."""
    processes: int = 0
    """Sequences that are made at once, each in a process of its own with a thread; 0: one after the
    other in this one. The files are the same."""


class Clock:
    """Seconds spent per part of the work."""

    def __init__(self):
        self.spent = dict.fromkeys(("frames", "truth", "events", "flow files", "writing"), 0.0)

    @contextmanager
    def on(self, name):
        start = time.perf_counter()
        try:
            yield
        finally:
            self.spent[name] += time.perf_counter() - start


@torch.no_grad()
def study(run: Run[Config]) -> None:
    require("h5py", "event-files", "a data set")
    start = time.perf_counter()
    config = checked(run.config)
    maker = Maker(config, run.device)
    fidelity = None
    if config.tolerance:
        fidelity = cheapest(run, maker)
        maker = Maker(config, run.device, fidelity)
    names = [
        f"sequence_{index:03d}_{FAMILIES[index % len(FAMILIES)]}"
        for index in range(config.trajectories)
    ]
    folders = [run.folder / name for name in names]
    missing = [index for index, folder in enumerate(folders) if not store.is_done(folder)]
    ready = [maker.chunks] * len(folders)
    for index in missing:
        ready[index] = store.parts_done(folders[index])
    resident_mb = []
    with run.progress(maker.chunks * len(names), "chunks", sum(ready)) as progress:
        if config.processes:
            same = {"fidelity": asdict(fidelity) if fidelity else None}
            calls = {k: {"folder": str(folders[k]), "index": k, **same} for k in missing}
            told_of = list(ready)

            def advance(index, chunks):
                while told_of[index] < chunks:
                    told_of[index] += 1
                    progress.advance(sequence=index)

            def look():
                for index in missing:
                    advance(index, store.parts_done(folders[index]))

            answering = workers.in_processes(made, calls, config.processes, look)
            with closing(answering) as answers:
                for index, told in answers:
                    advance(index, maker.chunks)
                    for part, seconds in told["spent"].items():
                        maker.clock.spent[part] += seconds
                    resident_mb.append(told["resident_mb"])
        else:
            for index in missing:
                maker.make(index, folders[index], progress.advance)
                resident_mb.append(resident_mb_now())
    wall_s = time.perf_counter() - start
    write_atomic(run.folder / "manifest.json", store.manifest(run.folder, names).encode())
    if resident_mb:
        run.record(
            session_resident_mb_first=resident_mb[0], session_resident_mb_last=resident_mb[-1]
        )
    fresh = sum(max(config.frames - done * maker.chunk_frames, 0) for done in ready)
    pages.show(run, names, maker.clock.spent, wall_s, fresh)


@torch.no_grad()
def made(folder: str, index: int, fidelity: dict[str, Any] | None) -> dict[str, Any]:
    """A sequence of the run around its folder, in a process that knows nothing yet, on one thread.
    Returns: memory that is held, and seconds ``spent``."""
    workers.with_threads(1)
    config = read_config(Path(folder).parent / "config.json", "make_dataset", Config)
    device = torch.device(config.device)
    maker = Maker(config, device, Fidelity(**fidelity) if fidelity else None)
    parent = os.getppid()

    def go_on(**_):
        if os.getppid() != parent:  # a run that goes on has workers of its own
            raise CodesignError("the run that asked has ended.")

    maker.make(index, Path(folder), go_on)
    return {"resident_mb": resident_mb_now(), "spent": maker.clock.spent}


def checked(config):
    """Raise DomainError for numbers that give no data set; returns the configuration."""
    for name, least, most in (
        ("trajectories", 1, 1000),
        ("frames", 2, 1_000_000),
        ("size", 8, 4096),
        ("samples", 1, 4096),
        ("chunk", 2, 1000),
        ("seed", 0, 2**31),
    ):
        if not least <= getattr(config, name) <= most:
            raise DomainError(
                f"--{name} is {getattr(config, name)}; {least} to {most} are possible."
            )
    check_least(config, 0, "processes")
    if not (0 < config.rate_hz <= 1e5 and config.frames / config.rate_hz <= LONGEST_S):
        raise DomainError(
            f"--rate-hz is {config.rate_hz:g}: above 0, at most 100000, and such that {config.frames} "
            f"frames last at most {LONGEST_S:g} s."
        )
    if config.tolerance and config.device == "cuda":
        raise DomainError(
            "--tolerance chooses by processor time, which says nothing of a GPU; leave it or --device cuda out."
        )
    if not 0.1 <= config.focal_length_mm <= 1000:
        raise DomainError(
            f"--focal-length-mm is {config.focal_length_mm:g}; 0.1 to 1000 are possible."
        )
    return config


def make_camera(config, device="cpu"):
    """The camera of a configuration: the lens scaled to its focal length, the film to FIELD_SHARE
    of its field."""
    geo = lens.load(config.lens)
    half_deg = geo.half_field_deg or (
        lens.half_field_deg(config.lens) if config.lens in catalogue.LENSES else None
    )
    if half_deg is None:
        raise DomainError(
            f"the lens '{config.lens}' does not say for which field it is made; add half_field_deg to its "
            "file."
        )
    geo = geo.scaled(config.focal_length_mm / float(geo.first_order().efl_mm.detach())).freeze()
    diagonal_mm = 2 * config.focal_length_mm * math.tan(math.radians(half_deg)) * FIELD_SHARE
    pitch_mm = diagonal_mm / (config.size * math.sqrt(2))
    levels = {
        "traced": lambda: geo,
        "thin": geo.thin,
        "pinhole": lambda: lens.Pinhole(config.focal_length_mm),
    }
    optics = levels[config.level]().to(device)
    return Camera(optics, config.size, config.size, pitch_mm, config.samples, config.seed)


def cheapest(run, maker):
    """What --tolerance allows, chosen on windows from the middle of the paths of the first
    sequences."""
    config = maker.config
    count = min(config.trajectories, len(FAMILIES))
    t_s = times(min(WINDOW, config.frames), config.rate_hz)
    since_s = LEAD_S + (config.frames - len(t_s)) // 2 / config.rate_hz
    poses = torch.stack([maker.path(index)(since_s + t_s).detach() for index in range(count)])
    task = Task(maker.camera, maker.sensor, poses, t_s, flow=estimate_lk)
    return chosen(run, maker.scene, task, "hard", BINS, "the data set")


class Maker:
    """What all sequences share: world, camera, sensor, the tables of truth, and the clock.

    device: where rays, truth and events are computed. fidelity: whose camera it is, in place of that
      of the options."""

    def __init__(
        self, config: Config, device: torch.device, fidelity: Fidelity | None = None
    ) -> None:
        self.device = device
        self.camera = make_camera(config, device)
        if fidelity:
            self.camera = camera_at(self.camera, fidelity)
            config = replace(config, level=fidelity.camera, samples=fidelity.samples)
        self.config = config
        self.scene, self.stage = make_world(config.world, config.light, device.type)
        self.sensor = SensorModel(
            config.theta, config.theta, config.theta_sigma, shot_rate_hz=config.shot_rate_hz
        )
        # the same for every session of a run
        self.chunk_frames = max(2, min(config.chunk, PIXELS_PER_CHUNK // config.size**2))
        self.chunks = math.ceil(config.frames / self.chunk_frames)
        self.table = ProjectionTable(self.camera)
        self.rays = self.camera.rays()
        self.chief = self.camera.chief_rays(self.camera.film.pixels())
        self.segments = Segments(self.scene)
        self.clock = Clock()

    def make(self, index: int, folder: Path, advance: Callable[..., Any]) -> None:
        """Make what is missing of a sequence; ``advance`` is told each chunk. Raises: CodesignError
        where another process, of a run that was killed, is at it."""
        folder.mkdir(parents=True, exist_ok=True)
        with held(folder):
            if not store.is_done(folder):
                sequence = Sequence(self, index, folder)
                for chunk in range(store.parts_done(folder), self.chunks):
                    advance(sequence=index, events=sequence.make(chunk))
                sequence.finish()

    def path(self, index):
        family = FAMILIES[index % len(FAMILIES)]
        duration_s = float(times(self.config.frames, self.config.rate_hz)[-1])
        draw = self.drawn(2 * index)
        return motion(family, self.stage, self.scene, self.camera, duration_s, draw)

    def drawn(self, number):
        return torch.Generator().manual_seed(1_000_003 * self.config.seed + number)

    def frames(self, poses, first, last):
        """Images [last - first, H, W]."""
        scene = at_frames(self.scene, slice(first, last))
        images = shade(self.rays, scene, poses[first:last], self.camera.samples_per_pixel)
        return images.reshape(-1, *self.camera.film.shape)

    def truth(self, poses, first, last):
        """Depth, objects, segments and flow of frames first to last, by the names of
        store.FRAME_TYPES."""
        step = max(1, PIXELS_PER_TRUTH // self.config.size**2)
        found = []
        for start in range(first, last, step):
            count = min(start + step, last) - start
            some = slice(start, min(start + count + 1, self.config.frames))
            scene = at_frames(self.scene, some)
            truth = truth_of_frames(self.table, scene, poses[some], count, self.chief)
            now = at_frames(scene, slice(count))
            segments = self.segments.at(
                self.chief, now, poses[start : start + count], truth.object_id
            )
            found.append(
                {
                    "depth": truth.depth_m,
                    "object_id": truth.object_id,
                    "segment_id": segments,
                    "flow": truth.flow_px,
                    "valid": truth.valid,
                    "occluded": truth.occluded,
                }
            )
        return {name: torch.cat([part[name] for part in found]) for name in found[0]}

    def calibration(self, folder):
        """camera.h5: the chief ray of every pixel, camera axes, and the matrix of the pinhole that
        it is near the axis; lens.json for a traced lens."""
        film = self.camera.film
        aside = torch.tensor(
            [[0.5, 0.0], [-0.5, 0.0], [0.0, 0.5], [0.0, -0.5]], dtype=torch.float64
        )
        beside = self.camera.chief_rays(film.middle_px + aside.to(self.device)).direction.double()
        x, y = (beside[:, :2] / beside[:, 2:]).T.cpu()
        cx, cy = film.middle_px.tolist()
        content = io.BytesIO()
        with store.h5(content, "w") as file:
            for name in ("direction", "origin_m"):
                rays = getattr(self.chief, name).reshape(*film.shape, 3)
                file[name] = rays.double().cpu().numpy()
            file["K"] = np.array(
                [[float(1 / (x[0] - x[1])), 0, cx], [0, float(1 / (y[2] - y[3])), cy], [0, 0, 1.0]]
            )
            file.attrs.update(
                lens=self.config.lens,
                level=self.config.level,
                focal_length_mm=self.config.focal_length_mm,
                pixel_pitch_mm=film.pixel_pitch_mm,
                width_px=film.width_px,
                height_px=film.height_px,
            )
        write_atomic(folder / "camera.h5", content.getvalue())
        if isinstance(self.camera.lens, lens.GeoLens):
            lens.save(self.camera.lens, folder / "lens.json")


class Sequence:
    """One sequence in the making."""

    def __init__(self, maker, index, folder):
        config = maker.config
        self.maker = maker
        self.folder = folder
        self.family = FAMILIES[index % len(FAMILIES)]
        (folder / store.PARTS).mkdir(parents=True, exist_ok=True)
        (folder / "flow" / "forward").mkdir(parents=True, exist_ok=True)
        self.t_s = times(config.frames, config.rate_hz)
        self.noise = maker.drawn(2 * index + 1)
        self.path = maker.path(index)
        self.poses = self.path(LEAD_S + self.t_s).detach().to(maker.device)
        self.state = None

    def make(self, chunk):
        """Render, simulate and store the frames of a chunk; returns the number of events."""
        maker = self.maker
        clock = maker.clock
        first = chunk * maker.chunk_frames
        last = min(first + maker.chunk_frames, maker.config.frames)
        if chunk == 0:
            self.state = SensorState(generator=self.noise)
        elif self.state is None:  # at the start of a session
            part = store.part_path(self.folder, chunk - 1)
            self.state = store.read_state(part, maker.device)
        with clock.on("frames"):
            frames = maker.frames(self.poses, first, last)
        with clock.on("truth"):
            truth = maker.truth(self.poses, first, last)
        with clock.on("events"):
            events = simulate(frames, self.t_s[first:last], maker.sensor, state=self.state)
        with clock.on("flow files"):
            for k, (flow, valid) in enumerate(zip(truth["flow"], truth["valid"], strict=True)):
                for kind in ("png", "flo") if maker.config.flo else ("png",):
                    write_flow(
                        self.folder / "flow" / "forward" / f"{first + k:06d}.{kind}", flow, valid
                    )
        with clock.on("writing"):
            part = store.part_path(self.folder, chunk)
            store.write_part(part, {"frames": frames, **truth}, events, self.state)
        return len(events)

    def finish(self):
        """Join the parts and write what describes the sequence; last of all the file that says
        so."""
        maker = self.maker
        with maker.clock.on("writing"):
            velocity = self.path.velocity(LEAD_S + self.t_s).detach()
            extra = {"poses": self.poses.cpu().numpy(), "velocity": velocity.numpy()}
            store.join(self.folder, maker.chunks, self.t_s.numpy(), extra)
            write_tum(self.folder / "poses.txt", self.t_s, self.poses.cpu())
            maker.calibration(self.folder)
            us = np.rint(self.t_s.numpy() * 1e6).astype(np.int64)
            lines = [
                "# from_timestamp_us, to_timestamp_us",
                *(f"{a}, {b}" for a, b in itertools.pairwise(us)),
            ]
            write_atomic(
                self.folder / "flow" / "forward_timestamps.txt", ("\n".join(lines) + "\n").encode()
            )
            facts = {
                "family": self.family,
                **pages.statistics(self.folder),
                "segments": maker.segments.names,
            }
            store.finish(self.folder, facts)


if __name__ == "__main__":
    sys.exit(main(study, Config))
