"""Errors of designs by arm, and what one head costs against one for each design."""

from dataclasses import dataclass

import torch
from torch import Tensor

from scenes.robot_pair import Design
from studies.velocity_head.training import typical

ARMS = ("plain", "hidden", "shared", "alone", "trained on")
OWN = ("alone", "trained on")
RESAMPLED = 1000


@dataclass(frozen=True)
class Row:
    """A design: bounded errors by arm [worlds, motions], and the typical ones."""

    pair: str
    design: Design
    bounded: dict[str, Tensor]
    typical: dict[str, float]


@dataclass(frozen=True)
class Errors:
    """Rows of all designs."""

    rows: list[Row]

    def add(self, pair: str, design: Design, found: dict[str, Tensor], worlds: int) -> None:
        """Add a design by its errors [N] per arm, world after world."""
        by_world = {arm: bounded.double().reshape(worlds, -1) for arm, bounded in found.items()}
        mean = {arm: float(typical(bounded.mean())) for arm, bounded in by_world.items()}
        self.rows.append(Row(pair, design, by_world, mean))

    def ratios(self, over: str, means: "list[dict[str, Tensor]] | None" = None) -> Tensor:
        """[designs] typical error of the shared head over that of another arm; over "own", the better of the two."""
        means = (
            [{arm: each.mean() for arm, each in row.bounded.items()} for row in self.rows]
            if means is None
            else means
        )
        found = []
        for mean in means:
            arms = OWN if over == "own" else (over,)
            found.append(typical(mean["shared"]) / torch.stack([typical(mean[arm]) for arm in arms]).amin(0))
        return torch.stack(found)

    def figures(self, seed: int) -> dict[str, float]:
        """Metrics: typical errors by pair and arm, ratios with what 90 % of resampled designs and worlds give."""
        found: dict[str, float] = {}
        for pair in dict.fromkeys(row.pair for row in self.rows):
            for arm in ARMS:
                mean = torch.stack([row.bounded[arm] for row in self.rows if row.pair == pair]).mean()
                found[f"{pair}_{_name(arm)}_error"] = float(typical(mean))
        again = list(self._resampled(seed))
        for over in ("own", *OWN, "hidden", "plain"):
            ratios = self.ratios(over)
            label = f"shared_over_{_name(over)}"
            medians = torch.stack([self.ratios(over, means).median() for means in again])
            low, high = torch.quantile(medians, torch.tensor([0.05, 0.95]).double()).tolist()
            found |= {
                f"{label}_median": float(ratios.median()),
                f"{label}_low90": low,
                f"{label}_high90": high,
            }
            found |= {f"{label}_worst": float(ratios.max()), f"{label}_best": float(ratios.min())}
            found[f"{label}_within_1_1"] = int((ratios <= 1.1).sum())
        found["held_out_designs"] = len(self.rows)
        return found

    def _resampled(self, seed):
        generator = torch.Generator().manual_seed(seed)
        for _ in range(RESAMPLED):
            picked = torch.randint(len(self.rows), (len(self.rows),), generator=generator).tolist()
            means = []
            for index in picked:
                row = self.rows[index]
                count = len(row.bounded["plain"])
                worlds = torch.randint(count, (count,), generator=generator)
                means.append({arm: bounded[worlds].mean() for arm, bounded in row.bounded.items()})
            yield means


def _name(arm):
    return arm.replace(" ", "_")
