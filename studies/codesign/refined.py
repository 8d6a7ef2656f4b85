"""Arms with a refiner: designs, its weights, or both in one optimiser."""

from collections.abc import Mapping, Sequence
from copy import deepcopy
from typing import Any

import torch
from torch import Tensor

from codesign import flow
from scenes.robots import pair as robot_pair
from studies.codesign.arms import END, RECORDED
from studies.codesign.cells import space_of
from studies.codesign.design import PARTS, Whole
from studies.codesign.objective import Objective
from studies.codesign.problem import Drawn, Looked
from studies.codesign.race import JUDGED, PER_SEED, last_kept, spread_over, start, with_threads
from studies.frame.sweep import Row

FIRST, LAST = 0.08, 0.01  # of the cube, a step of a number of the design
JOINT, AFTERWARDS = "joint", "design, then weights"


class Refined(Drawn):
    """Drives whose flow a refiner reads (``network``, which can be exchanged); None: the closed
    form."""

    network: flow.Refiner | None = None

    def system(self, whole: Whole, kind: str, head: Any = None) -> Any:
        made = super().system(whole, kind, head)
        if self.network is None:
            return made
        events = whole.events(kind, self.network.config["bins"])
        return made.replaced(flow=self.network, events=events)

    def error(self, looked: Looked) -> Tensor:
        """Mean bounded error of velocities read from recorded events. Gradient: weights."""
        kept = {"frames": looked.run["frames"], "events": looked.run["volume"]}
        run = self.system(looked.whole, "memory").begin(looked.batch, kept)
        return self.space.pair.errors(run["estimate"], looked.batch).bounded().mean()


def descended(
    drawn: Refined,
    begun: Tensor,
    seed: int,
    setting: Mapping[str, Any],
    design: bool,
    weights: bool,
) -> tuple[Tensor, list[Looked]]:
    """Shares [V] after all steps, or the last on the way that keep what is required, sensor settled;
    and what was rendered on the way. The weights of ``drawn.network`` change in place."""
    objective, share = Objective(drawn), begun.clone().requires_grad_(design)
    groups = [{"params": [share], "lr": FIRST}] if design else []
    if weights:
        groups.append({"params": list(drawn.network.parameters()), "lr": setting["rate"]})
    optimiser = torch.optim.Adam(groups) if groups else None
    way, seen = [], []
    for step in range(setting["steps"]):
        draw = drawn.draw(PER_SEED * seed + step)
        if design:
            _, slope, looked = objective(share.detach(), draw, range(len(share)))
            optimiser.param_groups[0]["lr"] = FIRST * (LAST / FIRST) ** (
                step / max(1, setting["steps"] - 1)
            )
        else:
            slope, looked = None, drawn.looked(drawn.space.made(share), draw)
        seen.append(looked)
        for update in range(setting["updates"] if weights else int(design)):
            optimiser.zero_grad()
            if weights:
                drawn.error(looked).backward()
            share.grad = slope if update == 0 else None
            optimiser.step()
        share.data.clamp_(0, 1)
        way.append(share.detach().clone())
    if not design:
        return begun, seen
    answer = torch.stack(way[-max(1, round(END * len(way))) :]).mean(0)
    answer = last_kept(drawn, [begun, *way, answer])
    return objective.settled(answer, seen[-RECORDED:], setting["settling"]), seen


def trained(
    drawn: Refined, share: Tensor, seen: Sequence[Looked], setting: Mapping[str, Any]
) -> None:
    """The weights, as often updated on the same drives, seen through the sensor of the answer."""
    optimiser = torch.optim.Adam(drawn.network.parameters(), setting["rate"])
    whole = drawn.space.made(share)
    sensor = {name: whole.numbers[name] for name in PARTS["read-out"]}
    for looked in seen:
        again = looked.again(looked.whole.with_numbers(**sensor))
        for _ in range(setting["updates"]):
            optimiser.zero_grad()
            drawn.error(again).backward()
            optimiser.step()


def raced(seed: int, setting: Mapping[str, Any], threads: int) -> list[Row]:
    """Answers of all arms from one start, judged, in a process that may know nothing yet.

    setting: of a cell (``cells.setting``), with judged_worlds, judged_drives, rate and updates.
    """
    with_threads(threads)
    space, worlds = space_of(setting), setting["judged_worlds"]
    spread = spread_over(setting["worlds"], setting["per_draw"])
    drawn = Refined(space, robot_pair.training(setting["worlds"]), *spread)
    unseen = Refined(space, robot_pair.unseen(worlds), worlds, setting["judged_drives"])
    delivered = flow.load("refiner")
    begun, own = start(space, seed), space.start
    rows = []

    def judged(arm, share):
        found = {"arm": arm, "share": share.tolist()}
        for name, network in (("errors", drawn.network), ("closed_form_errors", None)):
            unseen.network = network
            errors = unseen.looked(space.made(share), unseen.draw(JUDGED), "sensor").hard()
            of_worlds = errors.unflatten(0, (worlds, -1)).mean(1)
            found[name] = [round(error, 6) for error in of_worlds.tolist()]
        rows.append(found)

    def way(begun, **what):
        drawn.network = deepcopy(delivered)
        return descended(drawn, begun, seed, setting, **what)

    drawn.network = delivered
    judged("default", own)
    way(own, design=False, weights=True)
    judged("weights alone", own)
    answer, seen = way(begun, design=True, weights=False)
    judged("design alone", answer)
    trained(drawn, answer, seen, setting)
    judged(AFTERWARDS, answer)
    answer, _ = way(begun, design=True, weights=True)
    judged(JOINT, answer)
    return rows
