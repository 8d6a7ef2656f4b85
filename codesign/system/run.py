"""One pass of a system: each stage runs when what it makes is first asked for."""

import math
from collections import ChainMap
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from codesign import events as event_stage
from codesign import render as render_stage
from codesign.errors import DomainError, ShapeError
from codesign.events.entry import check_times
from codesign.render.moving import at_frames
from codesign.system.batch import check_batch, scenes_of
from codesign.system.contents import tensors_in
from codesign.system.layout import check_layout, look_at, look_at_times
from codesign.system.result import JUNCTIONS, RECORDABLE, Result, probe
from codesign.system.stage import event_call, label, modules_of
from codesign.types import EventVolume, FlowField, Rays


class Pass(Mapping[str, Any]):
    """One pass: everything that stages may ask for, made when it is first asked for."""

    def __init__(self, system: Any, batch: Any, recorded: dict[str, Any], probed: bool):
        unknown = sorted(set(recorded) - set(RECORDABLE))
        if unknown:
            raise DomainError(
                f"junctions {unknown} cannot be replaced; {', '.join(RECORDABLE)} can."
            )
        self.system = system
        self.recorded = recorded
        self.junctions: dict[str, tuple[Tensor, ...]] | None = {} if probed else None
        missing = [name for name in ("T_world_body", "t_s") if not hasattr(batch, name)]
        if missing:
            raise DomainError(
                f"the batch is a {type(batch).__name__} without '{missing[0]}'; give a system.Batch."
            )
        self.asked: dict[str, tuple[str, ...]] = {}
        self.samples: int | None = None
        self.making: list[str] = []
        self.made: dict[str, Any] = {"batch": batch, "t_s": check_times(batch.t_s)}
        if probed:
            look_at_times(self["t_s"])

    def __getitem__(self, name: str) -> Any:
        if name in self.made:
            return self.made[name]
        if name in self.making:
            circle = " needs ".join(
                f"'{each}'" for each in (*self.making[self.making.index(name) :], name)
            )
            raise DomainError(
                f"the stages go in a circle: {circle}; a stage may ask for what comes before it."
            )
        self.making.append(name)
        try:
            self.made[name] = getattr(self, f"_{name}")()
        finally:
            self.making.remove(name)
        return self.made[name]

    def __iter__(self):
        return iter(self.made)

    def __len__(self):
        return len(self.made)

    def result(self, objectives: dict[str, Tensor]) -> Result:
        pose = self.made.get("T_world_cam")
        kept = self.junctions
        if kept is not None:
            kept = {name: kept[name] for name in JUNCTIONS if name in kept}
        return Result(
            objectives,
            self.made.get("field"),
            self.made.get("estimate"),
            self["camera"],
            pose,
            kept,
        )

    def objective(self, name: str) -> Tensor:
        """Value of the objective of that name. Raises: DomainError when it is no tensor."""
        value = self._call(f"objective {name}", self.system.named_objectives[name])
        if not torch.is_tensor(value):
            raise DomainError(
                f"objective '{name}' returned a {type(value).__name__}; return a tensor."
            )
        self._check_interval({"field", "volume", "truth"} & set(self.asked[f"objective {name}"]))
        return value

    def _check_interval(self, asked: set[str]) -> None:
        """Raise DomainError where the truth that an objective asks for is of another interval."""
        if "truth" not in asked:
            return
        lasts_s = {
            each: float(value.collected_s.sum() if each == "volume" else value.interval_s)
            for each in asked
            if isinstance(value := self[each], EventVolume | FlowField)
        }
        for each, seconds in lasts_s.items():
            if not math.isclose(seconds, lasts_s["truth"], rel_tol=1e-3):
                raise DomainError(
                    f"'{each}' is over {seconds:.6g} s and the truth over {lasts_s['truth']:.6g} s; give events and truth of "
                    "one interval."
                )

    def _call(self, name, part, *inputs, **instead):
        stage = self.system.stage(name, part)
        has = ChainMap(instead, self)  # pyright: ignore[reportArgumentType] - read alone
        self.asked[name] = stage.asked if stage.input is None else (stage.input, *stage.asked)
        if self.junctions is None:
            return stage(has, *inputs)
        batch = self["batch"]
        given = (
            {each: has[each] for each in stage.asked}
            | self.made
            | {"inputs": inputs, "scene": None}
        )
        given |= {"batch": (batch.T_world_body, batch.t_s, getattr(batch, "truth", None))}
        before = [
            (each, t, t.detach().clone())
            for each, value in given.items()
            for t in tensors_in(value)
        ]
        found = stage(has, *inputs)
        changed = [each for each, tensor, copy in before if not torch.equal(tensor, copy)]
        if changed:
            raise DomainError(
                f"stage '{name}' ({label(part)}) changes '{changed[0]}' in place, which others read too; work on a "
                "copy: .clone() (and no inplace=True in its first layer)."
            )
        return found

    def _by(self, junction: str, stage: str) -> str:
        """Subject and verb of a sentence about what stands at a junction."""
        part = getattr(self.system, stage)
        own = "" if part is None or junction == "rays" else f" ({label(part)})"
        return (
            f"junction '{junction}' holds"
            if junction in self.recorded
            else f"stage '{stage}'{own} returned"
        )

    def _looked_at(self, junction: str) -> bool:
        """Whether values are read: where they are probed, and of recordings."""
        return self.junctions is not None or junction in self.recorded

    def _at(self, junction: str, make: Callable[[], Any], check: Callable[[Any], None]) -> Any:
        value = self.recorded[junction] if junction in self.recorded else make()
        check(value)
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
        return torch.Generator().manual_seed(
            self["camera"].seed if self.seed is None else self.seed
        )

    def _T_body_cam(self):
        if self.system.mount is None:
            return torch.eye(4, dtype=torch.float64)
        pose = self._call("mount", self.system.mount)
        check_layout("stage 'mount' returned", pose, Tensor, "...>=0 4 4")
        return pose

    def _T_world_body(self):
        trajectory = self.system.trajectory
        check_batch(self["batch"], self["scene"], trajectory is not None)
        poses = self["batch"].T_world_body
        if poses is None:
            poses = self._call("trajectory", trajectory)
            check_layout(
                "stage 'trajectory' returned", poses, Tensor, "... T 4 4", T=self["t_s"].numel()
            )
        return poses

    def _T_world_cam(self):
        poses = self["T_world_body"]
        if self.system.mount is not None:
            mounted = self["T_body_cam"][..., None, :, :].to(poses)
            try:
                np.broadcast_shapes(poses.shape, mounted.shape)  # torch's imports sympy
            except ValueError:
                raise ShapeError(
                    f"stage 'mount' returned poses of shape {tuple(self['T_body_cam'].shape)}, which do not go with "
                    f"those of the body, {tuple(poses.shape)}; give one for all, [4, 4], or one per trajectory."
                ) from None
            poses = poses @ mounted
        if self.junctions is not None:
            self.junctions["pose"] = probe("pose", poses)
        return poses

    def _rays(self) -> Rays:
        by = self._by("rays", "camera")
        return self._at(
            "rays", lambda: self["camera"].rays(), lambda rays: check_layout(by, rays, Rays)
        )

    def _frames(self):
        return self._at("frames", self._rendered, self._check_frames)

    def _check_frames(self, frames):
        film = tuple(self["camera"].film.shape)
        windows = film[0] if len(film) == 3 else 1
        axes = "... T windows H W" if len(film) == 3 else "... T H W"
        by = self._by("frames", "render")
        sizes = {"T": self["t_s"].numel(), "windows": windows, "H": film[-2], "W": film[-1]}
        check_layout(by, frames, Tensor, axes, **sizes)
        self._check_count("frames", frames.shape[: -1 - len(film)].numel() * windows)
        if self._looked_at("frames"):
            look_at(by, frames)

    def _rendered(self):
        scene = self["scene"]
        poses = self["T_world_cam"]
        if self.system.render is None:
            way = self.system.gradient
            self.asked["render"] = ("camera", "rays", "T_world_cam")
            rays = (
                self["rays"]
                if way in render_stage.sequence.PROVEN or "rays" in self.recorded
                else None
            )
            return render_stage.frames(self["camera"], scene, poses, way, rays=rays)
        pairs = scenes_of(scene, poses)
        parts = [
            self._call("render", self.system.render, scene=one, T_world_cam=its)
            for one, its in pairs
        ]
        for part in parts[1:]:
            check_layout(
                "stage 'render' returned", part, Tensor, tuple(getattr(parts[0], "shape", ()))
            )
        return torch.stack(parts) if isinstance(scene, (tuple, list)) else parts[0]

    def _volume(self) -> EventVolume:
        return self._at("events", self._events, self._check_volume)

    def _check_volume(self, volume):
        by = self._by("events", "events")
        height, width = self["camera"].film.shape[-2:]
        check_layout(by, volume, EventVolume, H=height, W=width)
        self._check_count("events", volume.counts.shape[0])
        if self._looked_at("events"):
            look_at(by, volume)
        built = built_bins(self.system.flow)
        wanted = self.system.asked_bins if built is None else built
        if wanted is not None and volume.counts.shape[2] != wanted:
            who = (
                f"the system was given bins={wanted}"
                if built is None
                else f"stage 'flow' ({label(self.system.flow)}) was built for {wanted} time bins"
            )
            raise ShapeError(
                f"{who}, stage 'events' made {volume.counts.shape[2]}; give the one as many as the other."
            )

    def _events(self):
        found = self._call("events", event_call(self.system.events), self._samples(self["frames"]))
        if not torch.is_tensor(found):
            return found
        count = self["t_s"].numel() - 1
        height, width = self["camera"].film.shape[-2:]
        check_layout(
            "stage 'events' returned", found, Tensor, f"N {count} 2 H W", H=height, W=width
        )
        return event_stage.from_counts(found.permute(1, 2, 0, 3, 4), self["t_s"], self.system.bins)

    def _check_count(self, what: str, given: int) -> None:
        """Raise ShapeError when a junction holds other than one sample per trajectory and
        window."""
        if "T_world_cam" in self.made or self["batch"].T_world_body is not None:
            film = self["camera"].film.shape
            windows = film[0] if len(film) == 3 else 1
            self.samples = self["T_world_cam"].shape[:-3].numel() * windows
        wanted = given if self.samples is None else self.samples
        if given != wanted:
            raise ShapeError(
                f"'{what}' holds {given} sample(s) and the batch has {wanted} (trajectories times windows "
                "of the film); give one for each."
            )
        self.samples = given

    def _samples(self, image: Tensor, channels: int = 0) -> Tensor:
        """[..., T, channels, *film.shape] as [N, T, channels, H, W]: trajectories times windows
        first."""
        film = self["camera"].film.shape
        kept = 1 + channels
        flat = image.reshape(-1, *image.shape[image.ndim - len(film) - kept :])
        return flat if len(film) == 2 else flat.movedim(-3, 1).flatten(0, 1)

    def _field(self):
        return self._at(
            "flow", lambda: self._call("flow", self.system.flow, self["volume"]), self._check_field
        )

    def _check_field(self, field):
        if isinstance(field, FlowField):
            height, width = self["camera"].film.shape[-2:]
            check_layout(self._by("flow", "flow"), field, FlowField, H=height, W=width)
            self._check_count("flow", field.flow_px.shape[0])

    def _estimate(self):
        if self.system.estimate is None and "estimate" not in self.recorded:
            raise DomainError("the system has no stage 'estimate'; give estimate=.")
        made = lambda: self._call("estimate", self.system.estimate, self["field"])  # noqa: E731
        return self._at("estimate", made, lambda value: None)

    def _truth(self) -> FlowField:
        """True flow over the interval whose events are read (behind the ``lead_s`` of the event
        stage) through the camera's lens, [N, 2, H, W], in float64."""
        recorded = getattr(self["batch"], "truth", None)
        if recorded is not None:
            height, width = self["camera"].film.shape[-2:]
            check_layout("the batch has as truth", recorded, FlowField, H=height, W=width)
            self._check_count("truth", recorded.flow_px.shape[0])
            return recorded
        t_s = self["t_s"]
        read_s = t_s[0] + getattr(self.system.events, "lead_s", 0.0)
        first = int((t_s[:-1] - read_s).abs().argmin())
        if abs(float(t_s[first] - read_s)) > 1e-6:
            raise DomainError(
                f"truth: no frame but the last stands {float(read_s - t_s[0]):g} s after the first, where events begin to "
                "be read; give one there."
            )
        scene, ends = self["scene"], [first, len(t_s) - 1]
        several = isinstance(scene, list | tuple)
        cut = [at_frames(one, ends) for one in scene] if several else at_frames(scene, ends)
        flow, valid = render_stage.true_flow(
            self["camera"], cut, self["T_world_cam"][..., ends, :, :]
        )
        interval_s = float(t_s[-1] - t_s[first])
        return FlowField(self._samples(flow, 1)[:, 0], self._samples(valid)[:, 0], interval_s)


def built_bins(flow: Any) -> int | None:
    """Time bins that an estimator says it was built for (``config``); None where it says
    nothing."""
    for part in (flow, *modules_of(getattr(flow, "call", flow))):
        built = getattr(part, "config", None)
        if isinstance(built, dict) and built.get("bins") is not None:
            return built["bins"]
    return None
