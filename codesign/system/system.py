"""The system: lens -> rays -> frames -> events -> flow -> objectives, as one torch Module."""

from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch import Tensor, nn

from codesign import events as event_stage
from codesign import render as render_stage
from codesign.errors import DomainError, ShapeError
from codesign.system.batch import Batch, check_batch, scenes_of
from codesign.system.result import JUNCTIONS, RECORDABLE, Result, probe
from codesign.system.stage import Stage
from codesign.types import EventVolume, FlowField, Rays

BINS = 5  # time bins where neither the estimator nor the user says


class System(nn.Module):
    """Camera, mount, event layer, estimator and named objectives in one graph.

    Every part is a Module or a plain function. A stage gets its input first and, by name, whatever else its
    signature asks for out of: batch, camera, scene, rays, T_body_cam, T_world_body, T_world_cam, t_s,
    generator (of the batch's seed), frames, volume, field, estimate, truth (FlowField through the lens).

    Args:
      camera: render.Camera (its lens is registered here when it is a Module), or a function that makes one.
      events: frames [N, T, H, W] -> counts [N, T-1, 2, H, W] or EventVolume.
      flow: EventVolume -> FlowField, or what else the objectives take.
      objectives: name -> function, all by name, -> tensor; a scalar each to go backward by ``Result.backward``.
      mount: () -> T_body_cam [..., 4, 4]; None: the batch's poses are the camera's.
      trajectory: () -> T_world_body [..., T, 4, 4], where the batch brings no poses.
      estimate: what follows the flow, for example a velocity; its input is the field.
      render: () -> frames [..., T, *film.shape] of one scene, for other than ``render.frames``.
      gradient: "interior", "boundary", "difference" or "auto", of ``render.frames``.
      scene: for batches without one. bins: time bins of the volume; by default those the flow stage was
        built for (its ``config``), or 5.
    Samples: N counts trajectories times windows of the film, trajectory by trajectory.
    Raises: DomainError when a stage asks for what a system does not have, or estimator and bins do not fit.

    >>> import torch
    >>> from codesign import System, events, flow, lens, render
    >>> camera = render.Camera(lens.ThinLens(8.0, 2.0), 32, 32, 0.05, samples_per_pixel=4)
    >>> system = System(camera=camera, events=events.layer("counts"), flow=flow.estimate_lk,
    ...     objectives={"error": lambda field, truth: (field.flow_px - truth.flow_px).square().mean()})
    """

    camera: Any
    lens: Any
    mount: Any
    trajectory: Any
    render: Any
    events: Any
    flow: Any
    estimate: Any

    def __init__(
        self,
        *,
        camera: Any,
        events: Callable[..., Any],
        flow: Callable[..., Any],
        objectives: Mapping[str, Callable[..., Tensor]],
        mount: Callable[..., Tensor] | None = None,
        trajectory: Callable[..., Tensor] | None = None,
        estimate: Callable[..., Any] | None = None,
        render: Callable[..., Tensor] | None = None,
        gradient: render_stage.sequence.Way = "interior",
        scene: Any = None,
        bins: int | None = None,
    ):
        super().__init__()
        self._parts = {name: value for name, value in locals().items() if name not in ("self", "__class__")}
        if not objectives:
            raise DomainError("a system needs at least one objective; give objectives={'name': function}.")
        self.gradient: render_stage.sequence.Way = gradient
        self.scene = scene
        self.bins = _bins(flow, bins)
        self._stages: dict[str, Stage] = {}
        self.camera = camera
        if hasattr(camera, "rays"):
            self._stages["camera"] = Stage("camera", lambda: camera, 0)
            self.lens = camera.lens  # a Module's parameters are the system's
        else:
            self._stages["camera"] = Stage("camera", camera, 0)
        self._stage("events", events, 1)
        self._stage("flow", flow, 1)
        for name, part in (("mount", mount), ("trajectory", trajectory), ("render", render)):
            if part is not None:
                self._stage(name, part, 0)
        if estimate is not None:
            self._stage("estimate", estimate, 1)
        self._objectives = {name: Stage(f"objective {name}", part, 0) for name, part in objectives.items()}
        self.objectives = nn.ModuleDict(
            {name: part for name, part in objectives.items() if isinstance(part, nn.Module)}
        )

    def _stage(self, name: str, part: Callable[..., Any], inputs: int) -> None:
        self._stages[name] = Stage(name, part, inputs)
        setattr(self, name, part)  # a Module's parameters are the system's

    def forward(
        self,
        batch: Batch,
        *,
        recorded: Mapping[str, Any] | None = None,
        objectives: tuple[str, ...] | None = None,
        probe: bool = False,
    ) -> Result:
        """One pass.

        Args:
          batch: Batch, or anything with its fields. recorded: junction ("rays", "frames", "events", "flow",
            "estimate") -> what to put there; the stages before it are not run.
          objectives: names of those wanted; all when None. probe: keep value and gradient of every junction
            and look for values that are not finite; otherwise nothing is kept and nothing is looked at.
        Returns: Result.
        Raises: DomainError for names that are not there; ShapeError where batch or stages do not fit;
          NonFiniteError naming the junction, when probed.
        """
        chosen = tuple(self._objectives) if objectives is None else objectives
        unknown = [name for name in chosen if name not in self._objectives]
        if unknown:
            raise DomainError(
                f"there is no objective '{unknown[0]}'; there are {', '.join(self._objectives)}."
            )
        run = Pass(self, batch, dict(recorded or {}), probe)
        found = {name: self._objectives[name](run) for name in chosen}
        return run.result(found)

    def begin(self, batch: Batch, recorded: Mapping[str, Any] | None = None) -> "Pass":
        """A pass to read from by name (``["frames"]``, ``["volume"]``, ...); each stage runs when it is asked for."""
        return Pass(self, batch, dict(recorded or {}), False)

    def replaced(self, **parts: Any) -> "System":
        """The same system with other parts, for example the hard sensor for ``events``; what stays is shared."""
        return System(**{**self._parts, **parts})


