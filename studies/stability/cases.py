"""All hard cases, by their labels. A case more is an entry more in one of these lists."""

from studies.stability.case import Case
from studies.stability.coincidences import CASES as COINCIDENCES
from studies.stability.event_cases import CASES as EVENTS
from studies.stability.flow_cases import CASES as FLOW
from studies.stability.lens_cases import CASES as LENS
from studies.stability.pose_cases import CASES as POSE
from studies.stability.render_cases import CASES as RENDER

ALL = [*POSE, *LENS, *COINCIDENCES, *RENDER, *EVENTS, *FLOW]
CASES: dict[str, Case] = {case.label: case for case in ALL}
