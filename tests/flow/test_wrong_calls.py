"""Every public function of flow, called right and, with one value exchanged at random, wrong: a wrong call ends in
one sentence of ours or in a result, never in an error from within."""

import random

import pytest
import torch

from codesign.errors import CodesignError
from tests.flow.wrong_calls_case import calls, wrong

SLOW = ("export", "Refiner.predictions", "with_weights")
ROUNDS = 2
NEEDS_A_DATA_SET = "open_windows"


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("wrong")


@pytest.fixture(scope="module")
def table(folder):
    return calls(folder)


def test_right_calls_have_a_result(table):
    for name, call in table.items():
        if name != NEEDS_A_DATA_SET:
            call.function(**call.given)


def test_wrong_calls_end_in_one_sentence(table, folder):
    draw = random.Random(7)
    sentences = []
    for name, call in table.items():
        for _ in range(0 if any(word in name for word in SLOW) else ROUNDS):
            argument, given = "the exchange itself", {}
            try:
                argument, given = wrong(call, draw, folder)
                call.function(**given)
            except CodesignError as error:
                sentences.append(str(error))
            except Exception as error:
                value = given.get(argument)
                shown = (
                    f"{value.dtype} {list(value.shape)}" if isinstance(value, torch.Tensor) else repr(value)
                )
                raise AssertionError(f"{name} with {argument} = {shown[:300]}") from error
    assert len(sentences) > ROUNDS * len(table) / 2  # most exchanges are wrong, and noticed
    assert all(len(sentence) > 20 and "\n" not in sentence for sentence in sentences)
