"""The loop of a training: budget, schedule, and what is counted."""

import math

import pytest

from codesign.errors import DomainError
from codesign.train import Budget, Cosine


def test_the_schedule_is_a_ramp_and_a_half_cosine():
    def rate(share):
        return 2e-3 * Cosine(warm_up=0.2)(share)

    assert rate(0.0) == pytest.approx(2e-5)
    assert rate(0.1) == pytest.approx((2e-5 + 2e-3) / 2)
    assert rate(0.2) == pytest.approx(2e-3)
    assert rate(0.6) == pytest.approx((2e-5 + 2e-3) / 2)
    assert rate(1.0) == pytest.approx(2e-5)
    assert rate(0.4) == pytest.approx(2e-5 + (2e-3 - 2e-5) * math.cos(math.pi / 8) ** 2)


def test_the_budget_is_steps_or_processor_time_or_the_first_of_both():
    assert Budget(steps=40).share(10, 1e9) == 0.25
    assert Budget(cpu_s=1200.0).share(10, 600.0) == 0.5
    assert Budget(steps=40, cpu_s=60.0).share(10, 59.0) == 0.25
    assert Budget(steps=40, cpu_s=60.0).share(10, 60.0) == 1.0
    with pytest.raises(DomainError, match="give steps, or processor time"):
        Budget().share(0, 0.0)
