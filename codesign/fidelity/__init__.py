"""Model only what a scene needs: the cheapest fidelity of every stage that keeps a task within a
tolerance."""

from codesign.doors import explain
from codesign.fidelity.choice import Choice
from codesign.fidelity.levels import Fidelity, levels_of
from codesign.fidelity.search import select
from codesign.fidelity.survey import Survey, survey
from codesign.fidelity.task import Task

__all__ = ["Choice", "Fidelity", "Survey", "Task", "levels_of", "select", "survey"]

explain(globals())
