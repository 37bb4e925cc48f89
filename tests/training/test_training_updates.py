"""One step of an optimiser, by hand: plain gradient descent on a * x with x = 3."""

import copy

import pytest
import torch

from nurec_sim.training.updates import update


def stepped(x, step=0, clip_norm=100.0):
    model = torch.nn.ParameterDict(
        {"a": torch.nn.Parameter(torch.tensor(2.0)), "b": torch.nn.Parameter(torch.ones(()))}
    )
    average = copy.deepcopy(model)
    optimiser = torch.optim.SGD([model["a"]], lr=0.5)
    found = update(
        optimiser, model["a"] * x, model, average, {"a": model["a"]}, step=step, clip_norm=clip_norm, decay=0.99
    )
    return found, model["a"].item(), average["a"].item(), average["b"].item()


def test_the_average_follows_quickly_at_first_and_only_what_is_trained():
    found, now, mean, untouched = stepped(3.0)
    assert found == {"gradient": 3.0, "skipped": 0.0}
    assert now == 2 - 0.5 * 3
    assert mean == pytest.approx(2 + (1 - 1 / 10) * (0.5 - 2))  # decay 1 / 10 at step 0
    assert untouched == 1
    assert stepped(3.0, step=100_000)[2] == pytest.approx(2 + 0.01 * (0.5 - 2))


def test_a_long_gradient_is_shortened_and_one_that_is_not_finite_is_skipped():
    assert stepped(3.0, clip_norm=1.0)[1] == pytest.approx(2 - 0.5)
    found, now, mean, _ = stepped(float("inf"))
    assert found == {"skipped": 1.0} and now == mean == 2
