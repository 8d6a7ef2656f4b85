"""Training: batches by step, the learner, the loop around it, several processes, validation."""

from codesign.doors import explain
from codesign.train.batches import Batches, Part, Source, Started
from codesign.train.fit import fit
from codesign.train.learner import Learner, adamw
from codesign.train.loop import Budget, Clock, Cosine, Progress
from codesign.train.objectives import Contrast, Photometric, Supervised
from codesign.train.parallel import Ranks, join
from codesign.train.validation import Score, error_ratio, score

__all__ = [
    "Batches",
    "Budget",
    "Clock",
    "Contrast",
    "Cosine",
    "Learner",
    "Part",
    "Photometric",
    "Progress",
    "Ranks",
    "Score",
    "Source",
    "Started",
    "Supervised",
    "adamw",
    "error_ratio",
    "fit",
    "join",
    "score",
]

explain(globals())
