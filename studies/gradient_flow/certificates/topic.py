"""Every junction and every group on five scenes: the rows, their three states, and the sentence
that says what they come to."""

from collections import Counter
from collections.abc import Iterator, Sequence
from typing import Any

from studies.gradient_flow.certificates import behind, picture, scenes
from studies.gradient_flow.topic import (
    NOT_JUDGEABLE,
    RIGHT,
    STATES,
    WRONG,
    Asked,
    Row,
    Topic,
    of_certificate,
)

BEHIND = {
    "events": behind.certify_events,
    "spikes": behind.certify_spikes,
    "flow": behind.certify_flow,
}


def jobs(quick: bool) -> list[tuple[str, str]]:
    """Scenes and parts of them, the quick ones first. Film samples at silhouettes need more draws
    than the quick form has."""
    slow = [(s, "seen") for s in scenes.BUILDERS if not (quick and s in scenes.SILHOUETTES)]
    return [(scene, part) for part in (*BEHIND, "true flow") for scene in scenes.BUILDERS] + slow


def measure(config: Any, scene: str, part: str) -> Iterator[Row]:
    """Rows of a scene: of what the camera sees and the final loss, of the true flow, or of a stage
    behind the frames."""
    few = config.directions or None
    if part == "seen":
        found = picture.certify_seen(scene, config.film_samples, config.draws, few)
    elif part == "true flow":
        found = picture.certify_truth(scene, few)
    else:
        found = BEHIND[part](scene, 4 if config.quick else 12)
    for junction, row in found:
        yield of_certificate((scene, junction, row.name), row, STATES[row.verdict])


def headline(rows: Sequence[Row]) -> str:
    """One sentence: how many gradients are right, wrong, and not to be judged."""
    count = Counter(row.state for row in rows)
    judged = count[RIGHT] + count[WRONG]
    share = f"{picture.TOLERANCE:.0%}".replace("%", " %")
    if not judged:
        said = "no gradient could be judged"
    elif count[WRONG]:
        worst = max((row for row in rows if row.state == WRONG), key=_error)
        said = (
            f"{count[WRONG]} of {judged} gradients that can be judged are wrong by more than "
            f"{share}, the worst by {_error(worst):.2g} of its length ({', '.join(worst.names)})"
        )
    else:
        said = f"every gradient that can be judged is right within {share} or its own noise"
    tail = f"{count[NOT_JUDGEABLE]} of {len(rows)} cannot be judged at this noise"
    return f"{said[0].upper()}{said[1:]}; {tail}."


def _error(row):
    return row.numbers["relative_error"]


TEXT = """
Each row compares a gradient by autograd with differences of the same loss, at the same random
numbers. Relative error is |autograd - difference| / |difference| (L2); signed bias is the length of
the gradient along the differences, less 1; signal to noise is |difference| over its noise. The
plateau is the step at which differences were taken, in unit steps: before the film a unit moves the
picture by about a tenth of a pixel, behind it it is the length of the parameter.

- **right**: no error above 1 % was seen at three standard deviations of the noise, and one of 10 % is excluded.
- **wrong**: the error is above 1 % by more than the noise can make, at odds that hundreds of rows allow.
- **not judgeable**: the noise is above the signal that would tell, so the differences say neither; more samples or draws (`--film-samples`, `--draws`) lower it.

Scenes with silhouettes (occluders, robot in view, dark room) take the gradient with the boundary
term; their noise is that of film samples. True flow is compared away from silhouettes, where it
jumps. Stages behind the frames are certified in float64, in their smooth forms, on the frames of
the scene with a grain of 1 %.
"""
TOPIC = Topic(
    "Every junction on five scenes",
    TEXT,
    ("scene", "junction", "group"),
    jobs,
    measure,
    lambda row: None if row.state == NOT_JUDGEABLE else Asked({}, {}),
)