def _bins(flow: Any, bins: int | None) -> int:
    """Time bins of the volume. Raises: DomainError when the estimator was built for others."""
    built = getattr(flow, "config", None)
    wanted = built.get("bins") if isinstance(built, dict) else None
    if bins is not None and wanted is not None and bins != wanted:
        raise DomainError(
            f"stage 'flow' ({type(flow).__name__}) was built for {wanted} time bins and the system makes {bins}; "
            f"give bins={wanted} or leave bins out."
        )
    return bins or wanted or BINS


class Pass(Mapping[str, Any]):
    """One pass: everything that stages may ask for, made when it is first asked for."""

    def __init__(self, system: System, batch: Any, recorded: dict[str, Any], probed: bool):
        unknown = sorted(set(recorded) - set(RECORDABLE))
        if unknown:
            raise DomainError(f"junctions {unknown} cannot be replaced; {', '.join(RECORDABLE)} can.")
        self.system = system
        self.stages = system._stages
        self.recorded = recorded
        self.junctions: dict[str, tuple[Tensor, ...]] | None = {} if probed else None
        self.made: dict[str, Any] = {"batch": batch, "t_s": batch.t_s}

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

    def _at(self, junction: str, make: Callable[[], Any]) -> Any:
        value = self.recorded[junction] if junction in self.recorded else make()
        if self.junctions is not None:
            self.junctions[junction] = probe(junction, value)
        return value

    def _camera(self):
        camera = self.stages["camera"](self)
        if self["batch"].seed is not None:
            camera = camera.with_seed(self["batch"].seed)
        if self.junctions is not None:
            self.junctions["lens"] = probe("lens", camera.lens)
        return camera

    def _scene(self):
        scene = getattr(self["batch"], "scene", None)
        return self.system.scene if scene is None else scene

    def _generator(self):
        seed = self["batch"].seed
        return torch.Generator().manual_seed(self["camera"].seed if seed is None else seed)

    def _T_body_cam(self):
        if "mount" in self.stages:
            return self.stages["mount"](self)
        return torch.eye(4, dtype=torch.float64)

    def _T_world_body(self):
        check_batch(self["batch"], self["scene"], "trajectory" in self.stages)
        poses = self["batch"].T_world_body
        return self.stages["trajectory"](self) if poses is None else poses

    def _T_world_cam(self):
        poses = self["T_world_body"]
        if "mount" in self.stages:
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
        if "render" not in self.stages:
            way = self.system.gradient
            rays = self["rays"] if way in render_stage.sequence.PROVEN or "rays" in self.recorded else None
            return render_stage.frames(self["camera"], scene, poses, way, rays=rays)
        stage = self.stages["render"]
        asked = {name: self[name] for name in stage.asked if name not in ("scene", "T_world_cam")}
        parts = [stage({**asked, "scene": one, "T_world_cam": its}) for one, its in scenes_of(scene, poses)]
        return torch.stack(parts) if isinstance(scene, (tuple, list)) else parts[0]

    def _volume(self) -> EventVolume:
        return self._at("events", self._events)

    def _events(self):
        found = self.stages["events"](self, self._samples(self["frames"]))
        if not torch.is_tensor(found):
            return found
        count = self["t_s"].numel() - 1
        if found.ndim != 5 or found.shape[1:3] != (count, 2):
            raise ShapeError(
                f"stage 'events' returned counts of shape {tuple(found.shape)}; [N, {count}, 2, H, W] is needed "
                "behind these frames, or an EventVolume."
            )
        return event_stage.from_counts(found.permute(1, 2, 0, 3, 4), self["t_s"], self.system.bins)

    def _samples(self, image: Tensor, channels: int = 0) -> Tensor:
        """[..., T, channels, *film.shape] as [N, T, channels, H, W]: trajectories times windows first."""
        film = self["camera"].film.shape
        kept = 1 + channels
        flat = image.reshape(-1, *image.shape[image.ndim - len(film) - kept :])
        return flat if len(film) == 2 else flat.movedim(-3, 1).flatten(0, 1)

    def _field(self):
        return self._at("flow", lambda: self.stages["flow"](self, self["volume"]))

    def _estimate(self):
        if "estimate" not in self.stages:
            raise DomainError(
                "an objective asks for 'estimate', but the system has no such stage; give estimate=."
            )
        return self._at("estimate", lambda: self.stages["estimate"](self, self["field"]))

    def _truth(self) -> FlowField:
        """True flow over the whole interval through the camera's lens, [N, 2, H, W], in float64."""
        batch = self["batch"]
        if getattr(batch, "truth", None) is not None:
            return batch.truth
        ends = [
            render_stage.true_flow(self["camera"], scene, poses[..., [0, -1], :, :])
            for scene, poses in scenes_of(self["scene"], self["T_world_cam"])
        ]
        flow = torch.stack([found for found, _ in ends])
        valid = torch.stack([valid for _, valid in ends])
        interval_s = float(self["t_s"][-1] - self["t_s"][0])
        return FlowField(self._samples(flow, 1)[:, 0], self._samples(valid)[:, 0], interval_s)


def _order(item: tuple[str, Any]) -> int:
    return JUNCTIONS.index(item[0])
