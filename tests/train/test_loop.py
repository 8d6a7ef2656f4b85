"""The loop of a training: budget, schedule, and what is counted."""

import math

import pytest

from codesign.errors import DomainError
from codesign.train import Budget, Clock, Cosine, Learner, Progress, Supervised, loop
from tests.flow_training_case import Linear, Made


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


def half_blind(step):
    """Four windows, the first without any true flow."""
    windows = Made().batch(range(4 * step, 4 * step + 4))
    windows.truth.valid[0] = False
    return windows


def test_steps_windows_and_time_of_earlier_sessions_are_carried_on():
    learner = Learner(Linear(), Supervised(), clip=1e-9)
    progress = Progress(step=2, data_s=100.0, training_s=50.0, clipped=1, blind=5, loss=[0.5, 0.25])
    shares = []
    loop.run(
        learner,
        half_blind,
        progress,
        Budget(steps=5, cpu_s=1e4),
        Cosine(),
        after_step=shares.append,
    )
    assert shares == [0.6, 0.8, 1.0]
    assert (progress.step, progress.clipped, progress.blind) == (5, 4, 8)
    assert progress.loss[:2] == [0.5, 0.25]
    assert len(progress.loss) == 5
    assert 100.0 < progress.data_s < 160.0
    assert 50.0 < progress.training_s < 110.0
    loop.run(learner, half_blind, progress, Budget(cpu_s=150.0), Cosine())
    assert progress.step == 5, "150 s were spent before"


def test_a_budget_that_making_the_sources_spends_is_named():
    clock = Clock()
    clock.spent["data"] = 66.0
    with pytest.raises(
        DomainError, match=r"1\.00 minutes is over before the first step: .* took 1\.10"
    ):
        loop.run(
            Learner(Linear(), Supervised()),
            half_blind,
            Progress(),
            Budget(cpu_s=60.0),
            Cosine(),
            clock=clock,
        )
