"""``codesign.select``: the cheapest combination of levels that keeps a task within a tolerance.

survey on a crop ─▶ cheapest whose changes add up to the tolerance ─▶ faster ones tried on the crop
                      ─▶ one finer run on the whole film, moving up the stage that changes most
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from codesign.checks import check_positive
from codesign.errors import DomainError
from codesign.fidelity.choice import Choice
from codesign.fidelity.levels import STAGES, Fidelity, finer, levels_of, pickable
from codesign.fidelity.survey import Survey, change, outcome, survey
from codesign.fidelity.task import Task
from codesign.render.moving import views_of
from codesign.render.sequence import cheapest as cheapest_gradient

ALIKE = 0.25  # share of the time within which combinations count as equally fast
SAFE = 0.7  # of the tolerance, for a combination that is faster than the sum of changes allows


def select(
    scene: Any,
    task: Task,
    tolerance: float,
    *,
    levels: Mapping[str, Sequence[Any]] | None = None,
    seed: int = 0,
) -> Choice:
    """The cheapest fidelity of every stage whose error in the task stays within a tolerance.

    Each level of each stage is run on a crop of this scene, all else finest: what it changes, and
    its processor time. Changes are added, which bounds them; faster combinations are tried on the
    crop. What is taken is run on the whole film beside one that is finer in every stage, and moves
    up while that changes more than the tolerance.

    Args:
      scene: what ``render.frames`` takes, of things that stand still.
      task: Task.
      tolerance: of the change of what is judged, root mean square, in its unit; > 0. What the
        sensor's noise alone changes does not count.
      levels: stage -> levels to choose from, cheap to fine, the last the reference; by default all.
      seed: of the sensor's noise. Changes are the same for the same seed. Times are measured: of
        combinations within 25 % of the least time the one that changes least is taken.
    Returns: Choice.
    Raises: DomainError when no combination stays within the tolerance, naming the best, or for
      levels that are not there.

    >>> import torch
    >>> import codesign
    >>> from codesign import events, lens, pose, render
    >>> from codesign.fidelity import Task
    >>> camera = render.Camera(lens.ThinLens(8.0, 2.0), 16, 16, 0.08, samples_per_pixel=16)
    >>> plane = render.TexturedPlane([[1.0, 0.5], [0.4, -0.8]], [0.3, 0.3], [0.0, 1.0])
    >>> still = pose.look_at((0, -0.1, 4), (0, 0, 0)).repeat(5, 1, 1)
    >>> task = Task(camera, events.SensorModel(), still, torch.linspace(0, 0.1, 5))
    >>> few = {"events": ("memory", "hard"), "bins": (4, 6), "flow": ("affine",)}
    >>> choice = codesign.select(plane, task, tolerance=0.1, levels=few)  # nothing moves
    >>> choice.change, choice.predicted
    (0.0, 0.0)
    """
    check_positive(tolerance, "select: tolerance", remedy="give it in the unit of what is judged")
    known = survey(scene, task.cropped(), levels_of(task, levels), seed)
    pick = faster(scene, task, cheapest(known, task, tolerance), known, tolerance, seed)
    pick, found = verified(scene, task, pick, known, tolerance, seed)
    return Choice(
        pick, found, known.predicted(pick), tolerance, known, scene, task, _way(scene, task)
    )


def cheapest(known: Survey, task: Task, tolerance: float) -> Fidelity:
    """The fastest combination whose changes add up to the tolerance at most; of those that are
    about as fast, the one that changes least. Where there is none, the one that changes least of
    all: the sum is a bound."""
    off = {pick: known.predicted(pick) for pick in known.combinations(task)}
    enough = {pick: known.cpu_s(pick) for pick in off if off[pick] <= tolerance}
    if not enough:
        return min(off, key=lambda pick: off[pick])
    least = min(enough.values())
    alike = [pick for pick, cpu_s in enough.items() if cpu_s <= (1 + ALIKE) * least]
    return min(alike, key=lambda pick: off[pick])


def faster(
    scene: Any, task: Task, safe: Fidelity, known: Survey, tolerance: float, seed: int = 0
) -> Fidelity:
    """The fastest combination that a run on the crop finds within SAFE of the tolerance, of those
    that change least for their time if their levels do so independently; ``safe`` where none is
    faster."""
    front = []
    for pick in sorted(known.combinations(task), key=known.cpu_s):
        if not front or known.likely(pick) < known.likely(front[-1]):
            front.append(pick)
    for pick in front:
        if known.cpu_s(pick) >= known.cpu_s(safe):
            break
        if known.likely(pick) > SAFE * tolerance:
            continue
        made = outcome(scene, task.cropped(), pick, seed).judged
        if change(made, known.judged) <= SAFE * tolerance:
            return pick
    return safe


def verified(
    scene: Any, task: Task, pick: Fidelity, known: Survey, tolerance: float, seed: int = 0
) -> tuple[Fidelity, float]:
    """The combination, moved up until one that is finer in every stage changes what is judged on
    the whole film by no more than the tolerance; and that change.

    Raises: DomainError when no stage can move up, naming the combination.
    """
    allowed = pickable(task, known.levels)
    while True:
        made = outcome(scene, task, pick, seed).judged
        above = finer(pick, known.levels)
        found = change(made, outcome(scene, task, above, seed).judged)
        if found <= tolerance:
            return pick, found
        changes = {}  # of a finer level in one stage alone
        for stage in STAGES:
            if getattr(pick, stage) != allowed[stage][-1]:
                tried = replace(pick, **{stage: getattr(above, stage)})
                changes[stage] = change(made, outcome(scene, task, tried, seed).judged)
        if not changes:
            raise DomainError(
                f"no combination keeps {task.name} within {tolerance:g} {task.unit}; the best found, "
                f"{pick}, is off by {found:.2g} {task.unit}: give that tolerance, or a finer task "
                "(samples, times)."
            )
        stage = max(changes, key=lambda each: changes[each])
        at = allowed[stage].index(getattr(pick, stage))
        pick = replace(pick, **{stage: allowed[stage][at + 1]})


def _way(scene, task):
    """Way of the gradient of frames that is right for the drives of a task."""
    if not task.gradient:
        return "interior"
    camera = task.cropped().camera.with_samples(len(task.camera.colours))
    poses = (
        task.T_world_body
        if task.mount is None
        else task.T_world_body @ task.mount()[..., None, :, :].to(task.T_world_body)
    )
    views = views_of(scene, poses.detach().requires_grad_(), camera.rays())
    return cheapest_gradient(camera, views)
