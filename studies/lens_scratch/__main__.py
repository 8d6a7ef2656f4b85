"""Design a triplet from plane plates: does it reach a published lens, from how many starts, and what does
each method take?

Three plates of N-SK16, F2 and N-SK16, plane but for radii of some two metres drawn from the seed, become a 50
mm f/5 triplet of 40 degrees by real rays alone: ray errors in F, d and C and hinges on centres, edges, gaps,
length and back focus, in one damped least-squares problem of 11 variables. The yardstick is the published
Cooke triplet: success is a mean RMS spot within twice its own, over fields 0, 0.7 and 1 with the whole
unvignetted pupil, every ray passing and every limit held.
"""

import dataclasses
import math
import statistics
import sys
import time
from dataclasses import dataclass
from typing import ClassVar

import torch

from codesign import lens
from codesign.errors import DomainError
from studies.frame.run import Run, StudyConfig, main
from studies.lens_scratch import page as lens_scratch_page
from studies.lens_scratch.search import ATTEMPTS, METHODS, Outcome, Search
from studies.lens_scratch.task import judge, polychromatic_spots_um

YARDSTICK = "cooke-triplet"
ALLOWED = 2.0  # mean RMS spot over that of the yardstick


@dataclass(frozen=True)
class Config(StudyConfig):
    QUICK: ClassVar = {"seeds": 3, "methods": ("curriculum",)}
    seeds: int = 10
    """Starts per method, seeded by --seed and the numbers after it."""
    methods: tuple[str, ...] = ("curriculum", "direct", "adam")
    """Methods to compare, out of curriculum, direct and adam; the first is the one that counts."""


def study(run: Run[Config]):
    config = run.config
    if config.seeds < 1 or not config.methods or set(config.methods) - set(METHODS):
        raise DomainError(
            f"{config.seeds} seeds and methods {config.methods}: give at least one seed, and methods out of "
            f"{', '.join(METHODS)}."
        )
    methods = config.methods
    seeds = range(config.seed, config.seed + config.seeds)
    published = lens.load(YARDSTICK).freeze()
    yardstick = {"F, d, C": polychromatic_spots_um(published), "d": polychromatic_spots_um(published, ("d",))}
    goal_um = ALLOWED * mean(yardstick["F, d, C"])
    run.say(
        f"{YARDSTICK}: mean RMS spot {mean(yardstick['F, d, C']):.2f} um in F, d, C "
        f"({mean(yardstick['d']):.2f} in d); goal {goal_um:.2f} um"
    )
    outcomes = search_all(run, [(method, seed) for method in methods for seed in seeds], goal_um)
    verdicts = [judge_outcome(outcome) for outcome in outcomes]
    for method in methods:
        record_method(
            run, method, [(o, v) for o, v in zip(outcomes, verdicts, strict=True) if o.method == method]
        )
    run.record(
        published_mean_spot_um=mean(yardstick["F, d, C"]),
        published_mean_spot_d_um=mean(yardstick["d"]),
        goal_mean_spot_um=goal_um,
    )
    lens_scratch_page.show(run, published, yardstick, goal_um, outcomes, verdicts)


def search_all(run, jobs, goal_um):
    """Outcome of every (method, seed), going on where an earlier session stopped."""
    stored = run.load_state() if run.resumed else None
    numbers = stored.numbers if stored else {"done": [], "now": None}
    done = [Outcome(**row) for row in numbers["done"]]
    searches: dict[str, Search | None] = {"now": None}

    def save():
        run.save_state(
            {},
            {
                "done": [dataclasses.asdict(o) for o in [*done, *ended(searches["now"])]],
                "now": search.state() if (search := searches["now"]) and not search.outcome else None,
            },
        )

    run.on_interrupt(save)
    for method, seed in jobs[len(done) :]:
        search = searches["now"] = Search(method, seed, goal_um, shorten=2 if run.config.quick else 1)
        if numbers["now"]:
            search.resume(numbers.pop("now"))
        numbers["now"] = None
        with run.progress(
            ATTEMPTS[method] * sum(s.steps for s in search.stages), f"{method} {seed}", search.steps
        ) as progress:
            while search.outcome is None:
                began = time.monotonic()
                entry = search.step()
                search.seconds += time.monotonic() - began
                progress.advance(loss=entry.loss)
        (outcome,) = ended(search)
        done.append(outcome)
        searches["now"] = None
        save()
        verdict = judge_outcome(outcome)
        run.say(
            f"{method} {seed}: {'success' if outcome.succeeded else 'no success'}, mean RMS spot "
            f"{verdict.mean_um if verdict else math.nan:.2f} um, "
            f"{outcome.steps} steps, {outcome.evaluations} evaluations, {search.seconds:.1f} s, attempt "
            f"{outcome.attempts}"
        )
    return done


def ended(search):
    """The outcome of a search, in a list; an empty one before its last step."""
    return [dataclasses.replace(search.outcome, seconds=search.seconds)] if search and search.outcome else []


def judge_outcome(outcome):
    """Verdict on an outcome's lens, None when it is no lens."""
    return judge(torch.tensor(outcome.variables, dtype=torch.float64))


def record_method(run, method, found):
    """Figures of one method into metrics.json."""
    wins = sum(o.succeeded for o, _ in found)
    low, high = wilson(wins, len(found))
    spots = sorted(v.mean_um for _, v in found if v is not None and math.isfinite(v.mean_um))
    run.record(
        **{
            f"{method}_seeds": len(found),
            f"{method}_seeds_succeeded": wins,
            f"{method}_success_low": low,
            f"{method}_success_high": high,
            f"{method}_seeds_succeeded_at_first_attempt": sum(
                o.succeeded and o.attempts == 1 for o, _ in found
            ),
            f"{method}_seconds_total": sum(o.seconds for o, _ in found),
            f"{method}_evaluations_total": sum(o.evaluations for o, _ in found),
        }
    )
    if spots:
        run.record(
            **{
                f"{method}_best_mean_spot_um": spots[0],
                f"{method}_median_mean_spot_um": statistics.median(spots),
                f"{method}_worst_mean_spot_um": spots[-1],
            }
        )
    for outcome, verdict in found:
        if verdict is not None and math.isfinite(verdict.mean_um):
            run.record(
                **{
                    f"{method}_seed{outcome.seed}_mean_spot_um": verdict.mean_um,
                    f"{method}_seed{outcome.seed}_mean_spot_d_um": mean(verdict.spots_d_um),
                }
            )


def wilson(wins, count, z=1.96):
    """95 % interval of a success rate. Source: Wilson, J. Am. Stat. Assoc. 22 (1927)."""
    share = wins / count
    spread = z * z / count
    centre = (share + spread / 2) / (1 + spread)
    half = z * math.sqrt(share * (1 - share) / count + spread / (4 * count)) / (1 + spread)
    return max(0.0, centre - half), min(1.0, centre + half)


def mean(values):
    return sum(values) / len(values)


if __name__ == "__main__":
    sys.exit(main(study, Config))
