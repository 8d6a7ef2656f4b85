"""What cannot be typed after the name of a study ends in a sentence. Words that need files of a kind
are in the tests that make these."""

import pytest

from tests import refusals
from tests.studies.runs import module_of

STUDIES = (
    *("codesign", "flow_quality", "gradient_flow", "hero", "joint_map", "lens_opt"),
    *("lens_report", "make_dataset", "placement", "spike_esim", "velocity_head"),
)
ROWS = [(name, row) for name in STUDIES for row in refusals.rows(__file__, name)]


@pytest.mark.parametrize(
    ("name", "row"), ROWS, ids=[f"{name}: {row.sentence}" for name, row in ROWS]
)
def test_wrong_command_lines_end_with_a_sentence(name, row, refuses):
    refuses(module_of(name), row)
