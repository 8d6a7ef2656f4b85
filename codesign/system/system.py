"""The system: lens -> rays -> frames -> events -> flow -> objectives, as one torch Module."""

import difflib
import functools
import inspect
from collections.abc import Callable, Mapping
from typing import Any, TypeVar, cast

from torch import Tensor, nn

from codesign import render as render_stage
from codesign.checks import check_choice, check_whole
from codesign.errors import DomainError
from codesign.system.batch import Batch
from codesign.system.result import Result
from codesign.system.run import Pass, built_bins
from codesign.system.stage import Stage, event_call, label, modules_of, registrable

BINS = 5  # time bins where neither the estimator nor the user says
PARTS = ("camera", "mount", "trajectory", "render", "events", "flow", "estimate")
OTHER_NAMES = {
    "network": "flow",
    "estimator": "flow",
    "sensor": "events",
    "layer": "events",
    "poses": "trajectory",
    "losses": "objectives",
}
_ALSO = ("lens", "objectives", "named_objectives", "gradient", "scene", "bins", "training")


Init = TypeVar("Init", bound=Callable[..., None])


def _by_known_names(init: Init) -> Init:
    """Refuse other names before Python does, whose sentence knows no nearest one."""
    known = tuple(inspect.signature(init).parameters)[1:]

    @functools.wraps(init)
    def checked(self: Any, *unnamed: Any, **parts: Any) -> None:
        unknown = [name for name in parts if name not in known]
        if unknown:
            raise _unknown(unknown[0], known)
        init(self, *unnamed, **parts)

    return cast(Init, checked)


