"""One pass of a system: each stage runs when what it makes is first asked for."""

from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch import Tensor

from codesign import events as event_stage
from codesign import render as render_stage
from codesign.errors import DomainError, ShapeError
from codesign.system.batch import check_batch, scenes_of
from codesign.system.result import JUNCTIONS, RECORDABLE, Result, probe
from codesign.system.stage import Stage, event_call
from codesign.types import EventVolume, FlowField, Rays


class Pass(Mapping[str, Any]):
    """One pass: everything that stages may ask for, made when it is first asked for."""

    def __init__(self, system: Any, batch: Any, recorded: dict[str, Any], probed: bool):
        unknown = sorted(set(recorded) - set(RECORDABLE))
        if unknown:
            raise DomainError(f"junctions {unknown} cannot be replaced; {', '.join(RECORDABLE)} can.")
        self.system = system
        self.recorded = recorded
        self.junctions: dict[str, tuple[Tensor, ...]] | None = {} if probed else None
        missing = [name for name in ("T_world_body", "t_s") if not hasattr(batch, name)]
        if missing:
            raise DomainError(
                f"the batch is a {type(batch).__name__} without '{missing[0]}'; give a system.Batch."
            )
        t_s = torch.as_tensor(batch.t_s, dtype=torch.float64)
        self.made: dict[str, Any] = {"batch": batch, "t_s": t_s}

    def __getitem__(self, name: str) -> Any:
        if name not in self.made:
            self.made[name] = getattr(self, f"_{name}")()
        return self.made[name]

    def __iter__(self):
        return iter(self.made)

    def __len__(self):
        return len(self.made)

    def result(self, objectives: dict[str, Tensor]) -> Result:
        pose = self.made.get("T_world_cam")
        kept = None if self.junctions is None else dict(sorted(self.junctions.items(), key=_order))
        return Result(
            objectives, self.made.get("field"), self.made.get("estimate"), self["camera"], pose, kept
        )

    def objective(self, name: str) -> Tensor:
        """Value of the objective of that name. Raises: DomainError when it is no tensor."""
        value = self._call(f"objective {name}", self.system.named_objectives[name])
        if not torch.is_tensor(value):
            raise DomainError(f"objective '{name}' returned a {type(value).__name__}; return a tensor.")
        return value

    def _call(self, name, part, *inputs):
        return Stage(name, part, len(inputs))(self, *inputs)

    def _at(self, junction: str, make: Callable[[], Any]) -> Any:
        value = self.recorded[junction] if junction in self.recorded else make()
        if self.junctions is not None:
            self.junctions[junction] = probe(junction, value)
        return value

    @property
    def seed(self) -> int | None:
        """Of the batch."""
        return getattr(self["batch"], "seed", None)

    def _camera(self):
        camera = self.system.camera
        if not hasattr(camera, "rays"):
            camera = self._call("camera", camera)
        elif camera.lens is not self.system.lens:
            camera = camera.with_lens(self.system.lens)
        if self.seed is not None:
            camera = camera.with_seed(self.seed)
        if self.junctions is not None:
            self.junctions["lens"] = probe("lens", camera.lens)
        return camera

    def _scene(self):
        scene = getattr(self["batch"], "scene", None)
        return self.system.scene if scene is None else scene

    def _bins(self):
        return self.system.bins

    def _generator(self):
        return torch.Generator().manual_seed(self["camera"].seed if self.seed is None else self.seed)

    def _T_body_cam(self):
        if self.system.mount is None:
            return torch.eye(4, dtype=torch.float64)
        pose = self._call("mount", self.system.mount)
        if not torch.is_tensor(pose) or pose.shape[-2:] != (4, 4):
            given = tuple(pose.shape) if torch.is_tensor(pose) else type(pose).__name__
            raise ShapeError(f"stage 'mount' returned {given}; T_body_cam [..., 4, 4] is needed.")
        return pose

    def _T_world_body(self):
        trajectory = self.system.trajectory
        check_batch(self["batch"], self["scene"], trajectory is not None)
        poses = self["batch"].T_world_body
        return self._call("trajectory", trajectory) if poses is None else poses

    def _T_world_cam(self):
        poses = self["T_world_body"]
        if self.system.mount is not None:
            poses = poses @ self["T_body_cam"][..., None, :, :].to(poses)
        if self.junctions is not None:
            self.junctions["pose"] = probe("pose", poses)
        return poses

    def _rays(self) -> Rays:
        return self._at("rays", lambda: self["camera"].rays())

    def _frames(self):
        return self._at("frames", self._rendered)

    def _rendered(self):
        scene = self["scene"]
        poses = self["T_world_cam"]
        if self.system.render is None:
            way = self.system.gradient
            rays = self["rays"] if way in render_stage.sequence.PROVEN or "rays" in self.recorded else None
            return render_stage.frames(self["camera"], scene, poses, way, rays=rays)
        stage = Stage("render", self.system.render, 0)
        asked = {name: self[name] for name in stage.asked if name not in ("scene", "T_world_cam")}
        parts = [stage({**asked, "scene": one, "T_world_cam": its}) for one, its in scenes_of(scene, poses)]
        return torch.stack(parts) if isinstance(scene, (tuple, list)) else parts[0]

    def _volume(self) -> EventVolume:
        volume = self._at("events", self._events)
        if not isinstance(volume, EventVolume):
            raise DomainError(
                f"junction 'events' holds a {type(volume).__name__}; an EventVolume is needed (events.from_counts, "
                "events.from_stream)."
            )
        self._check_count("events", volume.counts)
        built = getattr(self.system.flow, "config", None)
        wanted = (
            built.get("bins", volume.counts.shape[2]) if isinstance(built, dict) else volume.counts.shape[2]
        )
        if volume.counts.shape[2] != wanted:
            raise ShapeError(
                f"stage 'flow' ({type(self.system.flow).__name__}) was built for {wanted} time bins, stage 'events' "
                f"made {volume.counts.shape[2]}; give the one as many as the other."
            )
        return volume

    def _events(self):
        found = self._call("events", event_call(self.system.events), self._samples(self["frames"]))
        if not torch.is_tensor(found):
            return found
        count = self["t_s"].numel() - 1
        if found.ndim != 5 or found.shape[1:3] != (count, 2):
            raise ShapeError(
                f"stage 'events' returned counts of shape {tuple(found.shape)}; [N, {count}, 2, H, W] is needed "
                "behind these frames, or an EventVolume."
            )
        return event_stage.from_counts(found.permute(1, 2, 0, 3, 4), self["t_s"], self.system.bins)

    def _check_count(self, what, tensor):
        """Raise ShapeError when a junction holds other than one sample per trajectory and window."""
        if "T_world_cam" not in self.made and self["batch"].T_world_body is None:
            return  # recorded without poses: nothing to compare with
        film = self["camera"].film.shape
        windows = film[0] if len(film) == 3 else 1
        wanted = self["T_world_cam"].shape[:-3].numel() * windows
        if tensor.shape[0] != wanted:
            raise ShapeError(
                f"'{what}' holds {tensor.shape[0]} sample(s) and the batch has {wanted} (trajectories times windows "
                "of the film); give one for each."
            )

    def _samples(self, image: Tensor, channels: int = 0) -> Tensor:
        """[..., T, channels, *film.shape] as [N, T, channels, H, W]: trajectories times windows first."""
        film = self["camera"].film.shape
        kept = 1 + channels
        flat = image.reshape(-1, *image.shape[image.ndim - len(film) - kept :])
        return flat if len(film) == 2 else flat.movedim(-3, 1).flatten(0, 1)

    def _field(self):
        field = self._at("flow", lambda: self._call("flow", self.system.flow, self["volume"]))
        if isinstance(field, FlowField):
            self._check_count("flow", field.flow_px)
        return field

    def _estimate(self):
        if self.system.estimate is None and "estimate" not in self.recorded:
            raise DomainError("the system has no stage 'estimate'; give estimate=.")
        return self._at("estimate", lambda: self._call("estimate", self.system.estimate, self["field"]))

    def _truth(self) -> FlowField:
        """True flow over the whole interval through the camera's lens, [N, 2, H, W], in float64."""
        recorded = getattr(self["batch"], "truth", None)
        if recorded is not None:
            self._check_count("truth", recorded.flow_px)
            return recorded
        last = self["t_s"].numel() - 1
        flow, valid = render_stage.true_flow(self["camera"], self["scene"], self["T_world_cam"], stride=last)
        interval_s = float(self["t_s"][-1] - self["t_s"][0])
        return FlowField(self._samples(flow, 1)[:, 0], self._samples(valid)[:, 0], interval_s)


def _order(item: tuple[str, Any]) -> int:
    return JUNCTIONS.index(item[0])
