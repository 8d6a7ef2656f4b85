"""A search from plane plates that is stored and taken up again."""

import json

from studies.lens_scratch.__main__ import ended
from studies.lens_scratch.search import Search


def outcome(every):
    """Of a search that is stored and taken up again after so many steps each; 0 for never."""
    search = Search("curriculum", 11, 20.0, shorten=4)
    step = 0
    while search.outcome is None:
        search.step()
        step += 1
        if every and step % every == 0 and search.outcome is None:
            stored = json.loads(json.dumps(search.state()))
            search = Search("curriculum", 11, 20.0, shorten=4).resume(stored)
    (found,) = ended(search)
    return found


def test_a_search_taken_up_again_ends_with_the_same_lens_and_the_same_number_of_evaluations():
    whole, broken = outcome(0), outcome(1)
    assert broken.variables == whole.variables
    assert (broken.evaluations, broken.losses) == (whole.evaluations, whole.losses)
    assert not ended(None)