class System(nn.Module):
    """Camera, mount, event layer, estimator and named objectives in one graph.

    Every part is a Module or a plain function. A stage gets its input first and, by name, whatever
    else its signature asks for out of: batch, camera, scene, rays, T_body_cam, T_world_body,
    T_world_cam, t_s, bins, generator (of the batch's seed), frames, volume, field, estimate, truth
    (FlowField through the lens).

    Args:
      camera: render.Camera (its lens is registered here when it is a Module), or a function that
        makes one.
      events: frames [N, T, H, W] -> counts [N, T-1, 2, H, W] or EventVolume. Of a part that has
        ``volume`` (every ``events.layer``) that is called: it knows when events come between two
        frames. Counts have theirs in the middle of an interval (``events.from_counts``).
      flow: EventVolume -> FlowField, or what else the objectives take.
      objectives: name -> function, all by name, -> tensor; a scalar each to go backward by
        ``Result.backward``.
      mount: () -> T_body_cam [..., 4, 4]; None: the batch's poses are the camera's.
      trajectory: () -> T_world_body [..., T, 4, 4], where the batch brings no poses.
      estimate: what follows the flow, for example a velocity; its input is the field.
      render: () -> frames [..., T, *film.shape] of one scene, for other than ``render.frames``.
      gradient: "interior", "boundary", "difference" or "auto", of ``render.frames``.
      scene: for batches without one. bins: time bins of the volume, which an event stage that makes
        its own then has to have; by default those the flow stage was built for (its ``config``), or
        5 of an event stage that makes none.
    Samples: N counts trajectories times windows of the film, trajectory by trajectory.
    Raises: DomainError for a part that a system does not have, naming the nearest; when a stage
      asks for what it does not have, or estimator and bins do not fit.

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

    @_by_known_names
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
        self._stages: dict[str, Stage] = {}
        self.gradient: render_stage.sequence.Way = gradient
        self.scene = scene
        self.camera = camera
        self.mount = mount
        self.trajectory = trajectory
        self.render = render
        self.events = events
        self.flow = flow
        self.estimate = estimate
        self.bins = bins
        self.objectives: Any = objectives

    def __setattr__(self, name: str, value: Any) -> None:
        """Parts can be exchanged; a camera brings its lens, objectives their Modules."""
        known = (*PARTS, *_ALSO, "asked_bins")
        if type(self) is System and name not in known and not name.startswith("_"):
            raise _unknown(name, (*PARTS, *_ALSO))
        if name == "objectives":
            self.named_objectives = self._checked(value)
            held = [
                module for part in self.named_objectives.values() for module in modules_of(part)
            ]
            value = nn.ModuleList(dict.fromkeys(held))  # their parameters are the system's too
        elif name == "bins":
            self.asked_bins = value
            value = _bins(self.flow, value)
        elif name == "gradient":
            check_choice(value, "gradient", render_stage.sequence.WAYS)
        elif name == "lens":
            if not hasattr(self.camera, "rays"):
                raise DomainError("the camera is a function, with a lens of its own; exchange it.")
            name, value = "camera", self.camera.with_lens(value)
        elif (
            name in PARTS
            and value is not None
            and not (name == "camera" and hasattr(value, "rays"))
        ):
            if hasattr(value, "camera_rays"):
                raise DomainError(
                    f"stage '{name}' is a lens; put it into a camera: render.Camera(lens, ...)."
                )
            called = event_call(value) if name == "events" else value
            Stage(name, called)  # refuses what it cannot call
            owner = getattr(value, "__self__", None)
            of_layer = (
                name == "events" and isinstance(owner, nn.Module) and value == event_call(owner)
            )
            value = owner if of_layer else registrable(value)
        if name in PARTS:  # a Module in the place of a function, or the other way round
            for held in (self.__dict__, self._modules):
                held.pop(name, None)
                if name == "camera":
                    held.pop("lens", None)
        if name == "camera" and hasattr(value, "rays"):
            super().__setattr__("lens", value.lens)
        super().__setattr__(name, value)  # pyright: ignore[reportArgumentType] - None and functions are parts too

    def _checked(self, objectives: Any) -> dict[str, Callable[..., Tensor]]:
        if not isinstance(objectives, Mapping) or not objectives:
            raise DomainError(
                "a system needs at least one objective; give objectives={'name': function}."
            )
        for name, part in objectives.items():
            if "estimate" in Stage(f"objective {name}", part).asked and self.estimate is None:
                raise DomainError(
                    f"objective '{name}' asks for 'estimate', but the system has no such stage; give estimate=."
                )
        return dict(objectives)

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
          batch: Batch, or anything with its fields. recorded: junction ("rays", "frames", "events",
            "flow", "estimate") -> what to put there; the stages before it are not run.
          objectives: names of those wanted; all when None. probe: keep value and gradient of every
            junction and look for values that are not finite; otherwise nothing is kept and nothing
            is looked at.
        Returns: Result.
        Raises: DomainError for names that are not there; ShapeError where batch or stages do not
          fit; NonFiniteError naming the junction, when probed.
        """
        run = self.begin(batch, recorded, probe)
        return run.result({name: run.objective(name) for name in self.chosen(objectives)})

    def chosen(self, objectives: tuple[str, ...] | None) -> tuple[str, ...]:
        """Names of the objectives in use, all for None. Raises: DomainError for names that are not
        there."""
        chosen = tuple(self.named_objectives) if objectives is None else objectives
        unknown = [name for name in chosen if name not in self.named_objectives]
        if unknown or not chosen:
            asked = f"objective '{unknown[0]}'" if unknown else "objective at all"
            raise DomainError(f"there is no {asked}; there are {', '.join(self.named_objectives)}.")
        return chosen

    def begin(
        self,
        batch: Batch,
        recorded: Mapping[str, Any] | None = None,
        probe: bool = False,
    ) -> "Pass":
        """A pass to read from by name (``["frames"]``, ``["volume"]``, ...); each stage runs when
        it is asked for."""
        return Pass(self, batch, dict(recorded or {}), probe)

    def stage(self, name: str, part: Callable[..., Any]) -> Stage:
        """A part as a stage of that name; its signature is read once."""
        known = self._stages.get(name)
        if known is None or known.call != part:
            known = self._stages[name] = Stage(name, part)
        return known

    def replaced(self, **parts: Any) -> "System":
        """The same system with other parts, for example the hard sensor for ``events``; what stays
        is shared."""
        now = {name: getattr(self, name) for name in (*PARTS, "gradient", "scene")}
        now |= {"objectives": self.named_objectives, "bins": self.asked_bins}
        unknown = [name for name in parts if name not in now]
        if unknown:
            raise _unknown(unknown[0], tuple(now))
        if "flow" in parts:
            now["bins"] = None  # those of the new estimator
        return System(**{**now, **parts})


def _unknown(name: str, known: tuple[str, ...]) -> DomainError:
    meant = {each: each for each in known} | OTHER_NAMES
    near = difflib.get_close_matches(name, meant, n=1)
    meant = f", did you mean '{meant[near[0]]}'?" if near else ";"
    return DomainError(f"a system has no part '{name}'{meant} it has {', '.join(known)}.")


def _bins(flow: Any, bins: int | None) -> int:
    """Time bins of the volume. Raises: DomainError when the estimator was built for others."""
    wanted = built_bins(flow)
    if bins is not None and wanted is not None and bins != wanted:
        raise DomainError(
            f"stage 'flow' ({label(flow)}) was built for {wanted} time bins and the system makes {bins}; "
            f"give bins={wanted} or leave bins out."
        )
    found = next((n for n in (bins, wanted) if n is not None), BINS)
    return check_whole(found, "bins")
